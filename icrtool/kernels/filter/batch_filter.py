"""Kernels of the studies: many filter runs in one compiled call, and a true motion that follows the filter's model."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.compiled import njit
from icrtool.kernels.filter.ekf import REFERENCE_STEP_S, filter_rows
from icrtool.kernels.filter.filter_records import FilterInputs, FilterOutput, FilterParameters, FilterState
from icrtool.kernels.kinematics import euler_step


class Batch(NamedTuple):
    """Runs that share their stamps and their noise.

    Attributes
    ----------
    wheel_t : (n,) [s], n >= 2; gnss_t : (m,); heading_t : (h,); change_t : (c,), as in `FilterInputs`
    gnss_r : (m, 2) [m^2]; heading_r : (h,) [rad^2]
    v_left, v_right : (runs, n) [m/s]; gnss_z : (runs, m, 2) [m]; heading_z : (runs, h) [rad]
    t0 : time of the start [s]; x0 : (runs, 6) states there; P0 : (21,) upper triangle of the covariance there
    stops : (s,) rows of wheel_t, increasing, the last one n - 1, after which the whole covariance is kept
    """

    wheel_t: Floats
    gnss_t: Floats
    heading_t: Floats
    change_t: Floats
    gnss_r: Floats
    heading_r: Floats
    v_left: Floats
    v_right: Floats
    gnss_z: Floats
    heading_z: Floats
    t0: float
    x0: Floats
    P0: Floats
    stops: Ints


class BatchOutput(NamedTuple):
    """Results of the runs.

    Attributes
    ----------
    x, variance : (runs, k, 6) states and the diagonal of P, from the first wheel sample at or after t0 on
    P : (runs, s, 21) upper triangle of the covariance at every stop
    gnss_nis : (runs, m); heading_nis : (runs, h), NaN where unseen
    """

    x: Floats
    variance: Floats
    P: Floats
    gnss_nis: Floats
    heading_nis: Floats


def run_batch(batch: Batch, parameters: FilterParameters) -> BatchOutput:
    """Run the filter over every run of a batch, in one compiled call that frees the GIL."""
    runs, first = len(batch.x0), int(np.searchsorted(batch.wheel_t, batch.t0))
    rows = len(batch.wheel_t) - first
    out = BatchOutput(
        x=np.empty((runs, rows, 6)),
        variance=np.empty((runs, rows, 6)),
        P=np.empty((runs, len(batch.stops), 21)),
        gnss_nis=np.full((runs, len(batch.gnss_t)), np.nan),
        heading_nis=np.full((runs, len(batch.heading_t)), np.nan),
    )
    _filter_runs(batch, parameters, first, out)
    return out


@njit
def _filter_runs(batch: Batch, parameters: FilterParameters, first: int, out: BatchOutput) -> None:
    n_gnss, n_heading = len(batch.gnss_t), len(batch.heading_t)
    gnss_code, heading_code = np.zeros(n_gnss, np.uint8), np.zeros(n_heading, np.uint8)
    residual, innovation, distance = np.zeros((n_gnss, 2)), np.zeros(n_heading), np.zeros(len(batch.wheel_t))
    det = np.zeros(n_gnss)
    for run in range(len(batch.x0)):
        data = FilterInputs(
            batch.wheel_t, batch.v_left[run], batch.v_right[run], batch.gnss_t, batch.gnss_z[run], batch.gnss_r,
            batch.heading_t, batch.heading_z[run], batch.heading_r, batch.change_t, np.zeros(0, np.bool_),
            np.zeros(0),
        )  # fmt: skip
        place = np.empty(3, np.int64)
        place[0] = np.searchsorted(batch.gnss_t, batch.t0, side="right")
        place[1] = np.searchsorted(batch.heading_t, batch.t0, side="right")
        place[2] = np.searchsorted(batch.change_t, batch.t0, side="right")
        t, travelled, rejected = np.full(1, batch.t0), np.zeros(1), np.zeros((2, 4))
        state = FilterState(t, travelled, place, rejected, batch.x0[run].copy(), batch.P0.copy())
        begin = first
        for s in range(len(batch.stops)):
            end = batch.stops[s] + 1
            rows = FilterOutput(
                out.x[run, begin - first : end - first], out.variance[run, begin - first : end - first], distance,
                out.gnss_nis[run], det, gnss_code, residual, out.heading_nis[run], heading_code, innovation, state.P,
            )  # fmt: skip
            filter_rows(data, begin, end, state, parameters, rows, None)
            out.P[run, s] = state.P
            begin = end


@njit
def model_states(
    x0: Floats, wheel_t: Floats, v_left: Floats, v_right: Floats, std: Floats, rate_invariant: bool, noise: Floats
) -> Floats:
    """Return states (n, 6) that obey the filter's own model: Eq. 14 with its process noise.

    Parameters
    ----------
    x0 : (6,) at wheel_t[0]
    wheel_t : (n,) [s]; v_left, v_right : (n,) [m/s], held over [k, k+1)
    std : (6,) square roots of the diagonal of Q (Eq. 30)
    rate_invariant : as in `FilterParameters`
    noise : (n, 6) standard normal
    """
    states = np.empty((len(wheel_t), 6))
    states[0] = x0
    for k in range(len(wheel_t) - 1):
        N, E, psi, y_r, y_l, x_v = states[k]
        dt = wheel_t[k + 1] - wheel_t[k]
        N, E, psi = euler_step(N, E, psi, dt, v_left[k], v_right[k], y_r, y_l, x_v)
        scale = math.sqrt(REFERENCE_STEP_S * dt) if rate_invariant else dt
        moved = (N, E, psi, y_r, y_l, x_v)
        for i in range(6):
            states[k + 1, i] = moved[i] + scale * std[i] * noise[k, i]
    return states
