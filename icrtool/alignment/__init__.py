"""Alignment of the streams of a log: units, sides, heading, delays and GNSS quality are found and corrected."""
