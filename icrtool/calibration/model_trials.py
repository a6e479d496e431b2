"""What the models of the ladder predict: trials within blocks of way, by wheels alone or along a measured heading."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from icrtool.kernels.kinematics import MIN_ICR_SEPARATION_M
from icrtool.kernels.open_loop import trial_ends
from icrtool.kernels.open_loop_fast import open_loop_errors
from icrtool.kernels.trials import Drive, FrozenIcrs
from icrtool.motion.window_fit import Windows, coarse_rows
from icrtool.records.run import Run, drive_of
from icrtool.records.tables import Complexes, Floats, Ints

GYRO_SCALE_PRIOR = 0.02
"""Gyros are scaled this well; how much a drive adds is weighed against it."""

TURNS_WITH_ROBOT = 0.1
"""A gyro whose scale, but for its sign, is further than this from one does not measure the robot's yaw."""


class Trials(NamedTuple):
    """Trials that lie within one block.

    Attributes
    ----------
    drive : the run; t : (n,) [s]
    ends : int64 (n, h), negative where there is no trial, or one that leaves its block
    starts : (k,) states from which there is one
    block : int64 (n,), block of each state
    """

    drive: Drive
    t: Floats
    ends: Ints
    starts: Ints
    block: Ints

    def rows(self, block: int) -> slice:
        """Return the states of a block."""
        first, last = np.searchsorted(self.block, [block, block + 1])
        return slice(int(first), int(last))


def cut_trials(run: Run, edges_m: Floats, horizons_m: Sequence[float]) -> Trials:
    """Return the trials within blocks of way, `edges_m` their inner borders [m].

    Starts are as far apart as the steps of the fits are long: nearer ones are copies of one another.
    """
    table, drive = run.table, drive_of(run)
    block = np.searchsorted(edges_m, table.distance_m, side="right")
    every = coarse_rows(np.where(drive.gap, 0.0, drive.dt_s), drive.v_left, drive.v_right)
    found = trial_ends(drive, np.array(horizons_m, np.float64))
    ends = np.full((len(horizons_m), len(table)), -1, np.int64)
    for h, column in enumerate(found.T):
        mine = column[::every]
        ends[h, ::every] = np.where((mine >= 0) & (block[mine] == block[::every]), mine, -1)
    return Trials(drive, table.t_s, ends.T, np.flatnonzero((ends >= 0).any(axis=0)), block)


def predict(trials: Trials, p: Floats) -> Floats:
    """Return the errors (n, h) [m] of wheels alone, each block driven with its parameters p (blocks, 8).

    Notes
    -----
    Scales, bend, speed and delay change what the sides are taken to do: with the speeds
    V_l = v_x - omega y_l and V_r = v_x - omega y_r the ICRs of Eqs. 8-12 give just that v_x and omega.
    """
    drive, errors = trials.drive, np.full(trials.ends.shape, np.nan)
    for block, one in enumerate(p):
        rows = trials.rows(block)
        left, right = _driven(trials, rows, one)
        within = Drive(
            drive.dt_s[rows], left, right, drive.north[rows], drive.east[rows], drive.heading[rows],
            drive.distance[rows], drive.gap[rows], drive.in_outage[rows],
        )  # fmt: skip
        ends = np.maximum(trials.ends[rows] - rows.start, -1)
        icrs = FrozenIcrs.constant(*(float(icr) for icr in one[:3]))
        errors[rows] = open_loop_errors(within, icrs, ends)
    return errors


class Along:
    """Trials along a measured heading: wheels and ICRs only tell the way along it.

    Parameters
    ----------
    trials : where they start and end
    angle_rad : (n,) measured heading
    from_reference : the heading is that of the reference at the start, and turns as measured

    Notes
    -----
    With omega = d psi / dt the way is the sum of V e^{j psi}, V the mean track speed, and ((y_r + y_l) / 2 - j x)
    (e^{j psi_e} - e^{j psi_s}) / j: W drops out.
    """

    def __init__(self, trials: Trials, angle_rad: Floats, *, from_reference: bool) -> None:
        drive = trials.drive
        self._trials, self._dt = trials, np.where(drive.gap, 0.0, drive.dt_s)
        self._middle = _direction((angle_rad[:-1] + angle_rad[1:]) / 2.0)
        self._lever = _direction(angle_rad - math.pi / 2.0)
        self._turn = _direction(drive.heading - angle_rad) if from_reference else np.ones(1)
        self._reference = drive.north + 1j * drive.east

    def place(self, p: Floats) -> Complexes:
        """Return the prefix sum (n,) [m] of the way; of the parameters p (blocks, 8) scales and delay are used."""
        mean = np.empty(len(self._dt))
        for block, one in enumerate(p):
            rows = self._trials.rows(block)
            # on ICRs of half a metre the mean of the sides is the robot's, whatever the turn
            left, right = _driven(self._trials, rows, np.array([0.5, -0.5, 0.0, one[3], one[4], 0.0, 0.0, one[7]]))
            mean[rows] = (left + right) / 2.0
        return np.concatenate([[0.0], np.cumsum((self._dt * mean)[:-1] * self._middle)])

    def errors(self, place: Complexes, icrs: FrozenIcrs) -> Floats:
        """Return the errors (n, h) [m]; `icrs` by start, or one triple."""
        arm = (icrs.y_icr_right + icrs.y_icr_left) / 2.0 - 1j * icrs.x_icr
        ends = self._trials.ends
        errors = np.full(ends.shape, np.nan)
        for h in range(ends.shape[1]):
            start = np.flatnonzero(ends[:, h] >= 0)
            end = ends[start, h]
            lever = self._lever[end] - self._lever[start]
            moved = place[end] - place[start] + (arm if len(arm) == 1 else arm[start]) * lever
            moved = moved * (self._turn if len(self._turn) == 1 else self._turn[start])
            errors[start, h] = np.abs(moved - (self._reference[end] - self._reference[start]))
        return errors


def calibrate_gyro(
    gyro: Floats, drive: Drive, t: Floats, windows: Windows, kept: Sequence[np.ndarray]
) -> Floats | None:
    """Give a gyro scale and bias, for each block by the turns of windows clear of it.

    Parameters
    ----------
    gyro : (n,) integrated turn rate [rad]
    windows : of `cut_windows`
    kept : by block, the windows clear of it, (w,) each

    Returns
    -------
    (blocks, 2) scale and bias [rad/s], a scale near -1 where its turns count the other way; None where it does not
    turn with the robot.
    """
    rows = np.searchsorted(t, windows.knot_t)
    start, end = rows[windows.start], rows[windows.end]
    turned, told, took = drive.heading[end] - drive.heading[start], gyro[end] - gyro[start], t[end] - t[start]
    if not np.isfinite(told).all():
        return None
    found = np.empty((len(kept), 2))
    for block, clear in enumerate(kept):
        columns, target = np.column_stack([told, took])[clear], turned[clear]
        plain = np.linalg.lstsq(columns, target, rcond=None)[0]
        noise = np.median(np.abs(target - columns @ plain)) + 1e-6
        pull = np.array([noise / GYRO_SCALE_PRIOR, 0.0]) * np.sqrt(len(columns) / len(kept))
        near = math.copysign(pull[0], plain[0])
        found[block] = np.linalg.lstsq(np.vstack([columns, pull]), np.append(target, near), rcond=None)[0]
    along = np.abs(found[:, 0] - math.copysign(1.0, found[0, 0])) < TURNS_WITH_ROBOT
    return found if along.all() else None


def _direction(angle_rad: Floats) -> Complexes:
    """Return e^{j angle} in a third of the time of a complex exponential."""
    direction = np.empty(len(angle_rad), np.complex128)
    direction.real, direction.imag = np.cos(angle_rad), np.sin(angle_rad)
    return direction


def _driven(trials: Trials, rows: slice, p: Floats) -> tuple[Floats, Floats]:
    """Return the speeds of both sides (m,) [m/s] with which the ICRs of p (8,) do what p says, at some states."""
    drive, t = trials.drive, trials.t
    if p[7] == 0.0:
        return _equivalent(drive.v_left[rows], drive.v_right[rows], p)
    margin = abs(float(p[7])) + 1.0
    first = int(np.searchsorted(t, t[rows.start] - margin))
    last = min(int(np.searchsorted(t, t[rows.stop - 1] + margin)) + 1, len(t))
    near = slice(first, last)
    dt = np.where(drive.gap[near], 0.0, drive.dt_s[near])
    at = t[rows.start : min(rows.stop + 1, len(t))] + p[7]
    late = []
    for speed in _equivalent(drive.v_left[near], drive.v_right[near], p):
        way = np.interp(at, t[near], np.concatenate([[0.0], np.cumsum(dt * speed)[:-1]]))
        step = np.append(np.diff(way), 0.0)[: rows.stop - rows.start]
        held = drive.dt_s[rows]
        late.append(np.divide(step, held, out=np.zeros(len(step)), where=held > 0.0))
    return late[0], late[1]


def _equivalent(v_left: Floats, v_right: Floats, p: Floats) -> tuple[Floats, Floats]:
    v_x, _, omega = velocities(v_left, v_right, p)
    side = 1.0 if p[0] >= p[1] else -1.0
    return side * (v_x - omega * p[1]), side * (v_x - omega * p[0])


def velocities(v_left: Floats, v_right: Floats, p: Floats) -> tuple[Floats, Floats, Floats]:
    """Return v_x, v_y [m/s] and omega [rad/s], (n,) each: `icrtool.kernels.window_errors.rates` for columns."""
    left, right, both = p[3] * v_left, p[4] * v_right, np.abs(v_left) + np.abs(v_right)
    turning = np.divide(np.abs(v_left - v_right), both, out=np.zeros(len(both)), where=both > 0.0)
    w = max(abs(p[0] - p[1]), MIN_ICR_SEPARATION_M)
    omega = (left - right) / (w * (1.0 + p[5] * turning + p[6] * 0.5 * both))
    return (left * p[0] - right * p[1]) / w, -p[2] * omega, omega
