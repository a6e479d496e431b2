"""The page: a run, a fleet or a comparison as one HTML file that needs no network."""
