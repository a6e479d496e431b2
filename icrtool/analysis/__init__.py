"""Tables to results: knows time and meaning, never files, never pictures."""
