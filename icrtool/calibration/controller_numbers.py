"""What a differential-drive controller can be told of a run: multipliers, covariances from measured error growth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from icrtool.calibration.held_out_fits import clear_of
from icrtool.calibration.model_comparison import count_blocks
from icrtool.errors import ConfigError, DataError
from icrtool.estimation.observability import find_excitation
from icrtool.kernels.window_errors import displace, move
from icrtool.motion.window_fit import WindowFit, Windows, cut_windows, fit_windows
from icrtool.motion.window_models import EXTENDED, WindowModel
from icrtool.records.run import Run, drive_of
from icrtool.records.tables import Floats

CONTROLLER = WindowModel("controller", "what a controller can be told", ("separation", "scale", "scale_difference"))
"""Such a controller knows one separation and a radius a side; ICRs ahead of the axle and off centre it does not."""

SCALED = EXTENDED[0]
"""ICRs and scales: what the controller cannot be told is told beside."""

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
    icrs_m: tuple[float, float, float]
    icr_std_m: tuple[float, float, float]
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
    long, short = cut_windows(run, (POSE_AFTER_M,)), cut_windows(run, (TWIST_OVER_M,))
    fitted = cut_windows(run)
    controller, plain = fit_windows(fitted, CONTROLLER), fit_windows(fitted, SCALED)
    held_out = _held_out_fits(run, fitted)
    far, near = _misses(run, long, held_out), _misses(run, short, held_out)
    multiplier_std = float(np.sqrt(controller.covariance[0, 0])) / width
    scales, scale_stds = _scales(run, controller)
    config = run.summary["config"]["robot"]
    return ExportNumbers(
        log=run.name,
        begin_ns=int(run.table.stamp_ns[0]),
        way_m=float(run.table.distance_m[-1]),
        robot=config["name"],
        track_width_m=width,
        wheel_radius_m=config["wheel_radius_m"],
        separation_multiplier=float(controller.terms[0]) / width,
        separation_multiplier_std=multiplier_std,
        left_radius_multiplier=scales[0],
        left_radius_multiplier_std=scale_stds[0],
        right_radius_multiplier=scales[1],
        right_radius_multiplier_std=scale_stds[1],
        icrs_m=plain.icrs_m,
        icr_std_m=plain.icr_std_m,
        pose_variance=_variances(far[:, :3]),
        twist_variance=_variances(near[:, :3] / near[:, 3:4]),
        turn_noise=_shares(near[:, 2], near[:, 4], near[:, 5]),
        way_noise=_shares(np.hypot(near[:, 0], near[:, 1]), near[:, 5], near[:, 4]),
        p95_m=float(np.percentile(np.hypot(far[:, 0], far[:, 1]), 95)),
        doubts=_doubts(run, controller, width),
    )


def _held_out_fits(run: Run, windows: Windows) -> list[tuple[float, float, WindowFit]]:
    """Return, for each block of way, its borders [m] and the controller's fit without it."""
    total = float(run.table.distance_m[-1])
    edges = np.linspace(0.0, total, count_blocks(total) + 1)
    fits = []
    for block in range(len(edges) - 1):
        kept = clear_of(windows, edges[1:-1], block)
        if np.count_nonzero(kept) < 10:
            raise DataError(run.name, f"{total:.1f} m of way", "too short to fit on one part and judge on another")
        last = edges[block + 1] if block < len(edges) - 2 else math.inf
        fits.append((float(edges[block]), float(last), fit_windows(windows.keep(kept), CONTROLLER)))
    return fits


def _misses(run: Run, windows: Windows, fits: list[tuple[float, float, WindowFit]]) -> Floats:
    """Return (m, 6): miss along, across [m] and in heading [rad], duration [s], turn [rad], way [m] of each window."""
    rows = []
    heading = np.interp(windows.knot_t, run.table.t_s, run.table.heading_rad)
    for begin, last, fit in fits:
        mine = windows.keep((windows.start_m >= begin) & (windows.end_m <= last))
        motion = move(mine.t, mine.dt, mine.v_left, mine.v_right, fit.parameters[:7], mine.knot_t)
        d, _, _ = displace(motion, mine.start, mine.end)
        miss, turn = d - mine.reference, heading[mine.end] - heading[mine.start]
        turned = motion.theta[mine.end] - motion.theta[mine.start] - turn
        duration = mine.knot_t[mine.end] - mine.knot_t[mine.start]
        rows.append(np.column_stack([miss.real, miss.imag, turned, duration, turn, mine.length_m]))
    found = np.concatenate(rows)
    if len(found) < 10:
        raise DataError(run.name, f"{len(found)} windows held out", "error growth needs a longer drive")
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


def _scales(run: Run, fit: WindowFit) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return radius multipliers of left and right, what the run had applied included, and their deviations."""
    config: dict[str, Any] = run.summary["config"]["wheels"]
    applied = float(run.summary.get("wheels", {}).get("applied_scale", 1.0))
    factors = [
        applied * (1.0 if config[key] == "auto" else float(config[key])) for key in ("left_scale", "right_scale")
    ]
    deviations = np.sqrt(np.diag(fit.parameter_covariance)[3:5])
    return (
        (factors[0] * float(fit.parameters[3]), factors[1] * float(fit.parameters[4])),
        (factors[0] * float(deviations[0]), factors[1] * float(deviations[1])),
    )


def _doubts(run: Run, fit: WindowFit, width: float) -> tuple[str, ...]:
    """Return what to know before pasting."""
    doubts = [] if run.usable else [f"not usable: {run.summary['unusable_because']}"]
    doubts += find_excitation(run.table, drive_of(run), run.track_width_m).sentences
    multiplier = float(fit.terms[0]) / width
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
