"""Results to files: run directories, CSV and JSON, figures and text tables. Computes no metric, opens no log."""
