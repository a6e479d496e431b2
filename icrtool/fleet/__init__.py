"""Many logs in one go: find the recordings, process each in a process of its own, collect a row of each."""
