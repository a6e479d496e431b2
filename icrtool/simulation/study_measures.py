"""Numbers of each run of a study: ICR errors, convergence times, NIS, open-loop errors without GNSS. One row a run."""

from __future__ import annotations

import numpy as np

from icrtool.kernels.arrays import Floats
from icrtool.kernels.kinematics import drive
from icrtool.simulation.study_runs import StudyRun

ICR_NAMES = ("y_icr_right", "y_icr_left", "x_icr")

SETTLED_SHARE = 0.1
SETTLED_M = 0.02
"""An estimate has settled when its error stays below a tenth of its initial error, or below 2 cm."""

TRACE_POINTS = 400

TRIAL_M = 10.0
TRIAL_STARTS = 40
"""Open-loop trials per run; their starts are evenly spaced."""


def measure_errors(run: StudyRun) -> dict[str, float | Floats]:
    """Return, over the second half of a run, mean error and its rms, with the stated std, by ICR; and NIS."""
    half = len(run.t_s) // 2
    error = run.x[half:, 3:] - run.truth[half:, 3:]
    numbers = {"inverted": inverted(run)}
    for place, name in enumerate(ICR_NAMES):
        numbers[f"final_{name}_m"] = run.x[-1, 3 + place]
        numbers[f"std_{name}_m"] = run.std[-1, 3 + place]
        numbers[f"error_{name}_m"] = error[:, place].mean()
        numbers[f"rms_{name}_m"] = np.sqrt((error[:, place] ** 2).mean())
    numbers["nis_gnss"] = float(np.nanmean(run.gnss_nis))
    numbers["nis_heading"] = float(np.nanmean(run.heading_nis))
    return {**numbers}


def measure_times(run: StudyRun, since_s: float = 0.0, until_s: float = np.inf) -> dict[str, float | Floats]:
    """Return convergence and settling times [s] of every ICR after `since_s`; NaN: not before `until_s`."""
    begin = max(int(np.searchsorted(run.t_s, since_s - 1e-9)) - 1, 0)
    end = int(np.searchsorted(run.t_s, until_s - 1e-9))
    t = run.t_s[begin:end] - max(since_s, run.t_s[0])
    times = {}
    for place, name in enumerate(ICR_NAMES):
        value, target = run.x[begin:end, 3 + place], float(run.truth[end - 1, 3 + place])
        times[f"rise_{name}_s"] = convergence_time(t, value, target)
        times[f"settle_{name}_s"] = settling_time(t, value, target)
    return {**times, "settle_s": float(np.max([times[f"settle_{name}_s"] for name in ICR_NAMES]))}


def convergence_time(t: Floats, value: Floats, target: float) -> float:
    """Return the time [s] between the first samples past 10 % and past 90 % of the change to the target.

    Parameters
    ----------
    t : (k,) [s]; value : (k,); target : the true ICR [m]

    Returns
    -------
    NaN where the run does not reach 90 %. An estimate that jumps past the target has 0.

    Notes
    -----
    Pentzer 2014, Section 5.2. `icrtool.estimation.summary.converge` computes another time, of a run without a known
    truth: its target is the median of the run's second half, and from its end on the estimate must stay within 10 %
    of the change for some seconds. `settling_time` is the time to stay near the truth.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (value - value[0]) / (target - value[0])
    first = int(np.argmax(share >= 0.1))
    last = first + int(np.argmax(share[first:] >= 0.9))
    return float(t[last] - t[first]) if share[first] >= 0.1 and share[last] >= 0.9 else np.nan


def settling_time(t: Floats, value: Floats, target: float) -> float:
    """Return the time [s] from which on the value (k,) stays near the target (`SETTLED_SHARE`); NaN: it does not."""
    near = max(SETTLED_SHARE * abs(target - float(value[0])), SETTLED_M)
    away = np.flatnonzero(~(np.abs(value - target) <= near))
    settled = int(away[-1]) + 1 if len(away) else 0
    return max(float(t[settled]), 0.0) if settled < len(t) else np.nan


def inverted(run: StudyRun) -> float:
    """Return 1 where a run ended with y_icr_right <= y_icr_left, or with NaN; else 0."""
    return float(not run.x[-1, 3] > run.x[-1, 4])


def trace(run: StudyRun, until_s: float = np.inf) -> Floats:
    """Return time and ICR estimates, (about 400, 4) [s, m, m, m], from the start until `until_s`."""
    last = int(np.searchsorted(run.t_s, until_s, side="right")) - 1
    rows = np.unique(np.linspace(0, last, TRACE_POINTS).astype(np.int64))
    return np.column_stack([run.t_s[rows], run.x[rows, 3:]])


def open_loop_p95(run: StudyRun, track_width_m: float) -> dict[str, float | Floats]:
    """Return the 95th percentile of the open-loop error after 10 m [m]: with the final ICRs, and without slip.

    Notes
    -----
    Section 6.4 with the ICRs the filter ended with, over starts all along the true path.
    """
    no_slip = np.array([track_width_m / 2, -track_width_m / 2, 0.0])
    models = {"blind_icr_10m_p95_m": run.x[-1, 3:], "blind_no_slip_10m_p95_m": no_slip}
    return {name: float(np.percentile(_open_loop_errors(run, icrs), 95)) for name, icrs in models.items()}


def _open_loop_errors(run: StudyRun, icrs: Floats) -> Floats:
    truth = run.motion
    if truth is None:
        raise ValueError("open-loop errors need the true motion")
    north, east = truth.pose[:, 0], truth.pose[:, 1]
    distance = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(north), np.diff(east)))])
    ends = np.searchsorted(distance, distance + TRIAL_M)
    possible = np.flatnonzero(ends < len(distance))
    if not len(possible):
        return np.full(1, np.nan)
    errors = []
    for first in possible[np.linspace(0, len(possible) - 1, TRIAL_STARTS).astype(np.int64)]:
        rows = slice(first, int(ends[first]) + 1)
        t, v_left, v_right = truth.t_s[rows], truth.v_left_mps[rows], truth.v_right_mps[rows]
        end = drive(t, v_left, v_right, icrs[None, :], np.zeros(len(t), np.int64), truth.pose[first])[-1]
        errors.append(float(np.hypot(*(end - truth.pose[int(ends[first])])[:2])))
    return np.array(errors)
