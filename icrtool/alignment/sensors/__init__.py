"""Wheels and positions, each by itself: units, scales, quality and noise."""
