"""Batches of many logs: find the recordings, process each log in a separate process, and collect a row for each."""
