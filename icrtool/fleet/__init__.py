"""Batches of many logs: recordings are found, each log is processed in a separate process and gets a row."""
