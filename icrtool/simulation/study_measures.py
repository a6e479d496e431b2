"""Numbers of each run of a study: ICR errors, convergence times, NIS, open-loop errors without GNSS. One row a run."""

from __future__ import annotations

import numpy as np

from icrtool.kernels.arcs import drive
from icrtool.kernels.arrays import Bools, Floats
from icrtool.simulation.study_runs import Chunk

ICR_NAMES = ("y_icr_right", "y_icr_left", "x_icr")

SETTLED_SHARE = 0.1
SETTLED_M = 0.02
"""An estimate has settled when its error stays below a tenth of its initial error, or below 2 cm."""

TRACE_POINTS = 400

TRIAL_M = 10.0
TRIAL_STARTS = 40
"""Open-loop trials per run; their starts are evenly spaced."""


def measure_errors(chunk: Chunk) -> dict[str, Floats]:
    """Return, over the second half of every run, mean error and its rms, with the stated std, by ICR; and NIS."""
    half = len(chunk.t_s) // 2
    error = chunk.x[:, half:, 3:] - chunk.true_icrs_m[half:]
    columns = {"inverted": inverted(chunk).astype(np.float64)}
    for place, name in enumerate(ICR_NAMES):
        columns[f"final_{name}_m"] = chunk.x[:, -1, 3 + place]
        columns[f"std_{name}_m"] = chunk.std[:, -1, 3 + place]
        columns[f"error_{name}_m"] = error[:, :, place].mean(axis=1)
        columns[f"rms_{name}_m"] = np.sqrt((error[:, :, place] ** 2).mean(axis=1))
    columns["nis_gnss"] = np.nanmean(chunk.gnss_nis, axis=1)
    columns["nis_heading"] = np.nanmean(chunk.heading_nis, axis=1)
    return columns


def measure_times(chunk: Chunk, since_s: float = 0.0, until_s: float = np.inf) -> dict[str, Floats]:
    """Return convergence and settling times [s] of every ICR after `since_s`; NaN: not before `until_s`."""
    begin = max(int(np.searchsorted(chunk.t_s, since_s - 1e-9)) - 1, 0)
    end = int(np.searchsorted(chunk.t_s, until_s - 1e-9))
    t = chunk.t_s[begin:end] - max(since_s, chunk.t_s[0])
    columns = {}
    for place, name in enumerate(ICR_NAMES):
        value, target = chunk.x[:, begin:end, 3 + place], float(chunk.true_icrs_m[end - 1, place])
        columns[f"rise_{name}_s"] = convergence_times(t, value, target)
        columns[f"settle_{name}_s"] = settling_times(t, value, target)
    columns["settle_s"] = np.max([columns[f"settle_{name}_s"] for name in ICR_NAMES], axis=0)
    return columns


def convergence_times(t: Floats, value: Floats, target: float) -> Floats:
    """Return the time (runs,) [s] between the first samples past 10 % and past 90 % of the change to the target.

    Parameters
    ----------
    t : (k,) [s]; value : (runs, k); target : the true ICR [m]

    Returns
    -------
    (runs,) [s], NaN where a run does not reach 90 %. An estimate that jumps past the target has 0.

    Notes
    -----
    Pentzer 2014, Section 5.2. `icrtool.estimation.summary.converge` computes another time, of a run without a known
    truth: its target is the median of the run's second half, and from its end on the estimate must stay within 10 %
    of the change for some seconds. `settling_times` is the time to stay near the truth.
    """
    change = target - value[:, :1]
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = (value - value[:, :1]) / change
    times = np.full(len(value), np.nan)
    for run, share in enumerate(shares):
        first = int(np.argmax(share >= 0.1))
        last = first + int(np.argmax(share[first:] >= 0.9))
        if share[first] >= 0.1 and share[last] >= 0.9:
            times[run] = t[last] - t[first]
    return times


def settling_times(t: Floats, value: Floats, target: float) -> Floats:
    """Return the time (runs,) [s] from which on the value stays near the target (`SETTLED_SHARE`); NaN: it does not."""
    near = np.maximum(SETTLED_SHARE * np.abs(target - value[:, :1]), SETTLED_M)
    away: Bools = ~(np.abs(value - target) <= near)
    last = away.shape[1] - 1 - np.argmax(away[:, ::-1], axis=1)
    ever = away.any(axis=1)
    ends_away = away[:, -1]
    settled = np.where(ever, t[np.minimum(last + 1, len(t) - 1)], t[0])
    return np.where(ends_away, np.nan, np.maximum(settled, 0.0))


def inverted(chunk: Chunk) -> Bools:
    """Return which runs (runs,) ended with y_icr_right <= y_icr_left, or with NaN."""
    return ~(chunk.x[:, -1, 3] > chunk.x[:, -1, 4])


def trace(chunk: Chunk, until_s: float = np.inf) -> dict[str, Floats]:
    """Return time and ICR estimates, (runs, about 400, 4) [s, m, m, m], from the start until `until_s`."""
    last = int(np.searchsorted(chunk.t_s, until_s, side="right")) - 1
    rows = np.unique(np.linspace(0, last, TRACE_POINTS).astype(np.int64))
    times = np.broadcast_to(chunk.t_s[rows, None], (len(chunk.x), len(rows), 1))
    return {"trace": np.concatenate([times, chunk.x[:, rows, 3:]], axis=2)}


def open_loop_p95(chunk: Chunk, track_width_m: float) -> dict[str, Floats]:
    """Return the 95th percentile (runs,) of the open-loop error after 10 m [m]: with the final ICRs, and without slip.

    Notes
    -----
    Section 6.4 with the ICRs the filter ended with, over starts all along the true path.
    """
    runs = len(chunk.x)
    columns = {"blind_icr_10m_p95_m": np.full(runs, np.nan), "blind_no_slip_10m_p95_m": np.full(runs, np.nan)}
    for run in range(runs):
        no_slip = np.array([track_width_m / 2, -track_width_m / 2, 0.0])
        for name, icrs in zip(columns, (chunk.x[run, -1, 3:], no_slip), strict=True):
            columns[name][run] = np.percentile(_open_loop_errors(chunk, run, icrs), 95)
    return columns


def _open_loop_errors(chunk: Chunk, run: int, icrs: Floats) -> Floats:
    truth = chunk.truths[run]
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
