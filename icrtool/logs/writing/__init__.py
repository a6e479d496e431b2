"""Write logs: columns to messages, messages to containers."""
