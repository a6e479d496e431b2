"""Which estimate a blind drive is held against: the filter's, or the smoother's that also knows what came after."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from icrtool.records.run import DrivenRun
from icrtool.records.tables import Bools, Ints, States


@dataclass(frozen=True, slots=True)
class JudgedRun:
    """A run held against another trajectory than its filter's; attributes as `DrivenRun`."""

    name: str
    table: States
    in_gap: Bools
    outages_ns: Ints
    track_width_m: float | None
    summary: dict[str, Any]


def held_against(run: DrivenRun, smoothed: States) -> JudgedRun:
    """Return a run whose positions and headings are the smoother's.

    Parameters
    ----------
    run : what the filter made of the log
    smoothed : the smoother's states at the same stamps

    Notes
    -----
    Starts, their ICRs, the wheel speeds and the path length stay the filter's: only where a blind drive begins, where
    it points, and what its end is compared with change.
    """
    table = replace(
        run.table,
        north_m=smoothed.north_m, east_m=smoothed.east_m, heading_rad=smoothed.heading_rad,
        std_north_m=smoothed.std_north_m, std_east_m=smoothed.std_east_m, std_heading_rad=smoothed.std_heading_rad,
    )  # fmt: skip
    return JudgedRun(run.name, table, run.in_gap, run.outages_ns, run.track_width_m, run.summary)
