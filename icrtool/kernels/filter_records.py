"""Records of the filter: its constants, inputs, outputs, state. No kernel is here."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from icrtool.kernels.arrays import Floats, Ints

Codes = NDArray[np.uint8]
Flags = NDArray[np.bool_]

UNSEEN, USED, GATED, RECOVERED = 0, 1, 2, 3
"""Codes of the outcome of a measurement: outside of the run, used, rejected by the gate, used to end a lock-out."""

GUARDED, UNGUARDED, PRINTED = 0, 1, 2
"""Sign guards (Section 5.1): Eqs. 32-34 with their derivatives; no guard, Eqs. 8-10; Eqs. 32-34 with Eqs. 28-29 as
printed.

`PRINTED` divides by W, but differentiates y_r - y_l (Eq. 28 with the difference of Eqs. 32-34).
"""

REFERENCE_STEP_S = 0.01
"""Step of the paper's filter, which propagates at 100 Hz [s]. Its process noise of dt^2 Q for each step is 0.01 s * Q
for each second."""


class FilterParameters(NamedTuple):
    """Constants of one run.

    Attributes
    ----------
    process_variance : diagonal of Q, six of [(m/s)^2, (m/s)^2, (rad/s)^2, (m/s)^2 x 3], Eq. 30
    rate_invariant : add Q * 0.01 s * dt instead of the paper's dt^2 Q; for the ICRs, dt is multiplied by the speed of
        the wheels over 1 m/s
    step_heading : share of the turn of a step that is added to the heading before the displacement is rotated into the
        world: 0 for the heading at the start (Euler, Eq. 14), 0.5 for the heading in the middle, the direction of the
        chord of an arc
    gnss_gate, heading_gate : largest accepted NIS; inf accepts all
    heading_correlation : number of heading samples that count as one, because the errors of consecutive samples are
        correlated
    antenna_forward, antenna_right : lever arm of the antenna [m], body frame
    wheel_gap_s : interval between wheel samples above which there is a gap, which is not dead-reckoned [s]
    gap_speed_variance, gap_turn_variance : growth of the variances of position and heading in a gap [m^2/s, rad^2/s]
    recovery_count, recovery_s : smallest number and duration of agreeing rejected measurements that end a lock-out
    icr_inflation_m2 : smallest ICR variances after a terrain change (Section 5.2)
    least_icr : y_icr_right stays above this limit, y_icr_left below its negative [m]; -inf: no limit
    guard : sign guard of the kinematics; `PRINTED` in preset ``paper``, `UNGUARDED` only in studies
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


class FilterInputs(NamedTuple):
    """Inputs of one run; times are non-decreasing [s] since a common epoch.

    Attributes
    ----------
    wheel_t : (n,); v_left, v_right : (n,) [m/s], held over [k, k+1)
    gnss_t : (m,); gnss_z : (m, 2) north, east [m]; gnss_r : (m, 2) var north, var east [m^2]
    heading_t : (h,); heading_z : (h,) [rad]; heading_r : (h,) [rad^2]
    change_t : (c,) times of terrain changes
    slipping : (n,) whether the interval [k, k+1) lies in a slip event; empty: no interval
    turn_variance : (n,) further growth of the variance of the heading over [k, k+1) [rad^2/s]; empty: no growth
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
    turn_variance: Floats = np.zeros(0)


class FilterOutput(NamedTuple):
    """Results of a run for each recorded state, fix and heading. The run fills the arrays in place.

    Attributes
    ----------
    states : (13, k) x, diagonal of P, path length [m], after all updates at the stamps of the last k wheel samples
    gnss_code : (m,) outcome of each fix: `UNSEEN`, `USED`, `GATED` or `RECOVERED`
    gnss_nis : (m,) normalised innovation squared; gnss_det : (m,) determinant of S [m^4]; both NaN where unseen
    gnss_residual : (m, 2) fix minus estimate after the update, north and east [m]
    heading_code, heading_nis : (h,) outcome and NIS of each heading; heading_innovation : (h,) innovation [rad]
    P : (6, 6) covariance at the end
    P_at_stops : (s, 6, 6) covariance at the requested rows
    """

    states: Floats
    gnss_code: Codes
    gnss_nis: Floats
    gnss_det: Floats
    gnss_residual: Floats
    heading_code: Codes
    heading_nis: Floats
    heading_innovation: Floats
    P: Floats
    P_at_stops: Floats = np.zeros((0, 6, 6))

    @classmethod
    def empty(cls, data: FilterInputs, rows: int) -> FilterOutput:
        """Return the empty output of a run that records `rows` states."""
        m, h = len(data.gnss_t), len(data.heading_t)
        shapes = (m, m, (m, 2), h, h)
        nis, det, residual, heading_nis, innovation = (np.full(shape, np.nan) for shape in shapes)
        codes = np.full(m, UNSEEN, np.uint8), np.full(h, UNSEEN, np.uint8)
        return cls(
            np.empty((13, rows)), codes[0], nis, det, residual, codes[1], heading_nis, innovation, np.empty((6, 6))
        )

    @property
    def x(self) -> Floats:
        """States (k, 6)."""
        return np.asarray(self.states[:6].T)

    @property
    def variance(self) -> Floats:
        """Diagonal of P (k, 6)."""
        return np.asarray(self.states[6:12].T)

    @property
    def distance(self) -> Floats:
        """Path length (k,) [m]."""
        return np.asarray(self.states[12])


class Events(NamedTuple):
    """Events in order of time: (m,) time [s], kind, and row among the events of its kind."""

    t: Floats
    kind: Ints
    row: Ints


class FilterState(NamedTuple):
    """The state of a run between two events. It is changed in place.

    Attributes
    ----------
    reached : (2,) time [s], and path length until then [m]
    rejected : (2, 4) argument `run` of `store_rejection`, for fixes and for headings
    x : (6,) the states
    P : (6, 6) covariance of the states
    """

    reached: Floats
    rejected: Floats
    x: Floats
    P: Floats

    @classmethod
    def start(cls, t0: float, x0: Floats, P0: Floats) -> FilterState:
        """Return the state of a run that starts at t0 [s] with state x0 (6,) and covariance P0 (6, 6)."""
        return cls(np.array([t0, 0.0]), np.zeros((2, 4)), x0.astype(np.float64), P0.astype(np.float64))

    def copy(self) -> FilterState:
        """Return a state that later events do not change."""
        return FilterState._make(column.copy() for column in self)


class Space(NamedTuple):
    """Space of kernels, which allocate no memory: PH (6,); G (3, 4), as in `step_jacobian`; T (3, 6)."""

    PH: Floats
    G: Floats
    T: Floats

    @classmethod
    def empty(cls) -> Space:
        """Return new space."""
        return cls(np.empty(6), np.empty((3, 4)), np.empty((3, 6)))


class Nodes(NamedTuple):
    """Times of events in order, for the smoother; (m, ...) each.

    Attributes
    ----------
    x_predicted, x : (m, 6) before and after the updates; P_predicted, P : (m, 6, 6) likewise
    G : (m, 3, 4) of `step_jacobian` for the step from the node before; 0 where the pose is not dead-reckoned
    row : int64 (m,), wheel sample recorded here, -1 without one
    """

    x_predicted: Floats
    P_predicted: Floats
    x: Floats
    P: Floats
    G: Floats
    row: Ints

    @classmethod
    def empty(cls, count: int) -> Nodes:
        """Return `count` nodes, to be filled."""
        x, P, G = (count, 6), (count, 6, 6), (count, 3, 4)
        return cls(np.empty(x), np.empty(P), np.empty(x), np.empty(P), np.zeros(G), np.empty(count, np.int64))
