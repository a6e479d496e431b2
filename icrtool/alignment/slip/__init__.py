"""Slip events: where wheels and motion disagree."""
