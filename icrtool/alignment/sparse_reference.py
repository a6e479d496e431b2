"""References with few poses: headings carried by the wheels, noise of rare fixes, nodes of interpolated poses."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from icrtool.alignment.sensor_noise import MEDIAN_OF_RAYLEIGH, SLIP_SHARE, is_hole
from icrtool.kernels.arrays import Bools, Complexes, Floats, Ints, wrapped
from icrtool.kernels.track import Track
from icrtool.records.notes import note
from icrtool.records.samples import HeadingSamples
from icrtool.records.tables import LARGEST_STATE, RobotLog

SPARSE_S = 0.5
"""Usual interval between headings above which they are carried by the wheels [s]. Turns are compared over 1 s; rarer
headings do not resolve such turns."""

LONGEST_CARRIED_S = 30.0
"""Longest interval in which the wheels carry a heading [s]. A longer one holds a stop or an outage."""

FEWEST_CARRIED = 8
"""Smallest number of intervals from which the ratio of turn to the difference of the sides is taken."""

LARGEST_TURN_PER_M = 7.0
"""Largest turn of a robot per metre by which its sides differ [rad/m], of a robot with ICRs 0.14 m apart."""

AGREED_COSINE = 0.7
"""Smallest mean cosine of the differences of the turns at which wheels carry a heading. It is 0 for turns of any size,
and 0.7 for errors of 48 deg (rms)."""


def with_carried_heading(track: Track) -> Track:
    """Return the track with a heading at each wheel sample where its headings are rare; else the same track.

    Notes
    -----
    Between two measured headings the heading follows the wheels' turn, times one ratio of the whole drive; the
    remaining difference at the measured headings is interpolated. The ratio maximises the mean cosine of the
    differences, as a turn between two headings may be more than half a revolution (Fisher and Lee 1992, circular
    regression). `Track.measured_t` holds the times of the measured headings.
    """
    t, heading = track.heading_t, track.heading
    step = np.diff(t)
    if len(step) < FEWEST_CARRIED or not float(np.median(step)) > SPARSE_S:
        return track
    turned = np.interp(t, track.t, track.cumulate(2.0 * track.half_difference))
    usable = (step < LONGEST_CARRIED_S) & (step > 0.0) & track.clear(t[:-1], t[1:])
    apart, turn = np.diff(turned), wrapped(np.diff(heading))
    ratio = _turn_per_m(apart[usable], turn[usable])
    if ratio is None:
        return track
    remainder = heading[0] + np.append(
        0.0, np.cumsum(np.where(usable, wrapped(turn - ratio * apart), turn - ratio * apart))
    )
    inside = track.t[(track.t > t[0]) & (track.t < t[-1])]
    dense = np.union1d(t, inside)
    everywhere = np.interp(dense, track.t, track.cumulate(2.0 * track.half_difference)) - turned[0]
    return track._replace(heading_t=dense, heading=np.interp(dense, t, remainder) + ratio * everywhere, measured_t=t)


def _turn_per_m(apart: Floats, turn: Floats) -> float | None:
    """Return turn per metre by which the sides differ [rad/m]; None where the wheels do not explain the turns."""
    largest = float(np.abs(apart).max(initial=0.0))
    if len(apart) < FEWEST_CARRIED or largest <= 0.0:
        return None
    tried = _ratios(largest)
    score = np.array([float(np.cos(turn - ratio * apart).mean()) for ratio in tried.tolist()])
    best = float(tried[int(np.argmax(score))])
    if score.max() < AGREED_COSINE:
        return None
    return best + float(apart @ wrapped(turn - best * apart)) / float(apart @ apart)


def are_rare(track: Track) -> bool:
    """Return whether the fixes of a track are usually more than `SPARSE_S` apart."""
    return len(track.place_t) > 1 and float(np.median(np.diff(track.place_t))) > SPARSE_S


STANDING_SHARE = 0.05
"""Travel between two fixes below which the robot stands, as a share of the usual travel."""

AVERAGED_S = 0.1
"""Time over which wheel speeds are averaged for the path between rare fixes [s]."""

STRAIGHT_QUANTILE = 0.9
"""Quantile of the ratio of displacement to the wheels' travel that straight steps have."""


class WheelPath(NamedTuple):
    """The path of the wheels until each fix, with the ratio of turn to the difference of the sides that fits best.

    Attributes
    ----------
    position : (m,) positions by the wheels at the fixes, in the unit of the wheels, with an unknown direction
    noise_m : standard deviation of the fixes on one axis [m], without the part that path and slip explain
    misfit : median distance of a fix from the place that the two fixes before it and the path give, over the step
    """

    position: Complexes
    noise_m: float
    misfit: float


def wheel_path(track: Track) -> WheelPath | None:
    """Return the path of the wheels between rare fixes; None where fixes are frequent, or too few.

    Notes
    -----
    Of three fixes in a row, the second step is expected to be the first one times S_2 / S_1, with the steps S of the
    wheels. The expectation depends neither on the heading nor on the unit of the wheels. One ratio of turn to the
    difference of the sides is tried after the other, each also for wheels of which one side is reversed.
    """
    step_s = np.diff(track.place_t)
    if len(step_s) < FEWEST_CARRIED or not are_rare(track):
        return None
    track = _averaged_wheels(track)
    gone, seen = np.diff(track.at_places(np.abs(track.v_left) + np.abs(track.v_right))) / 2.0, np.diff(track.place)
    moves = gone > STANDING_SHARE * float(np.median(gone))
    usable = (step_s[:-1] < LONGEST_CARRIED_S) & (step_s[1:] < LONGEST_CARRIED_S) & moves[:-1] & moves[1:]
    usable &= track.clear(track.place_t[:-2], track.place_t[2:])
    if np.count_nonzero(usable) < FEWEST_CARRIED:
        return None
    metres = float(np.quantile(np.abs(seen[moves]) / gone[moves], STRAIGHT_QUANTILE))
    best, least = None, math.inf
    for ahead, apart in ((track.mean_speed, track.half_difference), (track.half_difference, track.mean_speed)):
        total = 2.0 * track.cumulate(apart)
        middle, turned = total + apart * track.held, np.abs(np.diff(np.interp(track.place_t, track.t, total)))
        largest = metres * float(turned.max())
        if not math.isfinite(largest):
            return None
        for ratio in (metres * _ratios(largest)).tolist():
            position = np.asarray(track.at_places(ahead * np.exp(1j * ratio * middle)), np.complex128)
            gain, away = _third_fixes(position, track.place, usable)
            misfit = float(np.median(np.abs(away) / (1.0 + np.abs(gain))))
            if misfit < least:
                turns = 1.0 + abs(ratio) * (turned[1:] + turned[:-1])
                slip_m = SLIP_SHARE * metres * (gone[1:] * turns)[usable]
                # the variance of p_3 - p_2 - gain (p_2 - p_1) by white noise, in variances of a fix
                spread = np.sqrt(1.0 + np.abs(1.0 + gain) ** 2 + np.abs(gain) ** 2)
                beyond = np.sqrt(np.maximum(np.abs(away) ** 2 - slip_m**2, 0.0)) / spread
                least, best = misfit, (position, float(np.median(beyond)) / MEDIAN_OF_RAYLEIGH)
    return None if best is None else WheelPath(*best, least / max(float(np.median(np.abs(seen[moves]))), 1e-9))


def _averaged_wheels(track: Track) -> Track:
    """Return a track with the wheel samples averaged over `AVERAGED_S`; gaps are kept."""
    every = round(AVERAGED_S / max(float(np.median(track.held)), 1e-3))
    if every < 2:
        return track
    begins = np.append(True, track.held[:-1] == 0.0) | (track.held == 0.0)
    begins[::every] = begins[-1] = True
    return track.joined(np.flatnonzero(begins))


def _third_fixes(path: Complexes, position: Complexes, usable: Bools) -> tuple[Complexes, Complexes]:
    """Return the ratio of the second step to the first by a path, and how far the third fix lies from its place [m].

    Parameters
    ----------
    path : (m,) positions by the wheels
    position : (m,) positions by the fixes [m]
    usable : (m - 2,) triples that are returned
    """
    first, second = np.diff(path)[:-1][usable], np.diff(path)[1:][usable]
    gain = second / np.where(np.abs(first) > 0.0, first, np.inf)
    return gain, np.diff(position)[1:][usable] - gain * np.diff(position)[:-1][usable]


def _ratios(largest_m: float) -> Floats:
    """Return ratios of turn to the difference of the sides to try [rad/m], for differences up to `largest_m`."""
    return np.arange(-LARGEST_TURN_PER_M, LARGEST_TURN_PER_M, min(0.5 / max(largest_m, 1e-9), 0.1))


def spans_of_measured(measured_t: Floats, least_s: float, intervals: int) -> tuple[Floats, Floats]:
    """Return starts and ends (w,) [s] of spans from one measured heading to another.

    Parameters
    ----------
    measured_t : (n,) stamps of the measured headings [s]
    least_s : shortest span [s]
    intervals : smallest number of intervals in a span
    """
    begin = np.arange(len(measured_t))
    end = np.maximum(begin + intervals, np.searchsorted(measured_t, measured_t + least_s - 1e-9))
    kept = end < len(measured_t)
    return measured_t[begin[kept]], measured_t[end[kept]]


LINE_SHARE, LINE_M, LINE_RAD = 1e-4, 2e-6, 2e-6
"""Largest second difference of a sample that lies on the line between its neighbours: as a share of the step, and in
metres and radians, by which stamps in microseconds and coordinates are rounded."""

CURVE_SHARE = 0.1
"""Difference of the sides, as a share of their sum, from which on a robot drives a curve."""

INTERPOLATED_SHARE = 0.6
"""Share of the positions in curves that lie on lines, from which on the positions are interpolated. No robot drives a
curve in a straight line; of every third position that was measured, two thirds lie on lines."""

FEWEST_IN_CURVES = 20
"""Smallest number of positions in curves by which positions are called interpolated."""


def without_interpolated(log: RobotLog) -> RobotLog:
    """Return the log with the nodes of positions that are linear between nodes; else the same log.

    Positions between the nodes are no measurements. A heading is reduced to its nodes where it is linear as well.
    """
    fixes, wheels = log.gnss, log.wheels
    stamps = fixes.stamp_ns
    if len(stamps) < FEWEST_IN_CURVES or len(wheels.stamp_ns) < 2:
        return log
    columns = fixes.north_m, fixes.east_m, wheels.left, wheels.right, log.heading.heading_rad
    in_order = all((np.diff(stream.stamp_ns) >= 0).all() for stream in (fixes, wheels, log.heading))
    if not in_order or not all((np.abs(column) < LARGEST_STATE).all() for column in columns):
        # Damaged streams are refused later, with the reason.
        return log
    t, position = (stamps - stamps[0]) / 1e9, fixes.north_m + 1j * fixes.east_m
    bend, step = _bends(t, position)
    straight = bend <= LINE_SHARE * step + LINE_M
    row = np.clip(np.searchsorted(wheels.stamp_ns, stamps, side="right") - 1, 0, len(wheels.stamp_ns) - 1)
    left, right = wheels.left[row], wheels.right[row]
    curves = np.abs(left - right) > CURVE_SHARE * (np.abs(left) + np.abs(right))
    curves &= step > 10.0 * LINE_M
    if np.count_nonzero(curves) < FEWEST_IN_CURVES or float(straight[curves].mean()) < INTERPOLATED_SHARE:
        return log
    heading = log.heading
    same_stamps = log.heading_is_of_position and np.array_equal(heading.stamp_ns, stamps)
    turn_straight, turn_bend, turns = _straight_turns(heading)
    if turns and same_stamps:
        straight, bend = straight & turn_straight, bend + turn_bend
    kept = _nodes(~straight, bend)
    apart_s = float(np.median(np.diff(t[kept])))
    text = (
        f"the positions are interpolated: they lie on straight lines between nodes {apart_s:.2g} s apart, also where "
        f"the robot turns; the {len(kept)} nodes of {len(stamps)} positions are used"
    )
    rows = np.zeros(len(stamps), np.bool_)
    rows[kept] = True
    finding = note("positions_interpolated", text, log.name)
    if same_stamps:
        heading = heading.cut(rows)
    elif turns:
        rows_of_heading = np.zeros(len(turn_straight), np.bool_)
        rows_of_heading[_nodes(~turn_straight, turn_bend)] = True
        heading = heading.cut(rows_of_heading)
    return replace(log, gnss=fixes.cut(rows), heading=heading, notes=(*log.notes, finding))


def _straight_turns(heading: HeadingSamples) -> tuple[Bools, Floats, bool]:
    """Return which headings (n,) lie on the line between their neighbours, how far off, and whether most turns do."""
    if len(heading.stamp_ns) < FEWEST_IN_CURVES:
        return np.zeros(len(heading.stamp_ns), np.bool_), np.zeros(len(heading.stamp_ns)), False
    bend, step = _bends((heading.stamp_ns - heading.stamp_ns[0]) / 1e9, np.unwrap(heading.heading_rad))
    straight, turning = bend <= LINE_SHARE * step + LINE_RAD, step > 10.0 * LINE_RAD
    many = np.count_nonzero(turning) >= FEWEST_IN_CURVES
    return straight, bend, bool(many and straight[turning].mean() > INTERPOLATED_SHARE)


def _bends(t: Floats, value: Floats) -> tuple[Floats, Floats]:
    """Return the distance of each sample (n,) from the line between its neighbours, and half the neighbours' distance.

    The first and the last sample, and samples at a hole, are far from any line.
    """
    before, after = np.diff(t)[:-1], np.diff(t)[1:]
    share = before / np.maximum(before + after, 1e-12)
    line = value[:-2] + share * (value[2:] - value[:-2])
    far = np.full(len(t), np.inf)
    far[1:-1] = np.where((before > 0.0) & (after > 0.0), np.abs(value[1:-1] - line), 0.0)
    hole = is_hole(np.diff(t))
    far[:-1][hole] = far[1:][hole] = np.inf
    half = np.zeros(len(t))
    half[1:-1] = np.abs(value[2:] - value[:-2]) / 2.0
    return far, half


def _nodes(bent: Bools, bend: Floats) -> Ints:
    """Return the rows of the nodes: in each run of samples off the line, the sample that is furthest off."""
    rows = np.flatnonzero(bent)
    first = np.append(True, np.diff(rows) > 1)
    kept = [run[int(np.argmax(bend[run]))] for run in np.split(rows, np.flatnonzero(first)[1:])]
    return np.asarray(kept, np.int64)
