"""Errors on a ground that a calibration was not fitted to: the recordings of each ground are left out in turn."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress

import numpy as np

from icrtool.calibration.adaptive_rows import adapt
from icrtool.calibration.held_out import GYRO_SUFFIX, errors_without, fit_models
from icrtool.errors import DataError
from icrtool.kernels.arrays import Floats
from icrtool.kernels.error_statistics import error_summary, ground_interval, within_budget
from icrtool.motion.models import CONTROLLER, FIVE, RECOMMENDED, FittedModel, controller_model
from icrtool.motion.recording import LogConstants, Recording, Trials, cut_trials, cut_windows
from icrtool.motion.robot_prior import prior_of_model
from icrtool.motion.window_fit import Fold, PooledFit, own_constants
from icrtool.records.acceptance import CHOICE_HORIZON_M, OTHER_GROUND_LAST_M
from icrtool.records.calibration_document import GroundScore
from icrtool.records.rows import row_of

GROUND_HORIZONS_M = (1.0, 2.0, 3.0, 5.0, 7.0, CHOICE_HORIZON_M, 15.0, OTHER_GROUND_LAST_M)
"""Distances of the errors on other grounds [m]."""

FEWEST_GROUNDS = 2
"""Smallest number of grounds of which each can be left out."""


def leave_grounds_out(recordings: Sequence[Recording], grounds: Sequence[str]) -> tuple[GroundScore, ...]:
    """Return the errors on each ground, of models that were fitted to all other grounds.

    Parameters
    ----------
    recordings : recordings of one robot
    grounds : name of the ground of each recording

    Returns
    -------
    tuple of GroundScore
        Empty for fewer than `FEWEST_GROUNDS` grounds. A ground has no score if it has no trials, or if the recordings
        of the other grounds are too short for a fit.
    """
    scores: list[GroundScore] = []
    names = list(dict.fromkeys(grounds))
    if len(names) < FEWEST_GROUNDS:
        return ()
    for ground in names:
        others = [recording for recording, own_ground in zip(recordings, grounds, strict=True) if own_ground != ground]
        on_ground = [
            recording for recording, own_ground in zip(recordings, grounds, strict=True) if own_ground == ground
        ]
        with suppress(DataError):
            scores += _scores(ground, on_ground, fit_models(others, (FIVE, RECOMMENDED)))
    return tuple(scores)


def _scores(ground: str, recordings: Sequence[Recording], fits: Mapping[str, PooledFit]) -> Iterator[GroundScore]:
    """Yield the errors in all recordings of a ground, by row and distance."""
    errors: dict[str, list[Floats]] = {}
    for recording in recordings:
        for name, position in _errors(recording, cut_trials(recording, GROUND_HORIZONS_M), fits):
            errors.setdefault(name, []).append(position)
    for name, parts in errors.items():
        if len(parts) < len(recordings):
            continue
        summary = error_summary(np.concatenate(parts))
        for h, horizon_m in enumerate(GROUND_HORIZONS_M):
            if summary.trials[h]:
                yield GroundScore(name, horizon_m, float(summary.p95[h]), float(summary.expected[h]), ground)


def _errors(recording: Recording, trials: Trials, fits: Mapping[str, PooledFit]) -> Iterator[tuple[str, Floats]]:
    """Yield the name of each row, and its errors (k, h) [m] in trials of a recording."""
    gyro_fit = fits.get(f"{RECOMMENDED}{GYRO_SUFFIX}")
    has_gyro = gyro_fit is not None and recording.track.gyro is not None
    windows = cut_windows(recording)
    for suffix in ("", GYRO_SUFFIX) if has_gyro else ("",):
        five_terms, eight_terms = (fits[f"{name}{suffix}"].fitted for name in (FIVE, RECOMMENDED))
        for name, fitted_model in (
            (CONTROLLER, controller_model(five_terms, recording.lever, recording.width_m)), (RECOMMENDED, eight_terms),
        ):  # fmt: skip
            yield (
                f"{name}{suffix}",
                _held(recording, trials, fitted_model, own_constants(windows, fitted_model, recording.width_m)),
            )
    gyro_model = gyro_fit.fitted if gyro_fit is not None else None
    drive = adapt(recording, prior_of_model(recording.width_m, fits[RECOMMENDED].fitted, gyro_model, "other grounds"))
    yield "adaptive", drive.errors(trials).position
    if has_gyro:
        yield f"adaptive{GYRO_SUFFIX}", drive.errors(trials, turned=True).position


def _held(recording: Recording, trials: Trials, fitted_model: FittedModel, constants: LogConstants) -> Floats:
    """Return the errors (k, h) [m] of a model with its constants in trials of a recording."""
    return errors_without(
        recording, trials, [Fold("", 0, 0, -np.inf, np.inf)], 0, lambda _: (fitted_model, constants)
    ).position


def other_ground_ends(
    scores: Sequence[GroundScore], row: str, budget_m: float
) -> tuple[float | None, float | None] | None:
    """Return the interval of the distance [m] over which a row stays within a budget on a further ground.

    Parameters
    ----------
    scores : result of `leave_grounds_out`
    row : name of the row
    budget_m : largest allowed error [m]

    Returns
    -------
    tuple or None
        Ends of the interval that holds the distance in 9 of 10 cases. An end is None if the error stays within the
        budget at every horizon. None for a row with fewer than `FEWEST_GROUNDS` grounds.
    """
    spread_std = row_of(row).spread.grounds
    by_horizon: dict[float, list[float]] = {}
    for score in scores:
        if score.model == row and score.p95_m > 0.0:
            by_horizon.setdefault(score.horizon_m, []).append(score.p95_m)
    p95_by_horizon = {metres: p95_m for metres, p95_m in sorted(by_horizon.items()) if len(p95_m) >= FEWEST_GROUNDS}
    if not p95_by_horizon:
        return None
    ends = np.array([ground_interval(np.array(p95_m), spread_std) for p95_m in p95_by_horizon.values()])
    reached = [within_budget(np.array(list(p95_by_horizon)), ends[:, column], budget_m) for column in (1, 0)]
    low, high = (None if end is None or end[1] else end[0] for end in reached)
    return low, high
