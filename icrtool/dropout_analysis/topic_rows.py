"""Rows of topics with poses that the localisation on the robot computed, tested in the trials of a report."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import partial
from typing import NamedTuple

import numpy as np

from icrtool.calibration.run_models import ComparedRow
from icrtool.errors import ConfigError
from icrtool.estimation.odometry import drive_wheels, odometry_icrs
from icrtool.kernels.arrays import Complexes, Floats, Ints, rows_at_steps
from icrtool.kernels.track import OpenLoopPath, Track
from icrtool.motion.recording import TrialErrors, Trials
from icrtool.records.notes import Note, note
from icrtool.records.rows import TOPIC_ROW
from icrtool.records.run import Run
from icrtool.records.text import distance_text
from icrtool.records.topic_poses import TopicPoses

PIECES = 8
"""Number of parts of equal distance. The errors over these parts are compared with the error over the whole drive."""

GROWTH_OF_RANDOM_WALK = math.sqrt(PIECES)
"""Ratio of the error over the whole drive to the error over a part, for a position that drifts as a random walk. If the
heading drifts, the ratio is larger; if the position is measured, the ratio is about 1."""

FEWEST_COMPARED, MOST_COMPARED = 200, 4000
"""Smallest and largest number of states in which a topic is compared with the reference over the whole drive."""

NOT_OPEN_LOOP = "GNSS or a map while it drives: not open loop"
GROWS = "not known: computed on the robot; its error grows with distance, as of dead reckoning"
UNDECIDED = "not known: computed on the robot; whether GNSS or a map is in it does not show"
"""Words for the data of a scored topic: its error does not grow with distance, it grows, or this is not known."""


class Departure(NamedTuple):
    """Rms distance [m] of a path from the reference, after the best turn, scale and shift.

    Attributes
    ----------
    whole_m : distance over the whole drive
    piece_m : distance over `PIECES` parts of the drive, each with its own turn, scale and shift
    log_std : standard deviation of the logarithm of `piece_m`
    """

    whole_m: float
    piece_m: float
    log_std: float

    @property
    def grows(self) -> bool | None:
        """Whether the error grows with distance, by two standard deviations; None if the data do not decide."""
        if not (self.whole_m > 0.0 and self.piece_m > 0.0):
            return None
        log_ratio, drifting = math.log(self.whole_m / self.piece_m), math.log(GROWTH_OF_RANDOM_WALK)
        if log_ratio - 2.0 * self.log_std > drifting / 2.0:
            return True
        return False if log_ratio + 2.0 * self.log_std < drifting else None


def topic_rows(run: Run, track: Track, scored: Iterable[TopicPoses]) -> tuple[list[ComparedRow], list[Note]]:
    """Return the row of each topic, and findings about the topics.

    Parameters
    ----------
    track : track of the run's states
    scored : poses of the topics

    Raises
    ------
    ConfigError
        A topic is the reference of the run, or has no pose within the run.
    """
    rows, notes = list[ComparedRow](), list[Note]()
    streams = {stream.role: stream for stream in run.document.streams}
    reference = streams["gnss"].topic if "gnss" in streams else ""
    by_log_time = "wheels" in streams and streams["wheels"].clock == "log"
    for poses in scored:
        if poses.topic == reference:
            why = f"{poses.topic} is the reference of this run: its error is 0"
            raise ConfigError("score", why, "topics.gnss names another reference")
        name = f"{TOPIC_ROW}:{poses.topic}"
        t = (poses.stamps(by_log_time=by_log_time) - run.table.stamp_ns[0]) / 1e9 + run.table.t_s[0]
        if not (covered := poses.covered(t, track.t, track.t)).any():
            why = f"{poses.topic} has no pose between the first and the last state of the run"
            raise ConfigError("score", why, "give the log that the run was made of")
        departs = departure_of(poses, t, track, covered)
        knows = UNDECIDED
        if departs is not None and departs.grows:
            knows = GROWS
        elif departs is not None and departs.grows is False and _wheels_depart(run, track, covered):
            knows = NOT_OPEN_LOOP
            driven = float(track.distance[-1])
            within = f"{departs.piece_m:.2g} m (rms) over parts of {distance_text(driven / PIECES)}"
            over_all = f"{departs.whole_m:.2g} m over {distance_text(driven)}"
            why = f"its error does not grow with distance: {within}, {over_all}"
            meaning = "GNSS or a map is in it, or its drift is below the noise of the reference"
            advice = "its row does not show its drift without GNSS; record a drive in which it has no GNSS"
            notes.append(note("topic_not_open_loop", f"{name}: {why}: {meaning}; {advice}"))
        errors_of, path = partial(_errors, poses, t, track), partial(_path, poses, t, track)
        rows.append(ComparedRow(name, errors_of, path, knows))
    return rows, notes


def _errors(poses: TopicPoses, t: Floats, track: Track, trials: Trials) -> TrialErrors:
    """Return the errors (k, h) of a topic in trials; its pose is aligned with the reference at each start.

    A trial needs poses along its whole path: it must not begin before the first pose, end after the last one, or cross
    a gap.

    Notes
    -----
    The position error is the translation part of the relative pose error (Sturm et al. 2012), the heading error the
    angle of its rotation part.
    """
    errors = TrialErrors.none(trials.ends.shape)
    for h in range(trials.ends.shape[1]):
        tried = np.flatnonzero(trials.ends[:, h] >= 0)
        tried = tried[poses.covered(t, track.t[trials.starts[tried]], track.t[trials.ends[tried, h]])]
        s, e = trials.starts[tried], trials.ends[tried, h]
        (from_place, from_heading), (to_place, to_heading) = (poses.at(t, track.t[rows]) for rows in (s, e))
        moved = np.exp(1j * (track.heading[s] - from_heading)) * (to_place - from_place)
        driven = track.north[e] - track.north[s] + 1j * (track.east[e] - track.east[s])
        errors.position[tried, h] = np.abs(moved - driven)
        errors.heading[tried, h] = np.abs(to_heading - from_heading - track.heading[e] + track.heading[s])
    return errors


def _path(poses: TopicPoses, t: Floats, track: Track, start: int, end: int) -> OpenLoopPath | None:
    """Return the path of a topic between two states, aligned with the reference at the first; None across a gap."""
    times_s = track.t[start : end + 1]
    if not poses.covered(t, times_s[:1], times_s[-1:]).all():
        return None
    position, heading = poses.at(t, times_s)
    turn = track.heading[start] - heading[0]
    moved = np.exp(1j * turn) * (position - position[0])
    return OpenLoopPath(track.north[start] + moved.real, track.east[start] + moved.imag, heading + turn)


def departure_of(poses: TopicPoses, t: Floats, track: Track, covered: np.ndarray) -> Departure | None:
    """Return the departure of a topic from the reference; None if the topic covers too little of the drive."""
    rows = _compared_rows(track, covered)
    return _departure(poses.at(t, track.t[rows])[0], track.place[rows], track.distance[rows])


def _wheels_depart(run: Run, track: Track, covered: np.ndarray) -> bool:
    """Return whether the error of the wheels' path grows over the drive: then the reference can show such errors."""
    path = drive_wheels(run.table, run.in_gap, odometry_icrs(run.table, None)["icr"])
    rows = _compared_rows(track, covered)
    departure = _departure(path.north_m[rows] + 1j * path.east_m[rows], track.place[rows], track.distance[rows])
    return departure is not None and departure.grows is True


def _compared_rows(track: Track, covered: np.ndarray) -> Ints:
    """Return the states at equal steps of distance at which a topic has poses and the reference can be used."""
    rows = rows_at_steps(track.distance, max(float(track.distance[-1]) / MOST_COMPARED, 1e-6))
    return np.asarray(rows[covered[rows] & ~track.in_outage[rows]])


def _departure(positions: Complexes, reference: Complexes, distance: Floats) -> Departure | None:
    """Return the departure of places (n,) from a reference (n,), at distances (n,) [m]; None for too few places."""
    if len(positions) < FEWEST_COMPARED:
        return None
    parts = np.searchsorted(distance, distance[0] + (distance[-1] - distance[0]) * np.arange(1, PIECES) / PIECES)
    drive_misfit = _misfit(positions, reference)
    pieces = [
        _misfit(part, other)
        for part, other in zip(np.split(positions, parts), np.split(reference, parts), strict=True)
        if len(part) >= FEWEST_COMPARED // PIECES
    ]
    if len(pieces) < PIECES or not min(pieces) > 0.0:
        return None
    logs = np.log(pieces)
    return Departure(drive_misfit, float(np.exp(logs.mean())), float(logs.std(ddof=1)) / math.sqrt(PIECES))


def _misfit(positions: Complexes, reference: Complexes) -> float:
    """Return the rms distance [m] of places (n,) from a reference (n,) after best turn, scale, shift (Umeyama 1991)."""
    centred, target = positions - positions.mean(), reference - reference.mean()
    size = float(np.vdot(centred, centred).real)
    fitted = centred * (np.vdot(centred, target) / size) if size > 0.0 else 0.0
    return float(np.sqrt(np.mean(np.abs(target - fitted) ** 2)))
