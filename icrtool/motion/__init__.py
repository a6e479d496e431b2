"""Motion models and their robust fit to windows of driven distance."""
