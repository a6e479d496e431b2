"""What a differential-drive controller can be told of a run: multipliers, covariances from measured error growth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from icrtool.calibration.held_out import Fold, mask_windows, plan_folds
from icrtool.calibration.pooled import recording_of
from icrtool.calibration.record import FittedModel
from icrtool.errors import ConfigError, DataError
from icrtool.estimation.observability import find_excitation
from icrtool.motion.fit import Pool, PooledFit
from icrtool.motion.models import MODELS, MotionModel, TypicalDrive
from icrtool.motion.recording import Recording, cut_windows
from icrtool.motion.trials import twist_rates
from icrtool.records.run import Run, drive_of
from icrtool.records.tables import Floats

CONTROLLER = MotionModel(
    "controller", "what a controller knows", ("vx_v", "omega_w", "omega_v"), "diff_drive_controller of ros2_controllers"
)
"""Such a controller knows one separation and a radius a side; ICRs ahead of the axle and off centre it does not."""

SCALED = MODELS["five"]
"""ICRs and scales: what the controller does not know stands beside."""

FEWEST_RESIDUALS = 20

POSE_AFTER_M = 10.0
TWIST_OVER_M = 1.0
SMALLEST_VARIANCE = 1e-6


@dataclass(frozen=True, slots=True)
class ExportNumbers:
    """Numbers of one run for a robot's configuration. Covariances are of x forward, y left, yaw.

    Attributes
    ----------
    log : its name; begin_ns : stamp of the first state; way_m : driven
    separation_multiplier : (y_r - y_l) / b of the fit that has only what a controller knows
    left_radius_multiplier, right_radius_multiplier : radius over the configured one, what the run applied included
    icrs_m, icr_std_m : y_icr_right, y_icr_left, x_icr of the window fit with scales
    pose_variance : (3,) after `POSE_AFTER_M` of way [m^2, m^2, rad^2], held out
    twist_variance : (3,) of velocities averaged over `TWIST_OVER_M` [m^2/s^2, m^2/s^2, rad^2/s^2], held out
    turn_noise, way_noise : shares of variance, AMCL's alpha1 alpha2 and alpha3 alpha4
    p95_m : 95th percentile of the miss after `POSE_AFTER_M`, held out
    doubts : sentences
    """

    log: str
    begin_ns: int
    way_m: float
    robot: str | None
    track_width_m: float
    wheel_radius_m: float | None
    separation_multiplier: float
    separation_multiplier_std: float
    left_radius_multiplier: float
    left_radius_multiplier_std: float
    right_radius_multiplier: float
    right_radius_multiplier_std: float
    icrs_m: tuple[float, ...]
    icr_std_m: tuple[float, ...]
    pose_variance: tuple[float, float, float]
    twist_variance: tuple[float, float, float]
    turn_noise: tuple[float, float]
    way_noise: tuple[float, float]
    p95_m: float
    doubts: tuple[str, ...]


def export_numbers(run: Run) -> ExportNumbers:
    """Return what a controller can be told of a run.

    Raises
    ------
    ConfigError
        The robot's track width is not known.
    DataError
        The drive is too short.

    Notes
    -----
    Variances are those of displacements and turns over blocks of way that were held out of the fit.
    """
    width = run.track_width_m
    if width is None:
        raise ConfigError(
            "robot.track_width_m", f"not known to run {run.name}", "fit the log again with it: a multiplier is of it"
        )
    recording = recording_of(run)
    windows, folds = cut_windows(recording), plan_folds([recording])
    pool = Pool([windows], [width], CONTROLLER)
    fitted = pool.fit()
    controller, plain = _geometry(fitted, width), _geometry(Pool([windows], [width], SCALED).fit(), width)
    held_out = []
    for fold, kept in zip(folds, mask_windows([windows], folds)[0], strict=True):
        if np.count_nonzero(kept) < FEWEST_RESIDUALS:
            why = f"{run.table.distance_m[-1]:.1f} m of driven distance"
            raise DataError(run.name, why, "too short to fit on one part and test on another")
        held_out.append((fold, pool.fit(kept)))
    far, near = (_misses(recording, length, held_out) for length in (POSE_AFTER_M, TWIST_OVER_M))
    scales, scale_stds = _scales(run, controller)
    config = run.summary["config"]["robot"]
    return ExportNumbers(
        log=run.name,
        begin_ns=int(run.table.stamp_ns[0]),
        way_m=float(run.table.distance_m[-1]),
        robot=config["name"],
        track_width_m=width,
        wheel_radius_m=config["wheel_radius_m"],
        separation_multiplier=controller.value[3],
        separation_multiplier_std=controller.std[3],
        left_radius_multiplier=scales[0],
        left_radius_multiplier_std=scale_stds[0],
        right_radius_multiplier=scales[1],
        right_radius_multiplier_std=scale_stds[1],
        icrs_m=plain.value[:3],
        icr_std_m=plain.std[:3],
        pose_variance=_variances(far[:, :3]),
        twist_variance=_variances(near[:, :3] / near[:, 3:4]),
        turn_noise=_shares(near[:, 2], near[:, 4], near[:, 5]),
        way_noise=_shares(np.hypot(near[:, 0], near[:, 1]), near[:, 5], near[:, 4]),
        p95_m=float(np.percentile(np.hypot(far[:, 0], far[:, 1]), 95)),
        doubts=_doubts(run, controller.value[3]),
    )


class _Geometry(NamedTuple):
    """ICRs, multipliers and radius factors, in the order of `TrackGeometry`, and one standard deviation of each."""

    value: tuple[float, ...]
    std: tuple[float, ...]


def _geometry(fit: PooledFit, width_m: float) -> _Geometry:
    found, covariance = FittedModel(fit.model, fit.parameters, fit.covariance).geometry(width_m, TypicalDrive())
    return _Geometry(tuple(found), tuple(np.sqrt(np.diag(covariance)).tolist()))


def _misses(recording: Recording, length_m: float, fits: Sequence[tuple[Fold, PooledFit]]) -> Floats:
    """Return (m, 6): miss along, across [m] and in heading [rad], duration [s], turn [rad], distance [m] of windows."""
    windows, t, held = cut_windows(recording, (length_m,)), recording.t_s, recording.held_s
    row, rows = np.searchsorted(t, windows.knot_t), []
    for fold, fit in fits:
        mine = (windows.start_m >= fold.begin_m) & (windows.end_m <= fold.end_m)
        s, e = row[windows.start[mine]], row[windows.end[mine]]
        v_x, v_y, omega = twist_rates(recording, fit.model, fit.parameters)
        theta = np.concatenate([[0.0], np.cumsum(held * omega)[:-1]])
        place = np.concatenate([[0.0], np.cumsum(held * (v_x + 1j * v_y) * np.exp(1j * theta))[:-1]])
        miss = np.exp(-1j * theta[s]) * (place[e] - place[s]) - windows.reference[mine]
        turn = recording.drive.heading[e] - recording.drive.heading[s]
        turned = theta[e] - theta[s] - turn
        rows.append(np.column_stack([miss.real, miss.imag, turned, t[e] - t[s], turn, np.full(len(s), length_m)]))
    found = np.concatenate(rows)
    if len(found) < 10:
        raise DataError(recording.name, f"{len(found)} windows held out", "error growth needs a longer drive")
    return found


def _variances(misses: Floats) -> tuple[float, float, float]:
    """Return mean squares (3,), never zero."""
    along, across, heading = (max(float(value), SMALLEST_VARIANCE) for value in (misses**2).mean(axis=0))
    return along, across, heading


def _shares(miss: Floats, first: Floats, second: Floats) -> tuple[float, float]:
    """Return a, b >= 0 with miss^2 about a first^2 + b second^2."""
    from scipy.optimize import nnls

    shares, _ = nnls(np.column_stack([first**2, second**2]), miss**2)
    return max(float(shares[0]), SMALLEST_VARIANCE), max(float(shares[1]), SMALLEST_VARIANCE)


def _scales(run: Run, controller: _Geometry) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return radius multipliers of left and right, configured scales included, and their deviations."""
    config: dict[str, Any] = run.summary["config"]["wheels"]
    left, right = (1.0 if config[key] == "auto" else float(config[key]) for key in ("left_scale", "right_scale"))
    return (
        (left * controller.value[5], right * controller.value[6]),
        (left * controller.std[5], right * controller.std[6]),
    )


def _doubts(run: Run, multiplier: float) -> tuple[str, ...]:
    """Return what to know before pasting."""
    doubts = [] if run.usable else [f"not usable: {run.summary['unusable_because']}"]
    doubts += find_excitation(run.table, drive_of(run), run.track_width_m).sentences
    if multiplier < 1.0:
        doubts.append(
            f"a multiplier of {multiplier:.2f} is below 1: a skid-steer robot turns less than its wheels, not more"
        )
    stream = next((one for one in run.summary["streams"] if one["role"] == "wheels"), None)
    if stream is not None and "Odometry" in stream["message_type"]:
        doubts.append(
            "the wheels were read from odometry twists, which hold the controller's own multipliers: "
            "these numbers are right only where b and radius are those the twists were made with"
        )
    return tuple(doubts)
