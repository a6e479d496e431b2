"""Outages: forced on the filter as if the receiver had lost GNSS, and the real ones of the log."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from icrtool.dropout_analysis.starts import standing_states
from icrtool.errors import ConfigError, DataError
from icrtool.estimation.run_filter import set_up_again
from icrtool.kernels.arrays import Bools, Floats, Ints
from icrtool.kernels.ekf import run_ekf
from icrtool.kernels.open_loop import open_loop_path
from icrtool.kernels.track import OpenLoopPath
from icrtool.records.dropout_document import Outage, OutageDocument
from icrtool.records.plain_data import known
from icrtool.records.run import Run, track_of

LONGEST_SHARE = 0.5
"""Spaced outages leave at least this share of the time between them to learn."""

MOST_SPACED = 10

SAME_M = 1e-6
"""Before the first outage the disturbed run is the undisturbed one, to rounding."""


def plan_outages(run: Run, length_s: float, at_s: Sequence[float] = ()) -> tuple[tuple[int, int], ...]:
    """Place outages of one length: at given seconds, or spaced over the time in which the robot moves.

    Returns
    -------
    Half-open spans [ns], in order.

    Raises
    ------
    ConfigError
        An outage that does not fit into the drive, or into the time between two others, or lies in one that the log
        has itself.
    """
    last = float(run.table.t_s[-1])
    if not length_s > 0:
        raise ConfigError("outage", f"{length_s:g} s is no duration", "give positive seconds")
    begins = sorted(float(t) for t in at_s) if at_s else _spaced(run, length_s)
    for begin in begins:
        if not 0 <= begin <= last - length_s:
            raise ConfigError(
                "outage", f"{length_s:g} s from {begin:g} s on do not fit", f"the drive lasts {last:.1f} s"
            )
    for begin, following in pairwise(begins):
        if begin + length_s >= following:
            raise ConfigError(
                "outage",
                f"{length_s:g} s from {begin:g} s on reach into the one at {following:g} s",
                "the filter must learn between two outages: place them further apart",
            )
    for begin, lost in zip(begins, _in_real_outage(run, np.array(begins), length_s), strict=True):
        if lost:
            raise ConfigError(
                "outage",
                f"{length_s:g} s from {begin:g} s on lie in an outage of the log's own",
                "there is no estimate to compare it with: choose another time",
            )
    origin = int(run.table.stamp_ns[0])
    return tuple((origin + round(t * 1e9), origin + round((t + length_s) * 1e9)) for t in begins)


def force_outages(run: Run, spans_ns: Sequence[tuple[int, int]]) -> tuple[Outage, ...]:
    """Run the filter again without GNSS and heading in the spans, and compare it with the undisturbed run.

    Raises
    ------
    ConfigError
        A span holds fewer than two states of the disturbed run.
    DataError
        The run cannot be made again.
    """
    setup = set_up_again(run, tuple(spans_ns))
    output = run_ekf(*setup)
    # An outage at the very start delays the first state of the disturbed run: the last rows are those of both.
    rows = min(len(output.x), len(run.table))
    north, east = output.x[-rows:, 0], output.x[-rows:, 1]
    away = np.hypot(north - run.table.north_m[-rows:], east - run.table.east_m[-rows:])
    stamps, distance = run.table.stamp_ns[-rows:], run.table.distance_m[-rows:]
    if (away[stamps < min(begin for begin, _ in spans_ns)] > SAME_M).any():
        raise DataError(run.name, "the run cannot be made again for forced outages", "run icrtool fit again")
    origin = int(run.table.stamp_ns[0])
    outages = []
    for begin, end in spans_ns:
        inside = slice(*np.searchsorted(stamps, [begin, end]))
        if len(stamps[inside]) < 2:
            raise ConfigError(
                "outage",
                f"{(end - begin) / 1e9:g} s from {(begin - origin) / 1e9:g} s on hold fewer than two states",
                "the filter must have begun, and the outage last longer than a wheel sample",
            )
        document = OutageDocument(
            "forced", (begin - origin) / 1e9, (end - origin) / 1e9, float(np.ptp(distance[inside])),
            known(float(away[inside][-1])), known(float(away[inside].max())),
        )  # fmt: skip
        outages.append(Outage(document, north[inside], east[inside]))
    return tuple(outages)


def _in_real_outage(run: Run, begin_s: Floats, length_s: float) -> Bools:
    """Return which outages of a length, by their begins (k,) [s], share time with one that the log has itself."""
    own: Floats = (run.outages_ns - int(run.table.stamp_ns[0])) / 1e9
    return _meets(begin_s, length_s, own[:, 0], own[:, 1])


def _meets(begin_s: Floats, length_s: float, from_s: Floats, to_s: Floats) -> Bools:
    """Return which outages of a length, by their begins (k,) [s], share time with one of the ordered spans (m,) [s]."""
    following = np.searchsorted(to_s, begin_s, side="right")
    meets: Bools = np.append(from_s, np.inf)[following] < begin_s + length_s
    return meets


def _spaced(run: Run, length_s: float) -> list[float]:
    """Return the begins [s] of outages, even in the time the robot moves, after convergence; half of it is to learn.

    Time from which an outage would reach into one of the log's own, a gap in the wheel data or a jump of the reference,
    is not one to begin in.
    """
    t, last = run.table.t_s, float(run.table.t_s[-1])
    moves = ~standing_states(track_of(run))[:-1]
    moves &= ~_in_real_outage(run, t[:-1], length_s)
    gaps = np.flatnonzero(run.in_gap | run.jumping)
    moves &= ~_meets(t[:-1], length_s, t[gaps], t[gaps + 1])
    moved = np.concatenate([[0.0], np.cumsum(np.diff(t) * moves)])
    before = float(np.interp(min(run.settled_s, last / 4), t, moved))
    rest = float(moved[-1]) - before
    count = min(MOST_SPACED, int(rest * LONGEST_SHARE / length_s))
    if count < 1:
        text = f"{length_s:g} s is too long for a drive of {last:.1f} s, {moved[-1]:.1f} s of it moving"
        raise ConfigError("outage", text, "choose a shorter one")
    free = (rest - count * length_s) / (count + 1)
    begins = before + free + np.arange(count) * (length_s + free)
    # Where the robot stood for a while, the outage begins when it goes on.
    return [float(t[place - 1]) for place in np.searchsorted(moved, begins, side="right")]


COMPARED_S = 1.0
"""Fixes of this time after an outage are compared with the open-loop path, which is driven on for as long."""


def real_outages(run: Run) -> tuple[Outage, ...]:
    """Return the log's own GNSS outages: open loop with wheels and the ICRs of the last fix before.

    The end error is the distance to the fixes that ended the outage, not to the filter: a filter that drove on with its
    wheels is as wrong as the open-loop path. An outage that never ends, and one with a gap in the wheel data, has no
    end error and is left out; so is one that the drive begins with: neither position nor ICRs were known before it.
    """
    track, table = track_of(run), run.table
    origin = int(table.stamp_ns[0])
    outages = []
    for begin, end in run.outages_ns:
        first, last = (int(row) for row in np.searchsorted(table.stamp_ns, [begin, end]))
        if first == 0 or last >= len(table) or last <= first or run.in_gap[first:last].any():
            continue
        after = int(np.searchsorted(table.stamp_ns, end + round(COMPARED_S * 1e9)))
        gaps = np.flatnonzero(run.in_gap[last:after])
        after = last + int(gaps[0]) if len(gaps) else min(after, len(table) - 1)
        path = open_loop_path(track, *table.icrs_at(first), first, after)
        error = known(_end_error_m(run, path, table.stamp_ns[first : after + 1], int(end)))
        inside = slice(last - first + 1)
        driven_m = float(table.distance_m[last] - table.distance_m[first])
        begin_s, end_s = ((int(one) - origin) / 1e9 for one in (begin, end))
        document = OutageDocument("real", begin_s, end_s, driven_m, error, error)
        outages.append(Outage(document, path.north[inside], path.east[inside]))
    return tuple(outages)


def _end_error_m(run: Run, path: OpenLoopPath, stamp_ns: Ints, end_ns: int) -> float:
    """Return how far the antenna on a path, with its stamps (m,), is from the used fixes since the outage's end."""
    fixes = run.sensors.fixes
    after = (fixes.stamp_ns >= end_ns) & (fixes.stamp_ns <= max(end_ns, int(stamp_ns[-1])))
    rows = np.flatnonzero(run.gnss.used & after)
    forward, right = run.sensors.antenna_m
    cos, sin = np.cos(path.heading), np.sin(path.heading)
    at, of = (fixes.stamp_ns[rows] - stamp_ns[0]) / 1e9, (stamp_ns - stamp_ns[0]) / 1e9
    north = np.interp(at, of, path.north + forward * cos - right * sin) - fixes.north_m[rows]
    east = np.interp(at, of, path.east + forward * sin + right * cos) - fixes.east_m[rows]
    return float(np.hypot(north.mean(), east.mean()))
