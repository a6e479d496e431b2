"""Open-loop trials and the statistics of their errors."""
