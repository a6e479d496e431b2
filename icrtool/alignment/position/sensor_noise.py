"""The noise that the filter takes fixes and headings to have: what the messages state where sane, else configured."""

from __future__ import annotations

import math

import numpy as np

from icrtool.alignment.position.gnss_quality import LARGEST_SANE_GNSS_STD_M
from icrtool.config import FilterConfig
from icrtool.kernels.arrays import Floats
from icrtool.records.samples import HeadingSamples, PositionFixes

LARGEST_SANE_HEADING_STD_RAD = math.radians(60.0)
"""A message that states more does not know its noise (1000 or 1e6 stand for "unknown")."""


def position_variance(fixes: PositionFixes, settings: FilterConfig) -> Floats:
    """Return the variances of north and east (m, 2) [m^2]; preset ``paper`` has the configured one throughout."""
    default = settings.gnss_std_m**2
    if settings.preset == "paper":
        return np.full((len(fixes.stamp_ns), 2), default)
    # The diagonal plus the covariance's size is never below the full matrix: correlated fixes are not overrated.
    correlated = np.nan_to_num(np.abs(fixes.cov_north_east_m2))
    stated = np.column_stack([fixes.var_north_m2 + correlated, fixes.var_east_m2 + correlated])
    sane = np.isfinite(stated) & (stated > 0) & (stated < LARGEST_SANE_GNSS_STD_M**2)
    return np.maximum(np.where(sane, stated, default), settings.gnss_std_floor_m**2)


def heading_variance(headings: HeadingSamples, settings: FilterConfig, at_least_rad: float = 0.0) -> Floats:
    """Return the variances (h,) [rad^2], nowhere below `at_least_rad` squared; preset ``paper`` as above."""
    default = math.radians(settings.heading_std_deg) ** 2
    if settings.preset == "paper":
        return np.full(len(headings.stamp_ns), default)
    stated = headings.var_rad2
    sane = np.isfinite(stated) & (stated > 0) & (stated < LARGEST_SANE_HEADING_STD_RAD**2)
    floor = max(math.radians(settings.heading_std_floor_deg), at_least_rad)
    return np.maximum(np.where(sane, stated, default), floor**2)
