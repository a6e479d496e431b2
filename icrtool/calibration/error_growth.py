"""How the error of a motion model grows along a path, measured on distance it was not fitted to.

The position error of a drive without GNSS has two parts. The parameters have a covariance; what it makes of the path
follows from their derivatives. What the model leaves out is described by a few sources of error with a variance each:
the heading at the start, a turn rate off by a constant, turns off by a share, a turn rate that wanders, a speed off by
a share, a speed that wanders. Their variances are fitted to the squared errors of held-out windows of several lengths,
and the quantiles are scaled so that they hold there. A controller expresses a part of the model alone: its errors are
measured in the same windows.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from itertools import product
from typing import NamedTuple, TypeVar

import numpy as np

from icrtool.calibration.held_out import HeldOut, left_out
from icrtool.errors import DataError
from icrtool.kernels.arrays import Bools, Complexes, Floats, Ints
from icrtool.kernels.track import Track
from icrtool.kernels.window_residuals import OMEGA, displacements, path_at
from icrtool.motion.models import CONTROLLER, RECOMMENDED, FittedModel, model_columns, wheel_motion
from icrtool.motion.recording import (
    NO_CONSTANTS,
    LogConstants,
    Recording,
    Windows,
    cut_windows,
    predicted_path,
    totals_of,
)
from icrtool.records.calibration_document import ControllerErrors, ErrorSources
from icrtool.records.dropout import CHOICE_HORIZON_M
from icrtool.records.plain_data import known

TWIST_OVER_M = 1.0
"""Errors of velocities are those of their means over windows of this length."""

LENGTHS_M = (2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
ALWAYS_TO_M, FEWEST_STRETCHES = 20.0, 10
"""Held-out windows of these lengths are compared; longer ones where the drives hold so many stretches of them."""

SCALED_FROM_M = 5.0
"""Errors of shorter windows are more the reference's noise than the model's; they do not scale the quantiles."""

FEWEST_WINDOWS = 20

ANGLES, BISECTIONS = 24, 26

NORMAL_STRETCHES = 10
"""That the errors are normal counts as much as so many independent stretches: quantiles of as many are as uncertain as
those of robots differ. A few windows never show that errors are smaller than normal."""

Values = TypeVar("Values", Floats, Complexes)

SOURCES = ErrorSources.__struct_fields__.index("p95_factor")


class Spread(NamedTuple):
    """Second moments of errors at the ends of windows, in the body frame of their start.

    Attributes
    ----------
    heading : (w, c) [rad^2]; xx, xy, yy : (w, c) [m^2], forward and right; c sources, or one column of all together
    """

    heading: Floats
    xx: Floats
    xy: Floats
    yy: Floats

    def combined(self, variances: Floats) -> Spread:
        """Return the moments (w, 1) for variances (c,) of the sources."""
        return Spread(*((one @ variances)[:, None] for one in self))

    def plus(self, other: Spread) -> Spread:
        """Return the moments of independent errors together."""
        return Spread(*(a + b for a, b in zip(self, other, strict=True)))


class PathErrors(NamedTuple):
    """What a model makes of windows: moved (w,) forward + j right [m], turned (w,) [rad], and moments of its errors.

    `of_parameters` has one column, `of_sources` one for each source.
    """

    moved: Complexes
    turned: Floats
    of_parameters: Spread
    of_sources: Spread


def path_errors(
    steps: Track, begin_s: Floats, end_s: Floats, fitted: FittedModel, width_m: float, own: LogConstants = NO_CONSTANTS
) -> PathErrors:
    """Return displacement and turn of windows by a model, and how errors of its parameters and of each source spread.

    Parameters
    ----------
    begin_s, end_s : (w,) times of the windows' starts and ends
    own : constants of the recording
    """
    gyro = None if steps.gyro is None else steps.gyro + own.gyro_later_s * steps.gyro_change()
    motion = wheel_motion(steps.v_left, steps.v_right, width_m, gyro)
    fixed, axes, columns = model_columns(fitted.model, fitted.complete(motion))
    fixed[OMEGA] += own.gyro_bias_radps
    # the sources act all along the path, not at the ends of windows alone
    of_start, of_end = begin_s + own.wheels_later_s, end_s + own.wheels_later_s
    at = np.unique(np.concatenate([of_start, of_end, steps.t]))
    path = path_at(steps, lambda some: (fixed[:, some], axes, columns[:, some]), fitted.parameters, at)
    s, e = np.searchsorted(at, of_start), np.searchsorted(at, of_end)
    moved, by = displacements(path, s, e)
    moved_by, turned_by = by[:-1], path.heading_by[:, e] - path.heading_by[:, s]
    of_parameters = Spread(
        *(np.einsum("kw,kl,lw->w", a, fitted.covariance, b)[:, None]
          for a, b in ((turned_by, turned_by), (moved_by.real, moved_by.real), (moved_by.real, moved_by.imag),
                       (moved_by.imag, moved_by.imag)))
    )  # fmt: skip
    turned = path.heading[e] - path.heading[s]
    return PathErrors(moved, turned, of_parameters, _source_moments(path.heading, path.place, s, e))


def _source_moments(theta: Floats, place: Complexes, s: Ints, e: Ints) -> Spread:
    """Return the moments (w, `SOURCES`) of a unit variance of each source, by sums between knots."""
    step = np.diff(place)
    length = np.concatenate([[0.0], np.cumsum(np.abs(step))])
    middle_m, middle_rad = (length[1:] + length[:-1]) / 2, (theta[1:] + theta[:-1]) / 2
    middle = (place[1:] + place[:-1]) / 2

    def between(values: Values) -> Values:
        sums = np.concatenate([np.zeros(1, values.dtype), np.cumsum(values)])
        difference: Values = sums[e] - sums[s]
        return difference

    back, went, driven = np.exp(-1j * theta[s]), place[e] - place[s], length[e] - length[s]
    by_rate = 1j * back * (between(step * middle_m) - length[s] * went)
    by_turn = 1j * back * (between(step * middle_rad) - theta[s] * went)
    constant = [
        (0.0 * driven, 1j * back * went),
        (driven, by_rate),
        (theta[e] - theta[s], by_turn),
        (0.0 * driven, back * went),
    ]
    one, first = np.abs(step), between(np.abs(step) * middle)
    zero = between(one)
    # sum of q (S_e - S_u)(S_e - S_u)^T along the path, as squared length and as the square of the complex number
    size = zero * np.abs(place[e]) ** 2 - 2.0 * (np.conj(place[e]) * first).real + between(one * np.abs(middle) ** 2)
    square = (zero * place[e] ** 2 - 2.0 * place[e] * first + between(one * middle**2)) * (1j * back) ** 2
    wander = _from_squares(driven, size, square)
    along = np.divide(step**2, one, out=np.zeros(len(step), np.complex128), where=one > 0.0)
    speed = _from_squares(0.0 * driven, zero, between(along) * back**2)
    moments = [Spread(h**2, p.real**2, p.real * p.imag, p.imag**2) for h, p in constant]
    ones, none = np.ones(len(s)), np.zeros(len(s))
    reference = [Spread(ones, none, none, none), Spread(none, ones, none, ones)]
    ordered = (*moments[:3], wander, moments[3], speed, *reference)
    return Spread(*(np.column_stack(column) for column in zip(*ordered, strict=True)))


def _from_squares(heading: Floats, size: Floats, square: Floats) -> Spread:
    """Return moments from the sums of |z|^2 and of z^2."""
    return Spread(heading, (size + square.real) / 2, square.imag / 2, (size - square.real) / 2)


def radius(spread: Spread, share: float) -> Floats:
    """Return the radius (w,) [m] that holds a share of the errors, normal with the moments (w, 1); bisection."""
    across = _directions(spread)
    low, high = np.zeros(len(across)), 6.0 * np.sqrt(across.max(axis=1))
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        with np.errstate(divide="ignore", invalid="ignore"):
            inside = 1.0 - np.nan_to_num(np.exp(-(middle[:, None] ** 2) / (2.0 * across))).mean(axis=1)
        low, high = np.where(inside < share, middle, low), np.where(inside < share, high, middle)
    return np.asarray((low + high) / 2)


def mean_error(spread: Spread) -> Floats:
    """Return the mean length (w,) [m] of errors that are normal with the moments (w, 1)."""
    return np.asarray(np.sqrt(np.pi / 2.0) * np.sqrt(_directions(spread)).mean(axis=1))


def _directions(spread: Spread) -> Floats:
    """Return the squared length (w, `ANGLES`) of a quarter of the unit circle by the square root of a covariance."""
    xx, xy, yy = spread.xx[:, 0], spread.xy[:, 0], spread.yy[:, 0]
    middle, apart = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    large, small = middle + apart, np.maximum(middle - apart, 0.0)
    angle = np.pi / 2 * (np.arange(ANGLES) + 0.5) / ANGLES
    return np.asarray(large[:, None] * np.cos(angle) ** 2 + small[:, None] * np.sin(angle) ** 2)


def cut_error_windows(recordings: Sequence[Recording]) -> list[tuple[int, Recording, Windows]]:
    """Return windows of `LENGTHS_M` and `TWIST_OVER_M`, with number and recording; short recordings have none."""
    pooled, found = totals_of(*recordings), []
    for i, recording in enumerate(recordings):
        with suppress(DataError):
            found.append((i, recording, cut_windows(recording, (TWIST_OVER_M, *LENGTHS_M), pooled)))
    return found


def measure_error_sources(
    cut: Sequence[tuple[int, Recording, Windows]], table: HeldOut, name: str
) -> ErrorSources | None:
    """Return the sources of error of a row of a held-out table, from windows of what it was not fitted to.

    Parameters
    ----------
    cut : of `cut_error_windows`

    Returns
    -------
    None where too few windows were left out.

    Notes
    -----
    Non-negative least squares of the squared errors, each length and direction with the same weight; the factors are
    those of split conformal prediction (Vovk et al. 2005), a window of 10 m counted as independent, shrunk towards one
    in their logarithm (James and Stein 1961): one short drive shows its largest error, not a quantile.
    """
    stretches: Counter[float] = Counter()
    found: list[tuple[Floats, PathErrors, Floats, Complexes]] = []
    for i, recording, windows in cut:
        begin, end = windows.knot_t[windows.start], windows.knot_t[windows.end]
        tested = np.zeros(len(begin), np.bool_)
        for fold, of_fold in left_out(table.folds, i, windows.start_m, windows.end_m):
            some = of_fold[windows.length_m[of_fold] >= LENGTHS_M[0]]
            if not len(some) or (predicted := table.without(name, fold)) is None:
                continue
            fitted, own = predicted
            steps = windows.steps.around(begin[some].min(), end[some].max())
            errors = path_errors(steps, begin[some], end[some], fitted, recording.width_m, own)
            reference = np.exp(-1j * own.heading_offset_rad) * windows.reference[some]
            turn = errors.turned - windows.turned[some]
            found.append((windows.length_m[some], errors, turn, errors.moved - reference))
            tested[some] = True
        for metres in LENGTHS_M:
            starts = windows.start_m[tested & (windows.length_m == metres)]
            stretches[metres] += len(np.unique(np.floor(starts / metres)))
    measured_to_m = max(one for one in LENGTHS_M if one <= ALWAYS_TO_M or stretches[one] >= FEWEST_STRETCHES)
    length = np.concatenate([one[0] for one in found]) if found else np.empty(0)
    used = length <= measured_to_m
    length = length[used]
    if np.count_nonzero(length >= SCALED_FROM_M) < FEWEST_WINDOWS:
        return None
    sources = _stacked([one[1].of_sources for one in found], used)
    known = _stacked([one[1].of_parameters for one in found], used)
    turned, missed = (np.concatenate([one[k] for one in found])[used] for k in (2, 3))
    variances = _fit_variances(length, sources, known, turned, missed)
    spread, far = sources.combined(variances).plus(known), length >= SCALED_FROM_M
    error, count = np.abs(missed)[far], max(stretches[CHOICE_HORIZON_M], 1)
    level = min(95.0 * (1.0 + 1.0 / count), 100.0)
    share = np.percentile(error / np.maximum(radius(spread, 0.95)[far], 1e-9), level)
    mean = error.mean() / max(float(mean_error(spread)[far].mean()), 1e-9)
    # measured over normal: the fewer stretches show it, the nearer to normal
    factors = np.maximum([share, mean], [1.0, 1e-9]) ** (count / (count + NORMAL_STRETCHES))
    return ErrorSources(*(*variances.tolist(), *factors.tolist(), measured_to_m))


def _stacked(parts: Sequence[Spread], used: Bools) -> Spread:
    return Spread(*(np.concatenate(column)[used] for column in zip(*parts, strict=True)))


def _fit_variances(length: Floats, sources: Spread, known: Spread, turned: Floats, missed: Complexes) -> Floats:
    """Return the variances (`SOURCES`,) that make the squared errors of windows, beside those of the parameters."""
    matrix, y = np.zeros((SOURCES, SOURCES)), np.zeros(SOURCES)
    kinds = (
        (sources.heading, known.heading, turned**2),
        (sources.xx, known.xx, missed.real**2),
        (sources.yy, known.yy, missed.imag**2),
    )
    for metres in np.unique(length):
        rows = length == metres
        for columns, of_parameters, squared in kinds:
            weight = 1.0 / max(float(squared[rows].mean()), 1e-12)
            scaled = weight * columns[rows]
            matrix += scaled.T @ scaled / np.count_nonzero(rows)
            y += scaled.T @ (weight * (squared[rows] - of_parameters[rows, 0])) / np.count_nonzero(rows)
    return nonnegative(matrix, y)


def nonnegative(matrix: Floats, y: Floats) -> Floats:
    """Return x >= 0 (n,) that minimises x matrix x / 2 - y x; matrix is positive semidefinite, n is small.

    Notes
    -----
    Of all 2^n choices of which values are above zero, the best solution without a negative value.
    """
    size = np.sqrt(np.maximum(np.diag(matrix), np.finfo(np.float64).tiny))
    scaled, target = matrix / np.outer(size, size), y / size
    above = np.array(list(product((0.0, 1.0), repeat=len(y))))
    parts = scaled * above[:, :, None] * above[:, None, :]
    x = above * (np.linalg.pinv(parts, hermitian=True) @ (above * target)[:, :, None])[:, :, 0]
    cost = np.einsum("si,ij,sj->s", x, scaled, x) / 2.0 - x @ target
    cost[(x < 0.0).any(axis=1)] = np.inf
    found: Floats = x[np.argmin(cost)] / size
    return found


SMALLEST_VARIANCE = 1e-6
FEWEST_TESTED = 10
"""A controller is given errors from so many windows at least."""


def measure_controller_errors(cut: Sequence[tuple[int, Recording, Windows]], table: HeldOut) -> ControllerErrors | None:
    """Return the errors of what a controller can express, fitted without each fold, in that fold.

    Parameters
    ----------
    cut : of `cut_error_windows`

    Returns
    -------
    None where too few windows were left out.
    """
    far, near = (_window_errors(cut, length, table) for length in (CHOICE_HORIZON_M, TWIST_OVER_M))
    if min(len(far), len(near)) < FEWEST_TESTED or CHOICE_HORIZON_M not in table.horizons_m:
        return None
    h = table.horizons_m.index(CHOICE_HORIZON_M)
    return ControllerErrors(
        pose_variance=_variances(far[:, :3]),
        twist_variance=_variances(near[:, :3] / near[:, 3:4]),
        turn_noise=_shares(near[:, 2], near[:, 4], near[:, 5]),
        way_noise=_shares(np.hypot(near[:, 0], near[:, 1]), near[:, 5], near[:, 4]),
        p95_m=known(float(table.score(CONTROLLER).together.p95[h])),
        full_p95_m=known(float(table.score(RECOMMENDED).together.p95[h])),
    )


def _window_errors(cut: Sequence[tuple[int, Recording, Windows]], length_m: float, table: HeldOut) -> Floats:
    """Return (m, 6): error along, across [m] and in heading [rad], duration [s], turn [rad], length [m] of windows."""
    rows = [np.empty((0, 6))]
    for i, recording, windows in cut:
        these = np.flatnonzero(windows.length_m == length_m)
        for fold, some in left_out(table.folds, i, windows.start_m[these], windows.end_m[these]):
            if (found := table.without(CONTROLLER, fold)) is not None:
                rows.append(_fold_errors(recording, windows, these[some], *found))
    return np.concatenate(rows)


def _fold_errors(
    recording: Recording, windows: Windows, some: Ints, fitted: FittedModel, own: LogConstants
) -> Floats:  # fmt: skip
    """Return the errors of some windows (m,) by a model that was not fitted to them."""
    s, e = windows.start[some], windows.end[some]
    begin, finish = windows.knot_t[s], windows.knot_t[e]
    path = predicted_path(recording, fitted, own, windows.steps.around(begin.min(), finish.max()))
    (theta, turned), (place, moved) = (np.split(one, 2) for one in path(np.append(begin, finish)))
    error = np.exp(-1j * theta) * (moved - place) - windows.reference[some]
    turn = windows.turned[some]
    columns = error.real, error.imag, turned - theta - turn, finish - begin, turn, windows.length_m[some]
    return np.column_stack(columns)


def _variances(errors: Floats) -> tuple[float, float, float]:
    """Return mean squares (3,), never zero."""
    along, across, heading = (max(float(value), SMALLEST_VARIANCE) for value in (errors**2).mean(axis=0))
    return along, across, heading


def _shares(miss: Floats, first: Floats, second: Floats) -> tuple[float, float]:
    """Return a, b >= 0 with miss^2 about a first^2 + b second^2, by least squares."""
    columns = np.column_stack([first**2, second**2])
    both = np.maximum(nonnegative(columns.T @ columns, columns.T @ miss**2), SMALLEST_VARIANCE)
    return float(both[0]), float(both[1])
