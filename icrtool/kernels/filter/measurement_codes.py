"""What the filter did with a measurement, as a code; without numba, for records that are only read or drawn."""

UNSEEN, USED, GATED, RECOVERED = 0, 1, 2, 3
"""Outside the run, used, rejected by the gate, used to end a lock-out."""
