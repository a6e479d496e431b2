"""Robust fit of motion models to windows of driven distance, pooled over recordings.

Heading, place and their derivatives are sums over the wheel samples, so one pass over the samples of a recording gives
all its windows (`icrtool.kernels.window_residuals`). To leave a fold out, its part is subtracted from the normal
equations, so one fit gives the solutions of all folds.

Each recording has its own constants, which are not part of a calibration (`icrtool.motion.recording.LogConstants`). If
there are several recordings, the constants are eliminated from the normal equations of each recording
(`icrtool.kernels.elimination`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from icrtool.kernels.arrays import Bools, Floats, Ints
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
from icrtool.kernels.track import Track, Windows
from icrtool.kernels.window_residuals import OMEGA, path_at, turn_residuals, window_residuals
from icrtool.motion.models import FittedModel, MotionModel, WheelMotion, model_columns, wheel_motion
from icrtool.motion.recording import STRETCH_M, LogConstants, size_of

LAST_DELAY_STEP_SIGMAS = 0.1
"""Length of a step of a delay below which it is the last step, in standard deviations. The residuals have kinks over
the delay, so that steps do not become shorter."""

REWEIGHTS = 2
"""Number of reweighted steps of a fit without a fold."""

FEWEST_TO_SUBTRACT = 4
"""Smallest number of recordings for which one is subtracted from the fit of all. Of fewer recordings, the others are
fitted anew, because one recording is then a large part of all."""


CONSTANT_STD = np.array([np.radians(3.0), 0.1, 0.02, 0.2])
"""Prior standard deviations of `LogConstants` about zero [rad, s, rad/s, s]. The heading was aligned before, and clocks
and gyro belong to one robot."""

CONSTANTS_OF_WHEELS = 2
"""Number of constants of a recording without a gyro. They come first in `LogConstants`."""

RESIDUAL_KINDS = (0, 0, 1)
"""Kind of each residual of a window. Forward and right have a common standard deviation, and the turn has its own."""

FEWEST_RESIDUALS = 10 * len(RESIDUAL_KINDS)
"""Smallest number of residuals outside of a fold from which parameters are computed."""


def constant_std(model: MotionModel) -> Floats:
    """Return the prior standard deviations (c,) of the constants that a model uses."""
    return CONSTANT_STD if model.uses_gyro else CONSTANT_STD[:CONSTANTS_OF_WHEELS]


def heading_wander(turn_error_rad: Floats, length_m: Floats) -> float:
    """Return the growth of the variance of a heading by slip for each metre [rad^2/m]; 0 for windows of one length.

    Parameters
    ----------
    turn_error_rad : (w,) turn of a model minus the reference's turn [rad]; length_m : (w,) of the windows

    Notes
    -----
    The growth is the increase of the variance from short to long windows. The part that both have in common is the
    noise of the reference.
    """
    short, long = float(length_m.min()), float(length_m.max())
    if short == long:
        return 0.0
    short_variance, long_variance = (mad_std(turn_error_rad[length_m == length]) ** 2 for length in (short, long))
    return max(long_variance - short_variance, 0.0) / (long - short)


def shortening_by_wander(wander: float, length_m: Floats) -> Floats:
    """Return the mean ratio (w,) of a window's displacement to its displacement without wander of the heading.

    Parameters
    ----------
    wander : result of `heading_wander` [rad^2/m]; length_m : (w,) lengths of the windows

    Notes
    -----
    If the variance of a heading grows by q for each metre, the mean of e^{j Theta} decreases by q s / 2 after s metres,
    and the displacement over a length L by a share of q L / 4, to first order. Without this ratio, the scale of the
    wheels and the multiplier would be too small.
    """
    return np.asarray(np.exp(-wander * length_m / 4.0))


Residuals = Callable[[Floats, Floats], tuple[Floats, Floats]]
"""Function that returns residuals (m,) and their derivatives (m, k + c) for parameters (k,) and constants (c,)."""


def residuals_of(
    windows: Windows, model: MotionModel, width_m: float, wheels: FittedModel | None = None,
    wander: float | None = None,
) -> Residuals:  # fmt: skip
    """Return a function for the residuals of all windows of a recording by a model, divided by sqrt(length).

    Displacements alone do not separate a turn from side slip, and show little of a spin on the spot. Therefore turns
    are residuals, too, weighted by their own standard deviation.

    Parameters
    ----------
    windows : result of `icrtool.motion.recording.cut_windows`
    model, width_m : the model, and the track width b [m]
    wheels : for a model with a gyro, the wheels-only model whose turn rate is combined with the turn rate of the gyro
    wander : result of `heading_wander`, if it is known [rad^2/m]; default: it is computed from these windows

    Returns
    -------
    Residuals
        Function of parameters (k,) and constants (c,) as in `LogConstants`, with constants of a gyro only for a model
        with a gyro. It returns residuals (3 w,), forward, right [m^0.5], then turn [rad/m^0.5], and their derivatives
        (3 w, k + c).
    """
    steps, root = windows.track, np.sqrt(windows.length_m)
    seen, seen_turned = windows.moved, windows.turned
    knots, rows = np.unique([windows.begin, windows.end], return_inverse=True)
    knot_t, (start, end) = steps.place_t[knots], rows.reshape(2, -1)
    columns_at = _step_columns(steps, wheel_motion(steps.v_left, steps.v_right, width_m, steps.gyro), model, wheels)

    def evaluate(parameters: Floats, constants: Floats) -> tuple[Floats, Floats]:
        offset, delay = constants[:CONSTANTS_OF_WHEELS].tolist()
        fixed, axes, columns, values = columns_at(parameters, constants)
        path = path_at(steps, lambda rows: (fixed[:, rows], axes, columns[:, rows]), values, knot_t + delay)
        turned, turned_by = turn_residuals(path, start, end, seen_turned, root)
        strayed = heading_wander(turned * root, windows.length_m) if wander is None else wander
        share = shortening_by_wander(strayed, windows.length_m)
        moved, moved_by = window_residuals(path, start, end, seen, offset, root, share)
        # The derivatives are reordered from terms, gyro columns, offset, delay to terms, `LogConstants`.
        k, terms = len(parameters), len(axes)
        jacobian = np.concatenate([moved_by, turned_by])[:, [*range(k), terms, terms + 1, *range(k, terms)]]
        return np.concatenate([moved, turned]), jacobian

    return evaluate


class StepColumns(NamedTuple):
    """Twists of a path at n steps, with p free terms: the k terms of the model, and terms of the gyro's constants.

    Attributes
    ----------
    fixed : (3, n) twist without the free terms; axes : (p,) axis of each free term
    columns : (p, n) twist per unit of each free term; values : (p,) of the free terms
    """

    fixed: Floats
    axes: Ints
    columns: Floats
    values: Floats


def _step_columns(
    steps: Track, motion: WheelMotion, model: MotionModel, wheels: FittedModel | None = None
) -> Callable[[Floats, Floats], StepColumns]:
    """Return a function for the columns of a track's steps, for parameters (k,) and constants (c,).

    Parameters
    ----------
    steps : track with joined wheel samples
    motion : motion of the wheels in the steps, with their gyro
    model, wheels : as in `residuals_of`
    """
    if wheels is not None:
        motion = motion._replace(turn=wheels.twist(motion)[OMEGA])
    fixed_twist, axes, term_columns = model_columns(model, motion)
    if not model.uses_gyro:
        return lambda parameters, _: StepColumns(fixed_twist, axes, term_columns, parameters)
    k, gyro_change = len(axes), steps.gyro_change()
    # The bias and the time of the gyro are two further columns of the turn rate.
    axes = np.append(axes, [OMEGA, OMEGA])
    term_columns = np.concatenate([term_columns, np.ones((2, len(steps.t)))])
    # These are the derivatives of the weight of the gyro in the turn rate by each parameter.
    gains = np.array([{"gyro_scale": 1.0, "wheels_weight": -1.0}.get(name, 0.0) for name in model.terms])

    def columns_at(parameters: Floats, constants: Floats) -> StepColumns:
        bias, later = constants[CONSTANTS_OF_WHEELS:].tolist()
        shift, fixed, columns = later * gyro_change, fixed_twist.copy(), term_columns.copy()
        fixed[OMEGA] += shift
        columns[:k] += gains[:, None] * shift
        columns[-1] = (1.0 + parameters @ gains) * gyro_change
        return StepColumns(fixed, axes, columns, np.concatenate([parameters, [bias, 0.0]]))

    return columns_at


class Fold(NamedTuple):
    """Data that are left out together: a recording, or a part of a single recording.

    Attributes
    ----------
    name, number : name and number, from 0, of the recording, or of the block of distance in which the fold begins
    recording : number of the recording
    begin_m, end_m : path lengths at start and end [m]; infinite for a whole recording
    """

    name: str
    number: int
    recording: int
    begin_m: float
    end_m: float

    @property
    def whole(self) -> bool:
        """Whether the fold is a whole recording."""
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
    wide : fit of the model with wide priors, from which the priors of this fit follow; None if no term has a wide prior
    solution : all parameters: first of the model, then the constants of each recording. Constants of several recordings
        were eliminated; constants of a single recording were fitted like the parameters of the model
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
        """Return the fit with a further standard deviation of its x_icr [m], which is -vy_w b / (2 omega_w)."""
        by_term = dict(zip(self.model.terms, self.parameters.tolist(), strict=True))
        vy_w_index, covariance = self.model.terms.index("vy_w"), self.covariance.copy()
        covariance[vy_w_index, vy_w_index] += (2.0 * by_term["omega_w"] / self.pool.widths_m[0] * x_std_m) ** 2
        return replace(self, covariance=covariance)

    def constants(self, recording: int) -> LogConstants:
        """Return the constants of a recording."""
        return LogConstants(*self._own(self.solution.x, recording).tolist())

    def _own(self, x: Floats, recording: int) -> Floats:
        """Return the constants (c,) of a recording in all parameters x."""
        constant_count = len(constant_std(self.model))
        first = len(self.parameters) + constant_count * recording
        return x[first : first + constant_count]

    def fit_without(self, fold: Fold) -> Prediction | None:
        """Return the model fitted without a fold, and the constants of the fold's recording for this model.

        None if too few residuals are left. The constants of a whole recording are estimated in this recording; with
        many recordings, to first order in the change of the parameters.
        """
        if fold not in self._left_out:
            self._left_out[fold] = self._fit_without(fold)
        return self._left_out[fold]

    def _fit_without(self, fold: Fold) -> Prediction | None:
        """Compute the result of `fit_without`, which keeps it."""
        pool, i, k = self.pool, fold.recording, len(self.parameters)
        clear = pool.clear_of(fold)
        if np.count_nonzero(clear) < FEWEST_RESIDUALS:
            return None
        if fold.whole and len(pool.windows) < FEWEST_TO_SUBTRACT:
            refit = self.refit_without(i)
            covariance = self._covariance(np.linalg.inv(refit.curvature)[:k, :k])
            fitted_model = replace(refit.fitted, covariance=covariance)
            return fitted_model, own_constants(pool.windows[i], fitted_model, pool.widths_m[i])
        wheels_prediction = None if self.wheels is None else self.wheels.fit_without(fold)
        wheels = None if wheels_prediction is None else wheels_prediction[0]
        wide_prediction = None if self.wide is None else self.wide.fit_without(fold)
        model = self.model
        if wide_prediction is not None:
            model = replace(self.model, stds=()).with_shown_priors(wide_prediction[0])
        if fold.whole:
            gradient, curvature = (derivatives[i] for derivatives in self._by_recording)
            # The priors may be different without the recording.
            pull = model.prior_std**-2.0 - self.model.prior_std**-2.0
            gradient, curvature = gradient - pull * (self.parameters - model.prior_mean), curvature - np.diag(pull)
            covariance = self._covariance(np.linalg.inv(self.curvature - curvature))
            # This is a Newton step. At the minimum the gradients of all residuals and of the prior sum to zero, so the
            # gradient without the fold is the negative gradient of the fold.
            steps = np.linalg.solve(self.curvature - curvature, gradient)
            fitted_model = FittedModel(model, self.parameters + steps, covariance, wheels)
            constants = self._own(self.solution.x, i) - self.solution.gain[i] @ steps
            return fitted_model, LogConstants(*constants.tolist())
        x, covariance = self._reweighted(clear, model)
        return FittedModel(model, x[:k], covariance, wheels), LogConstants(*self._own(x, i).tolist())

    def refit_without(self, recording: int) -> PooledFit:
        """Return a fit of the model to the other recordings."""
        if recording not in self._refits:
            wheels = None if self.wheels is None else self.wheels.refit_without(recording)
            self._refits[recording] = self.pool.without_recording(recording).fit(replace(self.model, stds=()), wheels)
        return self._refits[recording]

    def _reweighted(self, clear: Bools, model: MotionModel) -> tuple[Floats, Floats]:
        """Return all parameters of a single recording, fitted to some residuals, and the covariance of the model.

        Parameters
        ----------
        clear : (m,) residuals that are used
        model : the model with its priors

        Notes
        -----
        A Newton step, then two reweighted steps of a new fit. The residuals are linearised, which is nearly exact over
        some metres.
        """
        at, (mean, std), pool = self.solution, self.pool.prior(model), self.pool
        residuals, jacobian, pull = at.residuals[clear], at.jacobian[clear], std**-2.0

        def near(x: Floats) -> Linearised:
            predicted = residuals + jacobian @ (x - at.x)
            scale, prior = scale_by_kind(predicted, pool.kind[clear]), np.diag(pull)
            return Linearised(residuals=predicted, jacobian=jacobian, scale=scale, prior=prior, overlap=pool.overlap)

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
        The ratio of a parameter's variance to its variance for independent residuals is the same as with the recording.
        """
        grown = np.sqrt(np.diag(self.covariance) / np.diag(np.linalg.inv(self.curvature)))
        return np.asarray(inverse * np.outer(grown, grown), np.float64)

    @cached_property
    def _by_recording(self) -> tuple[Floats, Floats]:
        """Gradient (r, k) and curvature (r, k, k) of each recording, with its constants eliminated."""
        solution = self.solution
        both = [self._derivatives(self.pool.rows(i)) for i in range(len(self.pool.windows))]
        gradients, curvatures = (np.array(column) for column in zip(*both, strict=True))
        return gradients + solution.own_prior_gradient, curvatures + solution.own_prior

    @cached_property
    def curvature(self) -> Floats:
        """Second derivatives (k, k) of the sum of loss and prior."""
        prior = self.pool.prior(self.model)[1][: len(self.solution.prior)] ** -2.0
        return np.asarray(self._by_recording[1].sum(axis=0) + np.diag(prior), np.float64)

    def _derivatives(self, rows: Bools | slice) -> tuple[Floats, Floats]:
        """Return the first and second derivatives of the loss of some residuals."""
        solution = self.solution
        residuals, jacobian, scale = solution.residuals[rows], solution.jacobian[rows], solution.scale[rows]
        weights = robust_weights(residuals, scale, self.pool.overlap)
        # The second derivative of soft L1 is the cube of its weight.
        curvature, _ = normal_equations(residuals, jacobian, weights * soft_l1_weights(residuals / scale) ** 2)
        return jacobian.T @ (weights * residuals), curvature


class KnownConstants(NamedTuple):
    """Constants of a recording with their standard deviations; NaN for a constant that is not known."""

    mean: LogConstants
    std: LogConstants

    def usual(self) -> KnownConstants:
        """Return the constants; an unknown constant becomes the prior of a drive, `CONSTANT_STD` about zero."""
        both = zip(self.mean, self.std, UNKNOWN_CONSTANTS.std, strict=True)
        pairs = [(mean, std) if np.isfinite(mean) else (0.0, usual) for mean, std, usual in both]
        mean, std = zip(*pairs, strict=True)
        return KnownConstants(LogConstants(*mean), LogConstants(*std))


UNKNOWN_CONSTANTS = KnownConstants(LogConstants(), LogConstants(*CONSTANT_STD.tolist()))
"""Constants of a drive of which only the prior is known."""


def own_constants(
    windows: Windows, fitted_model: FittedModel, width_m: float, held: LogConstants | None = None
) -> LogConstants:
    """Return the constants of one recording for given parameters of the model.

    Parameters
    ----------
    windows : windows of the recording
    fitted_model, width_m : the model, and the track width b [m]
    held : constants that keep their values; a constant that is NaN is estimated. Default: all are estimated
    """
    held_values = np.full(len(constant_std(fitted_model.model)), np.nan)
    if held is not None:
        held_values = np.array(held)[: len(held_values)]
    if not np.isnan(held_values).any():
        return LogConstants(*held_values.tolist())
    return LogConstants(
        *_fit_constants(windows, fitted_model, width_m, held_values, len(windows.begin) / 5.0)[0].tolist()
    )


def measured_constants(windows: Windows, fitted_model: FittedModel, width_m: float) -> KnownConstants:
    """Return the constants of one recording for given parameters of the model, with their standard deviations.

    Notes
    -----
    Stretches of `STRETCH_M` count as independent, as in the covariance of parameters. The covariance of the parameters
    is not part of the standard deviations, because constants are used with the parameters they were measured with.
    """
    pool = Pool([windows], [width_m])
    unknown = np.full(len(constant_std(fitted_model.model)), np.nan)
    constants, fit = _fit_constants(windows, fitted_model, width_m, unknown, pool.overlap)
    std = np.sqrt(np.diag(student_covariance(fit, [pool.group])))
    without = np.full(len(CONSTANT_STD) - len(unknown), np.nan)
    return KnownConstants(*(LogConstants(*np.append(values, without).tolist()) for values in (constants, std)))


def _fit_constants(
    windows: Windows, fitted_model: FittedModel, width_m: float, known: Floats, overlap: float
) -> tuple[Floats, RobustFit]:
    """Return all constants (c,), and the fit of those that are NaN in `known` (c,); `overlap` as in `Linearised`."""
    joint_residuals = residuals_of(windows, fitted_model.model, width_m, fitted_model.wheels)
    is_estimated = np.isnan(known)
    std = constant_std(fitted_model.model)[is_estimated]

    def all_constants(values: Floats) -> Floats:
        constants = known.copy()
        constants[is_estimated] = values
        return constants

    def evaluate(values: Floats) -> tuple[Floats, Floats]:
        residuals, jacobian = joint_residuals(fitted_model.parameters, all_constants(values))
        return residuals, jacobian[:, len(fitted_model.parameters) :][:, is_estimated]

    zero, kind = np.zeros(len(std)), np.repeat(RESIDUAL_KINDS, len(windows.begin))
    fit = robust_least_squares(evaluate, zero, zero, std, kind=kind, overlap=overlap)
    return all_constants(fit.x), fit


class Pool:
    """Windows of several recordings, and the fits of models to them.

    Parameters
    ----------
    windows, widths_m : by recording

    Attributes
    ----------
    recording, start_m, end_m, length_m : (m,) recording, begin, end and length of the window of each residual
    first : (recordings + 1,) first residual of each recording, and the number of all residuals
    kind : (m,) kind of each residual (`RESIDUAL_KINDS`)
    group : (m,) stretch of distance of each residual; residuals of one stretch depend on each other
    overlap : mean number of windows that cover a place
    """

    def __init__(self, windows: Sequence[Windows], widths_m: Sequence[float]) -> None:
        self.windows, self.widths_m = windows, widths_m
        by_window = [np.tile([*w.track.distance[[w.begin, w.end]], w.length_m], len(RESIDUAL_KINDS)) for w in windows]
        self.start_m, self.end_m, self.length_m = np.concatenate(by_window, axis=1)
        self.kind = np.concatenate([np.repeat(RESIDUAL_KINDS, len(w.begin)) for w in windows])
        sizes = [window_residuals.shape[1] for window_residuals in by_window]
        self.first = np.cumsum([0, *sizes])
        self.recording = np.repeat(np.arange(len(windows)), sizes)
        stretch_m = STRETCH_M * np.array([size_of(width_m) for width_m in widths_m])
        stretch = np.column_stack([self.recording, np.floor(self.start_m / stretch_m[self.recording])])
        stretches, group = np.unique(stretch, axis=0, return_inverse=True)
        self.group = group.reshape(-1)
        covered_m = float(stretch_m[stretches[:, 0].astype(np.int64)].sum())
        self.overlap = max(float(self.length_m.sum()) / len(RESIDUAL_KINDS) / covered_m, 1.0)

    def prior(self, model: MotionModel) -> tuple[Floats, Floats]:
        """Return prior mean and standard deviation of all parameters: of the model, then of the constants."""
        constants_std = np.tile(constant_std(model), len(self.windows))
        mean = np.concatenate([model.prior_mean, np.zeros(len(constants_std))])
        return mean, np.concatenate([model.prior_std, constants_std])

    def without_recording(self, recording: int) -> Pool:
        """Return the windows of the other recordings."""
        others = [i for i in range(len(self.windows)) if i != recording]
        return Pool([self.windows[i] for i in others], [self.widths_m[i] for i in others])

    def rows(self, recording: int) -> slice:
        """Return the rows of the residuals of a recording."""
        return slice(self.first[recording], self.first[recording + 1])

    def clear_of(self, fold: Fold) -> Bools:
        """Return the residuals (m,) that share no distance with a fold."""
        apart = (self.end_m <= fold.begin_m) | (self.start_m >= fold.end_m)
        return np.asarray(apart | (self.recording != fold.recording), np.bool_)

    def fit(self, model: MotionModel, wheels: PooledFit | None = None) -> PooledFit:
        """Return the fit of a model to the windows.

        Parameters
        ----------
        wheels : for a model with a gyro, the wheels-only model whose turn rate is combined with the turn rate of the
            gyro

        Notes
        -----
        The priors of some terms become wider if these windows show the terms (`MotionModel.with_shown_priors`).
        """
        wide_model, wide = model.with_wide_priors(), None
        if wide_model is not None:
            wide = self.fit(wide_model, wheels)
            model = model.with_shown_priors(wide)
        residual_functions = [
            residuals_of(w, model, width, wheels) for w, width in zip(self.windows, self.widths_m, strict=True)
        ]
        k, constant_count, count = len(model.terms), len(constant_std(model)), len(self.windows)
        mean, std = self.prior(model)

        def evaluate(x: Floats) -> tuple[Floats, Floats]:
            residuals, jacobian = np.empty(len(self.group)), np.empty((len(self.group), k + constant_count))
            for i, constants in enumerate(x[k:].reshape(count, constant_count)):
                residuals[self.rows(i)], jacobian[self.rows(i)] = residual_functions[i](x[:k], constants)
            return residuals, jacobian

        solution = robust_least_squares(
            evaluate, mean, mean, std, kind=self.kind, parts=Parts(self.first, constant_count if count > 1 else 0),
            overlap=self.overlap, settled=LAST_DELAY_STEP_SIGMAS,
        )  # fmt: skip
        levels = [self.group, *([self.recording] if count > 1 else [])]
        covariance = student_covariance(solution, levels)[:k, :k]
        return PooledFit(model, solution.x[:k], covariance, wheels=wheels, pool=self, wide=wide, solution=solution)
