"""Residuals of windows of driven distance under a motion model: how far the robot moved and how far it turned."""

from __future__ import annotations

import numpy as np

from icrtool.kernels.arrays import Floats
from icrtool.kernels.robust import mad_std
from icrtool.kernels.window_residuals import OMEGA, path_at, turn_residuals, window_residuals
from icrtool.motion.models import FittedModel, MotionModel, gyro_gains, model_columns, wheel_motion
from icrtool.motion.recording import Windows

CONSTANT_STD = np.array([np.radians(3.0), 0.1, 0.02, 0.2])
"""Prior of `LogConstants` about zero: a heading that was aligned before, clocks of one robot, a gyro of one robot."""

OF_WHEELS = 2
"""So many of them, the first, are there without a gyro, too."""

KINDS = (0, 0, 1)
"""Residuals of a window: forward and right, whose spread is one, and turn."""


def constant_std(model: MotionModel) -> Floats:
    """Return the prior of the constants of each recording that a model has."""
    return CONSTANT_STD if model.uses_gyro else CONSTANT_STD[:OF_WHEELS]


def shortening(turned: Floats, length_m: Floats) -> Floats:
    """Return the share (w,) of its displacement that a window goes on average where slip makes its heading wander.

    Parameters
    ----------
    turned : (w,) turn of a model less that of the reference [rad]; length_m : (w,) of the windows

    Notes
    -----
    A heading that wanders with a variance of q for each metre leaves the mean of e^{j Theta} short by q s / 2 after s
    metres: a displacement over L by q L / 4, to first order. Without it, the scale of the wheels, and with it the
    multiplier, is too small. q is what longer windows stray more than short ones: what both have is of the reference.
    """
    short, long = length_m.min(), length_m.max()
    if short == long:
        return np.ones(len(turned))
    grown = np.square([mad_std(turned[length_m == one]) for one in (short, long)])
    shares: Floats = np.exp(-max(grown[1] - grown[0], 0.0) / (long - short) * length_m / 4.0)
    return shares


class WindowResiduals:
    """Residuals of all windows of one recording for one model, by sqrt(length), and their derivatives.

    Displacements alone do not separate a turn from side slip, and show little of a spin on the spot: turns are
    residuals, too, weighted by their own spread.

    Parameters
    ----------
    windows : of `icrtool.motion.recording.cut_windows`
    model, width_m : what predicts, and the track width b [m]
    wheels : for a model with a gyro, the wheels-only model whose turn rate it combines with the gyro's
    """

    def __init__(self, windows: Windows, model: MotionModel, width_m: float, wheels: FittedModel | None = None) -> None:
        steps = windows.steps
        motion = wheel_motion(steps.v_left, steps.v_right, width_m, steps.gyro)
        if wheels is not None:
            motion = motion._replace(turn=wheels.twist(motion)[OMEGA])
        self._windows = windows
        self._fixed, self._axes, self._columns = model_columns(model, motion)
        self._gains, self._gyro_change = np.zeros(0), steps.gyro_change()
        if model.uses_gyro:
            # the gyro's bias and time are two more columns of the turn rate
            self._gains = gyro_gains(model)
            self._axes = np.append(self._axes, [OMEGA, OMEGA])
            self._columns = np.concatenate([self._columns, np.ones((2, len(steps.t)))])
        self._root = np.sqrt(windows.length_m)

    def __call__(self, parameters: Floats, constants: Floats) -> tuple[Floats, Floats]:
        """Return residuals (3 w,), forward, right [m^0.5], then turn [rad/m^0.5], and derivatives (3 w, k + c).

        Parameters
        ----------
        constants : (c,) `LogConstants`, those of a gyro only for a model with one
        """
        windows, steps, k = self._windows, self._windows.steps, len(parameters)
        offset, delay = constants[:OF_WHEELS].tolist()
        fixed, axes, columns, values = self._fixed, self._axes, self._columns, parameters
        if len(self._gains):
            bias, later = constants[OF_WHEELS:].tolist()
            shift = later * self._gyro_change
            fixed, columns, values = fixed.copy(), columns.copy(), np.concatenate([parameters, [bias, 0.0]])
            fixed[OMEGA] += shift
            columns[:k] += self._gains[:, None] * shift
            columns[-1] = (1.0 + parameters @ self._gains) * self._gyro_change
        at = windows.knot_t + delay
        terms = len(axes)
        path = path_at(steps, lambda some: (fixed[:, some], axes, columns[:, some]), values, at)
        start, end = windows.start, windows.end
        turned, turned_by = turn_residuals(path, start, end, windows.turned, self._root)
        share = shortening(turned * self._root, windows.length_m)
        moved, moved_by = window_residuals(path, start, end, windows.reference, offset, self._root, share)
        # terms, those of the gyro, offset, delay: to terms, then `LogConstants`
        jacobian = np.concatenate([moved_by, turned_by])[:, [*range(k), terms, terms + 1, *range(k, terms)]]
        return np.concatenate([moved, turned]), jacobian
