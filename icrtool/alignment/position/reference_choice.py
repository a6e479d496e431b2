"""The choice of the position reference, where a log holds several: the one that agrees with wheels and heading."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from icrtool.alignment.conventions import apply_convention, decide_conventions
from icrtool.alignment.drive_windows import cut_windows, track_of_log
from icrtool.alignment.estimator import estimate_alignment
from icrtool.alignment.stream_checks import check_streams
from icrtool.alignment.wheels.wheel_units import with_wheel_speeds
from icrtool.config import Config
from icrtool.errors import ConfigError, DataError
from icrtool.records.run import width_or_usual_m
from icrtool.records.tables import RobotLog

LENGTH_M, SHARE = 10.0, 0.9
"""References are compared by the residual that this share of windows of this driven distance stays below."""

POOR_M = 1.0
"""A reference whose residual is less is kept: GNSS gives positions on the globe, and does not drift."""

BETTER = 0.5
"""Another reference is taken where its residual is less than this part of the chosen one's."""

LEAST_SHARE_COVERED = 0.7
"""... and where it covers this part of the distance that the chosen one covers."""


class Agreement(NamedTuple):
    """How a position reference agrees with wheels and heading.

    Attributes
    ----------
    residual_m : of displacements over `LENGTH_M`, inf where they cannot be compared
    distance_m : driven distance that windows cover
    """

    residual_m: float
    distance_m: float


NONE = Agreement(math.inf, 0.0)


def choose_reference(log: RobotLog, config: Config) -> RobotLog:
    """Return the log with the position reference that its wheels and headings support; preset ``paper``: as it is."""
    if not log.other_references or config.filter.preset == "paper" or not len(log.heading.stamp_ns):
        return log
    chosen = agreement(log, config)
    if chosen.residual_m <= POOR_M:
        return log
    found = [(agreement(other, config), other) for other in log.other_references]
    least = LEAST_SHARE_COVERED * chosen.distance_m
    fit = [(one.residual_m, other) for one, other in found if one.distance_m > least]
    residual, best = min(fit, key=lambda one: one[0], default=(math.inf, log))
    if not residual < min(BETTER * chosen.residual_m, POOR_M):
        return log
    topics = [one.topic("gnss") for one in (best, log)]
    against = f"{chosen.residual_m:.2f} m" if math.isfinite(chosen.residual_m) else "not comparable"
    why = f"agrees with wheels and heading within {residual:.2f} m over {LENGTH_M:.0f} m ({topics[1]}: {against})"
    streams = tuple(
        replace(stream, why=f"{stream.why}; {why}") if stream.role == "gnss" else stream for stream in best.streams
    )
    note = f"{log.name}: the position reference is {topics[0]}, which {why}; topics.gnss sets it"
    return replace(best, streams=streams, warnings=(*best.warnings, note))


def agreement(log: RobotLog, config: Config) -> Agreement:
    """Return how the position reference of a log agrees with its wheels along its heading."""
    width = width_or_usual_m(config.robot.track_width_m)
    try:
        log = with_wheel_speeds(log, config)
        check_streams(log)
    except (ConfigError, DataError):
        return NONE
    track = track_of_log(log)
    windows = cut_windows(track, LENGTH_M)
    free = config.frames.heading == "auto"
    decision = decide_conventions(track, windows, metric=log.datum is None and free, mirror_allowed=free)
    named = apply_convention(log, decision.convention)
    found = estimate_alignment(track if named is log else track_of_log(named), windows, width)
    if found is None:
        return NONE
    count = len(windows.begin)
    size = np.hypot(found.fit.residuals[:count], found.fit.residuals[count : 2 * count])
    covered = np.unique(np.floor(track.distance[windows.begin] / LENGTH_M))
    return Agreement(float(np.quantile(size, SHARE)), LENGTH_M * len(covered))
