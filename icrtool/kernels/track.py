"""Wheels and reference of one drive along time, and windows of driven distance and open-loop trials of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Self, TypeVar

import numpy as np

from icrtool.kernels.arrays import Bools, Complexes, Floats, Ints, Rows, rows_at_steps
from icrtool.kernels.compiled import njit

Rate = TypeVar("Rate", Floats, Complexes)

LONGEST_DELAY_S = 1.0
"""Longest delay of the wheels with respect to the reference [s]."""

SHORT, GAP, OUTAGE, STANDING, JUMP = -1, -2, -3, -4, -5
"""Negative codes of starts without a trial, in place of the row at which the trial ends. `SHORT`: the drive ends
before. `GAP`: the wheel data have a gap. `OUTAGE`: there is no reference at the end. `STANDING`: the robot stands at
the start, and another start counts for this standstill. `JUMP`: the reference jumps in between."""


class Track(NamedTuple):
    """Wheels and reference of one drive, each with its own times [s] since a common epoch.

    In a track of recorded states (`Track.of_states`) all times are the same, and every column has a row for each state.

    Attributes
    ----------
    t : (n,) begin of each wheel sample; held : (n,) time for which it holds [s], 0 over gaps and for the last sample
    v_left, v_right : (n,) [m/s], constant for the time `held`
    place_t : (m,); north, east : (m,) position of the reference [m]
    heading_t : (h,); heading : (h,) of the reference [rad], unwrapped, clockwise from north
    distance : (m,) path length at the positions [m], non-decreasing
    in_outage : (m,) positions that nothing can be compared with
    jump, slipping : (m,) whether the reference jumps in the interval after each position, and whether this interval
        lies in a slip event
    gyro : (n,) turn rate while a wheel sample holds [rad/s], with the delay of the reference; None without a gyro
    into : share of the time of a wheel sample after which its heading is taken: 0 for Euler steps, (k - 1) / 2k for k
        joined samples
    place_std_m : standard deviation of the positions on each axis [m]; 0 if it is not needed
    same_clock : whether position and heading are fields of the same messages
    measured_t : (k,) times of the measured headings, between which the wheels carry the heading; None: all headings are
        measured
    """

    t: Floats
    held: Floats
    v_left: Floats
    v_right: Floats
    place_t: Floats
    north: Floats
    east: Floats
    heading_t: Floats
    heading: Floats
    distance: Floats
    in_outage: Bools
    jump: Bools
    slipping: Bools
    gyro: Floats | None = None
    into: float = 0.0
    place_std_m: float = 0.0
    same_clock: bool = True
    measured_t: Floats | None = None

    @classmethod
    def of_states(
        cls, t: Floats, held: Floats, v_left: Floats, v_right: Floats, north: Floats, east: Floats, heading: Floats,
        distance: Floats, *, in_outage: Bools | None = None, jump: Bools | None = None, slipping: Bools | None = None,
    ) -> Self:  # fmt: skip
        """Return the track of states, every column (n,); flags that are not given are False."""
        outage, jumps, slips = (
            np.zeros(len(t), np.bool_) if flags is None else flags for flags in (in_outage, jump, slipping)
        )
        return cls(t, held, v_left, v_right, t, north, east, t, heading, distance, outage, jumps, slips)

    @property
    def place(self) -> Complexes:
        """Positions of the reference (m,), north + j east [m]."""
        return np.asarray(self.north + 1j * self.east)

    @property
    def mean_speed(self) -> Floats:
        """Mean of the sides' speeds (n,) [m/s]."""
        return (self.v_left + self.v_right) / 2

    @property
    def half_difference(self) -> Floats:
        """Half of the left speed minus the right speed (n,) [m/s]."""
        return (self.v_left - self.v_right) / 2

    @property
    def nose(self) -> Complexes:
        """Heading as a complex unit vector in the middle of each wheel sample (n,)."""
        return np.asarray(np.exp(1j * np.interp(self.t + self.held / 2, self.heading_t, self.heading)))

    @property
    def gap_t(self) -> Floats:
        """Begins of the gaps in the wheel data (g,) [s]."""
        return np.asarray(self.t[:-1][self.held[:-1] == 0.0])

    @property
    def travel(self) -> Floats:
        """Mean distance of the sides until each wheel sample (n,) [m]; driving backward increases it, too."""
        speed = np.abs(self.v_left)
        speed += np.abs(self.v_right)
        speed /= 2.0
        return self.cumulate(speed)

    def cumulate(self, rate: Rate) -> Rate:
        """Return the integral of a rate (n,) until each wheel sample (n,)."""
        sums = np.zeros_like(rate)
        np.multiply(rate[:-1], self.held[:-1], out=sums[1:])
        np.cumsum(sums[1:], out=sums[1:])
        return sums

    def at_places(self, rate: Rate) -> Rate:
        """Return the integral of a rate (n,) until each position (m,)."""
        return np.interp(self.place_t, self.t, self.cumulate(rate))

    @property
    def laid(self) -> Complexes:
        """Integral of the sides' mean speed along the heading, until each position (m,), north + j east [m]."""
        return self.at_places(np.asarray(self.mean_speed * self.nose))

    def heading_at(self, t: Floats) -> Floats:
        """Return the heading (k,) [rad] at times (k,) [s]."""
        return np.interp(t, self.heading_t, self.heading)

    @property
    def seen_heading_t(self) -> Floats:
        """Times of the measured headings [s]."""
        return self.heading_t if self.measured_t is None else self.measured_t

    def clear(self, begin_s: Floats, end_s: Floats) -> Bools:
        """Return which spans of time (w,) have no gap in the wheel data."""
        gap_t = self.gap_t
        return np.asarray(np.searchsorted(gap_t, begin_s) == np.searchsorted(gap_t, end_s))

    def places(self, rows: Ints | Bools | slice) -> Self:
        """Return the track with some of its positions."""
        names = ("place_t", "north", "east", "distance", "in_outage", "jump", "slipping")
        return self._replace(**{name: getattr(self, name)[rows] for name in names})

    def wheels(self, rows: Ints | slice) -> Self:
        """Return the track with some of its wheel samples."""
        gyro = None if self.gyro is None else self.gyro[rows]
        left, right = self.v_left[rows], self.v_right[rows]
        return self._replace(t=self.t[rows], held=self.held[rows], v_left=left, v_right=right, gyro=gyro)

    def rows_around(self, begin_s: float, end_s: float) -> slice:
        """Return the rows of the wheel samples in a span, extended by `LONGEST_DELAY_S` on both sides."""
        edges = [begin_s - LONGEST_DELAY_S, end_s + LONGEST_DELAY_S]
        first, stop = np.searchsorted(self.t, edges, side="right").tolist()
        return slice(max(first - 1, 0), stop)

    def around(self, begin_s: float, end_s: float) -> Self:
        """Return the track with the wheel samples of `rows_around`."""
        return self.wheels(self.rows_around(begin_s, end_s))

    def joined(self, first: Ints, into: float = 0.0) -> Self:
        """Return the track with the wheel samples from each row of `first` to the next joined to one sample.

        A joined sample has the means over its time. `into` is the field of the same name.
        """
        held = np.add.reduceat(self.held, first)

        def mean(column: Floats, over_gaps: Floats) -> Floats:
            """Return the mean of a column over the time of each joined sample; `over_gaps` where this time is 0."""
            total = np.add.reduceat(self.held * column, first)
            return np.divide(total, held, out=over_gaps, where=held > 0.0)

        left, right = (mean(speed, speed[first].copy()) for speed in (self.v_left, self.v_right))
        gyro = None if self.gyro is None else mean(self.gyro, np.zeros(len(first)))
        return self._replace(t=self.t[first], held=held, v_left=left, v_right=right, gyro=gyro, into=into)

    def gyro_change(self, part: slice = slice(None)) -> Floats:
        """Return the derivative of the gyro's turn rate [rad/s^2] at some wheel samples; 0 without a gyro."""
        rows = np.arange(*part.indices(len(self.t)))
        if self.gyro is None:
            return np.zeros(len(rows))
        before, after = np.maximum(rows - 1, 0), np.minimum(rows + 1, len(self.t) - 1)
        apart = (self.t[after] + self.held[after] / 2.0) - (self.t[before] + self.held[before] / 2.0)
        risen = self.gyro[after] - self.gyro[before]
        return np.divide(risen, apart, out=np.zeros(len(rows)), where=apart > 0.0)


@dataclass(frozen=True)
class Windows:
    """Windows of driven distance.

    Attributes
    ----------
    track : track of the windows; its wheel samples may have been joined
    begin, end : (w,) rows of the first and the last position of each window
    length_m : (w,) nominal distance [m]
    """

    track: Track
    begin: Ints
    end: Ints
    length_m: Floats

    def over(self, at_places: Rate) -> Rate:
        """Return the change over each window (w,) of a quantity at the positions (m,)."""
        return at_places[self.end] - at_places[self.begin]

    @cached_property
    def seen(self) -> Complexes:
        """Displacement of the reference (w,), north + j east [m]."""
        begin, end = (self.track.north[rows] + 1j * self.track.east[rows] for rows in (self.begin, self.end))
        return np.asarray(end - begin)

    @cached_property
    def moved(self) -> Complexes:
        """Displacement of the reference (w,), forward + j right in the body frame at the start [m]."""
        return np.asarray(np.exp(-1j * self.track.heading_at(self.track.place_t[self.begin])) * self.seen)

    @cached_property
    def turned(self) -> Floats:
        """Turn of the reference (w,) [rad]."""
        begin, end = self.track.heading_at(self.track.place_t[np.stack([self.begin, self.end])])
        return np.asarray(end - begin)


def cut(track: Track, lengths_m: Sequence[float], every_m: float) -> Windows:
    """Return windows of driven distance; no window crosses a gap, jump or slip event, or ends in an outage.

    Parameters
    ----------
    track : track of the drive
    lengths_m : lengths of the windows [m]
    every_m : distance between the starts of windows of one length [m]
    """
    lengths, begins = np.asarray(lengths_m, np.float64), rows_at_steps(track.distance, every_m)
    begins = begins[~track.in_outage[begins]]
    ends = ends_from(track, lengths, begins)
    column, row = np.nonzero(ends.T >= 0)
    begin, end = begins[row], ends[row, column].astype(np.int64)
    # If the number of slipping rows before both ends is the same, no slipping row lies between them.
    slips = np.flatnonzero(track.slipping)
    quiet = np.searchsorted(slips, begin) == np.searchsorted(slips, end)
    return Windows(track, begin[quiet], end[quiet], lengths[column][quiet])


@njit
def fill_ends(
    distance: Floats, place_t: Floats, in_outage: Bools, gap_t: Floats, jumps: Ints, horizons_m: Floats, starts: Ints,
    ends: Rows,
) -> None:  # fmt: skip
    """Fill `ends` (h, k) for `ends_from`; the last items of `gap_t` and `jumps` must lie after the drive."""
    rows = len(distance)
    for h in range(len(horizons_m)):
        end, gap, jump = 0, 0, 0
        for k in range(len(starts)):
            start = starts[k]
            while end < rows and distance[end] - distance[start] < horizons_m[h]:
                end += 1
            while gap_t[gap] < place_t[start]:
                gap += 1
            while jumps[jump] < start:
                jump += 1
            if end == rows:
                ends[h, k] = SHORT
            elif gap_t[gap] < place_t[end]:
                ends[h, k] = GAP
            elif in_outage[end]:
                ends[h, k] = OUTAGE
            elif jumps[jump] < end:
                ends[h, k] = JUMP
            else:
                ends[h, k] = end


def ends_from(track: Track, horizons_m: Floats, starts: Ints) -> Rows:
    """Return the rows of the positions at which distances end.

    Parameters
    ----------
    track : the drive
    horizons_m : (h,) distances [m], in any order
    starts : (k,) rows at which the distances begin, ascending

    Returns
    -------
    int32 (k, h)
        The first row j with ``distance[j] - distance[start] >= horizon``, or `SHORT`, `GAP`, `OUTAGE`, `JUMP`; each
        horizon contiguous.
    """
    ends = np.empty((len(horizons_m), len(starts)), np.int32)
    columns = (track.distance, track.place_t, horizons_m)
    distance, place_t, horizons_m = (np.require(column, np.float64, ["C", "A", "W"]) for column in columns)
    gap_t, jumps = np.append(track.gap_t, np.inf), np.append(np.flatnonzero(track.jump), len(distance))
    fill_ends(distance, place_t, track.in_outage, gap_t, jumps, horizons_m, starts, ends)
    return ends.T


class FrozenIcrs(NamedTuple):
    """ICRs with which the trial from each state is predicted; (n,) each, or (1,) for one triple for all states.

    Attributes
    ----------
    y_icr_right, y_icr_left, x_icr : float64 [m], body frame
    """

    y_icr_right: Floats
    y_icr_left: Floats
    x_icr: Floats

    @classmethod
    def constant(cls, y_icr_right: float, y_icr_left: float, x_icr: float) -> FrozenIcrs:
        """Return one triple [m] for all states; without slip it is ``(b/2, -b/2, 0)``."""
        return cls(np.array([y_icr_right]), np.array([y_icr_left]), np.array([x_icr]))


class OpenLoopPath(NamedTuple):
    """An open-loop path from a start state to an end state, both included; float64 (m,) [m, m, rad]."""

    north: Floats
    east: Floats
    heading: Floats


class TrialCounts(NamedTuple):
    """Numbers of starts with a trial, and of starts without a trial by reason; int64 (n_horizons,) each."""

    trials: Ints
    short: Ints
    gap: Ints
    outage: Ints
    standing: Ints
    crosses_jump: Ints


def trial_ends(track: Track, horizons_m: Floats, lo: int = 0, hi: int | None = None) -> Rows:
    """Return the result of `ends_from` for all starts in [lo, hi); default: all states."""
    return ends_from(track, horizons_m, np.arange(lo, len(track.distance) if hi is None else hi))


def count_trials(ends: Rows) -> TrialCounts:
    """Return the numbers of trials, and of starts without a trial by reason, from `ends` (n_starts, n_horizons)."""
    kinds = np.array([np.bincount(-column[column < 0], minlength=1 - JUMP) for column in ends.T]).T
    return TrialCounts(len(ends) - kinds.sum(axis=0), *kinds[-np.array([SHORT, GAP, OUTAGE, STANDING, JUMP])])
