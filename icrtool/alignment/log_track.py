"""The track of a log: checks that its streams can be used together, and windows of driven distance to compare."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from icrtool.alignment.sensor_noise import (
    FEWEST_FIXES,
    MEDIAN_OF_RAYLEIGH,
    NOISIER,
    USUAL_POSITION_STD_M,
    unbroken_intervals,
)
from icrtool.alignment.sparse_reference import spans_of_measured, wheel_path, with_carried_heading
from icrtool.errors import DataError
from icrtool.kernels.arrays import Bools, Complexes, Floats, Ints, in_spans, runs_of, unwrapped
from icrtool.kernels.track import Track, Windows, cut
from icrtool.records.measurements import TURNING_MPS, Fixes
from icrtool.records.samples import HeadingSamples, PositionFixes, WheelSamples
from icrtool.records.tables import RobotLog

ALIGNMENT_WINDOW_M, LONGEST_WINDOW_M = 2.0, 10.0
"""Usual and largest length of the windows of the alignment [m]."""

WINDOW_IN_WIDTHS = 4.0
"""Length of the windows of small robots, in track widths. Slip is a share of the distance; over 2 m it hides their
ICRs."""

WINDOW_IN_POSITION_STD = 12.0
"""Smallest length of a window, in standard deviations of a position. Noise of the fixes then turns the displacement of
a window by at most 7 deg."""

WINDOW_IN_VALUES = 12.0
"""Smallest length of a window, in distances for which a wheel value is held. A value that is held while the robot
accelerates moves the end of a window by a part of this distance."""

STARTS_A_WINDOW, FEWEST_ALIGNMENT_WINDOWS = 8, 8
"""Number of windows that start within the length of one window, and smallest number of windows for a fit."""

FEWEST_OVERLAPPING = 2 * STARTS_A_WINDOW
"""Smallest number of overlapping windows that are used: as many as start within two windows."""

LONGEST_ALIGNMENT_WINDOW_S = 30.0
"""Longest duration of a window [s]. A longer one holds an outage or a stop."""

TURN_WINDOW_S, TURN_WINDOW_IN_INTERVALS = 1.0, 2.0
"""Shortest window of heading changes: in seconds, and in intervals between samples."""

TURN_WINDOW_EVERY_S = 0.5
"""Time between the starts of two windows of heading changes [s]."""

CHORD_S, LEAST_CHORD_M = 2.0, 0.3
"""Time over which distances are compared without a heading [s], and the shortest chord that is compared [m]."""

STANDS_S = 5.0
"""Longest time from a heading to the nearest motion of the wheels [s]; beyond it the robot counts as standing."""

MOST_WHEEL_SAMPLES = 25_000
"""Approximate number of samples to which the wheel samples of a longer drive are joined: 1 h at 7 Hz."""


@dataclass(frozen=True)
class DriveWindows(Windows):
    """Windows of distance, all of one length, and windows of time in which the heading changes.

    Attributes
    ----------
    turn_begin, turn_end : (u,) [s] windows of heading changes
    group, turn_group : (w,), (u,) numbers of stretches of distance that are independent of one another
    """

    turn_begin: Floats
    turn_end: Floats
    group: Ints
    turn_group: Ints

    @cached_property
    def laid(self) -> Complexes:
        """Mean distance of the sides laid along the heading (w,), north + j east [m]."""
        return self.over(self.track.laid)

    @cached_property
    def usual_length_m(self) -> float:
        """Usual distance of a window [m]. Where fixes are rare it is more than the nominal length."""
        return float(np.median(self.over(self.track.distance)))

    @cached_property
    def heading_changes(self) -> Floats:
        """Turn of the heading in each window of time (u,) [rad]."""
        begin, end = self.track.heading_at(np.stack([self.turn_begin, self.turn_end]))
        return np.asarray(end - begin)


def track_of_log(log: RobotLog, heading: HeadingSamples | None = None) -> Track:
    """Return a log as arrays; `heading` replaces the log's own."""
    stated = log.heading if heading is None else heading
    return track_of_streams(
        log.wheels, log.gnss, stated, same_clock=log.heading_is_of_position, slipping_ns=log.slipping_ns
    )


def track_of_streams(
    wheels: WheelSamples, gnss: PositionFixes | Fixes, heading: HeadingSamples, *, same_clock: bool,
    slipping_ns: tuple[tuple[int, int], ...] = (),
) -> Track:  # fmt: skip
    """Return streams as arrays; `same_clock` as in `Track`; the spans `slipping_ns` (`RobotLog`) count as gaps."""
    epoch = int(wheels.stamp_ns[0])
    wheel_t, fix_t, heading_t = (
        (stamps - epoch) / 1e9 for stamps in (wheels.stamp_ns, gnss.stamp_ns, heading.stamp_ns)
    )
    held = np.append(unbroken_intervals(np.diff(wheel_t)), 0.0)
    for span in slipping_ns:
        held[slice(*np.searchsorted(wheels.stamp_ns, span))] = 0.0
    left, right = wheels.v_left_mps, wheels.v_right_mps
    turns = np.abs(left) + np.abs(right) > 2.0 * TURNING_MPS
    angle = unwrapped(heading.heading_rad)
    if len(heading_t) > MOST_WHEEL_SAMPLES:
        # Neighbours are averaged, so that a delay does not depend on the noise of single samples.
        begin, behind = runs_of(turns)
        first = _thinned(in_spans(heading_t, wheel_t[begin] - STANDS_S, wheel_t[behind - 1] + STANDS_S))
        count = np.diff(first, append=len(heading_t))
        heading_t, angle = (np.add.reduceat(column, first) / count for column in (heading_t, angle))
    none = np.zeros(len(fix_t), np.bool_)
    track = Track(
        wheel_t, held, left, right, fix_t, gnss.north_m, gnss.east_m, heading_t, angle, np.zeros(len(fix_t)),
        none, none, none, same_clock=same_clock,
    )  # fmt: skip
    if len(wheel_t) > MOST_WHEEL_SAMPLES:
        # Gaps are not joined with other samples.
        begins = (held == 0.0) | np.append(True, held[:-1] == 0.0)
        begins[_thinned(turns)] = begins[-1] = True
        track = track.joined(np.flatnonzero(begins))
    track = track._replace(distance=np.interp(fix_t, track.t, track.travel), place_std_m=fix_std_m(gnss, track))
    return with_carried_heading(track)


def _thinned(busy: Bools) -> Ints:
    """Return rows at which to join the samples of a long drive (n,): evenly, or only in its stops if that is enough.

    If a robot is parked for days, the samples of its drives are therefore not joined.
    """
    every = -(-len(busy) // MOST_WHEEL_SAMPLES)
    moving = np.flatnonzero(busy | np.append(False, busy[:-1]))
    even = np.arange(0, len(busy), every)
    return np.union1d(moving, even) if len(moving) <= MOST_WHEEL_SAMPLES else even


def fix_std_m(gnss: PositionFixes | Fixes, track: Track | None = None) -> float:
    """Return the noise of the fixes on one axis [m]: the stated noise, or the measured one where it is clearly larger.

    Parameters
    ----------
    gnss : the fixes
    track : of the same fixes, whose wheels explain a part of the motion between rare fixes

    Notes
    -----
    The noise is measured without a heading, whose meaning is not known yet: the second difference of white errors has
    six times their variance. The robot's motion between fixes adds little where fixes are frequent. Where they are
    rare, `wheel_path` leaves out the motion of the wheels.
    """
    variance = (gnss.var_north_m2 + gnss.var_east_m2) / 2
    known_variance = variance[np.isfinite(variance) & (variance > 0)]
    stated = math.sqrt(float(np.median(known_variance))) if len(known_variance) else USUAL_POSITION_STD_M
    if len(gnss.stamp_ns) < FEWEST_FIXES:
        return stated
    bend = np.sqrt(np.diff(gnss.north_m, 2) ** 2 + np.diff(gnss.east_m, 2) ** 2)
    measured = float(np.median(bend)) / (MEDIAN_OF_RAYLEIGH * math.sqrt(6.0))
    if track is not None and measured > NOISIER * stated and (path := wheel_path(track)) is not None:
        measured = min(measured, path.noise_m)
    return measured if measured > NOISIER * stated else stated


def windows_of_log(
    log: RobotLog, width_m: float, heading: HeadingSamples | None = None, measured_t: Floats | None = None
) -> DriveWindows:
    """Return the windows of the alignment, for a robot of track width b [m].

    Parameters
    ----------
    log : the log
    width_m : track width [m]
    heading : in place of the log's own; measured_t : times at which it was measured, `Track.measured_t`
    """
    track = track_of_log(log, heading)
    track = track if measured_t is None else track._replace(measured_t=measured_t)
    return cut_drive_windows(track, min(ALIGNMENT_WINDOW_M, WINDOW_IN_WIDTHS * width_m))


def cut_drive_windows(track: Track, least_m: float = ALIGNMENT_WINDOW_M, *, length_m: float = 0.0) -> DriveWindows:
    """Return overlapping windows of a drive: of wheel distance between fixes, and of time between headings.

    The length of the arrays depends on the number of samples and not on the speeds, so that a damaged speed needs no
    more memory.

    Parameters
    ----------
    track : the drive
    least_m : shortest window; noise of the fixes and held wheel values make windows longer
    length_m : length of the windows in place of the computed one; 0: not given
    """
    travel, noise = track.travel, WINDOW_IN_POSITION_STD * min(track.place_std_m, 10.0)
    # Distance for which a wheel value is held while the robot moves; repeated values count as one value.
    moving = np.diff(travel) > 0
    changes = [np.count_nonzero((np.diff(speed) != 0) & moving) for speed in (track.v_left, track.v_right)]
    lasts_m = float(travel[-1]) / max(sum(changes) / 2, 1.0)
    length = length_m or max(least_m, noise, min(WINDOW_IN_VALUES * lasts_m, LONGEST_WINDOW_M), _apart_m(track))
    windows = cut(track, [length], length / STARTS_A_WINDOW)
    begin, end = windows.begin, windows.end
    covers = [track.t, track.heading_t] if len(track.heading_t) else [track.t]
    first, last = max(t[0] for t in covers), min(t[-1] for t in covers)
    t, at = track.place_t, track.distance
    usable = (t[begin] >= first) & (t[end] <= last) & (t[end] - t[begin] < LONGEST_ALIGNMENT_WINDOW_S)
    usable &= at[end] - at[begin] < 2.0 * length
    begin, end, lengths = begin[usable], end[usable], windows.length_m[usable]
    # In a window of time, wheels and heading must be sampled and the wheels must turn.
    turn_begin = turn_end = np.empty(0)
    sampled = track.seen_heading_t
    if len(sampled):
        usual = float(np.median(np.diff(sampled))) if len(sampled) > 1 else 0.0
        if track.measured_t is None:
            turn_begin = sampled[0] + TURN_WINDOW_EVERY_S * np.unique(
                np.floor((sampled - sampled[0]) / TURN_WINDOW_EVERY_S)
            )
            turn_end = turn_begin + max(TURN_WINDOW_S, TURN_WINDOW_IN_INTERVALS * usual)
        else:
            turn_begin, turn_end = spans_of_measured(sampled, TURN_WINDOW_S, round(TURN_WINDOW_IN_INTERVALS))
            near = turn_end - turn_begin < LONGEST_ALIGNMENT_WINDOW_S
            turn_begin, turn_end = turn_begin[near], turn_end[near]
        usable = (turn_begin >= first) & (turn_end <= last) & track.clear(turn_begin, turn_end)
        usable &= np.searchsorted(sampled, turn_end) > np.searchsorted(sampled, turn_begin) + 1
        usable &= np.interp(turn_end, track.t, travel) > np.interp(turn_begin, track.t, travel)
        turn_begin, turn_end = turn_begin[usable], turn_end[usable]
    # Windows within `size` count as one independent observation: 10 windows, where the drive has 40 of this size.
    size = min(max(float(travel[-1]) / 40.0, 2.0 * length), 10.0 * length)
    turn_travel = np.interp(turn_begin, track.t, travel)
    return DriveWindows(
        track, begin, end, lengths, turn_begin, turn_end,
        np.floor(at[begin] / size).astype(np.int64), np.floor(turn_travel / size).astype(np.int64),
    )  # fmt: skip


APART_SHARE = 0.9
"""Quantile of the distances from fix to fix. No window is shorter than this quantile."""


def _apart_m(track: Track) -> float:
    """Return the usual largest distance from one fix to the next while the robot moves [m]; 0 without two fixes."""
    step = np.diff(track.distance)
    step = step[step > 0.0]
    return float(np.quantile(step, APART_SHARE)) if len(step) else 0.0


def chord_s(track: Track) -> float:
    """Return the duration of a chord [s]: `CHORD_S`, or the usual interval between fixes that are rarer."""
    return max(CHORD_S, float(np.median(np.diff(track.place_t)))) if len(track.place_t) > 1 else CHORD_S


def rows_of_chords(track: Track) -> Ints:
    """Return the rows of the fixes at which chords begin and end."""
    return np.unique(np.floor(track.place_t / chord_s(track) + 1e-9), return_index=True)[1]


def cut_chords(track: Track) -> tuple[Floats, Complexes, Floats, Floats]:
    """Return spans of `chord_s` of a drive from fix to fix, without a heading.

    Returns
    -------
    duration (w,) [s]; displacement of the fixes, north + j east; distance of the left and of the right side, with their
    signs [m]
    """
    rows = rows_of_chords(track)
    left, right = (np.diff(track.at_places(speed)[rows]) for speed in (track.v_left, track.v_right))
    return np.diff(track.place_t[rows]), np.diff(track.place[rows]), left, right


IMPOSSIBLE_MPS = 1e6
"""Wheel speed from which on a value is damaged [m/s]. Its distance could not be cut into windows."""

IMPOSSIBLE_M = 1e9
"""Distance from the origin from which on a position is damaged [m]. Metric coordinates of all countries are below 1e8
m."""


def check_streams(log: RobotLog) -> None:
    """Raise where streams cannot be used together.

    Raises
    ------
    DataError
        Fewer than two samples of a stream, none at the same time, stamps that go back, or a value that is not a finite
        number. `icrtool.read_log` sorts rows and leaves damaged ones out; a table made by a program may hold them.
    """
    wheels, gnss, heading = log.wheels, log.gnss, log.heading
    if not len(heading.stamp_ns):
        raise DataError(log.name, "no orientation in it", "use preset field, which estimates the heading")
    for name, stamps, values, variances in (
        ("wheel", wheels.stamp_ns, (wheels.v_left_mps, wheels.v_right_mps), ()),
        ("position", gnss.stamp_ns, (gnss.north_m, gnss.east_m), (gnss.var_north_m2, gnss.var_east_m2)),
        ("heading", heading.stamp_ns, (heading.heading_rad,), (heading.var_rad2,)),
    ):
        if len(stamps) < 2:
            raise DataError(log.name, f"{len(stamps)} usable {name} samples", "a run needs at least two of each stream")
        back = stamps < np.append(stamps[:1], stamps[:-1])
        bad = np.logical_or.reduce([~np.isfinite(values_of) for values_of in values])
        negative = np.logical_or.reduce([np.zeros(len(stamps), np.bool_), *(values_of < 0 for values_of in variances)])
        count = np.count_nonzero(bad)
        for rows, fault, advice in (
            (back, f"the {name} stamps go back at row", "sort the rows by stamp"),
            (bad, f"{count} {name} samples are not finite numbers, the first at row", "leave those rows out"),
            (negative, f"a {name} variance is negative, the first at row", "NaN stands for unknown"),
        ):
            if rows.any():
                raise DataError(log.name, f"{fault} {rows.argmax()}", advice)
    fastest = max(np.abs(values_of).max() for values_of in (wheels.left, wheels.right))
    farthest = max(np.abs(values_of).max() for values_of in (gnss.north_m, gnss.east_m))
    if fastest >= IMPOSSIBLE_MPS:
        raise DataError(log.name, f"a wheel speed of {fastest:.2g} m/s", "leave out speeds that no wheel can have")
    if farthest >= IMPOSSIBLE_M:
        raise DataError(log.name, f"a position {farthest:.2g} m from the origin", "are the positions in metres?")
    spans = {"wheel": wheels.stamp_ns, "position": gnss.stamp_ns, "heading": heading.stamp_ns}
    if max(int(s[0]) for s in spans.values()) >= min(int(s[-1]) for s in spans.values()):
        spans_text = ", ".join(f"{name} {int(s[0]) / 1e9:.1f}-{int(s[-1]) / 1e9:.1f} s" for name, s in spans.items())
        raise DataError(log.name, "wheels, position and heading do not overlap in time", spans_text)
