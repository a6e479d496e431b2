"""Comparison of groups of runs: parameters, differences, and errors of the calibration of one group in another.

The transfer matrix has a row for the calibration of each group, and a column for the runs of each group. On its
diagonal, the calibration and the runs are of the same group. There, each trial is predicted by a fit without its log
or, in a group of a single run, by a fit to the rest of the drive.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from msgspec.structs import astuple

from icrtool import __version__
from icrtool.calibration.pooled import CalibrationResult, calibrate_runs, predictor
from icrtool.calibration.record import Calibration
from icrtool.errors import ConfigError
from icrtool.kernels import error_statistics as statistics
from icrtool.kernels.arrays import Floats
from icrtool.kernels.track import Track
from icrtool.motion.models import RECOMMENDED
from icrtool.motion.recording import Recording, cut_trials
from icrtool.records import calibration_document as documents
from icrtool.records.acceptance import CHOICE_HORIZON_M
from icrtool.records.plain_data import finite_or_none
from icrtool.records.rows import FITTED_SPREAD
from icrtool.records.run import Run
from icrtool.records.text import with_interval, with_std

TRANSFER_HORIZONS_M = (1.0, 5.0, CHOICE_HORIZON_M, 20.0)
"""Distances of the errors of a comparison [m]."""

TWO_SIDED = 1.96
"""Half the length of a 95 % interval of a normal value, in standard deviations."""

SAME_ROUTE_M = 1.0
"""Largest distance between two drives of the same route at equal driven distances [m]."""

COMPARED = ("y_icr_right_m", "y_icr_left_m", "x_icr_m", "multiplier", "radius_left", "radius_right")
"""Fields of `TrackGeometry` that are compared."""


def compare_groups(groups: Mapping[str, Sequence[Run]]) -> documents.GroupComparison:
    """Return the comparison of groups of runs by their calibrations.

    Parameters
    ----------
    groups : runs of one robot, by the name of the group; at least two groups. If two groups have different robots, the
        calibration of one has no errors in the other (NaN)

    Raises
    ------
    ConfigError
        There are fewer than two groups, a log is in two groups, or a group has different robots.
    DataError
        The runs of a group are too short.

    Notes
    -----
    Parameters of different logs are independent, and their covariances are clustered by distance. Errors and their
    differences have intervals from blocks of the distance of all runs of a group
    (`icrtool.kernels.error_statistics`). If both groups have the same trials or the same route, the intervals of
    differences come from pairs of blocks.
    """
    if len(groups) < 2:
        raise ConfigError("groups", "only one group is given", "name two or more to compare")
    results = {name: calibrate_runs(runs) for name, runs in groups.items()}
    recordings = {name: result.table.recordings for name, result in results.items()}
    seen: dict[str, str] = {}
    for name, recording in ((name, recording) for name, group in recordings.items() for recording in group):
        if recording.sha256 and seen.setdefault(recording.sha256, name) != name:
            why = f"it is in {seen[recording.sha256]} and in {name}"
            raise ConfigError(recording.name, why, "a calibration would be tested on what it was fitted to")
    return compare_calibrations(results, recordings)


def compare_calibrations(
    results: Mapping[str, CalibrationResult], recordings: Mapping[str, Sequence[Recording]]
) -> documents.GroupComparison:
    """Return the comparison of groups of recordings by their calibrations; see `compare_groups`."""
    tested = {(name, name): _test(result, recordings[name], own=True) for name, result in results.items()}
    cells, costs = [], []
    for (row, result), (column, column_result) in product(results.items(), results.items()):
        held_out = applied = tested[column, column]
        if row != column:
            # Another track width or wheel radius means another robot.
            ours, theirs = result.calibration, column_result.calibration
            same_width = math.isclose(ours.width_m, theirs.width_m, rel_tol=1e-3)
            applied = held_out._replace(errors=np.full_like(held_out.errors, np.nan))
            if same_width and ours.robot.wheel_radius_m == theirs.robot.wheel_radius_m:
                applied = _test(result, recordings[column], own=False)
            differences = _differences(held_out, applied, paired=True)
            costs += [
                documents.TransferCost(*astuple(difference), calibrated_on=row, tested_on=column)
                for difference in differences
            ]
        for h, horizon in enumerate(TRANSFER_HORIZONS_M):
            errors, _ = _sum_up(applied.errors[:, h], applied.path, horizon)
            trials = int(np.count_nonzero(np.isfinite(applied.errors[:, h])))
            cells.append(documents.TransferCell(*astuple(errors), calibrated_on=row, tested_on=column, trials=trials))
    first, *others = results
    pairs = []
    for other in others:
        groups = recordings[first], recordings[other]
        paired = len(groups[0]) == len(groups[1]) == 1 and same_route(groups[0][0].track, groups[1][0].track)
        parameters = _parameter_differences(results[first].calibration, results[other].calibration)
        differences = _differences(tested[first, first], tested[other, other], paired=paired)
        at_choice = (first, other, CHOICE_HORIZON_M)
        cost = next(cost for cost in costs if (cost.calibrated_on, cost.tested_on, cost.horizon_m) == at_choice)
        sentence = _verdict(first, other, parameters, cost)
        errors_of_pair = tuple(
            documents.ErrorDifference(*astuple(difference), paired=paired) for difference in differences
        )
        pairs.append(documents.ComparedPair(first, other, parameters, errors_of_pair, sentence))
    compared = {}
    for name, result in results.items():
        calibration = result.calibration
        compared[name] = documents.ComparedGroup(calibration.recommended, calibration.logs, calibration.geometry)
    return documents.GroupComparison(
        schema=documents.COMPARE_SCHEMA, tool_version=__version__, groups=compared,
        pairs=tuple(pairs), transfer=tuple(cells), costs=tuple(costs),
    )  # fmt: skip


def _verdict(
    first: str, second: str, parameters: Sequence[documents.ParameterDifference], cost: documents.TransferCost
) -> str:
    """Return how the multipliers of two groups differ, and what the first calibration adds to the second's errors."""
    multiplier = next(difference for difference in parameters if difference.quantity == "multiplier")
    change = with_std(multiplier.difference, multiplier.std)
    differs = (
        f"Multiplier: {second} minus {first} is {change}{'' if multiplier.significant else ', no difference shown'}"
    )
    if cost.p95_m is None:
        return f"{differs}."
    low, high = cost.p95_low_m, cost.p95_high_m
    size = f"{with_interval(cost.p95_m, low, high)} after {CHOICE_HORIZON_M:g} m (95 %)"
    hidden = low is not None and high is not None and low <= 0.0 <= high
    used = f"The calibration of {first}, used on {second}, changes the error by {size}"
    return f"{differs}. {used}{', no loss shown' if hidden else ''}."


class _Tested(NamedTuple):
    """Errors (k, h) [m] of the trials of all recordings in sequence, and path lengths (k,) [m] at their starts."""

    errors: Floats
    path: Floats


def _test(result: CalibrationResult, recordings: Sequence[Recording], *, own: bool) -> _Tested:
    """Return the errors of a calibration in recordings.

    `own` : the calibration is from these recordings, so each trial is predicted by a fit without it.
    """
    errors, path, before = [], [], 0.0
    for i, recording in enumerate(recordings):
        trials = cut_trials(recording, TRANSFER_HORIZONS_M)
        errors_of_trials = (
            result.table.errors(RECOMMENDED, i, trials) if own else predictor(result.calibration, recording)(trials)
        )
        errors.append(errors_of_trials.position)
        path.append(before + recording.track.distance[trials.starts])
        before = path[-1][-1]
    return _Tested(np.concatenate(errors), np.concatenate(path))


def _sum_up(
    errors_m: Floats, path_m: Floats, horizon_m: float
) -> tuple[documents.ErrorsAt, statistics.BlockSums | None]:
    """Return p95 and mean [m] of trials (k,) of one horizon with their intervals, and the sums of blocks of path."""
    ranked = statistics.RankedTrials.from_errors(errors_m)
    _, expected, p50, p95, _ = ranked.summary()
    blocks = statistics.cut_blocks(np.isfinite(errors_m), path_m, horizon_m)
    sums = statistics.block_sums(errors_m, blocks, ranked, p50, p95)
    intervals = statistics.error_intervals(errors_m, blocks, sums, p50, p95, FITTED_SPREAD)
    numbers = (p95, intervals.p95_low, intervals.p95_high, expected, intervals.expected_low, intervals.expected_high)
    return documents.ErrorsAt(horizon_m, *map(finite_or_none, numbers)), sums


def _differences(first: _Tested, second: _Tested, *, paired: bool) -> list[documents.ErrorsAt]:
    """Return the difference of p95 and mean at each horizon, second minus first, with 95 % intervals.

    `paired` : both have the same trials or the same route, so that their blocks of path are compared in pairs.
    """
    differences = []
    same = np.array_equal(first.path, second.path)
    for h, horizon in enumerate(TRANSFER_HORIZONS_M):
        sides = [tested.errors[:, h] for tested in (first, second)]
        if same:
            both = np.isfinite(sides[0]) & np.isfinite(sides[1])
            sides = [np.where(both, errors, np.nan) for errors in sides]
        (before, old), (after, new) = (
            _sum_up(side, tested.path, horizon) for side, tested in zip(sides, (first, second), strict=True)
        )
        numbers: list[float | None] = []
        for metric, name in (("p95", "p95_m"), ("expected", "expected_m")):
            then, now = getattr(before, name), getattr(after, name)
            more = math.nan if then is None or now is None else now - then
            half = statistics.difference_half_width(new, old, metric, 1.0, paired=paired)
            numbers += [finite_or_none(more), finite_or_none(more - half), finite_or_none(more + half)]
        differences.append(documents.ErrorsAt(horizon, *numbers))
    return differences


def same_route(first: Track, second: Track) -> bool:
    """Return whether two drives took the same route: at equal distances they are less than `SAME_ROUTE_M` apart."""
    ends = [float(track.distance[-1]) for track in (first, second)]
    if abs(ends[1] - ends[0]) > 0.05 * min(ends):
        return False
    distances_m = np.arange(0.0, min(ends), 1.0)
    positions = [np.interp(distances_m, track.distance, track.place) for track in (first, second)]
    return bool(np.abs(positions[1] - positions[0]).max() < SAME_ROUTE_M)


def _parameter_differences(first: Calibration, second: Calibration) -> tuple[documents.ParameterDifference, ...]:
    """Return the difference of each compared parameter, second minus first, with its standard deviation."""
    differences = []
    for name in COMPARED:
        before, after = first.geometry[name], second.geometry[name]
        difference, std = after - before, math.hypot(first.geometry_std[name], second.geometry_std[name])
        differences.append(
            documents.ParameterDifference(name, before, after, difference, std, abs(difference) > TWO_SIDED * std)
        )
    return tuple(differences)
