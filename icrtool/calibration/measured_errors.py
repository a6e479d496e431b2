"""Errors of a calibration that were measured on distance it was not fitted to, and how a file holds them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np


class ControllerErrors(NamedTuple):
    """Errors of what a controller can express of the recommended model, on distance it was not fitted to.

    Attributes
    ----------
    pose_variance : (3,) of x forward, y left, yaw [m^2, m^2, rad^2] after 10 m
    twist_variance : (3,) of velocities averaged over 1 m [m^2/s^2, m^2/s^2, rad^2/s^2]
    turn_noise, way_noise : shares of variance, AMCL's alpha1 alpha2 and alpha3 alpha4
    p95_m, full_p95_m : after 10 m, of the controller's model and of the whole one; NaN without a trial of 10 m
    """

    pose_variance: tuple[float, float, float]
    twist_variance: tuple[float, float, float]
    turn_noise: tuple[float, float]
    way_noise: tuple[float, float]
    p95_m: float
    full_p95_m: float


class ErrorSources(NamedTuple):
    """Variances of what a model leaves out, and what its quantiles are scaled by.

    Attributes
    ----------
    heading_start_rad2 : of the heading at the start
    heading_rate_rad2pm2 : of a turn per metre that stays the same along the path
    turn_share : of the share by which every turn is off
    heading_wander_rad2pm : of the heading, for each metre
    speed_share : of the share by which the distance is off
    distance_wander_m2pm : of the distance, for each metre
    heading_noise_rad2, position_noise_m2 : of the reference alone, beside the others
    p95_factor, expected_factor : measured over predicted
    """

    heading_start_rad2: float
    heading_rate_rad2pm2: float
    turn_share: float
    heading_wander_rad2pm: float
    speed_share: float
    distance_wander_m2pm: float
    heading_noise_rad2: float
    position_noise_m2: float
    p95_factor: float
    expected_factor: float


def controller_errors_of(document: Mapping[str, Any] | None) -> ControllerErrors | None:
    """Return the errors that a file's plain data hold, None where there are none."""
    if document is None or "pose_variance" not in document:
        return None
    pose, twisted, turn, way = (
        tuple(map(float, document[name])) for name in ("pose_variance", "twist_variance", "turn_noise", "way_noise")
    )
    p95, full = (float("nan") if document[name] is None else float(document[name]) for name in ("p95_m", "full_p95_m"))
    return ControllerErrors(
        (pose[0], pose[1], pose[2]), (twisted[0], twisted[1], twisted[2]), (turn[0], turn[1]), (way[0], way[1]),
        p95, full,
    )  # fmt: skip


def error_sources_of(document: Mapping[str, Any] | None) -> ErrorSources | None:
    """Return the sources that a file's plain data hold, None where there are none."""
    if document is None:
        return None
    found = ErrorSources(**{key: float(value) for key, value in document.items()})
    if not all(np.isfinite(found)) or min(found) < 0.0:
        raise ValueError("error sources")
    return found
