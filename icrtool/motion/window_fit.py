"""Robust fit of motion models to windows of driven distance, pooled over recordings.

Heading and place are sums over the wheel samples, and so are their derivatives: all windows of a recording cost one
pass over its samples (`icrtool.kernels.window_residuals`). What is left out of a fit is subtracted from its normal
equations, so one fit serves all folds.

Each recording has constants of its own, which are not part of a calibration (`icrtool.motion.recording.LogConstants`).
Of several recordings they are eliminated from the normal equations of each (`icrtool.kernels.elimination`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from icrtool.kernels.arrays import Bools, Floats
from icrtool.kernels.elimination import Parts, normal_equations
from icrtool.kernels.robust import (
    Linearised,
    RobustFit,
    mad_std,
    robust_least_squares,
    robust_weights,
    scale_by_kind,
    soft_l1_weights,
    student_covariance,
)
from icrtool.kernels.track import Windows
from icrtool.kernels.window_residuals import OMEGA, path_at, turn_residuals, window_residuals
from icrtool.motion.models import FittedModel, MotionModel, model_columns, wheel_motion
from icrtool.motion.recording import STRETCH_M, LogConstants, size_of

LAST_DELAY_STEP_SIGMAS = 0.1
"""Delays have kinks, where a shorter last step is not found."""

REWEIGHTS = 2

FEWEST_TO_SUBTRACT = 4
"""Of fewer recordings each is too large a part of all: the others are fitted anew."""


CONSTANT_STD = np.array([np.radians(3.0), 0.1, 0.02, 0.2])
"""Prior of `LogConstants` about zero: a heading that was aligned before, clocks of one robot, a gyro of one robot."""

CONSTANTS_OF_WHEELS = 2
"""So many of them, the first, are there without a gyro, too."""

RESIDUAL_KINDS = (0, 0, 1)
"""Residuals of a window: forward and right, whose spread is one, and turn."""

FEWEST_RESIDUALS = 10 * len(RESIDUAL_KINDS)
"""Fewer that are left beside a fold give no parameters."""


def constant_std(model: MotionModel) -> Floats:
    """Return the prior of the constants of each recording that a model has."""
    return CONSTANT_STD if model.uses_gyro else CONSTANT_STD[:CONSTANTS_OF_WHEELS]


def heading_wander(turned: Floats, length_m: Floats) -> float:
    """Return the variance of a heading that slip makes wander, for each metre [rad^2/m]; 0 of windows of one length.

    Parameters
    ----------
    turned : (w,) turn of a model less that of the reference [rad]; length_m : (w,) of the windows

    Notes
    -----
    What longer windows stray more than short ones: what both have is of the reference.
    """
    short, long = float(length_m.min()), float(length_m.max())
    if short == long:
        return 0.0
    near, far = (mad_std(turned[length_m == one]) ** 2 for one in (short, long))
    return max(far - near, 0.0) / (long - short)


def shortening(wander: float, length_m: Floats) -> Floats:
    """Return the share (w,) of its displacement that a window goes on average where slip makes its heading wander.

    Parameters
    ----------
    wander : of `heading_wander` [rad^2/m]; length_m : (w,) of the windows

    Notes
    -----
    A heading that wanders with a variance of q for each metre leaves the mean of e^{j Theta} short by q s / 2 after s
    metres: a displacement over L by q L / 4, to first order. Without it, the scale of the wheels, and with it the
    multiplier, is too small.
    """
    return np.asarray(np.exp(-wander * length_m / 4.0))


Residuals = Callable[[Floats, Floats], tuple[Floats, Floats]]
"""Gives residuals (m,) and their derivatives (m, k + c), of parameters (k,) and constants (c,)."""


def residuals_of(
    windows: Windows, model: MotionModel, width_m: float, wheels: FittedModel | None = None,
    wander: float | None = None,
) -> Residuals:  # fmt: skip
    """Return what gives the residuals of all windows of one recording for one model, by sqrt(length).

    Displacements alone do not separate a turn from side slip, and show little of a spin on the spot: turns are
    residuals, too, weighted by their own spread.

    Parameters
    ----------
    windows : of `icrtool.motion.recording.cut_windows`
    model, width_m : what predicts, and the track width b [m]
    wheels : for a model with a gyro, the wheels-only model whose turn rate it combines with the gyro's
    wander : of `heading_wander`, where it is known [rad^2/m]; default: that of these windows

    Returns
    -------
    A function of parameters (k,) and constants (c,), `LogConstants`, those of a gyro only for a model with one. It
    returns residuals (3 w,), forward, right [m^0.5], then turn [rad/m^0.5], and their derivatives (3 w, k + c).
    """
    steps, root = windows.track, np.sqrt(windows.length_m)
    seen, seen_turned = windows.moved, windows.turned
    knots, rows = np.unique([windows.begin, windows.end], return_inverse=True)
    knot_t, (start, end) = steps.place_t[knots], rows.reshape(2, -1)
    motion = wheel_motion(steps.v_left, steps.v_right, width_m, steps.gyro)
    if wheels is not None:
        motion = motion._replace(turn=wheels.twist(motion)[OMEGA])
    of_model, axes, of_terms = model_columns(model, motion)
    gyro_change, k = steps.gyro_change(), len(axes)
    if model.uses_gyro:
        # the gyro's bias and time are two more columns of the turn rate
        axes = np.append(axes, [OMEGA, OMEGA])
        of_terms = np.concatenate([of_terms, np.ones((2, len(steps.t)))])
    # by how much each parameter raises the gyro's share of the turn rate
    gains = np.array([{"gyro_scale": 1.0, "wheels_weight": -1.0}.get(name, 0.0) for name in model.terms])

    def evaluate(parameters: Floats, constants: Floats) -> tuple[Floats, Floats]:
        offset, delay = constants[:CONSTANTS_OF_WHEELS].tolist()
        fixed, columns, values = of_model, of_terms, parameters
        if model.uses_gyro:
            bias, later = constants[CONSTANTS_OF_WHEELS:].tolist()
            shift = later * gyro_change
            fixed, columns, values = fixed.copy(), columns.copy(), np.concatenate([parameters, [bias, 0.0]])
            fixed[OMEGA] += shift
            columns[:k] += gains[:, None] * shift
            columns[-1] = (1.0 + parameters @ gains) * gyro_change
        path = path_at(steps, lambda some: (fixed[:, some], axes, columns[:, some]), values, knot_t + delay)
        turned, turned_by = turn_residuals(path, start, end, seen_turned, root)
        strayed = heading_wander(turned * root, windows.length_m) if wander is None else wander
        share = shortening(strayed, windows.length_m)
        moved, moved_by = window_residuals(path, start, end, seen, offset, root, share)
        # terms, those of the gyro, offset, delay: to terms, then `LogConstants`
        terms = len(axes)
        jacobian = np.concatenate([moved_by, turned_by])[:, [*range(k), terms, terms + 1, *range(k, terms)]]
        return np.concatenate([moved, turned]), jacobian

    return evaluate


class Fold(NamedTuple):
    """What is left out together: a recording, or some distance of a single one.

    Attributes
    ----------
    name : of the recording, or of the block of distance in which it begins; number : the same, counted from 0
    recording : which one; begin_m, end_m : path lengths [m], infinite for all of it
    """

    name: str
    number: int
    recording: int
    begin_m: float
    end_m: float

    @property
    def whole(self) -> bool:
        """Whether all of the recording is left out."""
        return bool(np.isinf(self.begin_m) and np.isinf(self.end_m))


Prediction = tuple[FittedModel, LogConstants]
"""A model that was not fitted to a fold, and the constants of the fold's recording."""


@dataclass(frozen=True, kw_only=True)
class PooledFit(FittedModel):
    """A model fitted to windows of several recordings.

    Attributes
    ----------
    wheels : as in `FittedModel`, fitted to the same windows
    pool : the windows
    wide : fit of the model with wide priors, which showed those of this one; None where no term has a wide prior
    solution : of all parameters, those of the model first, then the constants of each recording. Those of several
        recordings follow the model's; those of a single one are parameters like them.
    """

    wheels: PooledFit | None = None
    pool: Pool
    wide: PooledFit | None = None
    solution: RobustFit
    _refits: dict[int, PooledFit] = field(default_factory=dict, repr=False, compare=False)
    _left_out: dict[Fold, Prediction | None] = field(default_factory=dict, repr=False, compare=False)

    @property
    def fitted(self) -> FittedModel:
        """The model and its parameters alone."""
        wheels = None if self.wheels is None else self.wheels.fitted
        return FittedModel(self.model, self.parameters, self.covariance, wheels)

    def with_clock_error(self, x_std_m: float) -> PooledFit:
        """Return the fit with a further standard deviation of its x_icr [m], -vy_w b / (2 omega_w)."""
        of = dict(zip(self.model.terms, self.parameters.tolist(), strict=True))
        place, covariance = self.model.terms.index("vy_w"), self.covariance.copy()
        covariance[place, place] += (2.0 * of["omega_w"] / self.pool.widths_m[0] * x_std_m) ** 2
        return replace(self, covariance=covariance)

    def constants(self, recording: int) -> LogConstants:
        """Return the constants of a recording."""
        return LogConstants(*self._own(self.solution.x, recording).tolist())

    def _own(self, x: Floats, recording: int) -> Floats:
        own = len(constant_std(self.model))
        first = len(self.parameters) + own * recording
        return x[first : first + own]

    def without(self, fold: Fold) -> Prediction | None:
        """Return the model as fitted without a fold, and the constants of the fold's recording for that.

        Returns
        -------
        None where too little is left. The constants of a recording that is left out whole are found in it, of many to
        first order of the parameters' change.
        """
        if fold not in self._left_out:
            self._left_out[fold] = self._fit_without(fold)
        return self._left_out[fold]

    def _fit_without(self, fold: Fold) -> Prediction | None:
        pool, i, k = self.pool, fold.recording, len(self.parameters)
        clear = pool.clear_of(fold)
        if np.count_nonzero(clear) < FEWEST_RESIDUALS:
            return None
        if fold.whole and len(pool.windows) < FEWEST_TO_SUBTRACT:
            found = self.refit_without(i)
            covariance = self._covariance(np.linalg.inv(found.curvature)[:k, :k])
            fitted = replace(found.fitted, covariance=covariance)
            return fitted, own_constants(pool.windows[i], fitted, pool.widths_m[i])
        of_wheels = None if self.wheels is None else self.wheels.without(fold)
        wheels = None if of_wheels is None else of_wheels[0]
        shown = None if self.wide is None else self.wide.without(fold)
        model = self.model if shown is None else replace(self.model, stds=()).as_shown(shown[0])
        if fold.whole:
            gradient, curvature = (of_recordings[i] for of_recordings in self._by_recording)
            # the priors may be others without the recording
            pull = model.prior_std**-2.0 - self.model.prior_std**-2.0
            gradient, curvature = gradient - pull * (self.parameters - model.prior_mean), curvature - np.diag(pull)
            covariance = self._covariance(np.linalg.inv(self.curvature - curvature))
            # a Newton step: at the minimum the gradients of all residuals and of the prior sum to zero, so what is left
            # without some is minus theirs
            steps = np.linalg.solve(self.curvature - curvature, gradient)
            fitted = FittedModel(model, self.parameters + steps, covariance, wheels)
            own = self._own(self.solution.x, i) - self.solution.gain[i] @ steps
            return fitted, LogConstants(*own.tolist())
        x, covariance = self._reweighted(clear, model)
        return FittedModel(model, x[:k], covariance, wheels), LogConstants(*self._own(x, i).tolist())

    def refit_without(self, recording: int) -> PooledFit:
        """Return a fit of the model to the other recordings."""
        if recording not in self._refits:
            wheels = None if self.wheels is None else self.wheels.refit_without(recording)
            self._refits[recording] = self.pool.without(recording).fit(replace(self.model, stds=()), wheels)
        return self._refits[recording]

    def _reweighted(self, clear: Bools, model: MotionModel) -> tuple[Floats, Floats]:
        """Return all parameters of a single recording as fitted to some residuals (m,), and the model's covariance.

        Parameters
        ----------
        model : with its priors

        Notes
        -----
        A Newton step, then two of a new fit's reweighted steps, with residuals that follow the parameters to first
        order: over some metres they do so nearly exactly.
        """
        at, (mean, std), pool = self.solution, self.pool.prior(model), self.pool
        residuals, jacobian, pull = at.residuals[clear], at.jacobian[clear], std**-2.0

        def near(x: Floats) -> Linearised:
            left = residuals + jacobian @ (x - at.x)
            scale, prior = scale_by_kind(left, pool.kind[clear]), np.diag(pull)
            return Linearised(residuals=left, jacobian=jacobian, scale=scale, prior=prior, overlap=pool.overlap)

        gradient, curvature = self._derivatives(~clear)
        x = at.x + np.linalg.solve(self.curvature - curvature, gradient)
        for _ in range(REWEIGHTS):
            here = near(x)
            gradient = jacobian.T @ (here.weights * here.residuals) + pull * (x - mean)
            x = x - np.linalg.solve(here.information, gradient)
        k = len(self.parameters)
        return x, student_covariance(near(x), [pool.group[clear]])[:k, :k]

    def _covariance(self, inverse: NDArray[Any]) -> Floats:
        """Return the covariance (k, k) without a recording, from the inverse of its curvature.

        Notes
        -----
        A parameter's variance exceeds that of independent residuals by as much as with the recording.
        """
        grown = np.sqrt(np.diag(self.covariance) / np.diag(np.linalg.inv(self.curvature)))
        return np.asarray(inverse * np.outer(grown, grown), np.float64)

    @cached_property
    def _by_recording(self) -> tuple[Floats, Floats]:
        """Gradient and curvature of each recording, its constants eliminated; (r, k), (r, k, k)."""
        at = self.solution
        both = [self._derivatives(self.pool.rows(i)) for i in range(len(self.pool.windows))]
        gradients, curvatures = (np.array(one) for one in zip(*both, strict=True))
        return gradients + at.own_pull, curvatures + at.own_prior

    @cached_property
    def curvature(self) -> Floats:
        """Second derivatives of the loss and the prior together (k, k)."""
        prior = self.pool.prior(self.model)[1][: len(self.solution.prior)] ** -2.0
        return np.asarray(self._by_recording[1].sum(axis=0) + np.diag(prior), np.float64)

    def _derivatives(self, rows: Bools | slice) -> tuple[Floats, Floats]:
        """Return the first and second derivatives of the loss of some residuals."""
        at = self.solution
        residuals, jacobian, scale = at.residuals[rows], at.jacobian[rows], at.scale[rows]
        weights = robust_weights(residuals, scale, self.pool.overlap)
        # the second derivative of soft L1 is the cube of its weight
        curvature, _ = normal_equations(residuals, jacobian, weights * soft_l1_weights(residuals / scale) ** 2)
        return jacobian.T @ (weights * residuals), curvature


def own_constants(windows: Windows, fitted: FittedModel, width_m: float) -> LogConstants:
    """Return the constants of one recording for given parameters of the model."""
    of_both, std = residuals_of(windows, fitted.model, width_m, fitted.wheels), constant_std(fitted.model)

    def evaluate(constants: Floats) -> tuple[Floats, Floats]:
        residuals, by = of_both(fitted.parameters, constants)
        return residuals, by[:, len(fitted.parameters) :]

    zero, kind = np.zeros(len(std)), np.repeat(RESIDUAL_KINDS, len(windows.begin))
    overlap = len(windows.begin) / 5.0
    return LogConstants(*robust_least_squares(evaluate, zero, zero, std, kind=kind, overlap=overlap).x.tolist())


class Pool:
    """Windows of several recordings, and the fits of models to them.

    Parameters
    ----------
    windows, widths_m : by recording

    Attributes
    ----------
    recording, start_m, end_m, length_m : (m,) of the window of each residual
    first : (recordings + 1,) first residual of each, and the number of all
    kind : (m,) of `RESIDUAL_KINDS`
    group : (m,) stretches of distance whose residuals depend on one another
    overlap : how many windows cover a place on average
    """

    def __init__(self, windows: Sequence[Windows], widths_m: Sequence[float]) -> None:
        self.windows, self.widths_m = windows, widths_m
        by_window = [np.tile([*w.track.distance[[w.begin, w.end]], w.length_m], len(RESIDUAL_KINDS)) for w in windows]
        self.start_m, self.end_m, self.length_m = np.concatenate(by_window, axis=1)
        self.kind = np.concatenate([np.repeat(RESIDUAL_KINDS, len(w.begin)) for w in windows])
        sizes = [one.shape[1] for one in by_window]
        self.first = np.cumsum([0, *sizes])
        self.recording = np.repeat(np.arange(len(windows)), sizes)
        stretch_m = STRETCH_M * np.array([size_of(one) for one in widths_m])
        stretch = np.column_stack([self.recording, np.floor(self.start_m / stretch_m[self.recording])])
        stretches, group = np.unique(stretch, axis=0, return_inverse=True)
        self.group = group.reshape(-1)
        covered_m = float(stretch_m[stretches[:, 0].astype(np.int64)].sum())
        self.overlap = max(float(self.length_m.sum()) / len(RESIDUAL_KINDS) / covered_m, 1.0)

    def prior(self, model: MotionModel) -> tuple[Floats, Floats]:
        """Return mean and standard deviation of all parameters, model first, then the constants of each recording."""
        own = np.tile(constant_std(model), len(self.windows))
        mean = np.concatenate([model.prior_mean, np.zeros(len(own))])
        return mean, np.concatenate([model.prior_std, own])

    def without(self, recording: int) -> Pool:
        """Return the windows of the other recordings."""
        others = [i for i in range(len(self.windows)) if i != recording]
        return Pool([self.windows[i] for i in others], [self.widths_m[i] for i in others])

    def rows(self, recording: int) -> slice:
        """Return where the residuals of a recording are."""
        return slice(self.first[recording], self.first[recording + 1])

    def clear_of(self, fold: Fold) -> Bools:
        """Return the residuals (m,) that share no distance with a fold."""
        apart = (self.end_m <= fold.begin_m) | (self.start_m >= fold.end_m)
        return np.asarray(apart | (self.recording != fold.recording), np.bool_)

    def fit(self, model: MotionModel, wheels: PooledFit | None = None) -> PooledFit:
        """Fit a model.

        Parameters
        ----------
        wheels : for a model with a gyro, the wheels-only model whose turn rate it combines with the gyro's

        Notes
        -----
        The priors of some terms are as wide as these windows show them (`MotionModel.as_shown`).
        """
        widened, wide = model.widened(), None
        if widened is not None:
            wide = self.fit(widened, wheels)
            model = model.as_shown(wide)
        of_recordings = [
            residuals_of(w, model, width, wheels) for w, width in zip(self.windows, self.widths_m, strict=True)
        ]
        k, own, count = len(model.terms), len(constant_std(model)), len(self.windows)
        mean, std = self.prior(model)

        def evaluate(x: Floats) -> tuple[Floats, Floats]:
            residuals, jacobian = np.empty(len(self.group)), np.empty((len(self.group), k + own))
            for i, constants in enumerate(x[k:].reshape(count, own)):
                residuals[self.rows(i)], jacobian[self.rows(i)] = of_recordings[i](x[:k], constants)
            return residuals, jacobian

        found = robust_least_squares(
            evaluate, mean, mean, std, kind=self.kind, parts=Parts(self.first, own if count > 1 else 0),
            overlap=self.overlap, settled=LAST_DELAY_STEP_SIGMAS,
        )  # fmt: skip
        levels = [self.group, *([self.recording] if count > 1 else [])]
        covariance = student_covariance(found, levels)[:k, :k]
        return PooledFit(model, found.x[:k], covariance, wheels=wheels, pool=self, wide=wide, solution=found)
