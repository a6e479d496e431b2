"""The ICR EKF, compiled: event-driven propagation and updates (Pentzer 2014, Section 3, Eqs. 13-25).

The state is x = (N, E, psi, y_icr_right, y_icr_left, x_icr). The letters are the paper's: x P F Q H R nu S K.
The tests compare this filter with one in matrix form (tests/support/matrix_filter.py), the one to read first.
`filter_rows` is the one event loop: the filter, the smoother's forward pass and the runs of a study call it.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from icrtool.kernels.compiled import njit
from icrtool.kernels.ekf_step import DIAGONAL, EAST, HEADING, NORTH, correct, keep_sides, measured_column, predict, wrap
from icrtool.kernels.kinematics import GUARDED, Floats, body_velocity

Codes = NDArray[np.uint8]
Flags = NDArray[np.bool_]
Ints = NDArray[np.int64]

UNSEEN, USED, GATED, RECOVERED = 0, 1, 2, 3
"""What became of a measurement: outside the run, used, rejected by the gate, used to end a lock-out."""

REFERENCE_STEP_S = 0.01
"""The paper propagates at 100 Hz; its dt^2 Q per step is Q * 0.01 s per second of time at that rate."""

BLOCK_EVENTS = 500_000
"""Events in one compiled call of `run_filter`: some 0.2 s, between which Ctrl-C and SIGTERM are acted on."""


class FilterParameters(NamedTuple):
    """Constants of one run.

    Attributes
    ----------
    process_variance : diagonal of Q, six of [(m/s)^2, (m/s)^2, (rad/s)^2, (m/s)^2 x 3], Eq. 30
    rate_invariant : add Q * 0.01 s * dt instead of the paper's dt^2 Q
    step_heading : the part of a step's turn after which its displacement is turned into the world: 0 at the start
        (Euler, Eq. 14), 0.5 in the middle, where the displacement of an arc points
    gnss_gate, heading_gate : largest NIS accepted; inf accepts all
    heading_correlation : a heading sample counts as 1 / this of an independent one: neighbours err together
    antenna_forward, antenna_right : lever arm of the antenna [m], body frame
    wheel_gap_s : a longer interval between wheel samples is not dead-reckoned
    gap_speed_variance, gap_turn_variance : growth through such a gap [m^2/s, rad^2/s]
    recovery_count, recovery_s : consistent rejected measurements, and their least duration, that end a lock-out
    icr_inflation_m2 : ICR variances after a terrain change (Section 5.2)
    least_icr : y_icr_right stays above this, y_icr_left below its negative [m]; -inf: anywhere
    guard : sign guard of the kinematics, of `icrtool.kernels.kinematics`; other than GUARDED in studies only
    """

    process_variance: tuple[float, float, float, float, float, float]
    rate_invariant: bool
    step_heading: float
    gnss_gate: float
    heading_gate: float
    heading_correlation: float
    antenna_forward: float
    antenna_right: float
    wheel_gap_s: float
    gap_speed_variance: float
    gap_turn_variance: float
    recovery_count: int
    recovery_s: float
    icr_inflation_m2: float
    least_icr: float
    guard: int = GUARDED


class Measurements(NamedTuple):
    """Inputs of one run: times [s] since any one epoch, non-decreasing.

    Attributes
    ----------
    wheel_t : (n,); v_left, v_right : (n,) [m/s], held over [k, k+1)
    gnss_t : (m,); gnss_z : (m, 2) north, east [m]; gnss_r : (m, 2) var north, var east [m^2]
    heading_t : (h,); heading_z : (h,) [rad]; heading_r : (h,) [rad^2]
    change_t : (c,) times of terrain changes
    slipping : (n,) intervals [k, k+1) in which the robot does not do what its wheels do; empty for none
    """

    wheel_t: Floats
    v_left: Floats
    v_right: Floats
    gnss_t: Floats
    gnss_z: Floats
    gnss_r: Floats
    heading_t: Floats
    heading_z: Floats
    heading_r: Floats
    change_t: Floats
    slipping: Flags = np.zeros(0, np.bool_)


class FilterOutput(NamedTuple):
    """What one run leaves behind.

    Attributes
    ----------
    x : (k, 6) states after all updates at the stamps of the last k wheel samples; variance : (k, 6) diagonal of P
    distance : (k,) path length [m]
    gnss_nis, heading_nis : (m,), (h,) normalised innovation squared, NaN where unseen
    gnss_code, heading_code : UNSEEN, USED, GATED or RECOVERED
    gnss_residual : (m, 2) fix minus estimate after the update [m]
    heading_innovation : (h,) [rad]
    P : (21,) upper triangle of the covariance at the end, row by row
    """

    x: Floats
    variance: Floats
    distance: Floats
    gnss_nis: Floats
    gnss_code: Codes
    gnss_residual: Floats
    heading_nis: Floats
    heading_code: Codes
    heading_innovation: Floats
    P: Floats


class FilterState(NamedTuple):
    """All that a run needs to go on from the rows before. Changed in place.

    Attributes
    ----------
    t : (1,) time reached [s]; distance : (1,) path length up to there [m]
    place : (3,) next fix, next heading, next terrain change
    rejected : (2, 4) rows of `rejected_run`, of GNSS and of heading
    x : (6,); P : (21,) upper triangle of the covariance, row by row
    """

    t: Floats
    distance: Floats
    place: Ints
    rejected: Floats
    x: Floats
    P: Floats

    def copy(self) -> FilterState:
        """Return a state that later rows do not change."""
        t, distance, place, rejected, x, P = self
        return FilterState(t.copy(), distance.copy(), place.copy(), rejected.copy(), x.copy(), P.copy())


class Nodes(NamedTuple):
    """Events in order, for the smoother; (m, ...) each.

    Attributes
    ----------
    x_predicted, x : (m, 6) before and after the updates; P_predicted, P : (m, 21) likewise, upper triangles
    step : (m, 4) seconds since the node before, track speeds held over them [m/s], 1 in a gap or in slip
    row : int64 (m,), row of the state recorded here, -1 where none is
    """

    x_predicted: Floats
    P_predicted: Floats
    x: Floats
    P: Floats
    step: Floats
    row: Ints


@njit
def rejected_run(run: Floats, t: float, nu_n: float, nu_e: float, limit: float, parameters: FilterParameters) -> bool:
    """Remember a rejected innovation; say whether the run of rejected ones has been right all along.

    A wrong fix disagrees with the next wrong fix; a filter that is wrong sees the same innovation again and again.
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
    """Return the antenna's place relative to the body origin: a = R(psi) (forward, right), north and east [m].

    h(x) = (N, E) + a, so dh/dpsi = (-a_E, a_N); without a lever arm H is Eq. 22.
    """
    c, s = math.cos(x[2]), math.sin(x[2])
    return forward * c - right * s, forward * s + right * c


@njit
def take_fix(
    t: float, z_n: float, z_e: float, r_n: float, r_e: float, x: Floats, P: Floats, PH: Floats, run: Floats,
    parameters: FilterParameters, residual: Floats,
) -> tuple[int, float, float, float]:  # fmt: skip
    """Gate and apply one fix z [m] of variances r [m^2]; return its code, its NIS and its innovation [m].

    North and east are applied one after the other, which equals the joint update since their noises are independent.
    """
    a_n, a_e = antenna(x, parameters.antenna_forward, parameters.antenna_right)
    nu_n, nu_e = z_n - x[0] - a_n, z_e - x[1] - a_e
    S_ee = measured_column(P, EAST, a_n, PH) + r_e
    S_nn = measured_column(P, NORTH, -a_e, PH) + r_n
    S_ne = PH[1] + a_n * PH[2]
    nis = (S_ee * nu_n * nu_n - 2.0 * S_ne * nu_n * nu_e + S_nn * nu_e * nu_e) / (S_nn * S_ee - S_ne * S_ne)
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
    return code, nis, nu_n, nu_e


@njit
def take_heading(
    t: float, z: float, r: float, x: Floats, P: Floats, PH: Floats, run: Floats, parameters: FilterParameters
) -> tuple[int, float, float]:
    """Gate and apply one heading z [rad] of variance r; return what became of it, its NIS and its innovation.

    The gate asks whether this sample is right (variance r); the update gives it its share of what its neighbours say
    too (variance r times the correlation).
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
    dt: float, in_gap: bool, slips: bool, v_left: float, v_right: float, x: Floats, P: Floats,
    parameters: FilterParameters,
) -> float:  # fmt: skip
    """Propagate by dt [s] (Eqs. 14, 16) and add the process noise; return the path length by the wheels [m].

    Through a gap in the wheel data and through slip nothing is dead-reckoned: the pose only grows uncertain, and what
    is measured next does not change the ICRs.
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
    scale = REFERENCE_STEP_S * dt if parameters.rate_invariant else dt * dt
    for i in range(6):
        P[DIAGONAL[i]] += scale * parameters.process_variance[i]
    return travelled


@njit
def filter_rows(  # noqa: C901, PLR0912 - the order of events, in one place
    data: Measurements, begin: int, end: int, state: FilterState, parameters: FilterParameters, out: FilterOutput,
    nodes: Nodes,
) -> int:  # fmt: skip
    """Run the filter over wheel samples [begin, end); return the number of events.

    Parameters
    ----------
    state : as the rows before left it; changed to what these leave
    out : its x, variance and distance are of these rows (end - begin, ...), the rest is of all measurements
    nodes : filled with every event; without rows nothing is kept

    Notes
    -----
    At equal stamps: wheel speeds, terrain changes, GNSS, heading, then the state is recorded.
    """
    x, P, PH = state.x, state.P, np.zeros(6)
    n_gnss, n_heading, n_change = len(data.gnss_t), len(data.heading_t), len(data.change_t)
    t, travelled, j, h, c = state.t[0], state.distance[0], state.place[0], state.place[1], state.place[2]
    keep, count = len(nodes.row) > 0, 0
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
                travelled += advance(dt, in_gap, slips, data.v_left[held], data.v_right[held], x, P, parameters)
                t = t_next
            while c < n_change and data.change_t[c] <= t:
                for i in range(3, 6):
                    P[DIAGONAL[i]] = max(P[DIAGONAL[i]], parameters.icr_inflation_m2)
                c += 1
            if keep:
                nodes.step[count] = dt, data.v_left[held], data.v_right[held], 1.0 if in_gap or slips else 0.0
                nodes.x_predicted[count], nodes.P_predicted[count] = x, P
            while j < n_gnss and data.gnss_t[j] <= t:
                out.gnss_code[j], out.gnss_nis[j], nu_n, nu_e = take_fix(
                    t, data.gnss_z[j, 0], data.gnss_z[j, 1], data.gnss_r[j, 0], data.gnss_r[j, 1],
                    x, P, PH, state.rejected[0], parameters, out.gnss_residual[j],
                )  # fmt: skip
                if keep and out.gnss_code[j] == RECOVERED:
                    nodes.P_predicted[count, 0] += nu_n * nu_n
                    nodes.P_predicted[count, 6] += nu_e * nu_e
                j += 1
            while h < n_heading and data.heading_t[h] <= t:
                out.heading_code[h], out.heading_nis[h], nu = take_heading(
                    t, data.heading_z[h], data.heading_r[h], x, P, PH, state.rejected[1], parameters
                )
                out.heading_innovation[h] = nu
                if keep and out.heading_code[h] == RECOVERED:
                    nodes.P_predicted[count, 11] += nu * nu
                h += 1
            if keep:
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


def run_filter(data: Measurements, t0: float, x0: Floats, P0: Floats, parameters: FilterParameters) -> FilterOutput:
    """Run the filter from state x0 (6,), covariance P0 (6, 6) at time t0 [s] over all that follows.

    Measurements stamped at or before t0 are not used: x0 was made from them. One state is recorded per wheel sample
    from t0 on, after all updates at its stamp. At equal stamps: wheel, GNSS, heading.
    """
    first, last = int(np.searchsorted(data.wheel_t, t0)), len(data.wheel_t)
    state, out, nodes = start_state(data, t0, x0, P0), empty_output(data, last - first), empty_nodes(0)
    events = last + len(data.gnss_t) + len(data.heading_t)
    for begin, end in pairwise((*range(first, last, max(last * BLOCK_EVENTS // max(events, 1), 1)), last)):
        filter_rows(data, begin, end, state, parameters, output_rows(out, begin - first, end - first), nodes)
    return out._replace(P=state.P)


def start_state(data: Measurements, t0: float, x0: Floats, P0: Floats) -> FilterState:
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


def empty_output(data: Measurements, rows: int) -> FilterOutput:
    """Return the output of a run of so many recorded states, before it has run."""
    n_gnss, n_heading = len(data.gnss_t), len(data.heading_t)
    return FilterOutput(
        x=np.empty((rows, 6)),
        variance=np.empty((rows, 6)),
        distance=np.empty(rows),
        gnss_nis=np.full(n_gnss, np.nan),
        gnss_code=np.zeros(n_gnss, np.uint8),
        gnss_residual=np.full((n_gnss, 2), np.nan),
        heading_nis=np.full(n_heading, np.nan),
        heading_code=np.zeros(n_heading, np.uint8),
        heading_innovation=np.full(n_heading, np.nan),
        P=np.empty(21),
    )


def output_rows(out: FilterOutput, begin: int, end: int) -> FilterOutput:
    """Return a view of an output that holds its recorded states [begin, end) only."""
    rows = slice(begin, end)
    return out._replace(x=out.x[rows], variance=out.variance[rows], distance=out.distance[rows])


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
