"""Results to files: run directory, tables, figures, exports. No metric is computed here."""
