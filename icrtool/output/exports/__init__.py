"""Results for other programs: controllers, CI."""
