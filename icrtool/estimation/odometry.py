"""Distance and speed of a run, paths by its wheels alone (Pentzer 2014, Section 6.1), and headings without GNSS."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from typing import Literal, NamedTuple

import numpy as np

from icrtool.kernels.arrays import ROWS_AT_ONCE, Bools, Floats, Ints, trapezoids, unwrapped
from icrtool.kernels.kinematics import chord_rows
from icrtool.kernels.open_loop import open_loop_pieces
from icrtool.kernels.track import FrozenIcrs, OpenLoopPath
from icrtool.records.measurements import MeasuredHeading, ReferenceJump, SensorData
from icrtool.records.run import Run, no_slip_icrs, track_of_states
from icrtool.records.run_document import DriveDocument
from icrtool.records.tables import States

SHORTEST_STEP_M, STEP_IN_STD = 0.1, 5.0
"""Smallest length of a chord of the driven path, in metres and in standard deviations of the position."""

LEAST_MODELLED = 0.5
"""Ratio of the model's distance to a chord above which the speed within the chord follows the model."""


@dataclass(frozen=True, slots=True)
class OdometryPath:
    """Path by wheel speeds alone from the first recorded state.

    Attributes
    ----------
    north_m, east_m : float64 (n,), at every recorded state or at some states
    heading_rad : float64 (n,), clockwise from north, unwrapped
    end_error_m : distance to the filter's estimate at the last state
    mean_error_m, max_error_m : mean and largest distance to the filter's estimate, over every recorded state
    """

    north_m: Floats
    east_m: Floats
    heading_rad: Floats
    end_error_m: float
    mean_error_m: float
    max_error_m: float


OdometryName = Literal["icr", "icr_momentary", "no_slip"]
"""Name of a path that is computed from wheel speeds alone."""


def momentary_icrs(table: States) -> FrozenIcrs:
    """Return the ICRs that the filter had estimated at each state (n,)."""
    return FrozenIcrs(table.y_icr_right_m, table.y_icr_left_m, table.x_icr_m)


def odometry_icrs(table: States, track_width_m: float | None) -> dict[OdometryName, FrozenIcrs]:
    """Return the ICRs of each odometry of a drive: final, momentary and, if b is known, without slip.

    Notes
    -----
    Pentzer 2014, Section 6.1: the final ICRs for the circles, the most recent ICRs at each step for all other paths.
    """
    icrs: dict[OdometryName, FrozenIcrs] = {
        "icr": FrozenIcrs.constant(*table.icrs_at(-1)),
        "icr_momentary": momentary_icrs(table),
    }
    if track_width_m is not None:
        icrs["no_slip"] = FrozenIcrs.constant(*no_slip_icrs(track_width_m))
    return icrs


def drive_wheels(table: States, in_gap: Bools, icrs: FrozenIcrs, every: int = 1) -> OdometryPath:
    """Return the path by wheel speeds from the first state to the last; it follows the filter in gaps.

    Parameters
    ----------
    table : the recorded states
    in_gap : bool (n,), whether the interval after each state is a gap in the wheel data
    icrs : one triple for the whole path, or one for each state
    every : number of states from one kept point of the path to the next; the last state is kept, too

    Notes
    -----
    The motion of the wheels in a gap is not known. It is replaced by the filter's displacement, turned by the heading
    error of the odometry at the start of the gap, so that a gap does not change the error.
    """
    kept = np.append(np.arange(0, len(table) - 1, every), len(table) - 1)
    path, total_m, largest_m = OpenLoopPath(*np.empty((3, len(kept)))), 0.0, 0.0
    for rows, piece in _pieces(table, in_gap, icrs):
        here = slice(*np.searchsorted(kept, [rows.start, rows.stop]))
        for column, values in zip(path, piece, strict=True):
            column[here] = values[kept[here] - rows.start]
        away_m = np.hypot(piece.north - table.north_m[rows], piece.east - table.east_m[rows])
        total_m, largest_m = total_m + float(away_m.sum()), max(largest_m, float(away_m.max()))
    end_m = math.hypot(path.north[-1] - table.north_m[-1], path.east[-1] - table.east_m[-1])
    return OdometryPath(*path, end_m, total_m / len(table), largest_m)


def _pieces(table: States, in_gap: Bools, icrs: FrozenIcrs) -> Iterator[tuple[slice, OpenLoopPath]]:
    """Yield the path of `drive_wheels` in order, some states at a time, because a whole path is large."""
    track = track_of_states(table, in_gap, np.empty((0, 2), np.int64))
    edges = np.flatnonzero(in_gap[:-1])
    north_error, east_error, heading_error = 0.0, 0.0, 0.0
    for first, last in zip([0, *(edges + 1).tolist()], [*edges.tolist(), len(table) - 1], strict=True):
        north, east, psi = float(track.north[first]), float(track.east[first]), float(track.heading[first])
        cos, sin = math.cos(heading_error), math.sin(heading_error)
        if first:
            # The displacement is rotated by the heading error at the start of the gap. This is the resulting
            # difference.
            step_north, step_east = north - float(track.north[first - 1]), east - float(track.east[first - 1])
            north_error += step_north * cos - step_east * sin - step_north
            east_error += step_north * sin + step_east * cos - step_east
        path = OpenLoopPath(*(np.array([value]) for value in (north, east, psi)))
        for rows, piece in chain([(slice(first, first + 1), path)], open_loop_pieces(track, icrs, first, last)):
            ahead_north, ahead_east = piece.north - north, piece.east - east
            path = OpenLoopPath(
                north + north_error + ahead_north * cos - ahead_east * sin,
                east + east_error + ahead_north * sin + ahead_east * cos,
                piece.heading + heading_error,
            )
            yield rows, path
        north_error, east_error = (
            float(column[-1] - reference[last])
            for column, reference in ((path.north, track.north), (path.east, track.east))
        )
        heading_error = float(path.heading[-1] - track.heading[last])


def _without_jumps(table: States, jumps: Iterable[ReferenceJump]) -> tuple[Floats, Floats]:
    """Return the positions of states (n,), north and east [m], without the jumps of the reference.

    Across a jump the robot is assumed to drive on in the direction of its states before the jump, for the distance of
    its wheels.
    """
    north, east = table.north_m.copy(), table.east_m.copy()
    for jump in jumps:
        if jump.undecided:
            continue
        first = max(int(np.searchsorted(table.stamp_ns, jump.begin_ns, side="right")) - 1, 0)
        last = min(int(np.searchsorted(table.stamp_ns, jump.end_ns)), len(table) - 1)
        if last <= first:
            continue
        gone = table.distance_m[first : last + 1] - table.distance_m[first]
        heading = table.heading_rad[last]
        for axis, along in ((north, math.cos(heading)), (east, math.sin(heading))):
            moved = axis[last] - axis[first] - gone[-1] * along
            axis[last:] -= moved
            axis[first : last + 1] = axis[first] + gone * along
    return north, east


class GapPaths(NamedTuple):
    """The gaps in the wheel data of a run, and the paths in them.

    Attributes
    ----------
    row : (g,) rows of the states at their starts
    beyond_m : (g,) length of the path through the fixes in each gap, minus the chord from state to state [m]
    unseen_s, unseen_m : duration of the gaps without a fix in which the robot moved, and the straight distance there
    """

    row: Ints
    beyond_m: Floats
    unseen_s: float
    unseen_m: float


def measure_gaps(table: States, in_gap: Bools, sensors: SensorData, used: Bools) -> GapPaths:
    """Return the paths in the gaps of the wheel data, from the fixes there.

    Parameters
    ----------
    table : states (n,)
    in_gap : (n,) states that begin a gap
    sensors : sensor data of the run, with m fixes
    used : (m,) fixes that the filter used
    """
    rows, seen = np.flatnonzero(in_gap), sensors.fixes.cut(used)
    if not (len(rows) and len(seen.stamp_ns)):
        return GapPaths(rows, np.zeros(len(rows)), 0.0, 0.0)
    forward, right = sensors.facts.antenna_m
    heading = np.interp(seen.stamp_ns, sensors.headings.stamp_ns, unwrapped(sensors.headings.heading_rad))
    robot_positions = seen.north_m + 1j * seen.east_m - (forward + 1j * right) * np.exp(1j * heading)
    step_m = max(SHORTEST_STEP_M, STEP_IN_STD * float(np.sqrt(np.median(seen.var_north_m2 + seen.var_east_m2))))
    positions, beyond_m, unseen_s, unseen_m = table.north_m + 1j * table.east_m, np.zeros(len(rows)), 0.0, 0.0
    for gap, row in enumerate(rows.tolist()):
        first, last = np.searchsorted(seen.stamp_ns, table.stamp_ns[row : row + 2], side="right").tolist()
        if last > first:
            path = np.concatenate([positions[row : row + 1], robot_positions[first:last], positions[row + 1 : row + 2]])
            chosen = chord_rows(path.real.copy(), path.imag.copy(), step_m)
            length = np.abs(np.diff(path[chosen])).sum() + np.abs(path[-1] - path[chosen[-1]])
            beyond_m[gap] = max(float(length - np.abs(positions[row + 1] - positions[row])), 0.0)
        elif last < len(robot_positions):
            # The filter follows the robot at the first fix after the gap.
            after = int(np.searchsorted(table.stamp_ns, seen.stamp_ns[last]))
            driven = float(table.distance_m[min(after, len(table) - 1)] - table.distance_m[row + 1])
            moved = float(np.abs(robot_positions[last] - positions[row])) - driven
            noise = math.hypot(float(table.std_north_m[row]), float(table.std_east_m[row]))
            if moved > max(step_m, STEP_IN_STD * noise):
                unseen_s, unseen_m = unseen_s + float(table.t_s[row + 1] - table.t_s[row]), unseen_m + moved
    return GapPaths(rows, beyond_m, unseen_s, unseen_m)


NO_GAPS = GapPaths(np.empty(0, np.int64), np.empty(0), 0.0, 0.0)
"""Paths of a drive without gaps."""


def drive_summary(table: States, jumps: Iterable[ReferenceJump] = (), gaps: GapPaths = NO_GAPS) -> DriveDocument:
    """Return duration, distance of the positions, and mean and standard deviation of the speed over time.

    Parameters
    ----------
    table : the recorded states
    jumps : jumps of the reference; their length does not count as driven
    gaps : paths in the gaps of the wheel data

    Notes
    -----
    The distance is the sum of chords between positions. A chord is longer than the noise of the positions, so that a
    parked robot has no distance, and a spin on the spot has none. Within a chord the speed follows the model; it is
    constant if the model shows less than half of the chord. In a gap of the wheel data there is no state, and the path
    through the fixes counts.
    """
    interval, duration = np.diff(table.t_s), float(table.t_s[-1])
    noise = float(np.median(np.hypot(table.std_north_m, table.std_east_m), overwrite_input=True))
    north, east = _without_jumps(table, jumps)
    rows = chord_rows(north, east, max(SHORTEST_STEP_M, STEP_IN_STD * noise))
    chords = np.hypot(np.diff(north[rows]), np.diff(east[rows]))
    if rows[-1] != len(table) - 1:
        # The rest at the end is shorter than a chord and does not count.
        rows, chords = np.append(rows, len(table) - 1), np.append(chords, 0.0)
    if len(gaps.row) and len(chords):
        np.add.at(chords, np.searchsorted(rows, gaps.row, side="right") - 1, gaps.beyond_m)
    distance = float(chords.sum())
    modelled, lasted = np.diff(table.distance_m[rows]), np.diff(table.t_s[rows])
    # The model stands still in a gap of the wheel data.
    is_modelled = LEAST_MODELLED * chords < modelled
    stretched = np.divide(chords, modelled, out=np.zeros(len(chords)), where=is_modelled)
    even = np.divide(chords, lasted, out=np.zeros(len(chords)), where=~is_modelled & (lasted > 0))
    speed = np.divide(np.diff(table.distance_m), interval, out=np.zeros(len(interval)), where=interval > 0)
    speed *= np.repeat(stretched, np.diff(rows))
    speed += np.repeat(even, np.diff(rows))
    mean = distance / duration if duration > 0 else 0.0
    speed -= mean
    speed *= speed
    spread = float(np.sqrt(np.average(speed, weights=interval))) if duration > 0 else 0.0
    return DriveDocument(duration, distance, mean, spread)


LONGEST_GYRO_HOLE_S = 1.0
"""Longest time without a sample of a gyro that is used [s]."""


def measured_headings(run: Run) -> Iterator[MeasuredHeading]:
    """Yield the headings that are measured without the position reference: first of a gyro, then of an attitude sensor.

    A heading is left out if it depends on positions (it was estimated, or it is a field of the messages of the
    position), or if it does not cover the run.
    """
    sensors = run.sensors
    stamps = run.table.stamp_ns
    if sensors.gyro is not None and _covers(sensors.gyro.stamp_ns, stamps):
        yield MeasuredHeading(
            "gyro", _integrate(_since(sensors.gyro.stamp_ns, stamps), sensors.gyro.rate_radps, run.table.t_s)
        )
    needs_positions = sensors.facts.heading_from_position or sensors.facts.heading_is_estimated
    attitude = None if needs_positions else sensors.headings
    attitude = sensors.attitude if sensors.attitude is not None else attitude
    if attitude is not None and _covers(attitude.stamp_ns, stamps):
        heading_rad = unwrapped(attitude.heading_rad)
        angle = np.interp(run.table.t_s, _since(attitude.stamp_ns, stamps), heading_rad)
        yield MeasuredHeading("heading", angle)


def _since(stamp_ns: Ints, epoch_ns: Ints) -> Floats:
    """Return stamps as seconds since the first stamp of `epoch_ns`."""
    since: Floats = (stamp_ns - epoch_ns[0]) / 1e9
    return since


def _covers(measured_ns: Ints, states_ns: Ints) -> bool:
    """Return whether measurements reach from the first state to the last, without a hole of `LONGEST_GYRO_HOLE_S`."""
    hole = LONGEST_GYRO_HOLE_S * 1e9
    within = measured_ns[(measured_ns > states_ns[0]) & (measured_ns < states_ns[-1])]
    return bool(np.max(np.diff(np.concatenate([states_ns[:1], within, states_ns[-1:]]))) < hole)


def _integrate(t: Floats, rate: Floats, times_s: Floats) -> Floats:
    """Return the turn [rad] until each of `times_s`: by trapezoids; beyond the samples the rate is constant."""
    angle, sample_angle = np.empty(len(times_s)), trapezoids(t, rate)
    for lo in range(0, len(times_s), ROWS_AT_ONCE):
        chunk = times_s[lo : lo + ROWS_AT_ONCE]
        within = np.interp(chunk, t, sample_angle)
        within += np.minimum(chunk - t[0], 0.0) * rate[0]
        within += np.maximum(chunk - t[-1], 0.0) * rate[-1]
        angle[lo : lo + len(chunk)] = within
    return angle
