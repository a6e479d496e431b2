"""Heading of the robot: which source, how it is made, what offset it has."""
