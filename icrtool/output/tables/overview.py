"""What a log is at a glance, and what to do with it: the first and the last lines of `icrtool info`."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np

from icrtool.config import Config
from icrtool.errors import IcrToolError
from icrtool.output.tables.run import Row, excitation_row
from icrtool.output.text_format import driven_text, duration_text
from icrtool.records.run import Run
from icrtool.records.tables import RobotLog

OLDEST_DATE_NS = 946_684_800_000_000_000
"""1 January 2000: stamps before it count from the start of a computer or a simulation."""


def overview_rows(log: RobotLog, run: Run | None) -> list[Row]:
    """Return date, duration, distance and extent of a log; the distance where it could be fitted."""
    stamps = [table.stamp_ns for table in (log.wheels, log.gnss, log.heading) if len(table.stamp_ns)]
    if not stamps:
        return []
    begin, end = min(int(column[0]) for column in stamps), max(int(column[-1]) for column in stamps)
    if begin >= OLDEST_DATE_NS:
        date = datetime.fromtimestamp(begin / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    else:
        date = "at an unknown date (its stamps do not count from 1970)"
    rows = [("recorded", f"{date}, {duration_text((end - begin) / 1e9)}")]
    if run is not None:
        drive = run.summary["drive"]
        rows.append(("driven", f"{driven_text(drive)}, {drive['speed_mean_mps']:.2f} m/s on average"))
    return rows + _extent_rows(log)


def verdict_rows(run: Run | None, problem: IcrToolError | None, config: Config) -> list[Row]:
    """Return whether a log can be fitted, what it shows, and what is missing."""
    rows = [excitation_row(run)] if run is not None else []
    rows.append(("verdict", verdict(run, problem)))
    if run is not None and config.robot.track_width_m is None:
        missing = (
            "robot.track_width_m: without it, no-slip odometry and the multiplier are left out; --robot NAME "
            "(icrtool robots lists them) or --set robot.track_width_m=… gives it"
        )
        rows.append(("missing", missing))
    return rows


def verdict(run: Run | None, problem: IcrToolError | None) -> str:
    """Return in a sentence whether a log can be fitted and used, and whether it shows the ICRs."""
    if run is None:
        return f"cannot be fitted: {problem}" if problem is not None else "cannot be fitted"
    if not run.usable:
        return f"not usable: {run.summary['unusable_because']}"
    verdicts = run.summary["excitation"]["verdict"].values()
    return f"can be fitted, {'all ICRs are shown' if set(verdicts) == {'shown'} else 'not all ICRs are shown'}"


def next_command(log: str, options: Sequence[str], run: Run | None) -> str | None:
    """Return the command to run next with a log, by the options of this one; None where it is of no use."""
    if run is None or not run.usable:
        return None
    cut = "--from" in options or "--to" in options
    command = "fit" if cut else "dropout-report"
    return shlex.join(["icrtool", command, log, *options])


def _extent_rows(log: RobotLog) -> list[Row]:
    """Return the size of the area of the positions, outliers left out, and where it is."""
    fixes, datum = log.gnss, log.datum
    sound = np.isfinite(fixes.north_m) & np.isfinite(fixes.east_m)
    if not sound.any():
        return []
    sizes = [np.subtract(*np.percentile(column[sound], (99.9, 0.1))) for column in (fixes.east_m, fixes.north_m)]
    where = (
        f" about {datum.latitude_deg:.5f}°, {datum.longitude_deg:.5f}°" if datum is not None else " (metric positions)"
    )
    return [("area", f"{sizes[0]:.1f} m east-west x {sizes[1]:.1f} m north-south{where}")]
