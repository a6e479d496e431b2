"""The ICR EKF and its smoother, compiled (Pentzer 2014, Section 3, Eqs. 13-25; Rauch, Tung, Striebel 1965).

The state is x = (N, E, psi, y_icr_right, y_icr_left, x_icr). The letters are the paper's: x P F Q H R nu S K.
`filter_events` is the only event loop: the filter and the forward pass of the smoother call it. The tests compare the
filter with a filter in matrix form (tests/support/matrix_filter.py), which is easier to read first.

The smoother runs the filter again and keeps a node for every event: the predicted state, and the state after the
updates. Backwards, with F of Eqs. 17, 27-29 between node i and the next,

    C = P_i F^T (P-_{i+1})^-1,   xs_i = x_i + C (xs_{i+1} - x-_{i+1}),   Ps_i = P_i + C (Ps_{i+1} - P-_{i+1}) C^T

A long log is smoothed in chunks from checkpoints of the forward pass: the filter runs twice, and memory does not grow
with the log.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple, cast

import numpy as np

from icrtool.kernels.arrays import Floats
from icrtool.kernels.compiled import njit, njit_part
from icrtool.kernels.filter_records import (
    GATED,
    RECOVERED,
    REFERENCE_STEP_S,
    USED,
    Events,
    FilterInputs,
    FilterOutput,
    FilterParameters,
    FilterState,
    Nodes,
    Space,
)
from icrtool.kernels.kalman import correct, propagate, smooth_passes, store
from icrtool.kernels.kinematics import step_jacobian, wheel_speed

NORTH, EAST, PSI = (cast(int, np.int64(axis)) for axis in range(3))
"""Rows of the state that are measured. They are numbers of a NumPy type, because numba compiles a copy of a function
for each plain number in a call."""

CHANGE, FIX, HEADING, WHEELS = range(4)
"""Kinds of events, in their order at equal stamps: terrain change, fix, heading, wheel sample."""

BLOCK_EVENTS = 200_000
"""Number of events in one compiled call of `run_ekf`. A call takes about 0.03 s; Ctrl-C and SIGTERM act between
calls."""


@njit_part
def wrap(angle: float) -> float:
    """Wrap an angle [rad] to (-pi, pi]."""
    if -math.pi < angle <= math.pi:
        return angle
    return angle - 2.0 * math.pi * math.ceil((angle - math.pi) / (2.0 * math.pi))


@njit_part
def store_rejection(
    run: Floats, t: float, nu_n: float, nu_e: float, limit: float, parameters: FilterParameters
) -> bool:
    """Store a rejected innovation; return whether the rejected innovations agree, so that the filter must be wrong.

    Wrong fixes disagree with each other, and a wrong filter has the same innovation again and again.

    Parameters
    ----------
    run : (4,) number of agreeing innovations, time of the first one [s], and the last innovation
    t : time of the innovation [s]
    nu_n, nu_e : the innovation [m], north and east; of a heading [rad] and 0
    limit : largest squared difference of two consecutive innovations that agree [m^2], or [rad^2]
    parameters : parameters of the filter
    """
    step_n, step_e = nu_n - run[2], nu_e - run[3]
    if run[0] > 0.0 and step_n * step_n + step_e * step_e <= limit:
        run[0] += 1.0
    else:
        run[0] = 1.0
        run[1] = t
    run[2] = nu_n
    run[3] = nu_e
    return bool(run[0] >= parameters.recovery_count and t - run[1] >= parameters.recovery_s)


@njit_part
def antenna(x: Floats, forward: float, right: float) -> tuple[float, float]:
    """Return the antenna's position relative to the body origin: a = R(psi) (forward, right), north and east [m].

    h(x) = (N, E) + a, so dh/dpsi = (-a_E, a_N). Without a lever arm, H is Eq. 22.
    """
    c, s = math.cos(x[2]), math.sin(x[2])
    return forward * c - right * s, forward * s + right * c


@njit_part
def measured_column(P: Floats, axis: int, h_psi: float, PH: Floats) -> float:
    """Fill PH (6,) with P H^T and return H P H^T, for H = e_axis + h_psi e_psi; h_psi is 0 for a heading."""
    for i in range(6):
        PH[i] = P[i, axis] + h_psi * P[i, 2]
    return float(PH[axis] + h_psi * PH[2])


@njit_part
def keep_sides(x: Floats, P: Floats, least: float) -> None:
    """Move the state to the nearest one, in the metric of P, with y_icr_right >= least and y_icr_left <= -least.

    The right track is right of the left track: the guard of Pentzer 2014 (Section 5.1), applied to the states. Estimate
    projection (Simon and Chia 2002); the covariance does not change.
    """
    for sweep in range(4):
        row = 3 + sweep % 2
        sign = 1.0 if row == 3 else -1.0
        beyond = least - sign * x[row]
        if beyond > 0.0:
            for i in range(6):
                x[i] += sign * P[i, row] / P[row, row] * beyond


@njit_part
def take_fix(
    data: FilterInputs, row: int, state: FilterState, parameters: FilterParameters, PH: Floats, out: FilterOutput
) -> tuple[float, float, float]:
    """Gate and apply a fix, and fill its row of the output; return the variances (3,) that it added to P.

    A fix that ends a lock-out adds its squared innovation to the variances of north and east [m^2] before the update;
    other fixes add 0. North and east are applied one after the other, which equals the joint update, because their
    noises are independent.
    """
    x, P, run = state.x, state.P, state.rejected[0]
    z_n, z_e, r_n, r_e = data.gnss_z[row, 0], data.gnss_z[row, 1], data.gnss_r[row, 0], data.gnss_r[row, 1]
    a_n, a_e = antenna(x, parameters.antenna_forward, parameters.antenna_right)
    nu_n, nu_e = z_n - x[0] - a_n, z_e - x[1] - a_e
    S_ee = measured_column(P, EAST, a_n, PH) + r_e
    S_nn = measured_column(P, NORTH, -a_e, PH) + r_n
    S_ne = PH[1] + a_n * PH[2]
    det = S_nn * S_ee - S_ne * S_ne
    nis = (S_ee * nu_n * nu_n - 2.0 * S_ne * nu_n * nu_e + S_nn * nu_e * nu_e) / det
    code, more_n, more_e = USED, 0.0, 0.0
    if nis > parameters.gnss_gate:
        code = GATED
        if store_rejection(run, state.reached[0], nu_n, nu_e, parameters.gnss_gate * 2.0 * (r_n + r_e), parameters):
            code = RECOVERED
            more_n, more_e = nu_n * nu_n, nu_e * nu_e
            P[0, 0] += more_n
            P[1, 1] += more_e
            S_nn = measured_column(P, NORTH, -a_e, PH) + r_n
    if code != GATED:
        run[0] = 0.0
        E, psi = x[1], x[2]
        correct(x, P, PH, S_nn, nu_n, None, 6)
        S_ee = measured_column(P, EAST, a_n, PH) + r_e
        correct(x, P, PH, S_ee, nu_e - (x[1] - E) - a_n * (x[2] - psi), None, 6)
        keep_sides(x, P, parameters.least_icr)
    a_n, a_e = antenna(x, parameters.antenna_forward, parameters.antenna_right)
    out.gnss_code[row], out.gnss_nis[row], out.gnss_det[row] = code, nis, det
    out.gnss_residual[row, 0], out.gnss_residual[row, 1] = z_n - x[0] - a_n, z_e - x[1] - a_e
    return more_n, more_e, 0.0


@njit_part
def take_heading(
    data: FilterInputs, row: int, state: FilterState, parameters: FilterParameters, PH: Floats, out: FilterOutput
) -> tuple[float, float, float]:
    """Gate and apply a heading, and fill its row of the output; return the variances (3,) that it added to P.

    The gate tests the single sample, with variance r. The update uses r times the correlation, because the errors of
    consecutive samples are not independent.
    """
    x, P, run, r = state.x, state.P, state.rejected[1], data.heading_r[row]
    nu = wrap(data.heading_z[row] - x[2])
    nis = nu * nu / (P[2, 2] + r)
    code, added = USED, 0.0
    if nis > parameters.heading_gate:
        code = GATED
        if store_rejection(run, state.reached[0], nu, 0.0, parameters.heading_gate * 2.0 * r, parameters):
            code = RECOVERED
            added = nu * nu
            P[2, 2] += added
    if code != GATED:
        run[0] = 0.0
        S = measured_column(P, PSI, 0.0, PH) + r * parameters.heading_correlation
        correct(x, P, PH, S, nu, None, 6)
        keep_sides(x, P, parameters.least_icr)
    out.heading_code[row], out.heading_nis[row], out.heading_innovation[row] = code, nis, nu
    return 0.0, 0.0, added


@njit_part
def advance(
    dt: float, data: FilterInputs, k: int, state: FilterState, parameters: FilterParameters, space: Space
) -> None:
    """Propagate the state by dt [s] (Eqs. 14, 16), and add process noise and path length.

    Through a gap in the wheel data, and through slip, the pose is not dead-reckoned: ``space.G`` becomes 0, only the
    uncertainty of the pose grows, and the next measurement does not change the ICRs. The variance of the ICRs grows
    with the distance that the wheels travel, also in a gap, so that the ICRs of a parked robot keep their variance.

    Parameters
    ----------
    k : next wheel sample; until its stamp, the speeds of sample k - 1 hold
    """
    x, P, G, held = state.x, state.P, space.G, max(k - 1, 0)
    v_left, v_right = data.v_left[held], data.v_right[held]
    in_gap = data.wheel_t[k] - data.wheel_t[held] > parameters.wheel_gap_s
    turn, length = step_jacobian(x, v_left, v_right, dt, parameters.step_heading, parameters.guard, G)
    if in_gap or (len(data.slipping) > 0 and data.slipping[held]):
        P[0, 0] += parameters.gap_speed_variance * dt
        P[1, 1] += parameters.gap_speed_variance * dt
        P[2, 2] += parameters.gap_turn_variance * dt
        for i in range(3):
            for j in range(4):
                G[i, j] = 0.0
    else:
        propagate(G, P, space.T, 3, 2, 4, 6)
        x[0] += G[1, 0]
        x[1] -= G[0, 0]
        x[2] += turn
    pose_factor = icr_factor = dt * dt
    if parameters.rate_invariant:
        pose_factor = REFERENCE_STEP_S * dt
        icr_factor = pose_factor * wheel_speed(v_left, v_right)
    for i in range(6):
        P[i, i] += (pose_factor if i < 3 else icr_factor) * parameters.process_variance[i]
    if len(data.turn_variance) > 0:
        P[2, 2] += data.turn_variance[held] * dt
    if not in_gap:
        state.reached[1] += length


@njit_part
def begin_node(nodes: Nodes, m: int, state: FilterState, dt: float, G: Floats) -> None:
    """Store in node m the predicted state, dt [s] after the node before."""
    store(state.x, state.P, nodes.x_predicted, nodes.P_predicted, m)
    for i in range(3):
        for j in range(4):
            nodes.G[m, i, j] = G[i, j] if dt > 0.0 else 0.0


@njit_part
def end_node(nodes: Nodes, m: int, state: FilterState, row: int, added: tuple[float, float, float]) -> None:
    """Store in node m the state after an event, the variances that the event added to P, and the wheel sample."""
    store(state.x, state.P, nodes.x, nodes.P, m)
    nodes.row[m] = row
    for axis in range(3):
        nodes.P_predicted[m, axis, axis] += added[axis]


@njit_part
def record(state: FilterState, states: Floats, column: int) -> None:
    """Store the state in a column of `FilterOutput.states`."""
    for axis in range(6):
        states[axis, column], states[6 + axis, column] = state.x[axis], state.P[axis, axis]
    states[12, column] = state.reached[1]


@njit
def filter_events(
    events: Events, data: FilterInputs, first: int, begin: int, state: FilterState, parameters: FilterParameters,
    space: Space, out: FilterOutput, nodes: Nodes | None,
) -> int:  # fmt: skip
    """Run the filter over events; return the number of nodes, which are distinct times.

    Parameters
    ----------
    first, begin : wheel sample of the first column of ``out.states``, and of the first state that is recorded now
    nodes : gets a node for every time of events; None: no node is stored, and numba compiles a separate function
    """
    count, recorded, k = 0, True, begin
    for i in range(len(events.t)):
        kind, row, dt = events.kind[i], events.row[i], events.t[i] - state.reached[0]
        added = (0.0, 0.0, 0.0)
        if dt > 0.0:
            advance(dt, data, k, state, parameters, space)
            state.reached[0] = events.t[i]
        if kind == CHANGE:
            for axis in range(3, 6):
                state.P[axis, axis] = max(state.P[axis, axis], parameters.icr_inflation_m2)
        if nodes is not None and (dt > 0.0 or recorded):
            begin_node(nodes, count, state, dt, space.G)
            count += 1
        if kind == FIX:
            added = take_fix(data, row, state, parameters, space.PH, out)
        elif kind == HEADING:
            added = take_heading(data, row, state, parameters, space.PH, out)
        recorded = kind == WHEELS
        if recorded:
            record(state, out.states, row - first)
            k = row + 1
        if nodes is not None:
            end_node(nodes, count - 1, state, row if recorded else -1, added)
    return count


def events_until(data: FilterInputs, begin: int, end: int, after: float) -> Events:
    """Return in order of time: wheel samples [begin, end), and all other events after a time [s] until the last one."""
    stamps, until = (data.change_t, data.gnss_t, data.heading_t, data.wheel_t), data.wheel_t[end - 1]
    spans = [np.searchsorted(times, [after, until], side="right").tolist() for times in stamps[:-1]]
    spans.append([begin, end])
    t = np.concatenate([times[first:stop] for times, (first, stop) in zip(stamps, spans, strict=True)])
    order = np.argsort(t, kind="stable")
    kind = np.repeat(np.arange(len(spans)), [stop - first for first, stop in spans])
    row = np.concatenate([np.arange(first, stop) for first, stop in spans])
    return Events(t[order], kind[order], row[order])


def filter_rows(
    data: FilterInputs, begin: int, end: int, state: FilterState, parameters: FilterParameters, out: FilterOutput,
    first: int, *, keep: bool = False,
) -> Nodes:  # fmt: skip
    """Run the filter over wheel samples [begin, end); return its nodes if `keep`, else no nodes.

    Parameters
    ----------
    data : result of `compiled_inputs`
    state : state of the filter, which is changed in place
    parameters : parameters of the filter
    out : the output, which is filled
    first : wheel sample of the first column of ``out.states``
    """
    events = events_until(data, begin, end, state.reached[0])
    nodes = Nodes.empty(len(events.t)) if keep else None
    count = filter_events(events, data, first, begin, state, parameters, Space.empty(), out, nodes)
    return Nodes.empty(0) if nodes is None else Nodes._make(column[:count] for column in nodes)


def run_ekf(
    data: FilterInputs, t0: float, x0: Floats, P0: Floats, parameters: FilterParameters, stops: Sequence[int] = ()
) -> FilterOutput:
    """Return the output of the filter from a start over all later measurements.

    Measurements at or before t0 are not used, because x0 was made of them. One state is recorded for each wheel sample
    from t0 on, after all updates at its stamp. The order at equal stamps is: terrain change, fix, heading, wheels.

    Parameters
    ----------
    data : the measurements
    t0 : time of the start [s]
    x0 : (6,) state at the start
    P0 : (6, 6) covariance at the start
    parameters : parameters of the filter
    stops : rows of recorded states, ascending, at which the whole covariance is kept
    """
    first, last = int(np.searchsorted(data.wheel_t, t0)), len(data.wheel_t)
    size = max(last * BLOCK_EVENTS // (last + len(data.gnss_t) + len(data.heading_t)), 1)
    data, state = compiled_inputs(data), FilterState.start(t0, x0, P0)
    out, kept = FilterOutput.empty(data, last - first), []
    for begin, end in pairwise(sorted({*range(first, last, size), *(first + stop + 1 for stop in stops), last})):
        filter_rows(data, begin, end, state, parameters, out, first)
        if end - first - 1 in stops:
            kept.append(state.P.copy())
    return out._replace(P=state.P, P_at_stops=np.array(kept).reshape(-1, 6, 6))


def compiled_inputs(data: FilterInputs) -> FilterInputs:
    """Return the inputs in the form that the kernel is compiled for; only inputs in another form are copied."""
    return FilterInputs._make(np.require(column, requirements=["C", "A", "W"]) for column in data)


CHUNK_SAMPLES = 8192
"""Number of wheel samples whose nodes are kept at a time. The nodes need about 30 MB."""


class Smoothed(NamedTuple):
    """Smoothed states x (k, 6), and their variances (k, 6), the diagonal of P."""

    x: Floats
    variance: Floats


def run_smoother(
    data: FilterInputs, t0: float, x0: Floats, P0: Floats, parameters: FilterParameters, chunk_rows: int = CHUNK_SAMPLES
) -> Smoothed:
    """Return the smoothed states of the run that `run_ekf` makes of the same arguments.

    Returns
    -------
    Smoothed
        A state for each recorded state of the filter; the last one equals the last state of the filter.
    """
    first, last = int(np.searchsorted(data.wheel_t, t0)), len(data.wheel_t)
    chunks, saved = list(pairwise([*range(first, last, chunk_rows), last])), [FilterState.start(t0, x0, P0)]
    data, forward = compiled_inputs(data), FilterOutput.empty(data, min(chunk_rows, last - first))
    for begin, end in chunks[:-1]:
        saved.append(saved[-1].copy())
        filter_rows(data, begin, end, saved[-1], parameters, forward, begin)
    out, following = Smoothed(np.empty((last - first, 6)), np.empty((last - first, 6))), Nodes.empty(0)
    for (begin, end), state in zip(reversed(chunks), reversed(saved), strict=True):
        nodes = filter_rows(data, begin, end, state, parameters, forward, begin, keep=True)
        count = len(nodes.row)
        # The last node is already smoothed: it is the first node of the next chunk, or the end of the run.
        nodes = Nodes._make(np.concatenate(columns) for columns in zip(nodes, following, strict=True))
        F = np.tile(np.eye(6), (len(nodes.row) - 1, 1, 1))
        F[:, :3, 2:] += nodes.G[1:]
        smooth_passes(F, nodes.x_predicted, nodes.P_predicted, nodes.x, nodes.P)
        recorded = np.flatnonzero(nodes.row[:count] >= 0)
        out.x[begin - first : end - first] = nodes.x[recorded]
        out.variance[begin - first : end - first] = np.diagonal(nodes.P, axis1=1, axis2=2)[recorded]
        following = Nodes._make(column[:1].copy() for column in nodes)
    return out
