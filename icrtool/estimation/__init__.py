"""The filter over a log: set-up, run, smoother, summary, what the drive could show."""
