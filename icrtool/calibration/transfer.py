"""Groups of runs compared: what each teaches, how they differ, and what the calibration of one costs on another.

The transfer matrix holds the errors of the calibration of the row in the trials of the column's runs. On its diagonal a
calibration would be tested on what it was fitted to; there each trial is predicted without its log or, in a group of a
single run, without the blocks that it touches.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icrtool.calibration.error_differences import ErrorDifference, blocks_of, compare_errors, same_route
from icrtool.calibration.from_runs import calibrate_runs
from icrtool.calibration.pooled import CalibrationResult, block_predictor, fixed_predictor, gyro_recording_of, predictor
from icrtool.calibration.record import Calibration
from icrtool.errors import ConfigError
from icrtool.kernels.error_statistics import bootstrap_intervals, cut_blocks, summarise
from icrtool.motion.models import TrackGeometry
from icrtool.motion.recording import Recording
from icrtool.motion.trials import Trials, cut_trials
from icrtool.records.dropout import CHOICE_HORIZON_M, DEFAULT_SEED
from icrtool.records.run import Run
from icrtool.records.tables import Floats

HORIZONS_M = (1.0, 5.0, CHOICE_HORIZON_M, 20.0)

RESAMPLES, LEVEL = 300, 0.95

TWO_SIDED = 1.96
"""Standard deviations in a 95 % interval."""

COMPARED = ("y_icr_right_m", "y_icr_left_m", "x_icr_m", "multiplier", "radius_left", "radius_right")


class Difference(NamedTuple):
    """A quantity of two groups: second minus first, with one standard deviation."""

    quantity: str
    first: float
    second: float
    difference: float
    std: float

    @property
    def significant(self) -> bool:
        """Whether zero lies outside the 95 % interval."""
        return abs(self.difference) > TWO_SIDED * self.std


class Cell(NamedTuple):
    """Errors at one horizon of the calibration of one group in the runs of another, with 95 % intervals [m]."""

    calibrated_on: str
    tested_on: str
    horizon_m: float
    trials: int
    p95_m: float
    p95_low_m: float
    p95_high_m: float
    expected_m: float
    expected_low_m: float
    expected_high_m: float


class ErrorChange(NamedTuple):
    """Errors of the second group's held-out calibration minus those of the first's; `paired`: on the same route."""

    horizon_m: float
    p95_m: float
    p95_low_m: float
    p95_high_m: float
    expected_m: float
    expected_low_m: float
    expected_high_m: float
    paired: bool


class TransferCost(NamedTuple):
    """Errors of the calibration of one group minus those of the tested group's own, held out, in the same trials."""

    calibrated_on: str
    tested_on: str
    horizon_m: float
    p95_m: float
    p95_low_m: float
    p95_high_m: float
    expected_m: float
    expected_low_m: float
    expected_high_m: float


class Pair(NamedTuple):
    """Two groups: how their parameters differ, and their errors, each held out."""

    first: str
    second: str
    parameters: tuple[Difference, ...]
    errors: tuple[ErrorChange, ...]


@dataclass(frozen=True, slots=True)
class Transfer:
    """The comparison of groups.

    Attributes
    ----------
    calibrations : by group
    pairs : the first group with each of the others
    cells : the transfer matrix, by row, column and horizon
    costs : of each cell beside the diagonal, against the diagonal of its column
    """

    calibrations: Mapping[str, Calibration]
    pairs: tuple[Pair, ...]
    cells: tuple[Cell, ...]
    costs: tuple[TransferCost, ...]

    def cost(self, calibrated_on: str, tested_on: str, horizon_m: float) -> TransferCost:
        """Return what a calibration of one group costs on another."""
        where = (calibrated_on, tested_on, horizon_m)
        return next(one for one in self.costs if one[:3] == where)

    def cell(self, calibrated_on: str, tested_on: str, horizon_m: float) -> Cell:
        """Return a cell of the matrix."""
        where = (calibrated_on, tested_on, horizon_m)
        return next(one for one in self.cells if one[:3] == where)


def compare_groups(groups: Mapping[str, Sequence[Run]], *, seed: int = DEFAULT_SEED) -> Transfer:
    """Calibrate each group of runs and compare the groups.

    Parameters
    ----------
    groups : at least two, by name; the runs of one robot
    seed : of the bootstrap

    Raises
    ------
    ConfigError
        Fewer than two groups, a log that is in two of them, or robots that differ.
    DataError
        Too short a drive.

    Notes
    -----
    Parameters of different logs are independent, and their covariances are clustered by distance; errors have intervals
    of a moving-block bootstrap over the distance of all runs of a group, blocks as long as the horizon. Differences of
    errors have a bootstrap of their own, over pairs of blocks where both are of the same trials or the same route
    (`icrtool.calibration.error_differences`).
    """
    if len(groups) < 2:
        raise ConfigError("groups", "only one is given", "name two or more to compare")
    recordings = {name: [gyro_recording_of(run) for run in runs] for name, runs in groups.items()}
    _check_apart(recordings)
    return compare_calibrations({name: calibrate_runs(runs) for name, runs in groups.items()}, recordings, seed=seed)


def compare_calibrations(
    results: Mapping[str, CalibrationResult], recordings: Mapping[str, Sequence[Recording]], *, seed: int = DEFAULT_SEED
) -> Transfer:
    """Compare calibrations of groups of recordings; see `compare_groups`."""
    calibrations = {name: result.calibration for name, result in results.items()}
    cells: list[Cell] = []
    errors_of_cell: dict[tuple[str, str], tuple[Floats, Floats]] = {}
    for row, calibration in calibrations.items():
        for column, tested in recordings.items():
            if row == column and len(tested) == 1:
                predictors = [block_predictor(tested[0], results[row].wheels)]
            elif row == column:
                without = results[row].wheels.without
                predictors = [fixed_predictor(one, fit) for one, fit in zip(tested, without, strict=True)]
            else:
                predictors = [predictor(calibration, one) for one in tested]
            errors: list[Floats] = []
            path: list[Floats] = []
            for one, errors_of in zip(tested, predictors, strict=True):
                trials = cut_trials(one, HORIZONS_M)
                errors.append(errors_of(trials))
                path.append(_path(one, trials, path[-1][-1] if path else 0.0))
            errors_of_cell[row, column] = np.concatenate(errors), np.concatenate(path)
            cells += _cells(row, column, *errors_of_cell[row, column], seed)
    first, *others = results
    pairs = []
    for other in others:
        alike = len(recordings[first]) == len(recordings[other]) == 1 and same_route(
            *(_route(recordings[name][0]) for name in (first, other))
        )
        own = errors_of_cell[first, first], errors_of_cell[other, other]
        changes = tuple(
            ErrorChange(h, *difference, alike) for h, difference in _differences(*own, paired=alike, seed=seed)
        )
        pairs.append(Pair(first, other, _parameter_differences(first, other, calibrations), changes))
    costs = tuple(
        TransferCost(row, column, horizon, *difference)
        for (row, column), foreign in errors_of_cell.items() if row != column
        for horizon, difference in _differences(errors_of_cell[column, column], foreign, paired=True, seed=seed)
    )  # fmt: skip
    return Transfer(calibrations, tuple(pairs), tuple(cells), costs)


def _route(recording: Recording) -> tuple[Floats, Floats, Floats]:
    drive = recording.drive
    return drive.distance, drive.north, drive.east


def _differences(
    first: tuple[Floats, Floats], second: tuple[Floats, Floats], *, paired: bool, seed: int
) -> Iterator[tuple[float, ErrorDifference]]:
    """Yield each horizon with the difference of errors (k, h), each given with the path length at its start (k,)."""
    for h, horizon in enumerate(HORIZONS_M):
        blocks = [blocks_of(path, horizon) for _, path in (first, second)]
        yield horizon, compare_errors(
            first[0][:, h], blocks[0], second[0][:, h], blocks[1], paired=paired, seed=seed
        )  # fmt: skip


def _check_apart(recordings: Mapping[str, Sequence[Recording]]) -> None:
    seen: dict[str, str] = {}
    for name, group in recordings.items():
        for one in group:
            if one.sha256 and seen.setdefault(one.sha256, name) != name:
                why = f"it is in {seen[one.sha256]} and in {name}"
                raise ConfigError(one.name, why, "a calibration would be tested on what it was fitted to")


def _path(recording: Recording, trials: Trials, before_m: float) -> Floats:
    """Return the path length at each start, behind that of the recordings before."""
    path: Floats = before_m + recording.drive.distance[trials.starts]
    return path


def _cells(row: str, column: str, errors: Floats, path: Floats, seed: int) -> list[Cell]:
    summary = summarise(errors)
    blocks = [cut_blocks(np.isfinite(errors[:, h]), path, horizon) for h, horizon in enumerate(HORIZONS_M)]
    interval = bootstrap_intervals(errors, blocks, seed, RESAMPLES, LEVEL)
    return [
        Cell(
            row, column, horizon, int(summary.trials[h]),
            float(summary.p95[h]), float(interval.p95_low[h]), float(interval.p95_high[h]),
            float(summary.expected[h]), float(interval.expected_low[h]), float(interval.expected_high[h]),
        )
        for h, horizon in enumerate(HORIZONS_M)
    ]  # fmt: skip


def _parameter_differences(first: str, second: str, calibrations: Mapping[str, Calibration]) -> tuple[Difference, ...]:
    (before, covariance_before), (after, covariance_after) = (calibrations[name].geometry() for name in (first, second))
    places = [TrackGeometry._fields.index(name) for name in COMPARED]
    return tuple(
        Difference(
            name, before[k], after[k], after[k] - before[k],
            math.sqrt(covariance_before[k, k] + covariance_after[k, k]),
        )
        for name, k in zip(COMPARED, places, strict=True)
    )  # fmt: skip
