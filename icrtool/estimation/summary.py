"""The numbers of a run: distance, speed, ICR means, convergence, GNSS difference, NIS (Pentzer 2014, Tables I-III)."""

from __future__ import annotations

from dataclasses import asdict
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from icrtool import __version__
from icrtool.kernels.ekf import GATED, RECOVERED, UNSEEN
from icrtool.kernels.kinematics import MIN_ICR_SEPARATION_M
from icrtool.records.run import RUN_SCHEMA
from icrtool.records.tables import Floats, Ints, RobotLog, States

if TYPE_CHECKING:
    from icrtool.alignment.stream_delays import StreamDelays
    from icrtool.alignment.wheel_alignment import WheelCheck
    from icrtool.estimation.filter_setup import WarmStart
    from icrtool.estimation.fit import FilterRun
    from icrtool.estimation.observability import Excitation
    from icrtool.records.run import MeasurementOutcome


ICR_COLUMNS = ("y_icr_right_m", "y_icr_left_m", "x_icr_m")

SETTLED_S = 2.0
"""An estimate has arrived when it stays within 10 % of its way for this long: an overshoot passes through."""

SMALLEST_CHANGE_M = 0.03
"""An ICR whose estimate moved less than this from its start has no rise to time."""


def run_summary(
    run: FilterRun, wheels: WheelCheck, delays: StreamDelays, excitation: Excitation, *, reference_delay_s: float
) -> dict[str, Any]:
    """Return all of a run as plain data for run.json; `reference_delay_s` is how far the fixes' stamps were moved."""
    log, config, table, fixes = run.log, run.config, run.table, run.fix_quality
    return {
        "schema": RUN_SCHEMA,
        "tool_version": __version__,
        "log": log.name,
        "inputs": [asdict(file) for file in log.inputs],
        "config": config.effective(),
        "streams": [asdict(stream) for stream in log.streams],
        "warnings": list(run.warnings),
        "drive": drive_summary(table),
        "icr": icr_summary(table, run.convergence) | {"final_covariance_m2": run.covariance[3:, 3:].tolist()},
        "terrain": run.terrain.summary(),
        "segments": segment_summary(table, run.changes_s),
        "gnss": gnss_summary(log, run.gnss, fixes.down_weighted)
        | delays.gnss_summary()
        | fixes.summary(*used_and_rejected(run.gnss)),
        "heading": run.heading_check.summary() | delays.heading_summary(),
        "wheels": wheels.summary(),
        "outages_ns": run.outages_ns.tolist(),
        "rtk_losses_ns": fixes.losses_ns.tolist(),
        "wheel_gaps_ns": [[int(table.stamp_ns[k]), int(table.stamp_ns[k + 1])] for k in np.flatnonzero(run.in_gap)],
        "filter": {
            "preset": config.filter.preset,
            "process_position_mps": run.process_position_mps,
            "reference_delay_s": reference_delay_s,
            "states": len(table),
            "warm_start": _began_with(run.warm_start),
            **nis_summary(run.gnss, run.heading),
        },
        "excitation": excitation.summary(),
    }


def _began_with(warm_start: WarmStart | None) -> dict[str, Any] | None:
    if warm_start is None:
        return None
    return {"icrs_m": warm_start.icrs_m.tolist(), "covariance_m2": warm_start.covariance_m2.tolist()}


def converge(table: States, until_s: float | None = None) -> dict[str, tuple[float, float] | None]:
    """Time the rise of each ICR estimate, up to a time where one is given.

    Returns
    -------
    dict
        By column: time [s] at which the estimate has made 10 % of the change from its start to its settled value
        (median over the second half of the run), and time from which on it stays within 10 % of that change for
        `SETTLED_S`; None where the change is below `SMALLEST_CHANGE_M` or the estimate never settles.

    Notes
    -----
    Pentzer 2014, Section 5.2: the time from 10 % change to within 90 % of the final value.
    """
    rises: dict[str, tuple[float, float] | None] = {}
    rows = max(int(np.searchsorted(table.t_s, until_s)), 1) if until_s is not None else len(table)
    t_s = table.t_s[:rows]
    settled_by = np.searchsorted(t_s, t_s + SETTLED_S)
    for column in ICR_COLUMNS:
        estimate: Floats = getattr(table, column)[:rows]
        settled = float(np.median(estimate[len(estimate) // 2 :]))
        change = settled - float(estimate[0])
        if abs(change) < SMALLEST_CHANGE_M:
            rises[column] = None
            continue
        gone = (estimate - estimate[0]) / change
        first = int(np.argmax(np.abs(gone) >= 0.1))
        last = _first_stay(settled_by, np.abs(gone - 1.0) <= 0.1)
        rises[column] = (float(t_s[first]), float(t_s[last])) if last is not None else None
    return rises


def _first_stay(until: Ints, inside: NDArray[np.bool_]) -> int | None:
    """Return the first row from which `inside` holds up to row `until` of it, which must be one; None if none does."""
    outside = np.concatenate([[0], np.cumsum(~inside)])
    stays = inside & (outside[until] == outside[:-1]) & (until < len(inside))
    return int(np.argmax(stays)) if stays.any() else None


def path_speed(table: States) -> Floats:
    """Return the speed over each interval between states (n - 1,) [m/s]; NaN where no time passes."""
    interval = np.diff(table.t_s)
    speed = np.full(len(interval), np.nan)
    np.divide(np.diff(table.distance_m), interval, out=speed, where=interval > 0)
    return speed


def drive_summary(table: States) -> dict[str, float]:
    """Return duration, distance, and mean and standard deviation of the speed over time."""
    weight = np.diff(table.t_s)
    duration, distance = float(table.t_s[-1]), float(table.distance_m[-1])
    mean = distance / duration if duration > 0 else 0.0
    deviation = np.nan_to_num(path_speed(table)) - mean
    spread = float(np.sqrt(np.average(deviation**2, weights=weight))) if duration > 0 else 0.0
    return {"duration_s": duration, "distance_m": distance, "speed_mean_mps": mean, "speed_std_mps": spread}


def icr_summary(
    table: States, convergence: dict[str, tuple[float, float] | None]
) -> dict[str, dict[str, float | None]]:
    """Return the ICRs: final, mean and standard deviation over the states after convergence, and rise times."""
    settled = max((rise[1] for rise in convergence.values() if rise is not None), default=0.0)
    after = table.t_s >= settled
    columns: dict[str, Floats] = {column: getattr(table, column) for column in ICR_COLUMNS}
    return {
        "final": {column: float(values[-1]) for column, values in columns.items()},
        "final_std": {column: float(getattr(table, f"std_{column}")[-1]) for column in columns},
        "mean": {column: float(values[after].mean()) for column, values in columns.items()},
        "std": {column: float(values[after].std()) for column, values in columns.items()},
        "convergence_s": {
            column: rise[1] - rise[0] if rise is not None else None for column, rise in convergence.items()
        },
    }


def segment_summary(table: States, changes_s: tuple[float, ...]) -> list[dict[str, Any]]:
    """Return mean and standard deviation of the ICRs over the second half of each stretch between terrain changes."""
    if not changes_s:
        return []
    edges = [0.0, *sorted(changes_s), float(table.t_s[-1])]
    segments = []
    for begin, end in pairwise(edges):
        inside = (table.t_s >= (begin + end) / 2) & (table.t_s <= end)
        columns: dict[str, Floats] = {column: getattr(table, column)[inside] for column in ICR_COLUMNS}
        segments.append(
            {
                "begin_s": begin,
                "end_s": end,
                "mean": {column: float(values.mean()) if len(values) else None for column, values in columns.items()},
                "std": {column: float(values.std()) if len(values) else None for column, values in columns.items()},
            }
        )
    return segments


def separation_multiplier(table: States, track_width_m: float) -> float:
    """Return (y_r - y_l)/b of the final estimates: the wheel_separation_multiplier of a ROS diff-drive controller."""
    separation = abs(float(table.y_icr_right_m[-1]) - float(table.y_icr_left_m[-1]))
    return max(separation, MIN_ICR_SEPARATION_M) / track_width_m


def used_and_rejected(outcome: MeasurementOutcome) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which measurements (m,) moved the filter, and which its gate refused."""
    rejected = outcome.code == GATED
    return (outcome.code > UNSEEN) & ~rejected, rejected


def gnss_summary(log: RobotLog, gnss: MeasurementOutcome, down_weighted: NDArray[np.bool_]) -> dict[str, Any]:
    """Return how many fixes were used and rejected, and how far the filter stays from those it used and trusted."""
    used, _ = used_and_rejected(gnss)
    difference = gnss.difference[used & ~down_weighted]
    datum = log.datum
    return {
        "used": int(np.count_nonzero(used)),
        "rejected": int(np.count_nonzero(gnss.code == GATED)) + sum(log.rejected_fixes.values()),
        "rejected_by_gate": int(np.count_nonzero(gnss.code == GATED)),
        "rejected_by_reason": dict(log.rejected_fixes),
        "recoveries": int(np.count_nonzero(gnss.code == RECOVERED)),
        "mean_difference_m": float(difference.mean()) if len(difference) else None,
        "max_difference_m": float(difference.max()) if len(difference) else None,
        "datum": [datum.latitude_deg, datum.longitude_deg, datum.height_m] if datum is not None else None,
    }


def nis_summary(gnss: MeasurementOutcome, heading: MeasurementOutcome) -> dict[str, Any]:
    """Return mean NIS (2 and 1 expected where the noise is right) and rejections, over measurements not gated."""
    summary: dict[str, Any] = {}
    for name, outcome in (("gnss", gnss), ("heading", heading)):
        used = (outcome.code > UNSEEN) & (outcome.code != GATED)
        summary[f"nis_{name}_mean"] = float(outcome.nis[used].mean()) if used.any() else None
        summary[f"{name}_rejected"] = int(np.count_nonzero(outcome.code == GATED))
    return summary
