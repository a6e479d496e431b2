"""Errors of motion models on recordings, or on parts of one recording, that the models were not fitted to.

Each of several recordings is left out in turn (Stone 1974). In a single recording, each trial is predicted by a fit
without the windows that share distance with the trial (Burman, Chow and Nolan 1994). On recorded drives, a further
distance of 5 or 10 m between the trial and the windows of the fit changed no error.

Held-out windows of several lengths also show how the errors of a model grow (`icrtool.calibration.error_growth`). The
quantiles are scaled so that they hold in these windows. The errors of the controller's model are measured in these
windows, too.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from icrtool.calibration import error_growth
from icrtool.errors import DataError
from icrtool.kernels.arrays import Complexes, Floats, Ints
from icrtool.kernels.error_statistics import Summary, error_summary, within_budget
from icrtool.kernels.track import OpenLoopPath, Track, Windows
from icrtool.motion.models import CONTROLLER, FIVE, MODELS, NO_SLIP, RECOMMENDED, controller_model
from icrtool.motion.recording import (
    NO_CONSTANTS,
    Recording,
    TrialErrors,
    Trials,
    cut_trials,
    cut_windows,
    predicted_path,
    totals_of,
    trial_errors,
)
from icrtool.motion.window_fit import FEWEST_RESIDUALS, Fold, Pool, PooledFit, Prediction
from icrtool.records.acceptance import CHOICE_HORIZON_M, BudgetDistance
from icrtool.records.calibration_document import ControllerErrors, ErrorSources
from icrtool.records.plain_data import finite_or_none

HELD_OUT_HORIZONS_M = (5.0, 10.0, 20.0)
"""Distances of the held-out trials [m]."""

SHORTEST_BLOCK_M, FEWEST_FOLD_BLOCKS, MOST_FOLD_BLOCKS = 25.0, 3, 5
"""Shortest block of distance of a single drive [m], and smallest and largest number of blocks."""

STRIP_M = 5.0
"""Shortest strip of distance [m]. To save time, one fit predicts all trials that begin in one strip and end in
another."""

MOST_STRIPS = 2
"""Largest number of strips in a block."""

HELD_OUT = (NO_SLIP, CONTROLLER, RECOMMENDED)
"""Names of the rows of a held-out table. The name of a row with a gyro ends in ``_gyro``."""

GYRO_SUFFIX = "_gyro"
"""End of the name of a row with a gyro."""

TOO_SHORT = "too short to fit on one part and test on another"
"""Consequence of a drive that is too short, for errors."""

TWIST_OVER_M = 1.0
"""Length of the windows in which errors of velocities are measured [m]."""

LENGTHS_M = (2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
"""Lengths of the windows that show how errors grow [m]."""

ALWAYS_TO_M = 20.0
"""Length up to which held-out windows are always compared [m]."""

FEWEST_STRETCHES = 10
"""Number of separate stretches of a longer length that the drives must hold. With fewer, the length is not compared."""

SCALED_FROM_M = 5.0
"""Shortest windows that scale the quantiles [m]. In shorter windows the reference's noise exceeds the model's error."""

FEWEST_HELD_OUT_WINDOWS = 20
"""Number of windows of `SCALED_FROM_M` or more below which the growth of errors is not measured."""

NORMAL_STRETCHES = 10
"""Number of independent stretches that the assumption of normal errors counts as.

The measured quantile of n stretches has the weight n / (n + 10), because the uncertainty of a quantile of 10 stretches
equals the spread of this quantile between robots."""

SMALLEST_VARIANCE = 1e-6
"""Smallest variance that is stated to a controller, in the square of its unit."""

FEWEST_TESTED = 10
"""Number of held-out windows below which the errors of a controller are not stated."""


@dataclass(frozen=True, slots=True)
class HeldOutRow:
    """Errors of one model in trials that it was not fitted to.

    Attributes
    ----------
    name : name of the row
    folds : errors in each fold, by horizon; together : errors in all trials
    """

    name: str
    folds: tuple[Summary, ...]
    together: Summary

    def within(self, horizons_m: Sequence[float], budget_m: float) -> BudgetDistance | None:
        """Return the distance up to which p95 of all trials stays within a budget [m]; None without trials."""
        reached = within_budget(np.array(horizons_m), self.together.p95, budget_m)
        return None if reached is None else BudgetDistance(self.name, budget_m, *reached)

    def worst(self, column: str, h: int) -> float:
        """Return the largest ``p95`` or ``expected`` [m] of the folds at horizon number `h`; NaN without trials."""
        values = np.array([getattr(fold, column)[h] for fold in self.folds])
        values = values[np.isfinite(values)]
        return float(values.max()) if len(values) else float("nan")


@dataclass(frozen=True)
class HeldOut:
    """Fits of the motion models to recordings, and their predictions without each fold.

    Attributes
    ----------
    recordings : the recordings
    horizons_m : distances of the trials [m]
    folds : the recordings; of a single recording, its blocks of distance
    trials : trials of each recording
    fits : fits to all recordings together, by the name of the model
    """

    recordings: tuple[Recording, ...]
    horizons_m: tuple[float, ...]
    folds: tuple[Fold, ...]
    trials: tuple[Trials, ...]
    fits: dict[str, PooledFit]

    @cached_property
    def scores(self) -> tuple[HeldOutRow, ...]:
        """Errors in the trials of all recordings, a row for each model."""
        fold_of = []
        for i, (trials, recording) in enumerate(zip(self.trials, self.recordings, strict=True)):
            own_folds = [fold for fold in self.folds if fold.recording == i]
            edges = [fold.end_m for fold in own_folds[:-1]]
            start_m = recording.track.distance[trials.starts]
            fold_of.append(own_folds[0].number + np.searchsorted(edges, start_m, side="right"))
        first = np.searchsorted(np.concatenate(fold_of), np.arange(1, len(self.folds)))
        scores = []
        for name in self.rows:
            errors = np.concatenate([self.errors(name, i, trials).position for i, trials in enumerate(self.trials)])
            by_fold = tuple(error_summary(fold_errors) for fold_errors in np.split(errors, first))
            scores.append(HeldOutRow(name, by_fold, error_summary(errors)))
        return tuple(scores)

    @cached_property
    def error_windows(self) -> tuple[tuple[int, Windows], ...]:
        """Number of each recording, and its windows of `LENGTHS_M` and `TWIST_OVER_M`; short recordings have none."""
        pooled, windows = totals_of(*self.recordings), []
        for i, recording in enumerate(self.recordings):
            with suppress(DataError):
                windows.append((i, cut_windows(recording, (TWIST_OVER_M, *LENGTHS_M), pooled)))
        return tuple(windows)

    @property
    def has_gyro(self) -> bool:
        """Whether there are rows with a gyro, because every recording has a gyro."""
        return f"{RECOMMENDED}{GYRO_SUFFIX}" in self.fits

    @property
    def rows(self) -> tuple[str, ...]:
        """The names of the rows of the table."""
        gyro_rows = [f"{name}{GYRO_SUFFIX}" for name in HELD_OUT] if self.has_gyro else []
        return (*HELD_OUT, *gyro_rows)

    def score(self, name: str) -> HeldOutRow:
        """Return the row of this name."""
        return next(score for score in self.scores if score.name == name)

    def fit_without(self, name: str, fold: Fold) -> Prediction | None:
        """Return the model and constants of a row, fitted without a fold; None if too little data are left."""
        if name == NO_SLIP:
            return self.fits[NO_SLIP].fitted, NO_CONSTANTS
        base = name.removesuffix(GYRO_SUFFIX)
        if base != CONTROLLER:
            return self.fits[name].fit_without(fold)
        if (solution := self.fits[name.replace(CONTROLLER, FIVE)].fit_without(fold)) is None:
            return None
        recording = self.recordings[fold.recording]
        return controller_model(solution[0], recording.lever, recording.width_m), solution[1]

    def errors(self, name: str, i: int, trials: Trials) -> TrialErrors:
        """Return the errors (k, h) of a row in trials of recording i, each predicted without the fold it touches."""
        steps = self.fits[RECOMMENDED].pool.windows[i].track
        return errors_without(self.recordings[i], trials, self.folds, i, partial(self.fit_without, name), steps)

    def path(self, name: str, i: int, start: int, end: int) -> OpenLoopPath | None:
        """Return the path of a row between two states of recording i, predicted without the fold that it touches.

        None if too little data are left for a fit.
        """
        recording = self.recordings[i]
        ends = (recording.track.distance[row : row + 1] for row in (start, end))
        ((fold, _),) = left_out(self.folds, i, *ends)
        if (prediction := self.fit_without(name, fold)) is None:
            return None
        return path_between(recording, prediction, self.fits[RECOMMENDED].pool.windows[i].track, start, end)


def path_between(recording: Recording, prediction: Prediction, steps: Track, start: int, end: int) -> OpenLoopPath:
    """Return the path that a model predicts between two states of a recording.

    `steps` is the track of the recording with joined wheel samples.
    """
    track, rows = recording.track, np.arange(start, end + 1)
    span_steps = steps.around(track.t[start], track.t[end])
    heading_rad, position = predicted_path(recording, *prediction, span_steps)(track.t[rows])
    turn = track.heading[start] - heading_rad[0]
    moved = np.exp(1j * turn) * (position - position[0])
    return OpenLoopPath(track.north[start] + moved.real, track.east[start] + moved.imag, heading_rad + turn)


def plan_folds(recordings: Sequence[Recording]) -> tuple[Fold, ...]:
    """Return the folds that are left out in turn: the recordings, or contiguous blocks of a single recording.

    Raises
    ------
    DataError
        A single recording is shorter than two trials of `CHOICE_HORIZON_M`.
    """
    if len(recordings) > 1:
        return tuple(Fold(recording.name, i, i, -np.inf, np.inf) for i, recording in enumerate(recordings))
    total = float(recordings[0].track.distance[-1])
    if total < 2.0 * CHOICE_HORIZON_M:
        raise DataError(recordings[0].name, f"{total:.1f} m of driven distance", TOO_SHORT)
    count = int(np.clip(total // SHORTEST_BLOCK_M, FEWEST_FOLD_BLOCKS, MOST_FOLD_BLOCKS))
    edges = np.linspace(0.0, total, count + 1).tolist()
    return tuple(Fold(f"block {i + 1}", i, 0, edges[i], edges[i + 1]) for i in range(count))


def left_out(folds: Sequence[Fold], recording: int, start_m: Floats, end_m: Floats) -> Iterator[tuple[Fold, Ints]]:
    """Yield each fold that must be left out to predict trials of a recording, and the rows of these trials.

    Parameters
    ----------
    folds : result of `plan_folds`
    recording : number of the recording
    start_m, end_m : (k,) path lengths at the starts and ends of the trials [m]
    """
    if not len(start_m):
        return
    own_folds = [fold for fold in folds if fold.recording == recording]
    if own_folds[0].whole:
        yield own_folds[0], np.arange(len(start_m))
        return
    block_m = own_folds[0].end_m
    strips_a_block = int(np.clip(block_m // STRIP_M, 1, MOST_STRIPS))
    strip_m, last = block_m / strips_a_block, strips_a_block * len(own_folds) - 1
    start_strip, end_strip = (np.minimum((path_m / strip_m).astype(np.int64), last) for path_m in (start_m, end_m))
    pair = start_strip * (last + 1) + end_strip
    order = np.argsort(pair, kind="stable")
    pairs, first = np.unique(pair[order], return_index=True)
    for pair_number, rows in zip(pairs.tolist(), np.split(order, first[1:]), strict=True):
        a, b = divmod(pair_number, last + 1)
        block = own_folds[a // strips_a_block]
        yield block._replace(begin_m=a * strip_m, end_m=(b + 1) * strip_m), rows


def errors_without(
    recording: Recording, trials: Trials, folds: Sequence[Fold], i: int, without: Callable[[Fold], Prediction | None],
    steps: Track | None = None,
) -> TrialErrors:  # fmt: skip
    """Return the errors (k, h) of trials of recording i, each predicted without its fold; NaN if there is no model.

    Parameters
    ----------
    without : returns the model that is fitted without a fold; None if too little data are left
    steps : track of the recording with joined wheel samples; default: single samples
    """
    track, distance = recording.track, recording.track.distance
    errors = TrialErrors.none(trials.ends.shape)
    # The horizons are computed in the order in which the ends lie in memory.
    column, row = np.nonzero(trials.ends.T >= 0)
    start, end = trials.starts[row], trials.ends[row, column]
    for fold, in_fold in left_out(folds, i, distance[start], distance[end]):
        if (prediction := without(fold)) is not None:
            s, e = start[in_fold], end[in_fold]
            span = track.t[s.min()], track.t[e.max()]
            span_steps = recording.wheels(track.rows_around(*span)) if steps is None else steps.around(*span)
            fold_errors = trial_errors(recording, s, e, predicted_path(recording, *prediction, span_steps))
            for all_errors, column_errors in zip(errors, fold_errors, strict=True):
                all_errors[row[in_fold], column[in_fold]] = column_errors
    return errors


def fit_models(recordings: Sequence[Recording], names: Sequence[str] = tuple(MODELS)) -> dict[str, PooledFit]:
    """Return motion models that are fitted to recordings, by name; also with a gyro if every recording has a gyro.

    Raises
    ------
    DataError
        A recording is too short.
    """
    pooled = totals_of(*recordings)
    pool = Pool(
        [cut_windows(recording, pooled=pooled) for recording in recordings],
        [recording.width_m for recording in recordings],
    )
    fits = {name: pool.fit(MODELS[name]) for name in names}
    if FIVE in fits:
        # All recordings have the clocks of one robot, so several of them show its delay no better than one.
        x_clock_std_m = float(np.sqrt(np.mean([recording.x_clock_std_m**2 for recording in recordings])))
        fits[FIVE] = fits[FIVE].with_clock_error(x_clock_std_m)
    if all(recording.track.gyro is not None for recording in recordings):
        fits |= {f"{name}{GYRO_SUFFIX}": pool.fit(MODELS[name].with_gyro(), fits[name]) for name in names}
    return fits


def hold_out(recordings: Sequence[Recording], horizons_m: Sequence[float] = HELD_OUT_HORIZONS_M) -> HeldOut:
    """Return motion models that are fitted to recordings, with their tests on data that they were not fitted to.

    Parameters
    ----------
    recordings : at least one
    horizons_m : distances of the trials [m]

    Raises
    ------
    DataError
        A recording is too short, or too few windows lie outside a fold.
    """
    folds = plan_folds(recordings)
    fits = fit_models(recordings)
    for fold in folds:
        if np.count_nonzero(fits[RECOMMENDED].pool.clear_of(fold)) < FEWEST_RESIDUALS:
            raise DataError(fold.name, "too few windows outside it", TOO_SHORT)
    pooled = totals_of(*recordings)
    trials = tuple(cut_trials(recording, horizons_m, pooled) for recording in recordings)
    return HeldOut(tuple(recordings), tuple(horizons_m), folds, trials, fits)


def _left_out_windows(
    table: HeldOut, name: str, lengths_m: Sequence[float]
) -> Iterator[tuple[int, Windows, Prediction]]:
    """Yield the number of a recording, windows of it with the steps around them, and a model fitted without them."""
    for i, windows in table.error_windows:
        chosen = np.flatnonzero(np.isin(windows.length_m, lengths_m))
        start_m, end_m = (windows.track.distance[rows[chosen]] for rows in (windows.begin, windows.end))
        for fold, in_fold in left_out(table.folds, i, start_m, end_m):
            if (predicted := table.fit_without(name, fold)) is not None:
                rows = chosen[in_fold]
                begin, end = windows.begin[rows], windows.end[rows]
                steps = windows.track.around(*windows.track.place_t[[begin.min(), end.max()]].tolist())
                yield i, Windows(steps, begin, end, windows.length_m[rows]), predicted


class _LogErrors(NamedTuple):
    """Errors of a model in windows of one log that it was not fitted to.

    Attributes
    ----------
    length_m : (w,) length of each window [m]
    moments : moments of the errors by the model
    turn_error_rad : (w,) errors of the turn [rad]
    error_m : complex (w,) errors of the displacement, forward + j right [m]
    """

    length_m: Floats
    moments: error_growth.PathMoments
    turn_error_rad: Floats
    error_m: Complexes


def measure_error_sources(table: HeldOut, name: str) -> ErrorSources | None:
    """Return the sources of error of a row, from windows that the row was not fitted to; None for too few windows.

    Notes
    -----
    The variances are non-negative least squares of the squared errors; each length and direction has the same weight.
    The factors come from split conformal prediction (Vovk et al. 2005); windows of 10 m count as independent. Their
    logarithm is shrunk towards zero (James and Stein 1961), because a short drive shows its largest error and no
    quantile.
    """
    log_errors: list[_LogErrors] = []
    tested = [np.empty((0, 3))]
    for i, windows, (fitted_model, constants) in _left_out_windows(table, name, LENGTHS_M):
        errors = error_growth.path_errors(windows, fitted_model, table.recordings[i].width_m, constants)
        reference = np.exp(-1j * constants.heading_offset_rad) * windows.moved
        log_errors.append(
            _LogErrors(windows.length_m, errors, errors.turned - windows.turned, errors.moved - reference)
        )
        stretch = np.floor(windows.track.distance[windows.begin] / windows.length_m)
        tested.append(np.column_stack([np.full(len(stretch), i), windows.length_m, stretch]))
    stretches = Counter(np.unique(np.concatenate(tested), axis=0)[:, 1].tolist())
    measured_to_m = max(
        length_m for length_m in LENGTHS_M if length_m <= ALWAYS_TO_M or stretches[length_m] >= FEWEST_STRETCHES
    )
    length = np.concatenate([log.length_m for log in log_errors]) if log_errors else np.empty(0)
    used = length <= measured_to_m
    length = length[used]
    if np.count_nonzero(length >= SCALED_FROM_M) < FEWEST_HELD_OUT_WINDOWS:
        return None
    sources, stated = (
        error_growth.ErrorMoments(*(np.concatenate(column)[used] for column in zip(*moments, strict=True)))
        for moments in (
            [log.moments.of_sources for log in log_errors],
            [log.moments.of_parameters for log in log_errors],
        )
    )
    turn_error_rad = np.concatenate([log.turn_error_rad for log in log_errors])[used]
    error_m = np.concatenate([log.error_m for log in log_errors])[used]
    variances = error_growth.fit_variances(length, sources, stated, turn_error_rad, error_m)
    spread, is_long = sources.combined_moments(variances).plus(stated), length >= SCALED_FROM_M
    distance_m, count = np.abs(error_m)[is_long], max(stretches[CHOICE_HORIZON_M], 1)
    level = min(95.0 * (1.0 + 1.0 / count), 100.0)
    share = np.percentile(distance_m / np.maximum(error_growth.radius_of_share(spread, 0.95)[is_long], 1e-9), level)
    mean = distance_m.mean() / max(float(error_growth.mean_error(spread)[is_long].mean()), 1e-9)
    # The ratio of measured to normal error is moved towards 1, the more the fewer stretches there are.
    factors = np.maximum([share, mean], [1.0, 1e-9]) ** (count / (count + NORMAL_STRETCHES))
    return ErrorSources(*(*variances.tolist(), *factors.tolist(), measured_to_m))


def measure_controller_errors(table: HeldOut, *, has_gyro: bool) -> ControllerErrors | None:
    """Return the errors of the controller's model in each fold, fitted without this fold; None for too few windows."""
    pose_errors, _ = _window_errors(table, CONTROLLER, CHOICE_HORIZON_M)
    short_errors, stretches = _window_errors(table, CONTROLLER, TWIST_OVER_M)
    if min(len(pose_errors), len(short_errors)) < FEWEST_TESTED or CHOICE_HORIZON_M not in table.horizons_m:
        return None
    h = table.horizons_m.index(CHOICE_HORIZON_M)
    velocities = short_errors[:, :3] / short_errors[:, 3:4]
    turn_rate = turn_rate_std = None
    if has_gyro:
        gyro_errors, gyro_stretches = _window_errors(table, f"{RECOMMENDED}{GYRO_SUFFIX}", TWIST_OVER_M)
        if len(gyro_errors) >= FEWEST_TESTED:
            squares = (gyro_errors[:, 2] / gyro_errors[:, 3]) ** 2
            turn_rate = max(float(squares.mean()), SMALLEST_VARIANCE)
            turn_rate_std = float(squares.std()) / math.sqrt(max(gyro_stretches, 1))
    return ControllerErrors(
        pose_variance=_variances(pose_errors[:, :3]),
        twist_variance=_variances(velocities),
        turn_noise=_shares(short_errors[:, 2], short_errors[:, 4], short_errors[:, 5]),
        way_noise=_shares(np.hypot(short_errors[:, 0], short_errors[:, 1]), short_errors[:, 5], short_errors[:, 4]),
        p95_m=finite_or_none(float(table.score(CONTROLLER).together.p95[h])),
        full_p95_m=finite_or_none(float(table.score(RECOMMENDED).together.p95[h])),
        twist_variance_std=_variance_stds(velocities, stretches),
        gyro_rate_variance=turn_rate,
        gyro_rate_variance_std=turn_rate_std,
    )


def _variances(errors: Floats) -> tuple[float, float, float]:
    """Return the mean squares (3,) of errors (m, 3), at least `SMALLEST_VARIANCE`."""
    along, across, heading = np.maximum((errors**2).mean(axis=0), SMALLEST_VARIANCE).tolist()
    return along, across, heading


def _variance_stds(errors: Floats, stretches: int) -> tuple[float, float, float]:
    """Return the standard deviations of `_variances` (3,). Windows overlap, so only separate stretches are counted."""
    along, across, heading = ((errors**2).std(axis=0) / math.sqrt(max(stretches, 1))).tolist()
    return along, across, heading


def _shares(errors: Floats, first: Floats, second: Floats) -> tuple[float, float]:
    """Return a and b, at least `SMALLEST_VARIANCE`, for which a first^2 + b second^2 fits missed^2 by least squares."""
    columns = np.column_stack([first**2, second**2])
    a, b = np.maximum(
        error_growth.solve_nonnegative(columns.T @ columns, columns.T @ errors**2), SMALLEST_VARIANCE
    ).tolist()
    return a, b


def _window_errors(table: HeldOut, name: str, length_m: float) -> tuple[Floats, int]:
    """Return the errors of a row in windows that it was not fitted to, and the number of separate stretches in them.

    Returns
    -------
    errors : (m, 6) error along, across [m] and in heading [rad], duration [s], turn [rad], length [m]
    stretches : number of separate stretches
    """
    rows, stretches = [np.empty((0, 6))], set[tuple[int, float]]()
    for i, windows, predicted in _left_out_windows(table, name, [length_m]):
        path = predicted_path(table.recordings[i], *predicted, windows.track)
        begin, end = (windows.track.place_t[row] for row in (windows.begin, windows.end))
        (theta, turned_theta), (position, moved) = (np.split(column, 2) for column in path(np.append(begin, end)))
        error = np.exp(-1j * theta) * (moved - position) - windows.moved
        turn = windows.turned
        turn_error_rad = turned_theta - theta - turn
        rows.append(np.column_stack([error.real, error.imag, turn_error_rad, end - begin, turn, windows.length_m]))
        stretch_numbers = np.floor(windows.track.distance[windows.begin] / windows.length_m)
        stretches.update((i, number) for number in stretch_numbers.tolist())
    return np.concatenate(rows), len(stretches)
