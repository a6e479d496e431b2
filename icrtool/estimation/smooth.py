"""Smooth: the best trajectory and ICRs offline, every state knowing the whole log."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from icrtool.estimation.run_filter import carry_headings, set_up_again
from icrtool.kernels.arrays import Floats
from icrtool.kernels.ekf import run_smoother
from icrtool.kernels.kinematics import MIN_ICR_SEPARATION_M
from icrtool.records.run import STATE_COLUMNS, Run
from icrtool.records.tables import States


def smooth(run: Run) -> States:
    """Run the RTS smoother over a finished run.

    Parameters
    ----------
    run : what `icrtool.fit` returned

    Returns
    -------
    States
        One row per state of the run, at the same stamps. The path length is that of the smoothed ICRs.

    Notes
    -----
    The filter's noises are the smoother's: where the wheels contradict the reference, the smoothed ICRs still follow
    process noise of `filter.process_icr_mps`.
    """
    setup = set_up_again(run)
    smoothed = run_smoother(*setup)
    std = np.sqrt(np.maximum(smoothed.variance, 0.0))
    columns: dict[str, Floats] = {}
    for i, name in enumerate(STATE_COLUMNS):
        columns[name] = np.ascontiguousarray(smoothed.x[:, i])
        columns[f"std_{name}"] = np.ascontiguousarray(std[:, i])
    kept = {field.name: getattr(run.table, field.name) for field in fields(States) if field.name not in columns}
    table = States(**(kept | columns | {"distance_m": _distance(run, smoothed.x)}))
    carry_headings(table, run.sensors, run.heading.used)
    return table


def _distance(run: Run, x: Floats) -> Floats:
    """Return the path length (n,) [m] with the smoothed ICRs, as Eqs. 8-12 have it; gaps add nothing."""
    table = run.table
    right, left, ahead = x[:, 3], x[:, 4], x[:, 5]
    width = np.maximum(np.abs(left - right), MIN_ICR_SEPARATION_M)
    omega = (table.v_left_mps - table.v_right_mps) / width
    forward = (table.v_left_mps * right - table.v_right_mps * left) / width
    dt = np.where(run.in_gap, 0.0, np.append(np.diff(table.t_s), 0.0))
    distance: Floats = np.concatenate([[0.0], np.cumsum(dt * np.hypot(forward, omega * ahead))[:-1]])
    return distance
