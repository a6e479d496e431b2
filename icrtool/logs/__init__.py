"""Bytes to tables and back: the only package that opens a log, and the only one that knows ENU."""
