"""Files and directories on the disk: written whole or not at all, and the formats of icrtool's files."""
