"""Fit: learn the track ICRs of a robot from a log (Pentzer 2014, Sections 3, 6), and follow jumps of its reference."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import replace
from operator import attrgetter

import msgspec
import numpy as np

from icrtool.alignment.align import align, choose_reference
from icrtool.config import Config
from icrtool.estimation.run_filter import run_filter
from icrtool.estimation.run_filter import smooth as smooth_run
from icrtool.estimation.summary import summarise
from icrtool.kernels.arrays import Ints
from icrtool.records.measurements import ReferenceJump, SensorData
from icrtool.records.requests import FitRequest
from icrtool.records.run import MeasurementOutcome, Run, WarmStart
from icrtool.records.tables import RobotLog


def fit_filter(
    log: RobotLog,
    config: Config,
    request: FitRequest,
    *,
    warm_start: WarmStart | None = None,
    watch: Callable[[str], None] | None = None,
) -> Run:
    """Return the run of a log without its motion model: align the sensors, run the filter, summarise.

    Parameters and errors are those of `icrtool.pipeline.fit_log`.

    Notes
    -----
    The EKF of Pentzer 2014, Eqs. 13-25, event by event; ``filter.preset`` chooses between the paper's constants and
    start (``paper``) and those made for field logs (``field``).
    """
    begin = watch if watch is not None else lambda _: None
    begin("aligning")
    log = choose_reference(log, config)
    measurements = align(log, config)
    inputs, datum, rejected = log.inputs, log.datum, log.rejected_fixes
    # Its columns that the filter does not use take as much memory as half of the states.
    del log
    begin("filter")
    filtered = run_filter(measurements.sensors, config, warm_start=warm_start, changes_s=request.changes_s)
    jumps = followed_jumps(filtered.sensors, filtered.gnss, filtered.heading)
    filtered = filtered._replace(sensors=replace(filtered.sensors, jumps=jumps))
    begin("summary")
    run = Run(
        document=summarise(
            measurements, filtered, config, request, inputs=inputs, datum=datum, rejected_fixes=rejected
        ),
        table=filtered.table,
        in_gap=filtered.in_gap,
        outages_ns=filtered.outages_ns,
        sensors=filtered.sensors,
        gnss=filtered.gnss,
        heading=filtered.heading,
        smoothed=None,
    )
    if not request.smooth:
        return run
    begin("smoother")
    return replace(run, smoothed=smooth_run(run))


SAME_JUMP_NS = 10**9
"""Jumps closer together than this are one: no trial fits between them."""

FOLLOWED_SIGMAS, FOLLOWS_WITHIN_S = 3.0, 5.0
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
    near = gnss.stamp_ns[gnss.used & (gnss.difference < FOLLOWED_SIGMAS * noise)]

    def followed(jump: ReferenceJump) -> ReferenceJump:
        stamps = used[jump.kind == "heading"]
        before = int(np.searchsorted(stamps, jump.begin_ns, side="right")) - 1
        begin_ns = int(stamps[before]) if before >= 0 else jump.begin_ns
        return msgspec.structs.replace(jump, begin_ns=begin_ns, end_ns=_first_from(stamps, jump.end_ns))

    def settled(jump: ReferenceJump) -> ReferenceJump:
        end = jump.end_ns if jump.kind == "heading" else _first_from(near, jump.end_ns)
        return msgspec.structs.replace(jump, end_ns=min(end, jump.end_ns + round(FOLLOWS_WITHIN_S * 1e9)))

    # the filter follows nothing between the jumps of one rejection
    spans = [
        settled(one)
        for one in _joined([followed(jump) for jump in sensors.jumps], -1)
        # steps that have taken each other back are no jump
        if one.kind == "heading" or math.hypot(one.moved_north_m, one.moved_east_m) >= BRIDGED * one.size_m
    ]
    # what is decided takes in what is undecided about it
    decided = _joined([one for one in spans if not one.undecided], SAME_JUMP_NS)
    begins, free = [one.begin_ns for one in decided], []
    for one in spans:
        row = bisect_right(begins, one.begin_ns)
        before, after = decided[max(row - 1, 0) : row], decided[row : row + 1]
        joins = any(one.begin_ns <= other.end_ns + SAME_JUMP_NS for other in before)
        joined = any(other.begin_ns <= one.end_ns + SAME_JUMP_NS for other in after)
        if one.undecided and not joins and not joined:
            free.append(one)
    return tuple(sorted((*decided, *_joined(free, SAME_JUMP_NS)), key=attrgetter("begin_ns")))


def _first_from(stamps: Ints, at: int) -> int:
    row = int(np.searchsorted(stamps, at))
    return int(stamps[row]) if row < len(stamps) else at


def _joined(jumps: list[ReferenceJump], near_ns: int) -> list[ReferenceJump]:
    """Return jumps, each joined to the one before where it begins at most so long after its end."""
    found: list[ReferenceJump] = []
    for jump in sorted(jumps, key=attrgetter("begin_ns")):
        if not found or jump.begin_ns > found[-1].end_ns + near_ns:
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
