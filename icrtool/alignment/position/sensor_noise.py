"""The noise that the filter takes fixes and headings to have: stated where sane, else configured or measured."""

from __future__ import annotations

import math

import numpy as np

from icrtool.alignment.position.gnss_steps import FixSteps
from icrtool.config import FilterConfig
from icrtool.kernels.arrays import Floats
from icrtool.records.samples import HeadingSamples, PositionFixes
from icrtool.records.tables import RobotLog

LARGEST_SANE_GNSS_STD_M, LARGEST_SANE_HEADING_STD_RAD = 100.0, math.radians(60.0)
"""A message that states more does not know its noise (1000 or 1e6 stand for "unknown")."""

USUAL_POSITION_STD_M, USUAL_HEADING_STD_DEG = 0.01, 1.0
"""Pentzer 2014, Eq. 31: an RTK receiver, an attitude sensor."""

QUIETER = 3.0
"""A reference whose noise from step to step is so many times below the usual has that noise. One that is a little
quieter, as lidar poses are, may err alike for longer than a step."""

LEAST_POSITION_STD_M, LEAST_HEADING_STD_RAD = 1e-4, math.radians(0.01)
"""No reference is better: cameras of motion capture resolve a tenth of a millimetre."""


def unstated_position_std_m(settings: FilterConfig) -> float:
    """Return the noise of fixes that state none [m]: as configured, else the usual."""
    return USUAL_POSITION_STD_M if settings.gnss_std_m == "auto" else settings.gnss_std_m


def position_variance(fixes: PositionFixes, settings: FilterConfig, measured_m: float = math.nan) -> Floats:
    """Return the variances of north and east (m, 2) [m^2]; preset ``paper`` has the configured one throughout.

    Parameters
    ----------
    measured_m : of `reference_noise`; a number is used throughout
    """
    if math.isfinite(measured_m):
        return np.full((len(fixes.stamp_ns), 2), measured_m**2)
    default = unstated_position_std_m(settings) ** 2
    if settings.preset == "paper":
        return np.full((len(fixes.stamp_ns), 2), default)
    # The diagonal plus the covariance's size is never below the full matrix: correlated fixes are not overrated.
    correlated = np.nan_to_num(np.abs(fixes.cov_north_east_m2))
    stated = np.column_stack([fixes.var_north_m2 + correlated, fixes.var_east_m2 + correlated])
    sane = np.isfinite(stated) & (stated > 0) & (stated < LARGEST_SANE_GNSS_STD_M**2)
    return np.maximum(np.where(sane, stated, default), settings.gnss_std_floor_m**2)


def heading_variance(
    headings: HeadingSamples, settings: FilterConfig, at_least_rad: float = 0.0, measured_rad: float = math.nan
) -> Floats:
    """Return the variances (h,) [rad^2], nowhere below `at_least_rad` squared; other arguments as above."""
    if math.isfinite(measured_rad):
        return np.full(len(headings.stamp_ns), max(measured_rad, at_least_rad) ** 2)
    default = math.radians(USUAL_HEADING_STD_DEG if settings.heading_std_deg == "auto" else settings.heading_std_deg)
    if settings.preset == "paper":
        return np.full(len(headings.stamp_ns), default**2)
    stated = headings.var_rad2
    sane = np.isfinite(stated) & (stated > 0) & (stated < LARGEST_SANE_HEADING_STD_RAD**2)
    floor = max(math.radians(settings.heading_std_floor_deg), at_least_rad)
    return np.maximum(np.where(sane, stated, default**2), floor**2)


def reference_noise(log: RobotLog, settings: FilterConfig, place: FixSteps, turn: FixSteps) -> tuple[float, float]:
    """Return the measured noise of a reference's positions, an axis [m], and headings [rad]; NaN: take what is stated.

    Parameters
    ----------
    place, turn : steps of the positions and of the headings against the wheels

    Notes
    -----
    For poses of a metric reference (motion capture, lidar, total station) that state no noise, where none is
    configured. A receiver's fixes and an attitude sensor's headings step by less than they err, because they err alike
    for seconds. Preset ``paper`` measures nothing.
    """
    free = settings.preset != "paper" and settings.gnss_std_m == "auto" and log.datum is None
    if not free or _states_any(log.gnss.var_north_m2):
        return math.nan, math.nan
    values = np.concatenate([log.gnss.north_m, log.gnss.east_m])
    std_m = _measured(place, values, LEAST_POSITION_STD_M, USUAL_POSITION_STD_M)
    fields = log.heading_is_of_position and not _states_any(log.heading.var_rad2)
    if math.isnan(std_m) or not fields or settings.heading_std_deg != "auto":
        return std_m, math.nan
    # one axis: `white_std_m` shares the variance among two
    least, usual = (angle / math.sqrt(2.0) for angle in (LEAST_HEADING_STD_RAD, math.radians(USUAL_HEADING_STD_DEG)))
    return std_m, math.sqrt(2.0) * _measured(turn, log.heading.heading_rad, least, usual)


def _states_any(variance: Floats) -> bool:
    return bool((np.isfinite(variance) & (variance > 0.0)).any())


def _measured(steps: FixSteps, values: Floats, least: float, usual: float) -> float:
    """Return white noise [unit of the values (m,)], nowhere below what they resolve; NaN where hardly below the usual.

    Values in multiples of q err by q / sqrt(12), however little they step.
    """
    white = steps.white_std_m(np.ones(len(steps.step) + 1, np.bool_))
    between = np.diff(np.unique(values))
    resolution = float(between.min()) if len(between) else 0.0
    std = max(white, resolution / math.sqrt(12.0), least)
    return std if QUIETER * std < usual else math.nan
