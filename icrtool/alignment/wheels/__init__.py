"""Wheels: their units, and what is known of each side."""
