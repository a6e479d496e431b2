"""Groups of runs compared: what each teaches, how they differ, and what the calibration of one costs on another.

The transfer matrix holds the errors of the calibration of the row in the trials of the column's runs. On its diagonal a
calibration would be tested on what it was fitted to; there each trial is predicted without its log or, in a group of a
single run, by a fit to the rest of the drive.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from icrtool.calibration.from_runs import calibrate_runs
from icrtool.calibration.pooled import CalibrationResult, predictor
from icrtool.calibration.record import Calibration
from icrtool.errors import ConfigError
from icrtool.kernels.arrays import Floats
from icrtool.kernels.open_loop.block_sums import BlockSums, block_sums, difference_half_width, error_intervals
from icrtool.kernels.open_loop.error_statistics import cut_blocks, error_summary, sort_trials
from icrtool.kernels.track import Track
from icrtool.motion.models import RECOMMENDED, TrackGeometry
from icrtool.motion.recording import Recording, cut_trials
from icrtool.records.dropout import CHOICE_HORIZON_M
from icrtool.records.run import Run

HORIZONS_M = (1.0, 5.0, CHOICE_HORIZON_M, 20.0)

TWO_SIDED = 1.96
"""Standard deviations in a 95 % interval."""

SAME_ROUTE_M = 1.0
"""Two drives took the same route where they are nowhere further apart at the same distance."""

COMPARED = ("y_icr_right_m", "y_icr_left_m", "x_icr_m", "multiplier", "radius_left", "radius_right")


class ErrorEstimate(NamedTuple):
    """Errors, or differences of errors, with 95 % intervals [m]; NaN where there is none."""

    p95_m: float
    p95_low_m: float
    p95_high_m: float
    expected_m: float
    expected_low_m: float
    expected_high_m: float


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
    """Errors at one horizon of the calibration of one group in the runs of another.

    `cost` are these errors minus those of the tested group's own held-out calibration in the same trials; None on the
    diagonal.
    """

    calibrated_on: str
    tested_on: str
    horizon_m: float
    trials: int
    errors: ErrorEstimate
    cost: ErrorEstimate | None


class Pair(NamedTuple):
    """Two groups: how their parameters differ, and their held-out errors at each horizon [m], second minus first.

    `paired`: both drove the same route, and trials at the same distance are compared.
    """

    first: str
    second: str
    parameters: tuple[Difference, ...]
    errors: dict[float, ErrorEstimate]
    paired: bool


@dataclass(frozen=True, slots=True)
class Transfer:
    """The comparison of groups.

    Attributes
    ----------
    calibrations : by group
    pairs : the first group with each of the others
    cells : the transfer matrix, by row, column and horizon
    """

    calibrations: Mapping[str, Calibration]
    pairs: tuple[Pair, ...]
    cells: tuple[Cell, ...]

    def cell(self, calibrated_on: str, tested_on: str, horizon_m: float) -> Cell:
        """Return a cell of the matrix."""
        where = (calibrated_on, tested_on, horizon_m)
        return next(one for one in self.cells if one[:3] == where)


def compare_groups(groups: Mapping[str, Sequence[Run]]) -> Transfer:
    """Calibrate each group of runs and compare the groups.

    Parameters
    ----------
    groups : at least two, by name, each the runs of one robot; groups of different robots have no errors of one
        calibration on the other (NaN)

    Raises
    ------
    ConfigError
        Fewer than two groups, a log that is in two of them, or robots that differ in one group.
    DataError
        Too short a drive.

    Notes
    -----
    Parameters of different logs are independent, and their covariances are clustered by distance. Errors and their
    differences have intervals from blocks of the distance of all runs of a group
    (`icrtool.kernels.open_loop.block_sums`), differences from pairs of blocks where both are of the same trials or the
    same route.
    """
    if len(groups) < 2:
        raise ConfigError("groups", "only one is given", "name two or more to compare")
    results = {name: calibrate_runs(runs) for name, runs in groups.items()}
    recordings = {name: one.table.recordings for name, one in results.items()}
    _check_apart(recordings)
    return compare_calibrations(results, recordings)


def compare_calibrations(
    results: Mapping[str, CalibrationResult], recordings: Mapping[str, Sequence[Recording]]
) -> Transfer:
    """Compare calibrations of groups of recordings; see `compare_groups`."""
    tested = {(name, name): _test(result, recordings[name], own=True) for name, result in results.items()}
    for (row, result), (column, own) in product(results.items(), results.items()):
        if _of_one_robot(result.calibration, own.calibration):
            tested.setdefault((row, column), _test(result, recordings[column], own=False))
        else:
            known = tested[column, column]
            tested[row, column] = known._replace(errors=np.full_like(known.errors, np.nan))
    cells = (cell for row, column in product(results, results) for cell in _cells(row, column, tested))
    first, *others = results
    pairs = []
    for other in others:
        (one, *_), (two, *_) = groups = recordings[first], recordings[other]
        paired = len(groups[0]) == len(groups[1]) == 1 and same_route(one.track, two.track)
        parameters = _parameter_differences(results[first].calibration, results[other].calibration)
        errors = _differences(tested[first, first], tested[other, other], paired=paired)
        pairs.append(Pair(first, other, parameters, dict(zip(HORIZONS_M, errors, strict=True)), paired))
    return Transfer({name: one.calibration for name, one in results.items()}, tuple(pairs), tuple(cells))


def _of_one_robot(one: Calibration, other: Calibration) -> bool:
    """Return whether the parameters of two calibrations refer to the same track width and wheel radius."""
    same_width = math.isclose(one.width_m, other.width_m, rel_tol=1e-3)
    return same_width and one.robot.wheel_radius_m == other.robot.wheel_radius_m


class _Tested(NamedTuple):
    """Errors (k, h) [m] of trials, and path lengths (k,) [m] at their starts; recordings one behind the other."""

    errors: Floats
    path: Floats


def _test(result: CalibrationResult, recordings: Sequence[Recording], *, own: bool) -> _Tested:
    """Test a calibration in recordings; those of its own are predicted by fits that do not contain them."""
    errors, path, before = [], [], 0.0
    for i, one in enumerate(recordings):
        trials = cut_trials(one, HORIZONS_M)
        found = result.table.errors(RECOMMENDED, i, trials) if own else predictor(result.calibration, one)(trials)
        errors.append(found.position)
        path.append(before + one.track.distance[trials.starts])
        before = path[-1][-1]
    return _Tested(np.concatenate(errors), np.concatenate(path))


class _Sums(NamedTuple):
    """The trials of one horizon: p95 and mean [m] with their intervals, and the sums of blocks of path."""

    errors: ErrorEstimate
    blocks: BlockSums | None


def _sum_up(errors_m: Floats, path_m: Floats, horizon_m: float) -> _Sums:
    summary = error_summary(errors_m[:, None])
    p50, p95, expected = (float(one[0]) for one in (summary.p50, summary.p95, summary.expected))
    blocks = cut_blocks(np.isfinite(errors_m), path_m, horizon_m)
    sums = block_sums(errors_m, blocks, sort_trials(errors_m), p50, p95)
    low, high, p95_low, p95_high = error_intervals(errors_m, blocks, sums, p95)
    return _Sums(ErrorEstimate(p95, p95_low, p95_high, expected, low, high), sums)


def _differences(first: _Tested, second: _Tested, *, paired: bool) -> list[ErrorEstimate]:
    """Return the difference of errors at each horizon, second minus first; of the same trials only where both are."""
    found = []
    same = np.array_equal(first.path, second.path)
    for h, horizon in enumerate(HORIZONS_M):
        sides = [one.errors[:, h] for one in (first, second)]
        if same:
            both = np.isfinite(sides[0]) & np.isfinite(sides[1])
            sides = [np.where(both, one, np.nan) for one in sides]
        before, after = (_sum_up(side, one.path, horizon) for side, one in zip(sides, (first, second), strict=True))
        numbers = []
        for metric, name in (("p95", "p95_m"), ("expected", "expected_m")):
            more = getattr(after.errors, name) - getattr(before.errors, name)
            half = difference_half_width(after.blocks, before.blocks, metric, 1.0, paired=paired)
            numbers += [more, more - half, more + half]
        found.append(ErrorEstimate(*numbers))
    return found


def _cells(row: str, column: str, tested: Mapping[tuple[str, str], _Tested]) -> Iterator[Cell]:
    """Yield the cells of one row and column, a horizon each."""
    own, foreign = tested[column, column], tested[row, column]
    costs = [None] * len(HORIZONS_M) if row == column else _differences(own, foreign, paired=True)
    for h, (horizon, cost) in enumerate(zip(HORIZONS_M, costs, strict=True)):
        errors = foreign.errors[:, h]
        trials = int(np.count_nonzero(np.isfinite(errors)))
        yield Cell(row, column, horizon, trials, _sum_up(errors, foreign.path, horizon).errors, cost)


def same_route(first: Track, second: Track) -> bool:
    """Return whether two drives took the same route at the same distance."""
    ends = [float(one.distance[-1]) for one in (first, second)]
    if abs(ends[1] - ends[0]) > 0.05 * min(ends):
        return False
    at = np.arange(0.0, min(ends), 1.0)
    places = [np.interp(at, one.distance, one.north) + 1j * np.interp(at, one.distance, one.east)
              for one in (first, second)]  # fmt: skip
    return bool(np.abs(places[1] - places[0]).max() < SAME_ROUTE_M)


def _check_apart(recordings: Mapping[str, Sequence[Recording]]) -> None:
    seen: dict[str, str] = {}
    for name, group in recordings.items():
        for one in group:
            if one.sha256 and seen.setdefault(one.sha256, name) != name:
                why = f"it is in {seen[one.sha256]} and in {name}"
                raise ConfigError(one.name, why, "a calibration would be tested on what it was fitted to")


def _parameter_differences(first: Calibration, second: Calibration) -> tuple[Difference, ...]:
    (before, covariance_before), (after, covariance_after) = first.geometry(), second.geometry()
    places = [TrackGeometry._fields.index(name) for name in COMPARED]
    return tuple(
        Difference(
            name, before[k], after[k], after[k] - before[k],
            math.sqrt(covariance_before[k, k] + covariance_after[k, k]),
        )
        for name, k in zip(COMPARED, places, strict=True)
    )  # fmt: skip
