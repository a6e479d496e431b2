"""What a differential-drive controller can use of a calibration: multipliers, and covariances of held-out errors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from msgspec import UNSET

from icrtool.calibration.error_growth import TWIST_OVER_M, nonnegative
from icrtool.calibration.held_out import HeldOut, left_out
from icrtool.calibration.record import Calibration
from icrtool.kernels.arrays import Floats, Ints
from icrtool.motion.models import CONTROLLER, NO_SLIP, RECOMMENDED, TERMS, FittedModel
from icrtool.motion.recording import LogConstants, Recording, Windows, predicted_path
from icrtool.records.calibration_document import ControllerErrors
from icrtool.records.dropout import CHOICE_HORIZON_M
from icrtool.records.plain_data import known

POSE_AFTER_M = CHOICE_HORIZON_M
SMALLEST_VARIANCE = 1e-6
FEWEST_WINDOWS = 10

LARGEST_SHARE = 0.5
"""A calibration whose 95 % error is more than this share of the distance is not fit for use."""


def unfit_reasons(calibration: Calibration) -> tuple[str, ...]:
    """Return why a calibration is not fit for use, by what it was tested on; empty where it is."""
    reasons = [one for one in calibration.warnings if one.startswith("not usable")]
    p95, expected = calibration.held_out_m(RECOMMENDED, POSE_AFTER_M)
    _, without = calibration.held_out_m(NO_SLIP, POSE_AFTER_M)
    if p95 > LARGEST_SHARE * POSE_AFTER_M:
        reasons.append(f"its error after {POSE_AFTER_M:g} m is {p95:.1f} m (95 %, held out of the fit)")
    if expected >= without:
        errors = f"expected error {expected:.2f} m and {without:.2f} m, held out of the fit"
        reasons.append(f"it is no better than no slip: {errors}")
    if "omega_w" in calibration.fitted.not_shown:
        reasons.append("the driving did not show how the robot turns (omega_w)")
    return tuple(reasons)


def export_warnings(calibration: Calibration) -> tuple[str, ...]:
    """Return what to know before a controller uses a calibration, a sentence each."""
    warnings = [one for one in unfit_reasons(calibration) if one not in calibration.warnings]
    warnings += not_shown_sentences(calibration.fitted)
    if (multiplier := calibration.controller_numbers().multiplier) < 1.0:
        why = "a skid-steer robot turns less than its wheels, not more"
        warnings.append(f"a multiplier of {multiplier:.2f} is below 1: {why}")
    return (*calibration.warnings, *warnings)


def not_shown_sentences(fitted: FittedModel) -> list[str]:
    """Return a sentence for each parameter that rests on its prior."""
    return [
        f"not shown by this driving: {name} ({TERMS[name].meaning}); its value is the prior's"
        for name in fitted.not_shown
    ]


def factor_to_old(calibration: Calibration) -> float | None:
    """Return the multiplier over the one that the log's odometry was made with, None where that is not known."""
    old_width_m = calibration.robot.twist_width_m
    if old_width_m is UNSET:
        return None
    return calibration.controller_numbers().multiplier * calibration.width_m / old_width_m


def controller_errors(cut: Sequence[tuple[int, Recording, Windows]], table: HeldOut) -> ControllerErrors | None:
    """Return the errors of what a controller can express, fitted without each fold, in that fold.

    Parameters
    ----------
    cut : of `icrtool.calibration.error_growth.cut_error_windows`

    Returns
    -------
    None where too few windows were left out.
    """
    far, near = (_window_errors(cut, length, table) for length in (POSE_AFTER_M, TWIST_OVER_M))
    if min(len(far), len(near)) < FEWEST_WINDOWS or POSE_AFTER_M not in table.horizons_m:
        return None
    h = table.horizons_m.index(POSE_AFTER_M)
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
