"""Fit of a log: the track ICRs of a robot (Pentzer 2014, Sections 3, 6), and the jumps of its reference."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import replace
from operator import attrgetter

import msgspec
import numpy as np

from icrtool.alignment.align import align, choose_reference
from icrtool.alignment.mirrored_positions import with_right_positions
from icrtool.config import Config
from icrtool.estimation.run_filter import run_filter, smooth_run
from icrtool.estimation.summary import summarise
from icrtool.kernels.arrays import Ints
from icrtool.records.measurements import ReferenceJump, SensorData
from icrtool.records.requests import FitRequest
from icrtool.records.run import MeasurementOutcome, Run, WarmStart
from icrtool.records.stages import Watch, unwatched
from icrtool.records.tables import RobotLog


def fit_filter(
    log: RobotLog,
    config: Config,
    request: FitRequest,
    *,
    warm_start: WarmStart | None = None,
    watch: Watch = unwatched,
) -> Run:
    """Return the run of a log without its motion model: the sensors are aligned, filtered and summarised.

    `icrtool.pipeline.fit_log` describes the parameters and the errors.

    Notes
    -----
    The EKF of Pentzer 2014, Eqs. 13-25, event by event. ``filter.preset`` chooses between constants and start of the
    paper (``paper``) and constants for recorded logs (``field``).
    """
    watch("aligning")
    log = with_right_positions(choose_reference(log, config), config)
    measurements = align(log, config)
    inputs, datum, rejected = log.inputs, log.datum, log.rejected_fixes
    # The columns of the log are freed, because the filter does not use them. They need half of the memory of the
    # states.
    del log
    watch("filter")
    filtered = run_filter(measurements.sensors, config, warm_start=warm_start, changes_s=request.changes_s)
    jumps = followed_jumps(filtered.sensors, filtered.gnss, filtered.heading)
    filtered = filtered._replace(sensors=replace(filtered.sensors, jumps=jumps))
    watch("summary")
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
    watch("smoother")
    return replace(run, smoothed=smooth_run(run))


SAME_JUMP_NS = 10**9
"""Time between two jumps below which they count as one jump [ns]. No trial fits between them."""

FOLLOWED_SIGMAS, FOLLOWS_WITHIN_S = 3.0, 5.0
"""Distance to a fix below which the filter follows it, in standard deviations, and longest time until then [s]."""

BRIDGED = 0.25
"""Ratio of the sum of steps to the largest step below which the steps cancel."""


def followed_jumps(
    sensors: SensorData, gnss: MeasurementOutcome, heading: MeasurementOutcome
) -> tuple[ReferenceJump, ...]:
    """Return the jumps of the filter's states, which are the reference of the trials, in order of time.

    Parameters
    ----------
    sensors : the streams, with the jumps of fixes and headings
    gnss, heading : outcome of fixes and headings in the filter

    Notes
    -----
    If the filter rejects fixes, it continues with the wheels, and jumps when it follows the fixes again. If the fixes
    have jumped back by then, the filter does not jump.
    """
    used = gnss.stamp_ns[gnss.used], heading.stamp_ns[heading.used]
    noise = np.sqrt(sensors.fixes.var_north_m2 + sensors.fixes.var_east_m2)
    near_ns = gnss.stamp_ns[gnss.used & (gnss.difference < FOLLOWED_SIGMAS * noise)]

    def followed(jump: ReferenceJump) -> ReferenceJump:
        """Return a jump from the last used measurement before it to the first used measurement after it."""
        stamps = used[jump.kind == "heading"]
        before = int(np.searchsorted(stamps, jump.begin_ns, side="right")) - 1
        begin_ns = int(stamps[before]) if before >= 0 else jump.begin_ns
        return msgspec.structs.replace(jump, begin_ns=begin_ns, end_ns=_first_from(stamps, jump.end_ns))

    def settled(jump: ReferenceJump) -> ReferenceJump:
        """Return a jump that ends when the filter is near the fixes again."""
        end = jump.end_ns if jump.kind == "heading" else _first_from(near_ns, jump.end_ns)
        return msgspec.structs.replace(jump, end_ns=min(end, jump.end_ns + round(FOLLOWS_WITHIN_S * 1e9)))

    # The filter does not follow the reference between the jumps of one rejection, so these jumps are joined.
    spans = [
        settled(jump)
        for jump in _joined([followed(jump) for jump in sensors.jumps], -1)
        # Steps that cancel are not a jump.
        if jump.kind == "heading" or math.hypot(jump.moved_north_m, jump.moved_east_m) >= BRIDGED * jump.size_m
    ]
    # A decided jump includes the undecided jumps near it.
    decided = _joined([jump for jump in spans if not jump.undecided], SAME_JUMP_NS)
    begins, separate = [jump.begin_ns for jump in decided], []
    for jump in spans:
        row = bisect_right(begins, jump.begin_ns)
        before, after = decided[max(row - 1, 0) : row], decided[row : row + 1]
        joins = any(jump.begin_ns <= other.end_ns + SAME_JUMP_NS for other in before)
        joined = any(other.begin_ns <= jump.end_ns + SAME_JUMP_NS for other in after)
        if jump.undecided and not joins and not joined:
            separate.append(jump)
    return tuple(sorted((*decided, *_joined(separate, SAME_JUMP_NS)), key=attrgetter("begin_ns")))


def _first_from(stamps: Ints, time_ns: int) -> int:
    """Return the first stamp at or after a time [ns]; the time itself if there is no such stamp."""
    row = int(np.searchsorted(stamps, time_ns))
    return int(stamps[row]) if row < len(stamps) else time_ns


def _joined(jumps: list[ReferenceJump], near_ns: int) -> list[ReferenceJump]:
    """Return jumps; a jump that begins at most `near_ns` after the end of the jump before is joined to it."""
    joined: list[ReferenceJump] = []
    for jump in sorted(jumps, key=attrgetter("begin_ns")):
        if not joined or jump.begin_ns > joined[-1].end_ns + near_ns:
            joined.append(jump)
            continue
        before = joined[-1]
        larger = max(before, jump, key=lambda jump: (not jump.undecided, jump.size_m))
        joined[-1] = msgspec.structs.replace(
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
    return joined
