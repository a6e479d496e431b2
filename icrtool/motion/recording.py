"""Data to fit and test motion models: wheel speeds, reference trajectory, gyro, and windows of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from icrtool.errors import DataError
from icrtool.kernels.arrays import Bools, Complexes, Floats, Ints
from icrtool.kernels.equal_steps import rows_at_steps
from icrtool.kernels.open_loop.direct import ends_from
from icrtool.kernels.open_loop.trials import Drive
from icrtool.motion.models import NO_LEVER, Lever

WINDOWS_M = (5.0, 10.0)
"""Lengths of the windows [m]. With one length alone, a circle of that circumference would show nothing."""

USUAL_WIDTH_M = 0.5
"""Windows, their distances and stretches are those of robots of this track width and wider; smaller ones drive, and
err, in proportion."""

EVERY_M = 0.5
"""A window of each length starts every so much distance."""

MOST_STARTS, LEAST_OFTEN_M = 800, 2.5
"""Windows of long drives start further apart: about so many of a length in all logs, but at least every half window."""

STEP_S = 0.1
"""Wheel samples are joined to steps of this length."""

MOST_STEPS, LONGEST_STEP_S, LONGEST_STEP_M = 10_000, 0.4, 0.25
"""Steps are longer where there would be more of them, but not longer than this in time and distance."""

STRETCH_M = 20.0
"""Distance whose errors depend on one another, for the covariance: twice the longest window."""

FEWEST_WINDOWS = 10

LONGEST_DELAY_S = 1.0
"""Of the wheels against the poses."""

MOVING_MPS = 0.01
"""Slower than this the robot stands: its starts are copies of one another."""


@dataclass(frozen=True, slots=True)
class Recording:
    """One log as input of the motion models.

    Attributes
    ----------
    t_s : (n,) time of each state [s]
    drive : wheel speeds at the configured radius and the reference
    gyro_radps : (n,) turn rate over the interval after each state, clockwise, read when the reference turns; None
        without a gyro
    width_m : track width b
    path, sha256 : the log's first file; empty where it is not known
    gyro_reversed : the gyro counts turns in the other direction, and its sign was changed
    begin_ns : stamp of the first state; 0 where it is not known
    slipping : (n,) whether the interval after a state lies in a slip event, which no window crosses; None without one
    lever : what is known of the place of the position on the robot
    x_clock_std_m : what is not known of the time between position and heading looks like an x_icr so far off
    """

    name: str
    t_s: Floats
    drive: Drive
    gyro_radps: Floats | None
    width_m: float
    path: str = ""
    sha256: str = ""
    gyro_reversed: bool = False
    begin_ns: int = 0
    slipping: Bools | None = None
    lever: Lever = NO_LEVER
    x_clock_std_m: float = 0.0

    @property
    def held_s(self) -> Floats:
        """How long each wheel sample holds (n,) [s]; 0 over gaps and for the last one."""
        held: Floats = np.where(self.drive.gap, 0.0, self.drive.dt_s)
        held[-1] = 0.0
        return held

    def cumulate(self, rate: Floats) -> Floats:
        """Return the integral of a rate (n,) until each wheel sample (n,)."""
        by_step, sums = self.held_s, np.zeros(len(self.t_s))
        by_step *= rate
        np.cumsum(by_step[:-1], out=sums[1:])
        return sums

    def around(self, begin_s: float, end_s: float) -> Steps:
        """Return single wheel samples as `Steps.around` does; of a long log, columns of all would take much memory."""
        near = rows_around(self.t_s, begin_s, end_s)
        return joined_steps(self.part(near.start, near.stop + 1), 1)

    def part(self, first: int, stop: int) -> Recording:
        """Return the states [first, stop) as a recording."""
        rows = slice(first, stop)
        gyro = None if self.gyro_radps is None else self.gyro_radps[rows]
        slipping = None if self.slipping is None else self.slipping[rows]
        drive = Drive._make(c[rows] for c in self.drive)
        return replace(self, t_s=self.t_s[rows], drive=drive, gyro_radps=gyro, slipping=slipping)


class LogConstants(NamedTuple):
    """What is a recording's own, beside the parameters of its robot.

    Attributes
    ----------
    heading_offset_rad : added to the heading of the reference
    wheels_later_s : the wheels are read this much later than the poses
    gyro_bias_radps : added to the turn rate of a model with a gyro
    gyro_later_s : the gyro is read this much later than the wheels, to first order
    """

    heading_offset_rad: float = 0.0
    wheels_later_s: float = 0.0
    gyro_bias_radps: float = 0.0
    gyro_later_s: float = 0.0


NO_CONSTANTS = LogConstants()


class Steps(NamedTuple):
    """Wheel samples of a recording, joined; (n,) each.

    Attributes
    ----------
    t, held : begin and duration [s], `held` 0 over gaps
    v_left, v_right, gyro : mean over the step
    into : [s] how far into a step its heading is taken: Euler steps of m samples at a constant turn rate move along the
        heading (m - 1) / 2 samples into them
    """

    t: Floats
    held: Floats
    v_left: Floats
    v_right: Floats
    gyro: Floats
    into: Floats

    def around(self, begin_s: float, end_s: float) -> Steps:
        """Return the steps of the time between the first begin and the last end of trials, and a little for delays."""
        near = rows_around(self.t, begin_s, end_s)
        return Steps._make(column[near] for column in self)

    def gyro_change(self, some: slice = slice(None)) -> Floats:
        """Return the change of the gyro's turn rate by time (n,) [rad/s^2], of some steps; 0 where it has none."""
        rows = np.arange(*some.indices(len(self.t)))
        before, after = np.maximum(rows - 1, 0), np.minimum(rows + 1, len(self.t) - 1)
        apart = (self.t[after] + self.held[after] / 2.0) - (self.t[before] + self.held[before] / 2.0)
        risen = self.gyro[after] - self.gyro[before]
        change: Floats = np.divide(risen, apart, out=np.zeros(len(risen)), where=apart > 0.0)
        return change


def rows_around(t_s: Floats, begin_s: float, end_s: float) -> slice:
    """Return the rows of times (n,) from a begin to an end, and of a little more for delays."""
    first, stop = np.searchsorted(t_s, [begin_s - LONGEST_DELAY_S, end_s + LONGEST_DELAY_S], side="right").tolist()
    return slice(max(first - 1, 0), stop)


class Windows(NamedTuple):
    """Overlapping windows of driven distance of one recording, ready to be fitted.

    Attributes
    ----------
    steps : wheel samples joined
    knot_t : (m,) times at which windows start or end [s], ascending
    start, end : (w,) rows of `knot_t`
    start_m, end_m, length_m : (w,) path length at start and end, and nominal length [m]
    reference : complex (w,), displacement forward + j right in the body frame of the start [m]
    turned : (w,) turn of the reference [rad]
    """

    steps: Steps
    knot_t: Floats
    start: Ints
    end: Ints
    start_m: Floats
    end_m: Floats
    length_m: Floats
    reference: Complexes
    turned: Floats


class Totals(NamedTuple):
    """Distance [m] and time [s] of all recordings that are fitted together."""

    metres: float
    seconds: float


def totals_of(*recordings: Recording) -> Totals:
    """Return distance and time of recordings together."""
    return Totals(
        sum(float(one.drive.distance[-1]) for one in recordings), sum(float(one.held_s.sum()) for one in recordings)
    )


def size_of(width_m: float) -> float:
    """Return the part of the usual distances that is used for a robot of track width b [m], at most 1."""
    return min(1.0, width_m / USUAL_WIDTH_M)


def cut_windows(
    recording: Recording, lengths_m: Sequence[float] | None = None, pooled: Totals | None = None
) -> Windows:
    """Cut a recording into windows of driven distance; none crosses a gap or a slip event, or ends in an outage.

    Parameters
    ----------
    lengths_m : default `WINDOWS_M`, less for small robots
    pooled : of all that is fitted together, default the recording: the more it is, the coarser windows and steps

    Raises
    ------
    DataError
        There are fewer than `FEWEST_WINDOWS`.
    """
    drive = recording.drive
    pooled, size = pooled or totals_of(recording), size_of(recording.width_m)
    lengths_m = [size * one for one in WINDOWS_M] if lengths_m is None else lengths_m
    every = min(max(size * EVERY_M, pooled.metres / MOST_STARTS), size * LEAST_OFTEN_M)
    begins = rows_at_steps(drive.distance, every)
    begins = begins[~drive.in_outage[begins]]
    ends = ends_from(drive, np.array(lengths_m, np.float64), begins)
    row, column = np.nonzero(ends.T >= 0)[::-1]
    if recording.slipping is not None:
        before: Ints = np.cumsum(recording.slipping) - recording.slipping
        quiet: Bools = before[begins[row]] == before[ends[row, column]]
        row, column = row[quiet], column[quiet]
    if len(row) < FEWEST_WINDOWS:
        why = f"only {len(row)} windows of {min(lengths_m):g} m of driven distance"
        raise DataError(recording.name, why, "a calibration needs a longer drive")
    start, end = begins[row], ends[row, column]
    begin_place, end_place = (drive.north[rows] + 1j * drive.east[rows] for rows in (start, end))
    knots, rows = np.unique(np.concatenate([start, end]), return_inverse=True)
    return Windows(
        joined_steps(recording, samples_a_step(recording, pooled.seconds)),
        knot_t=recording.t_s[knots],
        start=rows[: len(start)],
        end=rows[len(start) :],
        start_m=drive.distance[start],
        end_m=drive.distance[end],
        length_m=np.asarray(lengths_m, np.float64)[column],
        reference=np.exp(-1j * drive.heading[start]) * (end_place - begin_place),
        turned=drive.heading[end] - drive.heading[start],
    )


def moving_states(drive: Drive) -> Bools:
    """Return the states (n,) in which the robot moves."""
    return np.append(np.diff(drive.distance) > MOVING_MPS * drive.dt_s[:-1], False)


def samples_a_step(recording: Recording, pooled_s: float | None = None) -> int:
    """Return how many wheel samples make a step of the fits; `pooled_s` is the time of all that is fitted together.

    A tenth of a second; on a long drive longer, up to four tenths, as long as a step is no more than a quarter of a
    metre.
    """
    drive, held = recording.drive, recording.held_s
    lasting = held > 0.0
    if not lasting.any():
        return 1
    total_s = float(held.sum())
    speed_mps = float((held * (np.abs(drive.v_left) + np.abs(drive.v_right))).sum()) / 2.0 / total_s
    step_s = min(
        (total_s if pooled_s is None else pooled_s) / MOST_STEPS, LONGEST_STEP_M / max(speed_mps, 1e-3), LONGEST_STEP_S
    )
    return max(int(max(step_s, STEP_S) / float(np.median(held[lasting]))), 1)


def joined_steps(recording: Recording, samples: int) -> Steps:
    """Return a recording's wheel samples, so many joined to a step with the mean speeds over its time."""
    drive, held = recording.drive, recording.held_s
    gyro = recording.gyro_radps if recording.gyro_radps is not None else np.zeros(len(held))
    if samples == 1:
        return Steps(recording.t_s, held, drive.v_left, drive.v_right, gyro, np.zeros(len(held)))
    first = np.arange(0, len(held), samples)
    lasting = np.add.reduceat(held, first)

    def mean(column: Floats) -> Floats:
        total = np.add.reduceat(held * column, first)
        return np.divide(total, lasting, out=np.zeros(len(first)), where=lasting > 0.0)

    return Steps(
        recording.t_s[first], lasting, mean(drive.v_left), mean(drive.v_right), mean(gyro),
        lasting * (samples - 1) / (2.0 * samples),
    )  # fmt: skip
