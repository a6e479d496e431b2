"""The ICR EKF, compiled: event-driven propagation and updates (Pentzer 2014, Section 3, Eqs. 13-25).

The state is x = (N, E, psi, y_icr_right, y_icr_left, x_icr). The letters are the paper's: x P F Q H R nu S K.
The tests compare this filter with one in matrix form (tests/support/matrix_filter.py), the one to read first.
`filter_rows` is the one event loop: the filter and the smoother's forward pass call it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import cast

import numpy as np

from icrtool.kernels.arrays import Floats
from icrtool.kernels.compiled import njit, njit_part
from icrtool.kernels.filter.filter_records import (
    CHANGE,
    DRIVES,
    FIX,
    HEADING,
    IN_GAP,
    SLIPS,
    WHEELS,
    Block,
    FilterInputs,
    FilterOutput,
    FilterParameters,
    FilterState,
    Flags,
    Nodes,
    Space,
)
from icrtool.kernels.filter.kalman import correct, propagate, store
from icrtool.kernels.filter.measurement_codes import GATED, RECOVERED, USED
from icrtool.kernels.kinematics import step_jacobian

REFERENCE_STEP_S = 0.01
"""The paper propagates at 100 Hz; its dt^2 Q per step is Q * 0.01 s per second of time at that rate."""

NORTH, EAST, PSI = (cast(int, np.int64(axis)) for axis in range(3))
"""Which state is measured. Typed: numba compiles one more copy of a function for every plain number in a call."""

BLOCK_EVENTS = 500_000
"""Events in one compiled call of `run_ekf`: some 0.2 s, between which Ctrl-C and SIGTERM are acted on."""


@njit_part
def begin_node(nodes: Nodes, m: int, dt: float, driven: Floats, x: Floats, P: Floats) -> None:
    """Keep in node m what is predicted there, dt [s] after the node before."""
    nodes.step[m, 0], nodes.step[m, 1], nodes.step[m, 2] = dt, driven[0], driven[1]
    nodes.step[m, 3] = 0.0 if driven[2] == DRIVES else 1.0
    store(x, P, nodes.x_predicted, nodes.P_predicted, m)


@njit_part
def end_node(nodes: Nodes, m: int, row: int, x: Floats, P: Floats) -> None:
    """Keep in node m what is left after an event, and the row of the state recorded there."""
    store(x, P, nodes.x, nodes.P, m)
    nodes.row[m] = row


@njit_part
def wrap(angle: float) -> float:
    """Wrap an angle [rad] to (-pi, pi]."""
    if -math.pi < angle <= math.pi:
        return angle
    return angle - 2.0 * math.pi * math.ceil((angle - math.pi) / (2.0 * math.pi))


@njit_part
def rejected_run(run: Floats, t: float, nu_n: float, nu_e: float, limit: float, parameters: FilterParameters) -> bool:
    """Remember a rejected innovation; return whether the rejected ones agree, so that the filter must be wrong.

    Wrong fixes disagree with one another; a filter that is wrong sees the same innovation again and again.
    `run` (4,) holds count, time of the first, and the last innovation; `limit` is the squared difference that two
    consecutive innovations of a run may have.
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

    h(x) = (N, E) + a, so dh/dpsi = (-a_E, a_N); without a lever arm H is Eq. 22.
    """
    c, s = math.cos(x[2]), math.sin(x[2])
    return forward * c - right * s, forward * s + right * c


@njit_part
def measured_column(P: Floats, axis: int, h_psi: float, PH: Floats) -> float:
    """Fill PH (6,) = P H^T and return H P H^T, for H = e_axis + h_psi e_psi; of the heading with h_psi 0."""
    for i in range(6):
        PH[i] = P[i, axis] + h_psi * P[i, 2]
    return float(PH[axis] + h_psi * PH[2])


@njit_part
def keep_sides(x: Floats, P: Floats, least: float) -> None:
    """Move the state to the nearest one, in the metric of P, with y_icr_right >= least and y_icr_left <= -least.

    The right track is to the right of the left one: the paper's guard (Section 5.1) applied to the states, too.
    Estimate projection (Simon and Chia 2002): the covariance stays as it is.
    """
    for turn in range(4):
        place = 3 + turn % 2
        sign = 7.0 - 2.0 * place
        beyond = least - sign * x[place]
        if beyond > 0.0:
            for i in range(6):
                x[i] += sign * P[i, place] / P[place, place] * beyond


@njit_part
def take_fix(
    t: float, given: Floats, x: Floats, P: Floats, run: Floats, parameters: FilterParameters, PH: Floats,
    fixed: Flags, found: Floats,
) -> tuple[float, float]:  # fmt: skip
    """Gate and apply one fix of `Block.fixes` (4,), and fill `found` (5,); return what it adds to P first.

    A fix that ends a lock-out makes north and east uncertain by its innovation [m^2]; others add nothing.
    North and east are applied one after the other, which equals the joint update since their noises are independent.
    """
    z_n, z_e, r_n, r_e = given[0], given[1], given[2], given[3]
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
        if rejected_run(run, t, nu_n, nu_e, parameters.gnss_gate * 2.0 * (r_n + r_e), parameters):
            code = RECOVERED
            more_n, more_e = nu_n * nu_n, nu_e * nu_e
            P[0, 0] += more_n
            P[1, 1] += more_e
            S_nn = measured_column(P, NORTH, -a_e, PH) + r_n
    if code != GATED:
        run[0] = 0.0
        E, psi = x[1], x[2]
        correct(x, P, PH, S_nn, nu_n, fixed)
        S_ee = measured_column(P, EAST, a_n, PH) + r_e
        correct(x, P, PH, S_ee, nu_e - (x[1] - E) - a_n * (x[2] - psi), fixed)
        keep_sides(x, P, parameters.least_icr)
    a_n, a_e = antenna(x, parameters.antenna_forward, parameters.antenna_right)
    found[0], found[1], found[2], found[3], found[4] = code, nis, det, z_n - x[0] - a_n, z_e - x[1] - a_e
    return more_n, more_e


@njit_part
def take_heading(
    t: float, given: Floats, x: Floats, P: Floats, run: Floats, parameters: FilterParameters, PH: Floats,
    fixed: Flags, found: Floats,
) -> float:  # fmt: skip
    """Gate and apply one heading of `Block.headings` (2,), and fill `found` (3,); return what it adds to P first.

    The gate tests this sample alone (variance r). The update uses variance r times the correlation, because the errors
    of neighbouring samples are not independent.
    """
    r, nu = given[1], wrap(given[0] - x[2])
    nis = nu * nu / (P[2, 2] + r)
    code, more = USED, 0.0
    if nis > parameters.heading_gate:
        code = GATED
        if rejected_run(run, t, nu, 0.0, parameters.heading_gate * 2.0 * r, parameters):
            code = RECOVERED
            more = nu * nu
            P[2, 2] += more
    if code != GATED:
        run[0] = 0.0
        S = measured_column(P, PSI, 0.0, PH) + r * parameters.heading_correlation
        correct(x, P, PH, S, nu, fixed)
        keep_sides(x, P, parameters.least_icr)
    found[0], found[1], found[2] = code, nis, nu
    return more


@njit_part
def advance(
    dt: float, given: Floats, x: Floats, P: Floats, parameters: FilterParameters, G: Floats, T: Floats
) -> float:
    """Propagate by dt [s] (Eqs. 14, 16) and add the process noise; return the path length by the wheels [m].

    Through a gap in the wheel data, and through slip, the pose is not dead-reckoned: only its uncertainty grows, and
    the next measurement does not change the ICRs. These wander with the wheels' travel, through
    a gap as before it: a parked robot keeps what it has learned.

    Parameters
    ----------
    given : (4,) of `Block.wheels`
    """
    v_left, v_right = given[0], given[1]
    turn, length = step_jacobian(x, v_left, v_right, dt, parameters.step_heading, parameters.guard, G)
    if given[2] == DRIVES:
        propagate(G, P, T)
        x[0] += G[1, 0]
        x[1] -= G[0, 0]
        x[2] += turn
    else:
        P[0, 0] += parameters.gap_speed_variance * dt
        P[1, 1] += parameters.gap_speed_variance * dt
        P[2, 2] += parameters.gap_turn_variance * dt
    of_pose = of_icrs = dt * dt
    if parameters.rate_invariant:
        of_pose = REFERENCE_STEP_S * dt
        of_icrs = of_pose * 0.5 * (abs(v_left) + abs(v_right))
    for i in range(6):
        P[i, i] += (of_pose if i < 3 else of_icrs) * parameters.process_variance[i]
    P[2, 2] += given[3] * dt
    return 0.0 if given[2] == IN_GAP else length


@njit
def filter_block(
    block: Block, reached: Floats, x: Floats, P: Floats, rejected: Floats, parameters: FilterParameters, space: Space,
    nodes: Nodes | None,
) -> int:  # fmt: skip
    """Run the filter over a block; return the number of nodes.

    Parameters
    ----------
    reached, x, P, rejected : of `FilterState`
    nodes : as in `filter_rows`; without them compiled as a function of its own
    """
    k, count, recorded = 0, 0, True
    for i in range(len(block.t)):
        t, kind, row, driven = block.t[i], block.kind[i], block.row[i], block.wheels[k]
        dt, more_n, more_e, more_psi = t - reached[0], 0.0, 0.0, 0.0
        if dt > 0.0:
            reached[1] += advance(dt, driven, x, P, parameters, space.G, space.T)
            reached[0] = t
        if kind == CHANGE:
            for axis in range(3, 6):
                P[axis, axis] = max(P[axis, axis], parameters.icr_inflation_m2)
        if nodes is not None and (dt > 0.0 or recorded):
            begin_node(nodes, count, max(dt, 0.0), driven, x, P)
            count += 1
        if kind == FIX:
            more_n, more_e = take_fix(
                reached[0], block.fixes[row], x, P, rejected[0], parameters, space.PH, space.fixed, block.of_fixes[row]
            )
        elif kind == HEADING:
            more_psi = take_heading(
                reached[0],
                block.headings[row],
                x,
                P,
                rejected[1],
                parameters,
                space.PH,
                space.fixed,
                block.of_headings[row],
            )
        recorded = kind == WHEELS
        if recorded:
            for axis in range(6):
                block.states[k, axis], block.states[k, 6 + axis] = x[axis], P[axis, axis]
            block.states[k, 12] = reached[1]
            k += 1
        if nodes is not None:
            end_node(nodes, count - 1, row if recorded else -1, x, P)
            for axis, more in enumerate((more_n, more_e, more_psi)):
                nodes.P_predicted[count - 1, axis, axis] += more
    return count


def filter_rows(
    data: FilterInputs, begin: int, end: int, state: FilterState, parameters: FilterParameters, out: FilterOutput,
    nodes: Nodes | None,
) -> int:  # fmt: skip
    """Run the filter over wheel samples [begin, end); return the number of nodes: of distinct times.

    Parameters
    ----------
    state : after the rows before `begin`; changed in place to the state after row `end` - 1
    out : its x, variance and distance begin with these rows, the rest is of all measurements
    nodes : filled with every time of events; None: nothing is kept

    Notes
    -----
    At equal stamps: terrain changes, GNSS, heading, then the state is recorded.
    """
    stamps, first = (data.change_t, data.gnss_t, data.heading_t), state.place.copy()
    stop = [np.searchsorted(times, data.wheel_t[end - 1], side="right") for times in stamps]
    state.place[:] = np.maximum(stop, first)
    changes, fixes, headings = (slice(*span) for span in zip(first, state.place, strict=True))
    block = _block(data, begin, end, changes, fixes, headings, parameters.wheel_gap_s)
    count = filter_block(block, state.reached, state.x, state.P, state.rejected, parameters, Space.empty(), nodes)
    rows, states = slice(end - begin), block.states
    out.x[rows], out.variance[rows], out.distance[rows] = states[:, :6], states[:, 6:12], states[:, 12]
    out.gnss_code[fixes], out.gnss_nis[fixes], out.gnss_det[fixes] = block.of_fixes[:, :3].T
    out.gnss_residual[fixes] = block.of_fixes[:, 3:]
    out.heading_code[headings], out.heading_nis[headings], out.heading_innovation[headings] = block.of_headings.T
    return int(count)


def _block(
    data: FilterInputs, begin: int, end: int, changes: slice, fixes: slice, headings: slice, wheel_gap_s: float
) -> Block:
    """Return the events of wheel samples [begin, end), and of some rows of the measurements, in order."""
    held = np.maximum(np.arange(begin, end) - 1, 0)
    wheels = np.zeros((end - begin, 4))
    wheels[:, 0], wheels[:, 1] = data.v_left[held], data.v_right[held]
    if len(data.slipping):
        wheels[:, 2] = np.where(data.slipping[held], SLIPS, DRIVES)
    wheels[data.wheel_t[begin:end] - data.wheel_t[held] > wheel_gap_s, 2] = IN_GAP
    if len(data.turn_variance):
        wheels[:, 3] = data.turn_variance[held]
    stamps = (data.change_t[changes], data.gnss_t[fixes], data.heading_t[headings], data.wheel_t[begin:end])
    counts = [len(one) for one in stamps]
    t = np.concatenate(stamps)
    order = np.argsort(t, kind="stable")
    kind = np.repeat(np.arange(WHEELS + 1), counts)[order]
    row = np.concatenate([np.arange(count) for count in counts])[order]
    _, n_fixes, n_headings, n_wheels = counts
    return Block(
        t[order], kind, row, wheels,
        np.column_stack([data.gnss_z[fixes], data.gnss_r[fixes]]),
        np.column_stack([data.heading_z[headings], data.heading_r[headings]]),
        np.empty((n_fixes, 5)), np.empty((n_headings, 3)), np.empty((n_wheels, 13)),
    )  # fmt: skip


def run_ekf(
    data: FilterInputs, t0: float, x0: Floats, P0: Floats, parameters: FilterParameters, stops: Sequence[int] = ()
) -> FilterOutput:
    """Run the filter from state x0 (6,), covariance P0 (6, 6) at time t0 [s] over all that follows.

    Measurements stamped at or before t0 are not used: x0 was made from them. One state is recorded per wheel sample
    from t0 on, after all updates at its stamp. At equal stamps: wheel, GNSS, heading.

    Parameters
    ----------
    stops : rows of recorded states, ascending, at which the whole covariance is kept
    """
    first, last = int(np.searchsorted(data.wheel_t, t0)), len(data.wheel_t)
    state, events = start_state(data, t0, x0, P0), last + len(data.gnss_t) + len(data.heading_t)
    size = max(last * BLOCK_EVENTS // max(events, 1), 1)
    out, kept = empty_output(data, last - first), []
    for begin, end in pairwise(sorted({*range(first, last, size), *(first + stop + 1 for stop in stops), last})):
        rows = slice(begin - first, end - first)
        of_rows = out._replace(x=out.x[rows], variance=out.variance[rows], distance=out.distance[rows])
        filter_rows(data, begin, end, state, parameters, of_rows, None)
        if end - first - 1 in stops:
            kept.append(state.P.copy())
    return out._replace(P=state.P, P_at_stops=np.array(kept).reshape(-1, 6, 6))


def start_state(data: FilterInputs, t0: float, x0: Floats, P0: Floats) -> FilterState:
    """Return the state of a run that starts at t0 [s] with state x0 (6,) and covariance P0 (6, 6)."""
    times = (data.change_t, data.gnss_t, data.heading_t)
    return FilterState(
        reached=np.array([t0, 0.0]),
        place=np.array([np.searchsorted(stamps, t0, side="right") for stamps in times], np.int64),
        rejected=np.zeros((2, 4)),
        x=x0.astype(np.float64),
        P=P0.astype(np.float64),
    )


def empty_output(data: FilterInputs, rows: int) -> FilterOutput:
    """Return the output of a run of so many recorded states, before it has run."""
    n_gnss, n_heading = len(data.gnss_t), len(data.heading_t)
    return FilterOutput(
        # each column contiguous: the states need no copy of them
        x=np.empty((6, rows)).T,
        variance=np.empty((6, rows)).T,
        distance=np.empty(rows),
        gnss_nis=np.full(n_gnss, np.nan),
        gnss_det=np.full(n_gnss, np.nan),
        gnss_code=np.zeros(n_gnss, np.uint8),
        gnss_residual=np.full((n_gnss, 2), np.nan),
        heading_nis=np.full(n_heading, np.nan),
        heading_code=np.zeros(n_heading, np.uint8),
        heading_innovation=np.full(n_heading, np.nan),
        P=np.empty((6, 6)),
    )
