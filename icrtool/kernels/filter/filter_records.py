"""Records of the compiled filter: its constants, inputs, outputs and what it carries from event to event."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.kinematics import GUARDED

Codes = NDArray[np.uint8]
Flags = NDArray[np.bool_]


class FilterParameters(NamedTuple):
    """Constants of one run.

    Attributes
    ----------
    process_variance : diagonal of Q, six of [(m/s)^2, (m/s)^2, (rad/s)^2, (m/s)^2 x 3], Eq. 30
    rate_invariant : add Q * 0.01 s * dt instead of the paper's dt^2 Q, that of the ICRs by the wheels' travel: dt times
        their speed over 1 m/s
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


class FilterInputs(NamedTuple):
    """Inputs of one run: times [s] since any one epoch, non-decreasing.

    Attributes
    ----------
    wheel_t : (n,); v_left, v_right : (n,) [m/s], held over [k, k+1)
    gnss_t : (m,); gnss_z : (m, 2) north, east [m]; gnss_r : (m, 2) var north, var east [m^2]
    heading_t : (h,); heading_z : (h,) [rad]; heading_r : (h,) [rad^2]
    change_t : (c,) times of terrain changes
    slipping : (n,) intervals [k, k+1) in a slip event; empty for none
    turn_variance : (n,) further growth of the heading's variance over [k, k+1) [rad^2/s]; empty for none
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


CHANGE, FIX, HEADING, WHEELS = range(4)
"""Kinds of events, in their order at equal stamps: terrain changes, fixes, headings, wheel samples."""

DRIVES, SLIPS, IN_GAP = range(3)
"""How the robot moves between two wheel samples."""


class Block(NamedTuple):
    """The events of some wheel samples in order of time, and what comes of them.

    Attributes
    ----------
    t : (m,) [s]; kind : (m,) `CHANGE`, `FIX`, `HEADING` or `WHEELS`; row : (m,) of the array of its kind
    wheels : (n, 4) what holds until each wheel sample: track speeds [m/s], `DRIVES`, `SLIPS` or `IN_GAP`, and further
        growth of the heading's variance [rad^2/s]
    fixes : (f, 4) north, east [m] and their variances [m^2]; headings : (h, 2) [rad], [rad^2]
    of_fixes : (f, 5) becomes code, NIS, det S, and fix minus estimate after the update
    of_headings : (h, 3) becomes code, NIS, innovation
    states : (n, 13) becomes the recorded states, their variances, and the path length
    """

    t: Floats
    kind: Ints
    row: Ints
    wheels: Floats
    fixes: Floats
    headings: Floats
    of_fixes: Floats
    of_headings: Floats
    states: Floats


class Space(NamedTuple):
    """Memory of one run: its kernel allocates none.

    Attributes
    ----------
    PH : (6,); G : (3, 4), as in `step_jacobian`; T, X : (6, 6)
    fixed : (6,) all states are estimated
    """

    PH: Floats
    G: Floats
    T: Floats
    X: Floats
    fixed: Flags

    @classmethod
    def empty(cls) -> Space:
        """Return the memory of a new run."""
        return cls(np.empty(6), np.empty((3, 4)), np.empty((6, 6)), np.empty((6, 6)), np.zeros(6, np.bool_))


class FilterOutput(NamedTuple):
    """Results of one run.

    Attributes
    ----------
    x : (k, 6) states after all updates at the stamps of the last k wheel samples; variance : (k, 6) diagonal of P
    distance : (k,) path length [m]
    gnss_nis, heading_nis : (m,), (h,) normalised innovation squared, NaN where unseen
    gnss_det : (m,) determinant of the innovation covariance S [m^4], NaN where unseen
    gnss_code, heading_code : UNSEEN, USED, GATED or RECOVERED
    gnss_residual : (m, 2) fix minus estimate after the update [m]
    heading_innovation : (h,) [rad]
    P : (6, 6) covariance at the end
    P_at_stops : (s, 6, 6) likewise at the rows that were asked for
    """

    x: Floats
    variance: Floats
    distance: Floats
    gnss_nis: Floats
    gnss_det: Floats
    gnss_code: Codes
    gnss_residual: Floats
    heading_nis: Floats
    heading_code: Codes
    heading_innovation: Floats
    P: Floats
    P_at_stops: Floats = np.zeros((0, 6, 6))


class FilterState(NamedTuple):
    """All that a run needs to go on from the rows before. Changed in place.

    Attributes
    ----------
    reached : (2,) time [s], and path length up to there [m]
    place : (3,) next terrain change, next fix, next heading
    rejected : (2, 4) rows of `rejected_run`, of GNSS and of heading
    x : (6,); P : (6, 6)
    """

    reached: Floats
    place: Ints
    rejected: Floats
    x: Floats
    P: Floats

    def copy(self) -> FilterState:
        """Return a state that later rows do not change."""
        return FilterState._make(column.copy() for column in self)


class Nodes(NamedTuple):
    """Times of events in order, for the smoother; (m, ...) each.

    Attributes
    ----------
    x_predicted, x : (m, 6) before and after the updates; P_predicted, P : (m, 6, 6) likewise
    step : (m, 4) seconds since the node before, track speeds held over them [m/s], 1 in a gap or in slip
    row : int64 (m,), row of the state recorded here, -1 where none is
    """

    x_predicted: Floats
    P_predicted: Floats
    x: Floats
    P: Floats
    step: Floats
    row: Ints

    @classmethod
    def empty(cls, count: int) -> Nodes:
        """Return so many nodes, to be filled."""
        x, P = (count, 6), (count, 6, 6)
        return cls(np.empty(x), np.empty(P), np.empty(x), np.empty(P), np.empty((count, 4)), np.empty(count, np.int64))
