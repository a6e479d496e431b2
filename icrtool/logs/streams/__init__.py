"""Candidates for wheels, position and heading from the tables of topics, and the choice among them."""
