"""Write results to files: run directory, tables, figures, exports. This package computes no metric."""
