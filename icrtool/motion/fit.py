"""Robust fit of motion models to windows of driven distance, pooled over recordings.

Heading and place are sums over the wheel samples, and so are their derivatives: all windows of a recording cost one
pass over its samples (`icrtool.kernels.window_residuals`).

Each recording has constants of its own, which are not part of a calibration (`icrtool.motion.recording.LogConstants`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from icrtool.kernels.arrays import Bools, Floats
from icrtool.kernels.robust import RobustFit, normal_equations, robust_least_squares
from icrtool.kernels.window_residuals import OMEGA, sums_at_knots, window_residuals
from icrtool.motion.models import FittedModel, MotionModel, gyro_gains, model_columns, wheel_motion
from icrtool.motion.recording import STRETCH_M, LogConstants, Windows

CONSTANT_STD = np.array([np.radians(3.0), 0.1, 0.02, 0.2])
"""Prior of `LogConstants` about zero: a heading that was aligned before, clocks of one robot, a gyro of one robot."""

SETTLED = 0.1
"""Delays have kinks, where a shorter last step is not found."""

OF_WHEELS = 2
"""So many of them, the first, are there without a gyro, too."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PooledFit(FittedModel):
    """A model fitted to windows of several recordings.

    Attributes
    ----------
    constants : of each recording
    solution : of all parameters, those of the model first, then those of each recording
    residuals, jacobian : of all windows (m,), (m, parameters), at the minimum
    kept : (m,) the residuals that were fitted
    """

    constants: tuple[LogConstants, ...]
    solution: RobustFit
    residuals: Floats
    jacobian: Floats
    kept: Bools

    @property
    def fitted(self) -> FittedModel:
        """The model and its parameters alone."""
        return FittedModel(self.model, self.parameters, self.covariance, self.wheels)


class WindowResiduals:
    """Residuals of all windows of one recording for one model, (d - d_ref) / sqrt(length), and their derivatives.

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
        self._reference = np.column_stack([windows.reference.real, windows.reference.imag])
        self._root = np.sqrt(windows.length_m)

    def __call__(self, parameters: Floats, constants: Floats) -> tuple[Floats, Floats]:
        """Return residuals (2 w,), forward then right [m per root metre], and derivatives (2 w, k + c).

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
        row, share = steps.locate(windows.knot_t + delay)
        terms, knots, count = len(axes), len(row), len(windows.start)
        rate, sums, by = np.empty((knots, 3)), np.empty((knots, 3)), np.empty((terms, knots, 3))
        sums_at_knots(fixed, columns, axes, values, steps.held, steps.into, row, share, rate, sums, by)
        residual, jacobian = np.empty(2 * count), np.empty((2 * count, terms + OF_WHEELS))
        window_residuals(
            rate, sums, by, windows.start, windows.end, self._reference, offset, self._root, residual, jacobian
        )
        # terms, those of the gyro, offset, delay: to terms, then `LogConstants`
        return residual, jacobian[:, [*range(k), terms, terms + 1, *range(k, terms)]]


class Pool:
    """Windows of several recordings, and the fits of one model to parts of them.

    Parameters
    ----------
    windows, widths_m : by recording
    wheels : for a model with a gyro, the wheels-only model whose turn rate it combines with the gyro's
    """

    def __init__(
        self,
        windows: Sequence[Windows],
        widths_m: Sequence[float],
        model: MotionModel,
        wheels: FittedModel | None = None,
    ) -> None:
        self.model, self._wheels = model, wheels
        self._parts = [WindowResiduals(w, model, width, wheels) for w, width in zip(windows, widths_m, strict=True)]
        self._windows = windows
        groups, offset = [], 0
        for w in windows:
            stretch = np.unique(np.floor(w.start_m / STRETCH_M), return_inverse=True)[1]
            groups.append(np.tile(stretch + offset, 2))
            offset += int(stretch.max()) + 1
        self.group = np.concatenate(groups)
        self.length_m = np.concatenate([np.tile(w.length_m, 2) for w in windows])

    def own_constants(self, recording: int, parameters: Floats) -> LogConstants:
        """Return the constants of one recording for given parameters of the model."""
        part, std, k = self._parts[recording], self._constant_std, len(parameters)

        def evaluate(constants: Floats) -> tuple[Floats, Floats]:
            residuals, by = part(parameters, constants)
            return residuals, by[:, k:]

        zero = np.zeros(len(std))
        overlap = len(self._windows[recording].start) / 5.0
        return LogConstants(*robust_least_squares(evaluate, zero, zero, std, overlap=overlap).x.tolist())

    @property
    def _constant_std(self) -> Floats:
        return CONSTANT_STD if self.model.uses_gyro else CONSTANT_STD[:OF_WHEELS]

    @property
    def prior(self) -> tuple[Floats, Floats]:
        """Mean and standard deviation of all parameters, model first, then the constants of each recording."""
        own = np.tile(self._constant_std, len(self._parts))
        mean = np.concatenate([self.model.prior_mean, np.zeros(len(own))])
        return mean, np.concatenate([self.model.prior_std, own])

    def evaluate(self, x: Floats) -> tuple[Floats, Floats]:
        """Return residuals (m,) of all windows of all recordings and their derivatives (m, parameters)."""
        k, own = len(self.model.terms), len(self._constant_std)
        residuals, jacobians = [], []
        for i, part in enumerate(self._parts):
            columns = slice(k + own * i, k + own * (i + 1))
            residual, by = part(x[:k], x[columns])
            jacobian = np.zeros((len(residual), len(x)))
            jacobian[:, :k], jacobian[:, columns] = by[:, :k], by[:, k:]
            residuals.append(residual)
            jacobians.append(jacobian)
        return np.concatenate(residuals), np.concatenate(jacobians)

    def overlap(self, kept: Bools) -> float:
        """Return how many windows of those marked in `kept` (m,) cover a place on average."""
        covered_m = STRETCH_M * max(len(np.unique(self.group[kept])), 1)
        return max(float(self.length_m[kept].sum()) / 2.0 / covered_m, 1.0)

    def fit(self, kept: Bools | None = None, start: Floats | None = None) -> PooledFit:
        """Fit the model to the residuals marked in `kept` (m,); default all.

        Parameters
        ----------
        start : all parameters to start from; default the prior's mean
        """
        mean, std = self.prior
        rows = np.ones(len(self.group), np.bool_) if kept is None else kept
        last: list[tuple[Floats, Floats, Floats]] = []

        def evaluate(x: Floats) -> tuple[Floats, Floats]:
            residuals, jacobian = self.evaluate(x)
            last[:] = [(x, residuals, jacobian)]
            return residuals[rows], jacobian[rows]

        found = robust_least_squares(
            evaluate,
            mean if start is None else start,
            mean,
            std,
            group=self.group[rows],
            overlap=self.overlap(rows),
            settled=SETTLED,
        )
        k, own = len(self.model.terms), len(self._constant_std)
        constants = (LogConstants(*one) for one in found.x[k:].reshape(-1, own).tolist())
        at, residuals, jacobian = last[0]
        return PooledFit(
            self.model, found.x[:k], found.covariance[:k, :k], self._wheels,
            constants=tuple(constants), solution=found, residuals=residuals + jacobian @ (found.x - at),
            jacobian=jacobian, kept=rows,
        )  # fmt: skip

    def without(self, fit: PooledFit, dropped: Bools) -> Floats:
        """Return all parameters as they would be without the residuals marked in `dropped` (m,), to first order.

        Notes
        -----
        At the minimum the gradients of all residuals and of the prior sum to zero, so what is left without some is
        minus theirs: one step with the curvature of the rest (a downdate, as for studentised residuals).
        """
        out = dropped & fit.kept
        scale = np.full(int(np.count_nonzero(out)), fit.solution.scale[0])
        H, g = normal_equations(fit.residuals[out], fit.jacobian[out], scale, self.overlap(fit.kept))
        changed: Floats = fit.solution.x + np.linalg.solve(fit.solution.information - H, g)
        return changed
