"""Drives with exact sensors that park, slip, pause and repeat stamps are fitted and reported without a numpy warning.

Warnings are errors in all tests. The kind that divides by zero: a robot that stands next to a slip event, its fixes and
headings without noise, as simulations and held sensors give them.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest

from icrtool.config import load_config
from icrtool.dropout_analysis.dropout_report import dropout_report
from icrtool.errors import IcrToolError
from icrtool.pipeline import fit
from icrtool.records.tables import RobotLog
from support.drives import make_log

CONFIG = load_config(sets=["robot.track_width_m=0.8"])
Trouble = Callable[[np.random.Generator, RobotLog], RobotLog]


def slips(rng: np.random.Generator, log: RobotLog) -> RobotLog:
    """Make the wheels of a stretch turn by another factor a side, also backwards or not at all."""
    left, right = log.wheels.left.copy(), log.wheels.right.copy()
    begin = int(rng.uniform(0.0, 0.8) * len(left))
    rows = slice(begin, begin + int(rng.uniform(10, 400)))
    left[rows] *= rng.choice([2.0, -1.0, 0.0, 5.0])
    right[rows] *= rng.choice([1.0, 2.0, -1.0, 0.0, 5.0])
    return replace(log, wheels=replace(log.wheels, left=left, right=right))


def parks(rng: np.random.Generator, log: RobotLog) -> RobotLog:
    """Hold all streams for a stretch: nothing turns, fixes and headings repeat their last values."""
    stamps = log.wheels.stamp_ns
    begin = int(rng.uniform(0.0, 0.9) * len(stamps))
    end = min(begin + int(rng.uniform(0.1, 0.6) * len(stamps)), len(stamps) - 1)

    def held(of: np.ndarray, values: np.ndarray, fixed: float | None = None) -> np.ndarray:
        rows = (of >= stamps[begin]) & (of <= stamps[end])
        return np.where(rows, values[np.argmax(rows)] if fixed is None else fixed, values)

    fixes, heading = log.gnss, log.heading
    return replace(
        log,
        wheels=replace(
            log.wheels, left=held(stamps, log.wheels.left, 0.0), right=held(stamps, log.wheels.right, 0.0)
        ),
        gnss=replace(
            fixes, north_m=held(fixes.stamp_ns, fixes.north_m), east_m=held(fixes.stamp_ns, fixes.east_m)
        ),
        heading=replace(heading, heading_rad=held(heading.stamp_ns, heading.heading_rad)),
    )  # fmt: skip


def pauses(rng: np.random.Generator, log: RobotLog) -> RobotLog:
    """Leave all samples of a stretch out."""
    begin, span = log.wheels.stamp_ns[0], log.wheels.stamp_ns[-1] - log.wheels.stamp_ns[0]
    first, last = begin + span * rng.uniform(0.2, 0.5), begin + span * rng.uniform(0.5, 0.8)
    wheels, fixes, headings = (
        one.cut((one.stamp_ns < first) | (one.stamp_ns > last)) for one in (log.wheels, log.gnss, log.heading)
    )
    return replace(log, wheels=wheels, gnss=fixes, heading=headings)


def repeats(rng: np.random.Generator, log: RobotLog) -> RobotLog:
    """Give fixes the stamp of the one before."""
    stamps = log.gnss.stamp_ns.copy()
    stamps[1:] = np.where(rng.random(len(stamps) - 1) < 0.3, stamps[:-1], stamps[1:])
    return replace(log, gnss=replace(log.gnss, stamp_ns=np.maximum.accumulate(stamps)))


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("troubles", [(slips, parks, parks), (slips, pauses, repeats)])
def test_a_troubled_drive_of_exact_sensors_gives_no_warning(seed: int, troubles: tuple[Trouble, ...]) -> None:
    rng = np.random.default_rng(seed)
    log = make_log(seed, 40.0, gnss_std=0.0, rate=20.0, heading_std_deg=0.0)
    for trouble in troubles:
        log = trouble(rng, log)
    log = replace(log, heading=replace(log.heading, var_rad2=np.zeros(len(log.heading.stamp_ns))))
    with suppress(IcrToolError):  # a drive that shows nothing is refused
        run = fit(log, CONFIG)
        assert np.isfinite(run.table.std_north_m).all()
        dropout_report(run)
