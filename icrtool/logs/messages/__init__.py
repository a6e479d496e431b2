"""Message definitions and decoding: blocks of raw messages to a table of columns per topic."""
