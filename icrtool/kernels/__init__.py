"""Compiled equations: arrays in, arrays or NamedTuples out; numpy and numba only; the letters are the paper's."""
