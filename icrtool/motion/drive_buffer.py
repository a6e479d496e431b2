"""The past of a drive: wheel samples that are joined to steps, poses at every half metre, and windows of both.

The result depends on the samples, and not on the number of samples that come at a time.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from icrtool.kernels.arrays import Bools, Floats, Ints
from icrtool.kernels.track import LONGEST_DELAY_S, Track, Windows
from icrtool.motion.recording import EVERY_M, RECORDING_STEP_S

LEARNT_WINDOWS_M = (1.0, 2.0, 5.0)
"""Lengths of the windows that a model learns from [m]. With further windows of 10 m, the expected error after 10 m does
not change on 18 simulated robots of which nothing is known, and is 5 % larger on recorded drives of one robot. With
windows of 5 and 10 m alone, it is 8 and 9 % larger."""

STANDING_STEP_S = 10.0
"""Length of the steps to which wheel samples are joined while a robot stands [s]. It may stand for hours."""

LARGEST_ADVANCE_M = 5.0
"""Largest distance that wheels roll between two samples [m]. A longer distance comes from a damaged speed or stamp, and
counts as a gap."""

ON_EDGE = 1e-6
"""Share of a step by which a stamp may precede the start of the step. Decimal fractions of a second are not exact."""


class SampleRow(IntEnum):
    """Rows of samples (10, n).

    Time [s]; wheel speeds until the next sample [m/s]; pose of the reference [m, m, rad]; turn rate of a gyro [rad/s];
    whether the pose is known; whether windows end before the next sample; whether the wheels are unknown until then.
    """

    T, LEFT, RIGHT, NORTH, EAST, HEADING, GYRO, KNOWN, BROKEN, GAP = range(10)


POSE_ROWS = [SampleRow.NORTH, SampleRow.EAST, SampleRow.HEADING]
"""Rows of samples with the pose."""

KNOT_T, KNOT_SEGMENT, KNOT_KNOWN, KNOT_STEPS, KNOT_SAMPLES = 0, 4, 5, 6, 7
"""Rows of the knots (8, m): time, segment, whether the pose is known, number of complete steps, samples in these steps.

Rows 1 to 3 are north, east and heading. The segment changes where windows end."""


class DriveBuffer:
    """Steps and knots of a drive: a knot is the first sample after each half metre of driven distance.

    Driven distance is the path of the mean of both sides: a spin on the spot adds none.

    Attributes
    ----------
    size : factor of the usual distances (`icrtool.motion.recording.size_of`)
    every_m : distance between knots [m]
    count : number of the knots, with the forgotten ones
    """

    def __init__(self, size: float) -> None:
        self.size, self.every_m = size, EVERY_M * size
        self._open = np.empty((len(SampleRow), 0))
        self._distance, self._segment, self._heading = 0.0, 0.0, 0.0
        self._steps, self._steps_before, self._samples = np.empty((5, 0)), 0, 0
        self._knots, self._knots_before = np.empty((8, 0)), 0

    @property
    def distance_m(self) -> float:
        """Driven distance until the last sample [m]."""
        return self._distance

    @property
    def count(self) -> int:
        """Number of the knots, with the forgotten ones."""
        return self._knots_before + self._knots.shape[1]

    def take(self, samples: Floats) -> int:
        """Take further samples (10, n), `SampleRow`, in order of time; return the number of the first new knot."""
        first_knot, old = self.count, self._open.shape[1]
        if not samples.shape[1]:
            return first_knot
        rows = np.concatenate([self._open, samples], axis=1)
        held, advance, gap = _intervals(rows, self.size)
        # These are the intervals before the new samples. The first sample of a drive has none.
        before = slice(max(old - 1, 0), None)
        distance = np.cumsum(np.append(self._distance, advance[before]))
        ends = gap[before] | (rows[SampleRow.BROKEN, :-1][before] > 0.0)
        segment = np.cumsum(np.append(self._segment, ends))
        self._distance, self._segment = float(distance[-1]), float(segment[-1])
        cell = np.floor(distance / self.every_m)
        if old:
            laid = np.diff(cell)
            segment = segment[1:]
        else:
            laid = np.diff(cell, prepend=-1.0)
        is_known = (rows[SampleRow.KNOWN] > 0.0) & np.isfinite(
            rows[[SampleRow.NORTH, SampleRow.EAST, SampleRow.HEADING]]
        ).all(axis=0)
        heading = self._unwrapped(rows[SampleRow.HEADING, old:], is_known[old:])
        number, first = _step_of(rows, gap)
        # Knots are added first, because they count the steps that were complete before these samples.
        knot_rows = np.repeat(np.arange(len(laid)), laid.astype(np.int64))
        row = old + knot_rows
        pose = [np.where(is_known[row], column, 0.0) for column in (*rows[POSE_ROWS[:2]][:, row], heading[knot_rows])]
        steps = self._steps_before + self._steps.shape[1] + number[row]
        self._knots = np.column_stack(
            [
                self._knots,
                [
                    rows[SampleRow.T, row],
                    *pose,
                    segment[knot_rows],
                    is_known[row],
                    steps,
                    self._samples + first[number[row]],
                ],
            ]
        )
        self._close(rows, held, first)
        return first_knot

    def _unwrapped(self, heading: Floats, known: Bools) -> Floats:
        """Return headings (n,) unwrapped: where known, each differs from the one before by at most a half turn."""
        angles = np.append(self._heading, heading[known])
        turns = np.cumsum(np.rint(np.diff(angles) / (2.0 * np.pi)))
        unwrapped = np.zeros(len(heading))
        unwrapped[known] = angles[1:] - 2.0 * np.pi * turns
        if len(turns):
            self._heading = float(unwrapped[known][-1])
        return unwrapped

    def _close(self, rows: Floats, held: Floats, first: Ints) -> None:
        """Keep complete steps as means over their time, and the samples of the open step unchanged."""
        closed = int(first[-1])
        if closed:
            begin, lasting = first[:-1], held[:closed]
            total = np.add.reduceat(lasting, begin)
            joined = [rows[SampleRow.T, begin], total]
            for column in (rows[SampleRow.LEFT], rows[SampleRow.RIGHT], rows[SampleRow.GYRO]):
                mean = np.add.reduceat(lasting * column[:closed], begin)
                joined.append(np.divide(mean, total, out=column[begin], where=total > 0.0))
            self._steps = np.column_stack([self._steps, joined])
            self._samples += closed
        self._open = rows[:, closed:].copy()

    def time_of(self, knot: int) -> float:
        """Return the time of a knot [s]."""
        return float(self._knots[KNOT_T, knot - self._knots_before])

    def last_by(self, t_s: float) -> int:
        """Return the number of the last knot at or before a time [s]."""
        return self._knots_before + int(np.searchsorted(self._knots[KNOT_T], t_s, side="right")) - 1

    def windows(self, first: int, last: int, now: int) -> Windows | None:
        """Return the windows that end at the knots from `first` to `last`; None without windows.

        Parameters
        ----------
        now : last knot at which the wheels are known; the track has the steps that were complete at this knot

        Notes
        -----
        No window crosses a gap, a jump or a slip event, or ends without a pose, as in `icrtool.kernels.track.cut`.
        """
        knots, before = self._knots, self._knots_before
        segment, is_known = knots[KNOT_SEGMENT], knots[KNOT_KNOWN] > 0.0
        cut = []
        for length_m in LEARNT_WINDOWS_M:
            over = round(length_m / EVERY_M)
            end = np.arange(max(first - before, over), last - before + 1)
            end = end[(segment[end] == segment[end - over]) & is_known[end] & is_known[end - over]]
            cut.append(np.stack([end - over, end, np.full(len(end), length_m * self.size)]))
        begin, end, length = np.concatenate(cut, axis=1)
        if not len(begin):
            return None
        lo, hi = int(begin.min()), last - before + 1
        t, north, east, heading = knots[:4, lo:hi]
        complete, samples = knots[KNOT_STEPS, now - before], knots[KNOT_SAMPLES, now - before]
        steps = self._steps[:, : int(complete) - self._steps_before]
        steps = steps[:, max(int(np.searchsorted(steps[0], t[0] - LONGEST_DELAY_S)) - 1, 0) :]
        none = np.zeros(hi - lo, np.bool_)
        track = Track(
            t=steps[0], held=steps[1], v_left=steps[2], v_right=steps[3], place_t=t, north=north, east=east,
            heading_t=t, heading=heading, distance=np.arange(lo, hi, dtype=np.float64) * self.every_m, in_outage=none,
            jump=none, slipping=none, gyro=steps[4], into=(1.0 - complete / max(samples, 1.0)) / 2.0,
        )  # fmt: skip
        return Windows(track, begin.astype(np.int64) - lo, end.astype(np.int64) - lo, length)

    def forget_until(self, end: int) -> None:
        """Drop the steps and knots that are not needed by windows that end at knot `end` or later."""
        keep = end - round(max(LEARNT_WINDOWS_M) / EVERY_M)
        drop = keep - self._knots_before
        if drop <= 0:
            return
        self._knots, self._knots_before = self._knots[:, drop:].copy(), keep
        since_s = self._knots[KNOT_T, 0] - LONGEST_DELAY_S
        old = max(int(np.searchsorted(self._steps[0], since_s)) - 1, 0)
        self._steps, self._steps_before = self._steps[:, old:].copy(), self._steps_before + old


def _intervals(rows: Floats, size: float) -> tuple[Floats, Floats, Bools]:
    """Return for each sample but the last: time that it holds [s], distance of the wheels [m], whether it is a gap."""
    duration_s = np.diff(rows[SampleRow.T])
    advance = np.abs((rows[SampleRow.LEFT, :-1] + rows[SampleRow.RIGHT, :-1]) / 2.0) * duration_s
    gap = (rows[SampleRow.GAP, :-1] > 0.0) | ~(duration_s >= 0.0) | ~(advance <= LARGEST_ADVANCE_M * size)
    duration_s[gap] = advance[gap] = 0.0
    return duration_s, advance, gap


def _step_of(rows: Floats, gap: Bools) -> tuple[Ints, Ints]:
    """Return the step of each sample (n,), counted from 0, and the first sample of each step."""
    standing = (rows[SampleRow.LEFT] == 0.0) & (rows[SampleRow.RIGHT] == 0.0)
    cell = np.floor(rows[SampleRow.T] / np.where(standing, STANDING_STEP_S, RECORDING_STEP_S) + ON_EDGE)
    begins = np.ones(rows.shape[1], np.bool_)
    begins[1:] = (np.diff(cell) != 0.0) | (standing[1:] != standing[:-1]) | gap
    return np.cumsum(begins) - 1, np.flatnonzero(begins)
