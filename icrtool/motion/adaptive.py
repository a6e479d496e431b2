"""A motion model that learns from the past of a drive, on a robot and as row ``adaptive`` of a report.

The model begins with a prior from a calibration or from other robots. Each window of driven distance that has ended is
added to the normal equations, with the terms, residuals, weights and priors of `icrtool.motion.window_fit`.
Gauss-Newton steps give the next solution. On the first `REBUILT_TO_M` of a drive, the normal equations are also
computed anew from time to time, because the first windows were linearised far from the later solution.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.elimination import normal_equations
from icrtool.kernels.robust import robust_weights, scale_by_kind
from icrtool.kernels.track import Windows
from icrtool.kernels.window_residuals import OMEGA
from icrtool.motion.drive_buffer import LARGEST_ADVANCE_M, DriveBuffer
from icrtool.motion.models import GYRO_TERMS, MODELS, RECOMMENDED, TERMS, FittedModel, MotionModel, wheel_motion
from icrtool.motion.recording import NO_CONSTANTS, LogConstants, size_of
from icrtool.motion.window_fit import (
    RESIDUAL_KINDS,
    UNKNOWN_CONSTANTS,
    KnownConstants,
    Residuals,
    constant_std,
    heading_wander,
    residuals_of,
)

WINDOWS_AS_ONE = 80.0
"""Number of windows that count as one independent window. A stretch of 20 m has 120 windows, and the information of one
to two independent windows."""

GAUSS_NEWTON_STEPS = 3
"""Number of Gauss-Newton steps from one solution to the next."""

SHARE_OF_DISTANCE = 0.02
"""Distance between two solutions, as a share of the driven distance."""

SHORTEST_M, LONGEST_M = 0.5, 6.0
"""Shortest and longest distance between two solutions [m]."""

REBUILT_SHARE = 0.3
"""Growth of the driven distance after which all windows are linearised anew, as a share of the distance."""

REBUILT_TO_M = 150.0
"""Driven distance up to which all windows are linearised anew [m]."""

SETTLE_S = 0.5
"""Time from the end of a window to its use [s]. The wheels may be read up to `LARGEST_DELAY_S` later than the poses."""

LARGEST_DELAY_S = 0.4
"""Largest delay between wheels and poses [s], four standard deviations of its prior."""

FEWEST_FOR_WANDER = 60
"""Smallest number of windows from which the wander of the heading is estimated. With fewer windows, the estimate would
be the error of the prior."""

USUAL_STD = (0.02, 0.02)
"""Assumed standard deviations of residuals before a drive, of displacements [m^0.5] and of turns [rad/m^0.5]. With
0.03, the expected error after 10 m is 3 % larger on 18 simulated robots of which nothing is known."""

USUAL_COUNTS_AS = 4.0
"""Number of independent windows that `USUAL_STD` counts as. The first windows are fitted almost exactly, so their
residuals do not show the standard deviation."""

MOST_PENDING = 1000
"""Largest number of pending samples. While a robot stands, samples are pending until this number is reached."""

WHEELS_MODEL, TURNED_MODEL = MODELS[RECOMMENDED], MODELS[RECOMMENDED].with_gyro()
"""The models with wheels alone, and with wheels and gyro."""

SHARED_TERMS = [name for name in WHEELS_MODEL.terms if name in TURNED_MODEL.terms]
"""Names of the terms that both models have."""

SHARED_OF_WHEELS, SHARED_OF_TURNED = (
    [model.terms.index(name) for name in SHARED_TERMS] for model in (WHEELS_MODEL, TURNED_MODEL)
)
"""Places of the common terms in the model without a gyro, and in the model with a gyro."""


@dataclass(frozen=True)
class TermsPrior:
    """The prior of a robot before a drive: mean and covariance of the terms of model `RECOMMENDED`.

    Attributes
    ----------
    width_m : track width b that the terms refer to [m]
    mean, covariance : (8,), (8, 8)
    turned_mean, turned_covariance : of the terms of the model with a gyro (6,), (6, 6)
    source : source of the prior, in a few words
    constants, turned_constants : prior of the drive's constants, with wheels alone and with a gyro
    """

    width_m: float
    mean: Floats
    covariance: Floats
    turned_mean: Floats
    turned_covariance: Floats
    source: str = ""
    constants: KnownConstants = UNKNOWN_CONSTANTS
    turned_constants: KnownConstants = UNKNOWN_CONSTANTS

    @classmethod
    def of_wheels(cls, width_m: float, mean: Floats, covariance: Floats, source: str = "") -> TermsPrior:
        """Return a prior from the terms without a gyro; the terms of the gyro have their usual prior."""
        gyro_std = np.array([TERMS[name].std for name in GYRO_TERMS])
        k = len(SHARED_OF_WHEELS)
        turned_mean, turned = np.zeros(k + len(gyro_std)), np.zeros((k + len(gyro_std), k + len(gyro_std)))
        turned_mean[SHARED_OF_TURNED] = mean[SHARED_OF_WHEELS]
        turned[np.ix_(SHARED_OF_TURNED, SHARED_OF_TURNED)] = covariance[np.ix_(SHARED_OF_WHEELS, SHARED_OF_WHEELS)]
        turned[range(k, k + len(gyro_std)), range(k, k + len(gyro_std))] = gyro_std**2
        return cls(width_m, mean, covariance, turned_mean, turned, source)


class Learned(NamedTuple):
    """The model and constants that are known from a time of a drive on.

    Attributes
    ----------
    t_s : the time [s]; distance_m : distance driven until then
    fitted, constants : the model with wheels alone, and the constants of the drive for this model
    turned, turned_constants : the model with a gyro, and its constants; the model is None without a gyro
    """

    t_s: float
    distance_m: float
    fitted: FittedModel
    constants: LogConstants
    turned: FittedModel | None = None
    turned_constants: LogConstants = NO_CONSTANTS


class Estimate:
    """Parameters of a model and constants of a drive, with the normal equations of the windows that have ended.

    Attributes
    ----------
    x : (k + c,) parameters, then `LogConstants`
    mean, prior : (k + c,), (k + c, k + c) mean and information before the drive
    pull : (k + c,) product of information and mean before the drive
    matrix, vector : (k + c, k + c), (k + c,) of the data: x solves (prior + matrix) x = pull + vector
    scale : (2,) robust standard deviation of the residuals of displacements and turns
    wander : growth of the variance of the heading for each metre [rad^2/m]
    fitted, constants : x as a model and constants, for predictions
    """

    def __init__(
        self, model: MotionModel, width_m: float, mean: Floats, covariance: Floats, constants: KnownConstants
    ) -> None:
        self.model, self.width_m = model, width_m
        constant_count, k = len(constant_std(model)), len(model.terms)
        self.mean = np.concatenate([mean, constants.mean[:constant_count]])
        self.prior = np.diag(np.concatenate([np.zeros(k), np.array(constants.std[:constant_count]) ** -2.0]))
        self.prior[:k, :k] = np.linalg.inv(covariance)
        self.pull = self.prior @ self.mean
        self.matrix, self.vector = np.zeros_like(self.prior), np.zeros_like(self.mean)
        self.x, self.scale, self.wander = self.mean, np.array(USUAL_STD), 0.0
        self.fitted, self.constants = (
            FittedModel(model, mean, covariance),
            LogConstants(*constants.mean[:constant_count]),
        )

    def solve_anew(self, windows: Windows, wheels: FittedModel | None = None) -> None:
        """Solve with all windows that have ended, linearised at every step; `wheels` as in `residuals_of`."""
        kind = np.repeat(RESIDUAL_KINDS, len(windows.begin))
        few = len(windows.begin) < FEWEST_FOR_WANDER
        evaluate = residuals_of(windows, self.model, self.width_m, wheels, 0.0 if few else None)
        residuals, target, jacobian = self._linearised(evaluate)
        for step in range(GAUSS_NEWTON_STEPS):
            if step:
                residuals, target, jacobian = self._linearised(evaluate)
            self.scale = _scale_of(residuals, kind)
            self._step(*self._equations(target, jacobian, kind))
        self.matrix, self.vector = self._equations(target, jacobian, kind)
        if not few:
            turns = (jacobian @ self.x - target)[kind == RESIDUAL_KINDS[-1]]
            self.wander = heading_wander(turns * np.sqrt(windows.length_m), windows.length_m)
        self._finish(wheels)

    def solve_with(self, windows: Windows, wheels: FittedModel | None = None) -> None:
        """Solve with some further windows, linearised at the last solution; `wheels` as in `residuals_of`."""
        kind = np.repeat(RESIDUAL_KINDS, len(windows.begin))
        evaluate = residuals_of(windows, self.model, self.width_m, wheels, self.wander)
        _, target, jacobian = self._linearised(evaluate)
        for _ in range(GAUSS_NEWTON_STEPS):
            matrix, vector = self._equations(target, jacobian, kind)
            self._step(self.matrix + matrix, self.vector + vector)
        matrix, vector = self._equations(target, jacobian, kind)
        self.matrix, self.vector = self.matrix + matrix, self.vector + vector
        self._finish(wheels)

    def _linearised(self, evaluate: Residuals) -> tuple[Floats, Floats, Floats]:
        """Return residuals (m,) at `x`, and target (m,) and J (m, k + c) of the residuals near it, J x - target."""
        k = len(self.model.terms)
        residuals, jacobian = evaluate(self.x[:k], self.x[k:])
        return residuals, jacobian @ self.x - residuals, jacobian

    def _equations(self, target: Floats, jacobian: Floats, kind: Ints) -> tuple[Floats, Floats]:
        """Return matrix and vector of the normal equations of linearised residuals, weighted at `x`."""
        weights = robust_weights(jacobian @ self.x - target, self.scale[kind], WINDOWS_AS_ONE)
        return normal_equations(target, jacobian, weights)

    def _step(self, matrix: Floats, vector: Floats) -> None:
        """Replace x by the solution of the normal equations of prior and data."""
        x = np.linalg.solve(self.prior + matrix, self.pull + vector)
        delay = len(self.model.terms) + LogConstants._fields.index("wheels_later_s")
        x[delay] = np.clip(x[delay], -LARGEST_DELAY_S, LARGEST_DELAY_S)
        if np.isfinite(x).all():
            self.x = x

    def _finish(self, wheels: FittedModel | None) -> None:
        """Set model and constants from x; `wheels` as in `residuals_of`."""
        k = len(self.model.terms)
        covariance = np.linalg.inv(self.prior + self.matrix)[:k, :k]
        self.fitted = FittedModel(self.model, self.x[:k], covariance, wheels)
        self.constants = LogConstants(*self.x[k:].tolist())


def _scale_of(residuals: Floats, kind: Ints) -> Floats:
    """Return the robust standard deviation (2,) of the residuals of each kind, pooled with `USUAL_STD`."""
    count = len(kind) / len(RESIDUAL_KINDS) / WINDOWS_AS_ONE
    scales = scale_by_kind(residuals, kind)[[0, -1]]
    together = (count * scales**2 + USUAL_COUNTS_AS * np.square(USUAL_STD)) / (count + USUAL_COUNTS_AS)
    return np.asarray(np.sqrt(together))


class AdaptiveModel:
    """A motion model that starts from a prior and learns from the samples of a drive when they come.

    Frames and signs follow `icrtool`: x forward, y right, turns clockwise. The model needs only NumPy and some
    kilobytes of memory, and opens no file or log.

    Parameters
    ----------
    prior : result of `icrtool.Calibration.prior` or `icrtool.prior_of_robots`
    with_gyro : compute the turn rate from gyro and wheels; each sample then needs the turn rate of the gyro

    Attributes
    ----------
    distance_m : distance driven until the last sample
    """

    def __init__(self, prior: TermsPrior, *, with_gyro: bool = False) -> None:
        self.prior, self.with_gyro, self.distance_m = prior, with_gyro, 0.0
        size = size_of(prior.width_m)
        self._drive, self._longest_m = DriveBuffer(size), LARGEST_ADVANCE_M * size
        self._wheels = Estimate(WHEELS_MODEL, prior.width_m, prior.mean, prior.covariance, prior.constants)
        self._turned = None
        if with_gyro:
            terms = prior.turned_mean, prior.turned_covariance
            turned = Estimate(TURNED_MODEL, prior.width_m, *terms, prior.turned_constants)
            turned.fitted = FittedModel(turned.model, prior.turned_mean, prior.turned_covariance, self._wheels.fitted)
            self._turned = turned
        self._used, self._next_m, self._next_anew_m = 0, SHORTEST_M * size, 0.0
        self._pending: list[tuple[float, ...]] = []
        self._last: tuple[float, float, float] | None = None
        self._begin_s: float | None = None

    @property
    def now(self) -> Learned:
        """The model and constants that are known now."""
        wheels_estimate, gyro_estimate = self._wheels, self._turned
        time_s = self._last[0] if self._last is not None else 0.0
        if gyro_estimate is None:
            return Learned(time_s, self.distance_m, wheels_estimate.fitted, wheels_estimate.constants)
        return Learned(
            time_s,
            self.distance_m,
            wheels_estimate.fitted,
            wheels_estimate.constants,
            gyro_estimate.fitted,
            gyro_estimate.constants,
        )

    def observe(
        self, t_s: float, v_left: float, v_right: float, pose: Sequence[float] | None = None, gyro_radps: float = 0.0,
        *, broken: bool = False, gap: bool = False,
    ) -> bool:  # fmt: skip
        """Take one sample; return whether the parameters changed.

        Parameters
        ----------
        t_s : time of the sample, of any clock, ascending
        v_left, v_right : wheel speeds [m/s] at the configured radius, which hold until the next sample
        pose : north, east [m] and heading [rad] of the reference at this time; None without a pose (no GNSS)
        gyro_radps : turn rate of the gyro, clockwise
        broken : the robot slips or the reference jumps before the next sample, so that no window crosses this interval
        gap : wheel samples were lost before the next sample
        """
        begin = self._begin_s = t_s if self._begin_s is None else self._begin_s
        north, east, heading = (np.nan, np.nan, np.nan) if pose is None else pose
        time_s = t_s - begin
        before = self.distance_m
        if self._last is not None:
            since, speed, unknown = self._last
            advance = abs(speed) * (time_s - since)
            if not unknown and time_s >= since and advance <= self._longest_m:
                self.distance_m += advance
        self._last = time_s, (v_left + v_right) / 2.0, float(gap)
        self._pending.append(
            (time_s, v_left, v_right, north, east, heading, gyro_radps, pose is not None, float(broken), float(gap))
        )
        every = self._drive.every_m
        if math.floor(self.distance_m / every) == math.floor(before / every) and len(self._pending) < MOST_PENDING:
            return False
        samples, self._pending = np.array(self._pending, np.float64).T, []
        return bool(self._take(samples))

    def observe_all(self, samples: Floats) -> list[Learned]:
        """Take many samples (10, n), in rows `icrtool.motion.drive_buffer.SampleRow`; return all learned models.

        Notes
        -----
        The result is the same as with `observe` for each sample. Times count from the first sample.
        """
        if self._begin_s is None:
            self._begin_s = 0.0
        rows_taken = self._take(samples)
        self.distance_m = self._drive.distance_m
        self._last = float(samples[0, -1]), float(samples[1, -1] + samples[2, -1]) / 2.0, float(samples[-1, -1])
        return rows_taken

    def twist(self, v_left: Floats | float, v_right: Floats | float, gyro_radps: Floats | float = 0.0) -> Floats:
        """Return the body twist v_x, v_y [m/s], omega [rad/s] of wheel speeds [m/s], (3,) or (3, n), as known now.

        Parameters
        ----------
        v_left, v_right : at the configured wheel radius; gyro_radps : turn rate of the gyro, for a model with a gyro

        Notes
        -----
        x forward, y right, omega clockwise; for REP-103 (y left, counter-clockwise) negate v_y and omega.
        """
        left, right = np.atleast_1d(np.asarray(v_left, np.float64)), np.atleast_1d(np.asarray(v_right, np.float64))
        estimate = self._wheels if self._turned is None else self._turned
        gyro = np.broadcast_to(np.asarray(gyro_radps, np.float64), left.shape)
        twist = estimate.fitted.twist(wheel_motion(left, right, self.prior.width_m, gyro))
        twist[OMEGA] += estimate.constants.gyro_bias_radps
        return twist[:, 0] if np.ndim(v_left) == 0 else twist

    def _take(self, samples: Floats) -> list[Learned]:
        """Take samples, and solve at each knot at which a new solution is due; return all learned models."""
        rows_taken = []
        for knot in range(self._drive.take(samples), self._drive.count):
            at_m, size = knot * self._drive.every_m, self._drive.size
            if at_m < self._next_m:
                continue
            self._next_m = at_m + float(np.clip(SHARE_OF_DISTANCE * at_m, SHORTEST_M * size, LONGEST_M * size))
            if self._solve(knot, at_m):
                rows_taken.append(self.now._replace(t_s=self._drive.time_of(knot), distance_m=at_m))
        if self._drive.distance_m > REBUILT_TO_M * self._drive.size:
            self._drive.forget_until(self._used)
        return rows_taken

    def _solve(self, knot: int, at_m: float) -> bool:
        """Solve with the windows that have ended at a knot; return whether there were new windows."""
        last = self._drive.last_by(self._drive.time_of(knot) - SETTLE_S)
        windows = self._drive.windows(self._used, last, knot)
        self._used = max(self._used, last + 1)
        if windows is None:
            return False
        if anew := self._next_anew_m <= at_m <= REBUILT_TO_M * self._drive.size:
            self._next_anew_m = (1.0 + REBUILT_SHARE) * at_m
            windows = self._drive.windows(0, last, knot) or windows
        wheels: FittedModel | None = None
        for estimate in (self._wheels, self._turned):
            if estimate is not None:
                solve = estimate.solve_anew if anew else estimate.solve_with
                solve(windows, wheels)
                wheels = estimate.fitted
        return True
