"""Single files and directories on the disk: whole or not at all, and how each of ours is written."""
