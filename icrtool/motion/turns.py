"""Turns compared: of a reference with those of the wheels, or with those of a gyro by its scale, bias and lead."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from icrtool.kernels.arrays import Floats, Ints, rows_at_steps
from icrtool.kernels.robust import robust_least_squares, robust_regression, sandwich_covariance
from icrtool.kernels.track import Track

STEP_S, FEWEST_STEPS = 1.0, 10
"""Turns over this time are compared, at least so many."""

PRIOR_STD = np.array([10.0, 0.005, 0.2])
"""Of scale, whose sign is open, bias [rad/s] and lead [s]: on a circle only this separates scale and bias."""

SCALE_RANGE = 0.1
"""A gyro whose turn differs from the reference's by more than this share does not measure the robot's yaw."""


class GyroLine(NamedTuple):
    """Scale, bias [rad/s] and lead [s] of a gyro; NaN, and no lead, where too few turns show them."""

    scale: float
    bias_radps: float
    lead_s: float

    @property
    def is_yaw(self) -> bool:
        """Whether the gyro measures the robot's yaw, in either sense."""
        return abs(abs(self.scale) - 1.0) < SCALE_RANGE


def fit_gyro_line(t: Floats, rate: Floats, turned: Floats, at: Floats, heading: Floats) -> GyroLine:
    """Fit the line to the reference's turns over seconds.

    Parameters
    ----------
    t : (n,) times [s]; rate : (n,) of the gyro [rad/s]; turned : (n,) its integral [rad]
    at : (m,) times of the headings [s], ascending; heading : (m,) of the reference, unwrapped [rad]
    """
    every = rows_at_steps(at - at[0], STEP_S)
    if len(every) < FEWEST_STEPS:
        return GyroLine(float("nan"), float("nan"), 0.0)
    made, lasting = np.diff(heading[every]), np.diff(at[every])

    def evaluate(x: Floats) -> tuple[Floats, Floats]:
        read = at[every] + x[2]
        by_scale, by_lead = (np.diff(np.interp(read, t, column)) for column in (turned, x[0] * rate))
        return x[0] * by_scale + x[1] * lasting - made, np.column_stack([by_scale, lasting, by_lead])

    zero = np.zeros(3)
    return GyroLine(*robust_least_squares(evaluate, zero, zero, PRIOR_STD, overlap=10.0).x.tolist())


STARTS_A_WINDOW, FEWEST_SPANS = 4, 6
"""Windows of turns start so often in one, and so many whole ones are needed."""


class Turns(NamedTuple):
    """Turns of the heading and of the wheels over windows of one length.

    Attributes
    ----------
    ratio, ratio_std : turn of the heading per turn of the wheels
    left_rad : robust scatter of the heading's turn beyond that; turn_rad : rms turn of the heading
    """

    ratio: float
    ratio_std: float
    left_rad: float
    turn_rad: float


def compare_turns(track: Track, width_m: float, delay_s: float, window_s: float) -> Turns | None:
    """Compare the turns of heading and wheels over windows of some length; None where there are too few.

    Parameters
    ----------
    width_m : the track width b
    delay_s : by which the heading lags the wheels
    """
    t = track.t
    turned = track.cumulate(2.0 * track.half_difference / width_m)
    first = max(t[0] + delay_s, track.heading_t[0])
    last = min(t[-1] + delay_s, track.heading_t[-1]) - window_s
    begin = np.arange(first, last, window_s / STARTS_A_WINDOW)
    by_wheels, by_heading = (
        np.interp(begin + window_s - shift, times, angle) - np.interp(begin - shift, times, angle)
        for shift, times, angle in ((delay_s, t, turned), (0.0, track.heading_t, track.heading))
    )
    whole = track.clear(begin - delay_s, begin + window_s - delay_s)
    moved = np.interp(begin + window_s - delay_s, t, track.travel) > np.interp(begin - delay_s, t, track.travel)
    kept = whole & moved
    if np.count_nonzero(kept) < STARTS_A_WINDOW * FEWEST_SPANS:
        return None
    return _ratio(by_wheels[kept], by_heading[kept], np.arange(len(begin))[kept] // STARTS_A_WINDOW)


def _ratio(wheels: Floats, heading: Floats, group: Ints) -> Turns | None:
    """Return the ratio of two turns (w,), its deviation from groups of windows."""
    if not wheels.any():
        return None
    fit = robust_regression(wheels[:, None], heading)
    std, turn = math.sqrt(float(sandwich_covariance(fit, group)[0, 0])), math.sqrt(float(np.mean(heading**2)))
    return Turns(float(fit.x[0]), std, float(fit.scale[0]), turn)
