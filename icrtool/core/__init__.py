"""Equations: arrays in, arrays or NamedTuples out; pure; no files, no pandas, no errors raised for data."""
