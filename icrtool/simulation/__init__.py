"""Simulated drives of robots with known ICRs, and the studies of the paper's Section 5."""
