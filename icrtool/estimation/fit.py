"""Fit: learn the track ICRs of a robot from a log (Pentzer 2014, Sections 3, 6), and follow jumps of its reference."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import replace

import msgspec
import numpy as np

from icrtool.alignment.align import align, choose_reference
from icrtool.config import Config
from icrtool.estimation.run_filter import run_filter
from icrtool.estimation.run_filter import smooth as smooth_run
from icrtool.estimation.summary import summarise
from icrtool.kernels.arrays import Ints
from icrtool.records.measurements import ReferenceJump, SensorData
from icrtool.records.run import MeasurementOutcome, Run, WarmStart
from icrtool.records.tables import RobotLog


def fit(
    log: RobotLog,
    config: Config | None = None,
    *,
    warm_start: WarmStart | None = None,
    changes_s: tuple[float, ...] = (),
    smooth: bool = False,
    watch: Callable[[str], None] | None = None,
) -> Run:
    """Align the sensors of a log, run the filter, summarise: `icrtool.fit` without its recommendation.

    Parameters, return value and errors are those of `icrtool.calibration.run_models.fit`.

    Notes
    -----
    The EKF of Pentzer 2014, Eqs. 13-25, event by event; ``filter.preset`` chooses between the paper's constants and
    start (``paper``) and those made for field logs (``field``).
    """
    config = config if config is not None else Config()
    begin = watch if watch is not None else _ignore
    begin("aligning")
    log = choose_reference(log, config)
    measurements = align(log, config)
    inputs, datum, rejected = log.inputs, log.datum, log.rejected_fixes
    # Its columns that the filter does not use take as much memory as half of the states.
    del log
    begin("filter")
    filtered = run_filter(measurements.sensors, config, warm_start=warm_start, changes_s=changes_s)
    jumps = followed_jumps(filtered.sensors, filtered.gnss, filtered.heading)
    filtered = filtered._replace(sensors=replace(filtered.sensors, jumps=jumps))
    begin("summary")
    run = Run(
        document=summarise(measurements, filtered, config, inputs=inputs, datum=datum, rejected_fixes=rejected),
        table=filtered.table,
        in_gap=filtered.in_gap,
        outages_ns=filtered.outages_ns,
        sensors=filtered.sensors,
        gnss=filtered.gnss,
        heading=filtered.heading,
        smoothed=None,
    )
    return replace(run, smoothed=smooth_run(run)) if smooth else run


def _ignore(stage: str) -> None:
    """Take no notice of a stage."""


NEAR_S = 1.0
"""Jumps closer together than this are one: no trial fits between them."""

SETTLED_SIGMAS, SETTLES_S = 3.0, 5.0
"""The filter has followed where its estimate is this near to a fix; it takes no longer than this."""

BRIDGED = 0.25
"""Steps whose sum is less than this part of the largest have taken each other back."""


def followed_jumps(
    sensors: SensorData, gnss: MeasurementOutcome, heading: MeasurementOutcome
) -> tuple[ReferenceJump, ...]:
    """Return the jumps that the reference of the trials makes, the filter's states, in order of time.

    Parameters
    ----------
    sensors : with the jumps of fixes and headings
    gnss, heading : what the filter did with them

    Notes
    -----
    A filter that rejects fixes drives on with its wheels, and jumps when it follows them again. Where they have come
    back by then it does not jump at all.
    """
    used = gnss.stamp_ns[gnss.used], heading.stamp_ns[heading.used]
    noise = np.sqrt(sensors.fixes.var_north_m2 + sensors.fixes.var_east_m2)
    near = gnss.stamp_ns[gnss.used & (gnss.difference < SETTLED_SIGMAS * noise)]

    def followed(jump: ReferenceJump) -> ReferenceJump:
        stamps = used[jump.kind == "heading"]
        begin, end = _last_until(stamps, jump.begin_ns), _first_from(stamps, jump.end_ns)
        return msgspec.structs.replace(jump, begin_ns=begin, end_ns=end)

    def settled(jump: ReferenceJump) -> ReferenceJump:
        end = jump.end_ns if jump.kind == "heading" else _first_from(near, jump.end_ns)
        return msgspec.structs.replace(jump, end_ns=min(end, jump.end_ns + round(SETTLES_S * 1e9)))

    spans = _joined([followed(jump) for jump in sensors.jumps], _in_one_rejection)
    spans = [settled(one) for one in spans if one.kind == "heading" or _remains(one)]
    # what is decided takes in what is undecided about it
    decided = _joined([one for one in spans if not one.undecided], _near)
    begins = [one.begin_ns for one in decided]

    def is_apart(one: ReferenceJump) -> bool:
        row = bisect_right(begins, one.begin_ns)
        before, after = decided[max(row - 1, 0) : row], decided[row : row + 1]
        return not (any(_near(other, one) for other in before) or any(_near(one, other) for other in after))

    free = [one for one in spans if one.undecided and is_apart(one)]
    return tuple(sorted((*decided, *_joined(free, _near)), key=_begin))


def _last_until(stamps: Ints, at: int) -> int:
    row = int(np.searchsorted(stamps, at, side="right")) - 1
    return int(stamps[row]) if row >= 0 else at


def _first_from(stamps: Ints, at: int) -> int:
    row = int(np.searchsorted(stamps, at))
    return int(stamps[row]) if row < len(stamps) else at


def _begin(jump: ReferenceJump) -> int:
    return jump.begin_ns


def _in_one_rejection(one: ReferenceJump, other: ReferenceJump) -> bool:
    """Return whether the filter followed nothing between two jumps."""
    return other.begin_ns < one.end_ns


def _near(one: ReferenceJump, other: ReferenceJump) -> bool:
    return other.begin_ns <= one.end_ns + round(NEAR_S * 1e9)


def _joined(jumps: list[ReferenceJump], belongs: Callable[[ReferenceJump, ReferenceJump], bool]) -> list[ReferenceJump]:
    """Return jumps, each joined to the one before where it belongs to that."""
    found: list[ReferenceJump] = []
    for jump in sorted(jumps, key=_begin):
        if not (found and belongs(found[-1], jump)):
            found.append(jump)
            continue
        before = found[-1]
        larger = max(before, jump, key=lambda one: (not one.undecided, one.size_m))
        found[-1] = msgspec.structs.replace(
            larger,
            begin_ns=before.begin_ns,
            end_ns=max(before.end_ns, jump.end_ns),
            north_m=before.north_m,
            east_m=before.east_m,
            size_m=max(before.size_m, jump.size_m),
            turn_deg=max(before.turn_deg, jump.turn_deg, key=abs),
            moved_north_m=before.moved_north_m + jump.moved_north_m,
            moved_east_m=before.moved_east_m + jump.moved_east_m,
        )
    return found


def _remains(jump: ReferenceJump) -> bool:
    """Return whether the steps of a jump have not taken each other back."""
    return math.hypot(jump.moved_north_m, jump.moved_east_m) >= BRIDGED * jump.size_m
