"""Constant parameters from one or several drives, tested on distance they were not fitted to."""
