"""The line by which a gyro makes the turns of a reference: its scale, bias and lead."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icrtool.kernels.arrays import Floats
from icrtool.kernels.equal_steps import rows_at_steps
from icrtool.kernels.robust import robust_least_squares

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
