"""Results for other programs: controllers, CI, trajectory evaluation, maps, Foxglove."""
