"""Log files and directories: bytes to blocks of raw messages by channel."""
