"""The true motion of a simulated robot: of known ICRs, or on sliding contacts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.kinematics import poses_at


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """True motion on a fine grid of time.

    Attributes
    ----------
    t_s : (n,) increasing from 0
    command_left_mps, command_right_mps : (n,) motor commands, held over [k, k+1)
    v_left_mps, v_right_mps : (n,) true track speeds, held over [k, k+1)
    travel_left_m, travel_right_m : (n,) their integrals
    pose : (n, 3) north, east [m], heading [rad] (unwrapped)
    """

    t_s: Floats
    command_left_mps: Floats
    command_right_mps: Floats
    v_left_mps: Floats
    v_right_mps: Floats
    travel_left_m: Floats
    travel_right_m: Floats
    pose: Floats

    def rows(self, times: Floats) -> Ints:
        """Return the row (m,) whose step each time (m,) [s] falls into."""
        return np.clip(np.searchsorted(self.t_s, times, side="right") - 1, 0, len(self.t_s) - 1).astype(np.int64)

    def poses(self, times: Floats) -> Floats:
        """Return the pose (m, 3) at times (m,) [s]."""
        raise NotImplementedError

    def turn_rates(self, times: Floats) -> Floats:
        """Return the turn rate (m,) [rad/s], clockwise positive, at times (m,) [s]."""
        raise NotImplementedError

    def icrs(self, times: Floats) -> Floats:
        """Return y_icr_right, y_icr_left, x_icr (m, 3) [m] at times (m,) [s]."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True, kw_only=True)
class IcrTruth(Truth):
    """Motion of a robot of known ICRs, on arcs.

    Attributes
    ----------
    icrs_m : (c, 3); icr_row : int64 (n,), the row of `icrs_m` that holds over [k, k+1)
    """

    icrs_m: Floats
    icr_row: Ints

    def poses(self, times: Floats) -> Floats:
        """Return the pose (m, 3) at times (m,) [s], on the arcs between the rows."""
        return poses_at(times, self.t_s, self.v_left_mps, self.v_right_mps, self.icrs_m, self.icr_row, self.pose)

    def turn_rates(self, times: Floats) -> Floats:
        """Return the turn rate (m,) [rad/s], clockwise positive, at times (m,) [s]."""
        row = self.rows(times)
        right, left, _ = self.icrs_m[self.icr_row[row]].T
        return np.asarray((self.v_left_mps[row] - self.v_right_mps[row]) / (right - left))

    def icrs(self, times: Floats) -> Floats:
        """Return y_icr_right, y_icr_left, x_icr (m, 3) [m] at times (m,) [s]."""
        return self.icrs_m[self.icr_row[self.rows(times)]]


@dataclass(frozen=True, slots=True, kw_only=True)
class FrictionTruth(Truth):
    """Motion of a robot on sliding contacts.

    Attributes
    ----------
    velocity : (n, 3) v_x, v_y [m/s], omega [rad/s] of the body origin
    icrs_m : (n, 3) ICRs that explain the motion about each row
    """

    velocity: Floats
    icrs_m: Floats

    def poses(self, times: Floats) -> Floats:
        """Return the pose (m, 3) at times (m,) [s], linear between the rows."""
        return np.column_stack([np.interp(times, self.t_s, column) for column in self.pose.T])

    def turn_rates(self, times: Floats) -> Floats:
        """Return the turn rate (m,) [rad/s], clockwise positive, at times (m,) [s]."""
        return np.interp(times, self.t_s, self.velocity[:, 2])

    def icrs(self, times: Floats) -> Floats:
        """Return y_icr_right, y_icr_left, x_icr (m, 3) [m] at times (m,) [s]."""
        return self.icrs_m[self.rows(times)]
