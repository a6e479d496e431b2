"""The ICR EKF, compiled: event-driven propagation and updates (Pentzer 2014, Section 3, Eqs. 13-25).

The state is x = (N, E, psi, y_icr_right, y_icr_left, x_icr). The letters are the paper's: x P F Q H R nu S K.
The tests compare this filter with one in matrix form (tests/support/matrix_filter.py), the one to read first.
`filter_rows` is the one event loop: the filter and the smoother's forward pass call it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from icrtool.kernels.arrays import Floats
from icrtool.kernels.compiled import njit
from icrtool.kernels.filter.ekf_step import (
    DIAGONAL,
    EAST,
    HEADING,
    NORTH,
    correct,
    keep_sides,
    measured_column,
    predict,
    wrap,
)
from icrtool.kernels.filter.filter_records import FilterInputs, FilterOutput, FilterParameters, FilterState, Nodes
from icrtool.kernels.filter.measurement_codes import GATED, RECOVERED, USED
from icrtool.kernels.kinematics import body_velocity, wheel_speed

REFERENCE_STEP_S = 0.01
"""The paper propagates at 100 Hz; its dt^2 Q per step is Q * 0.01 s per second of time at that rate."""

BLOCK_EVENTS = 500_000
"""Events in one compiled call of `run_ekf`: some 0.2 s, between which Ctrl-C and SIGTERM are acted on."""


@njit
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


@njit
def antenna(x: Floats, forward: float, right: float) -> tuple[float, float]:
    """Return the antenna's position relative to the body origin: a = R(psi) (forward, right), north and east [m].

    h(x) = (N, E) + a, so dh/dpsi = (-a_E, a_N); without a lever arm H is Eq. 22.
    """
    c, s = math.cos(x[2]), math.sin(x[2])
    return forward * c - right * s, forward * s + right * c


@njit
def take_fix(
    t: float, z_n: float, z_e: float, r_n: float, r_e: float, x: Floats, P: Floats, PH: Floats, run: Floats,
    parameters: FilterParameters, residual: Floats,
) -> tuple[int, float, float, float, float]:  # fmt: skip
    """Gate and apply one fix z [m] of variances r [m^2]; return its code, its NIS, det S [m^4] and its innovation [m].

    North and east are applied one after the other, which equals the joint update since their noises are independent.
    """
    a_n, a_e = antenna(x, parameters.antenna_forward, parameters.antenna_right)
    nu_n, nu_e = z_n - x[0] - a_n, z_e - x[1] - a_e
    S_ee = measured_column(P, EAST, a_n, PH) + r_e
    S_nn = measured_column(P, NORTH, -a_e, PH) + r_n
    S_ne = PH[1] + a_n * PH[2]
    det = S_nn * S_ee - S_ne * S_ne
    nis = (S_ee * nu_n * nu_n - 2.0 * S_ne * nu_n * nu_e + S_nn * nu_e * nu_e) / det
    code = USED
    if nis > parameters.gnss_gate:
        if rejected_run(run, t, nu_n, nu_e, parameters.gnss_gate * 2.0 * (r_n + r_e), parameters):
            code = RECOVERED
            P[0] += nu_n * nu_n
            P[6] += nu_e * nu_e
            S_nn = measured_column(P, NORTH, -a_e, PH) + r_n
        else:
            code = GATED
    if code != GATED:
        run[0] = 0.0
        E, psi = x[1], x[2]
        correct(x, P, PH, S_nn, nu_n)
        S_ee = measured_column(P, EAST, a_n, PH) + r_e
        correct(x, P, PH, S_ee, nu_e - (x[1] - E) - a_n * (x[2] - psi))
        keep_sides(x, P, PH, parameters.least_icr)
    a_n, a_e = antenna(x, parameters.antenna_forward, parameters.antenna_right)
    residual[0] = z_n - x[0] - a_n
    residual[1] = z_e - x[1] - a_e
    return code, nis, det, nu_n, nu_e


@njit
def take_heading(
    t: float, z: float, r: float, x: Floats, P: Floats, PH: Floats, run: Floats, parameters: FilterParameters
) -> tuple[int, float, float]:
    """Gate and apply one heading z [rad] of variance r; return its code, its NIS and its innovation [rad].

    The gate tests this sample alone (variance r). The update uses variance r times the correlation, because the errors
    of neighbouring samples are not independent.
    """
    nu = wrap(z - x[2])
    nis = nu * nu / (P[11] + r)
    code = USED
    if nis > parameters.heading_gate:
        if rejected_run(run, t, nu, 0.0, parameters.heading_gate * 2.0 * r, parameters):
            code = RECOVERED
            P[11] += nu * nu
        else:
            code = GATED
    if code != GATED:
        run[0] = 0.0
        S = measured_column(P, HEADING, 0.0, PH) + r * parameters.heading_correlation
        correct(x, P, PH, S, nu)
        keep_sides(x, P, PH, parameters.least_icr)
    return code, nis, nu


@njit
def advance(
    dt: float, in_gap: bool, slips: bool, v_left: float, v_right: float, turn_variance: float, x: Floats, P: Floats,
    parameters: FilterParameters,
) -> float:  # fmt: skip
    """Propagate by dt [s] (Eqs. 14, 16) and add the process noise; return the path length by the wheels [m].

    Through a gap in the wheel data, and through slip, the pose is not dead-reckoned: only its uncertainty grows, and
    the next measurement does not change the ICRs. These wander with the wheels' travel, through
    a gap as before it: a parked robot keeps what it has learned.
    """
    travelled = 0.0
    if in_gap or slips:
        if slips:
            v_x, v_y, _ = body_velocity(v_left, v_right, x[3], x[4], x[5])
            travelled = 0.0 if in_gap else dt * math.sqrt(v_x * v_x + v_y * v_y)
        P[0] += parameters.gap_speed_variance * dt
        P[6] += parameters.gap_speed_variance * dt
        P[11] += parameters.gap_turn_variance * dt
    else:
        travelled = predict(x, P, v_left, v_right, dt, parameters.step_heading, parameters.guard)
    of_pose = of_icrs = dt * dt
    if parameters.rate_invariant:
        of_pose = REFERENCE_STEP_S * dt
        of_icrs = of_pose * wheel_speed(v_left, v_right)
    for i in range(6):
        P[DIAGONAL[i]] += (of_pose if i < 3 else of_icrs) * parameters.process_variance[i]
    P[11] += turn_variance * dt
    return travelled


@njit
def filter_rows(  # noqa: C901, PLR0912 - the order of events, in one place
    data: FilterInputs, begin: int, end: int, state: FilterState, parameters: FilterParameters, out: FilterOutput,
    nodes: Nodes | None,
) -> int:  # fmt: skip
    """Run the filter over wheel samples [begin, end); return the number of events.

    Parameters
    ----------
    state : after the rows before `begin`; changed in place to the state after row `end` - 1
    out : its x, variance and distance are of these rows (end - begin, ...), the rest is of all measurements
    nodes : filled with every event; None: nothing is kept (compiled as a function of its own)

    Notes
    -----
    At equal stamps: wheel speeds, terrain changes, GNSS, heading, then the state is recorded.
    """
    x, P, PH = state.x, state.P, np.zeros(6)
    gnss_run, heading_run = state.rejected[0], state.rejected[1]
    n_gnss, n_heading, n_change = len(data.gnss_t), len(data.heading_t), len(data.change_t)
    t, travelled, j, h, c = state.t[0], state.distance[0], state.place[0], state.place[1], state.place[2]
    count = 0
    for k in range(begin, end):
        held = max(k - 1, 0)
        t_wheel = data.wheel_t[k]
        in_gap = t_wheel - data.wheel_t[held] > parameters.wheel_gap_s
        slips = held < len(data.slipping) and data.slipping[held]
        while True:
            t_next = t_wheel
            if j < n_gnss:
                t_next = min(t_next, data.gnss_t[j])
            if h < n_heading:
                t_next = min(t_next, data.heading_t[h])
            if c < n_change:
                t_next = min(t_next, data.change_t[c])
            dt = max(t_next - t, 0.0)
            if dt > 0.0:
                travelled += advance(
                    dt, in_gap, slips, data.v_left[held], data.v_right[held],
                    data.turn_variance[held] if held < len(data.turn_variance) else 0.0, x, P, parameters,
                )  # fmt: skip
                t = t_next
            while c < n_change and data.change_t[c] <= t:
                for i in range(3, 6):
                    P[DIAGONAL[i]] = max(P[DIAGONAL[i]], parameters.icr_inflation_m2)
                c += 1
            if nodes is not None:
                nodes.step[count] = dt, data.v_left[held], data.v_right[held], 1.0 if in_gap or slips else 0.0
                nodes.x_predicted[count], nodes.P_predicted[count] = x, P
            while j < n_gnss and data.gnss_t[j] <= t:
                out.gnss_code[j], out.gnss_nis[j], out.gnss_det[j], nu_n, nu_e = take_fix(
                    t, data.gnss_z[j, 0], data.gnss_z[j, 1], data.gnss_r[j, 0], data.gnss_r[j, 1],
                    x, P, PH, gnss_run, parameters, out.gnss_residual[j],
                )  # fmt: skip
                if nodes is not None and out.gnss_code[j] == RECOVERED:
                    nodes.P_predicted[count, 0] += nu_n * nu_n
                    nodes.P_predicted[count, 6] += nu_e * nu_e
                j += 1
            while h < n_heading and data.heading_t[h] <= t:
                out.heading_code[h], out.heading_nis[h], nu = take_heading(
                    t, data.heading_z[h], data.heading_r[h], x, P, PH, heading_run, parameters
                )
                out.heading_innovation[h] = nu
                if nodes is not None and out.heading_code[h] == RECOVERED:
                    nodes.P_predicted[count, 11] += nu * nu
                h += 1
            if nodes is not None:
                nodes.x[count], nodes.P[count] = x, P
                nodes.row[count] = k - begin if t >= t_wheel else -1
            count += 1
            if t >= t_wheel:
                break
        for i in range(6):
            out.x[k - begin, i] = x[i]
            out.variance[k - begin, i] = P[DIAGONAL[i]]
        out.distance[k - begin] = travelled
    state.t[0], state.distance[0], state.place[0], state.place[1], state.place[2] = t, travelled, j, h, c
    return count


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
    block = empty_output(data, min(size, last - first))
    # The kernel writes row by row; here each column is contiguous, so that the states need no copy of them.
    x, variance, distance = np.empty((6, last - first)).T, np.empty((6, last - first)).T, np.empty(last - first)
    kept = []
    for begin, end in pairwise(sorted({*range(first, last, size), *(first + stop + 1 for stop in stops), last})):
        count, rows = end - begin, slice(begin - first, end - first)
        out = block._replace(x=block.x[:count], variance=block.variance[:count], distance=block.distance[:count])
        filter_rows(data, begin, end, state, parameters, out, None)
        x[rows], variance[rows], distance[rows] = out.x, out.variance, out.distance
        if end - first - 1 in stops:
            kept.append(state.P.copy())
    at_stops = np.array(kept).reshape(-1, len(state.P))
    return block._replace(x=x, variance=variance, distance=distance, P=state.P, P_at_stops=at_stops)


def start_state(data: FilterInputs, t0: float, x0: Floats, P0: Floats) -> FilterState:
    """Return the state of a run that starts at t0 [s] with state x0 (6,) and covariance P0 (6, 6)."""
    times = (data.gnss_t, data.heading_t, data.change_t)
    return FilterState(
        t=np.array([t0], np.float64),
        distance=np.zeros(1),
        place=np.array([np.searchsorted(stamps, t0, side="right") for stamps in times], np.int64),
        rejected=np.zeros((2, 4)),
        x=x0.astype(np.float64),
        P=P0[np.triu_indices(6)].astype(np.float64),
    )


def empty_output(data: FilterInputs, rows: int) -> FilterOutput:
    """Return the output of a run of so many recorded states, before it has run."""
    n_gnss, n_heading = len(data.gnss_t), len(data.heading_t)
    return FilterOutput(
        x=np.empty((rows, 6)),
        variance=np.empty((rows, 6)),
        distance=np.empty(rows),
        gnss_nis=np.full(n_gnss, np.nan),
        gnss_det=np.full(n_gnss, np.nan),
        gnss_code=np.zeros(n_gnss, np.uint8),
        gnss_residual=np.full((n_gnss, 2), np.nan),
        heading_nis=np.full(n_heading, np.nan),
        heading_code=np.zeros(n_heading, np.uint8),
        heading_innovation=np.full(n_heading, np.nan),
        P=np.empty(21),
    )


def empty_nodes(events: int) -> Nodes:
    """Return nodes for so many events, to be filled."""
    return Nodes(
        x_predicted=np.empty((events, 6)),
        P_predicted=np.empty((events, 21)),
        x=np.empty((events, 6)),
        P=np.empty((events, 21)),
        step=np.empty((events, 4)),
        row=np.empty(events, np.int64),
    )
