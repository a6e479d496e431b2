"""Outages: forced ones the filter must drive through (Pentzer 2014, Fig. 27), and those the log really had."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from icrtool.analysis.dropout import DrivenRun, drive_of
from icrtool.analysis.filter_setup import set_up_filter
from icrtool.analysis.fit import FilterRun
from icrtool.core.ekf import run_filter
from icrtool.core.open_loop import open_loop_path
from icrtool.errors import ConfigError
from icrtool.tables import Floats, Ints

LONGEST_SHARE = 0.5
"""Spaced outages leave at least this share of the time between them to learn."""

MOST_SPACED = 10


@dataclass(frozen=True, slots=True)
class Outage:
    """One outage.

    Attributes
    ----------
    begin_s, end_s : seconds since the first recorded state
    distance_m : path driven through it
    end_error_m, max_error_m : forced: against the undisturbed estimate; real: miss at re-acquisition (both the same)
    north_m, east_m : (m,) the blind path, for a picture
    """

    kind: str
    begin_s: float
    end_s: float
    distance_m: float
    end_error_m: float
    max_error_m: float
    north_m: Floats
    east_m: Floats


def plan_outages(run: FilterRun, length_s: float, at_s: Sequence[float] = ()) -> tuple[tuple[int, int], ...]:
    """Place outages of one length: at given seconds, or spaced evenly after the ICRs have converged.

    Raises
    ------
    ConfigError
        An outage that does not fit into the drive.
    """
    table = run.table
    last = float(table.t_s[-1])
    if at_s:
        begins = [float(t) for t in at_s]
        if any(t < 0 or t + length_s > last for t in begins):
            raise ConfigError("outage", f"{length_s:g} s at {', '.join(f'{t:g}' for t in begins)} s do not fit", f"the drive lasts {last:.1f} s")
    else:
        settled = max((rise[1] for rise in run.convergence.values() if rise is not None), default=0.0)
        settled = min(settled, last / 4)
        count = min(MOST_SPACED, int((last - settled) * LONGEST_SHARE / length_s))
        if count < 1:
            raise ConfigError("outage", f"{length_s:g} s is too long for a drive of {last:.1f} s", "choose a shorter one")
        free = (last - settled - count * length_s) / (count + 1)
        begins = [settled + free + i * (length_s + free) for i in range(count)]
    origin = int(table.stamp_ns[0])
    return tuple((origin + int(t * 1e9), origin + int((t + length_s) * 1e9)) for t in sorted(begins))


def force_outages(run: FilterRun, spans_ns: Sequence[tuple[int, int]]) -> tuple[Outage, ...]:
    """Run the filter again without GNSS and heading in the spans, and hold it against the undisturbed run."""
    setup = set_up_filter(
        run.log,
        run.config,
        heading_offset_rad=run.heading_check.applied_offset_rad,
        heading_std_at_least_rad=run.heading_check.applied_std_rad,
        process_position_mps=run.process_position_mps,
        outages_ns=tuple(spans_ns),
    )
    output = run_filter(setup.data, setup.t0, setup.x0, setup.P0, setup.parameters)
    table = run.table
    rows = min(len(output.x), len(table))
    north, east = output.x[-rows:, 0], output.x[-rows:, 1]
    away = np.hypot(north - table.north_m[-rows:], east - table.east_m[-rows:])
    stamps, distance = table.stamp_ns[-rows:], table.distance_m[-rows:]
    outages = []
    for begin, end in spans_ns:
        inside = np.flatnonzero((stamps >= begin) & (stamps < end))
        if len(inside) > 1:
            outages.append(_outage("forced", table.stamp_ns[0], begin, end, inside, distance, away, north, east))
    return tuple(outages)


def real_outages(run: DrivenRun) -> tuple[Outage, ...]:
    """Return the log's own GNSS outages: open loop with wheels and the ICRs of the last fix, missed at the next one."""
    drive, table = drive_of(run), run.table
    outages = []
    for begin, end in run.outages_ns:
        inside = np.flatnonzero((table.stamp_ns >= begin) & (table.stamp_ns <= end))
        if len(inside) < 2 or table.stamp_ns[-1] < end:  # noqa: PLR2004 - an interval; one that never ends has no miss
            continue
        first, last = int(inside[0]), min(int(inside[-1]) + 1, len(table) - 1)
        icrs = (float(column[first]) for column in (table.y_icr_right_m, table.y_icr_left_m, table.x_icr_m))
        path = open_loop_path(drive, *icrs, first, last)
        miss = float(np.hypot(path.north[-1] - table.north_m[last], path.east[-1] - table.east_m[last]))
        origin = int(table.stamp_ns[0])
        outages.append(
            Outage(
                "real", (begin - origin) / 1e9, (end - origin) / 1e9,
                float(table.distance_m[last] - table.distance_m[first]), miss, miss, path.north, path.east,
            )  # fmt: skip
        )
    return tuple(outages)


def _outage(
    kind: str, origin: int, begin: int, end: int, inside: Ints, distance: Floats, away: Floats, north: Floats, east: Floats
) -> Outage:
    first, last = int(inside[0]), int(inside[-1])
    return Outage(
        kind, (begin - int(origin)) / 1e9, (end - int(origin)) / 1e9, float(distance[last] - distance[first]),
        float(away[last]), float(away[first : last + 1].max()), north[first : last + 1], east[first : last + 1],
    )  # fmt: skip
