"""Which estimate a trial is compared with: the filter's, or the smoother's that also knows what came after."""

from __future__ import annotations

from dataclasses import replace

from icrtool.errors import RunError
from icrtool.records.run import Run


def with_smoothed_reference(run: Run) -> Run:
    """Return a run whose positions and headings are the smoother's.

    Raises
    ------
    RunError
        The run has no smoothed states.

    Notes
    -----
    Starts, their ICRs, the wheel speeds and the path length stay the filter's: only where a trial begins, where it
    points, and what its end is compared with change.
    """
    smoothed = run.smoothed
    if smoothed is None:
        raise RunError(run.directory or run.name, "it has no smoothed states", "run icrtool fit --smooth")
    table = replace(
        run.table,
        north_m=smoothed.north_m, east_m=smoothed.east_m, heading_rad=smoothed.heading_rad,
        std_north_m=smoothed.std_north_m, std_east_m=smoothed.std_east_m, std_heading_rad=smoothed.std_heading_rad,
    )  # fmt: skip
    return replace(run, table=table)
