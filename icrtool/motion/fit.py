"""Robust fit of motion models to windows of driven distance, pooled over recordings.

Heading and place are sums over the wheel samples, and so are their derivatives: all windows of a recording cost one
pass over its samples (`icrtool.kernels.window_residuals`).

Each recording has constants of its own, which are not part of a calibration: the offset of its reference heading, the
delay of its wheels relative to its poses, the bias of its gyro.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from icrtool.kernels.robust import RobustFit, normal_equations, robust_least_squares
from icrtool.kernels.window_residuals import OMEGA, sums_at_knots, window_residuals
from icrtool.motion.models import FittedModel, MotionModel, model_columns, wheel_motion
from icrtool.motion.recording import STRETCH_M, Windows
from icrtool.records.tables import Bools, Floats

CONSTANTS = ("heading_offset_rad", "wheels_read_later_s", "gyro_bias_radps")
"""Constants of each recording: offset added to the reference heading; delay of the wheels; added to the turn rate."""

CONSTANT_STD = np.array([np.radians(3.0), 0.1, 0.02])
"""Prior of `CONSTANTS` about zero: a heading that was aligned before, clocks of one robot, a gyro of one robot."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PooledFit(FittedModel):
    """A model fitted to windows of several recordings.

    Attributes
    ----------
    constants : (recordings, 3), see `CONSTANTS`
    solution : of all parameters, those of the model first, then three a recording
    residuals, jacobian : of all windows (m,), (m, k + 3 recordings), at the minimum
    kept : (m,) the residuals that were fitted
    """

    constants: Floats
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
        self._fixed, axes, columns = model_columns(model, motion)
        # the gyro's bias is one more column of the turn rate
        self._axes = np.append(axes, OMEGA)
        self._columns = np.concatenate([columns, np.full((1, len(steps.t)), float(model.uses_gyro))])
        self._windows = windows
        self._reference = np.column_stack([windows.reference.real, windows.reference.imag])
        self._root = np.sqrt(windows.length_m)

    def __call__(self, parameters: Floats, constants: Floats) -> tuple[Floats, Floats]:
        """Return residuals (2 w,), forward then right [m per root metre], and derivatives (2 w, k + 3)."""
        windows, steps = self._windows, self._windows.steps
        offset, delay, bias = constants.tolist()
        row, share = steps.locate(windows.knot_t + delay)
        terms, knots, count = len(self._axes), len(row), len(windows.start)
        rate, sums, by = np.empty((knots, 3)), np.empty((knots, 3)), np.empty((terms, knots, 3))
        sums_at_knots(
            self._fixed, self._columns, self._axes, np.append(parameters, bias), steps.held, steps.into, row, share,
            rate, sums, by,
        )  # fmt: skip
        residual, jacobian = np.empty(2 * count), np.empty((2 * count, terms + 2))
        window_residuals(
            rate, sums, by, windows.start, windows.end, self._reference, offset, self._root, residual, jacobian
        )
        # terms, bias, offset, delay: to terms, then `CONSTANTS`
        order = [*range(terms - 1), terms, terms + 1, terms - 1]
        return residual, jacobian[:, order]


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

    def own_constants(self, recording: int, parameters: Floats) -> Floats:
        """Return the constants (3,) of one recording for given parameters of the model."""
        part, free = self._parts[recording], self._constant_std()
        kept = np.ones(len(self._windows[recording].start) * 2, np.bool_)

        def evaluate(constants: Floats) -> tuple[Floats, Floats]:
            residuals, by = part(parameters, constants)
            return residuals, by[:, -3:]

        return robust_least_squares(evaluate, np.zeros(3), np.zeros(3), free, overlap=len(kept) / 10.0).x

    def _constant_std(self) -> Floats:
        free = CONSTANT_STD.copy()
        if not self.model.uses_gyro:
            free[2] = 1e-9
        return free

    @property
    def prior(self) -> tuple[Floats, Floats]:
        """Mean and standard deviation of all parameters, model first, then the constants of each recording."""
        count = len(self._parts)
        mean = np.concatenate([self.model.prior_mean, np.zeros(3 * count)])
        return mean, np.concatenate([self.model.prior_std, np.tile(self._constant_std(), count)])

    def evaluate(self, x: Floats) -> tuple[Floats, Floats]:
        """Return residuals (m,) of all windows of all recordings and their derivatives (m, k + 3 recordings)."""
        k = len(self.model.terms)
        residuals, jacobians = [], []
        for i, part in enumerate(self._parts):
            columns = slice(k + 3 * i, k + 3 * i + 3)
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
            evaluate, mean if start is None else start, mean, std, group=self.group[rows], overlap=self.overlap(rows)
        )
        k = len(self.model.terms)
        at, residuals, jacobian = last[0]
        return PooledFit(
            self.model, found.x[:k], found.covariance[:k, :k], self._wheels,
            constants=found.x[k:].reshape(-1, 3), solution=found, residuals=residuals + jacobian @ (found.x - at),
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
