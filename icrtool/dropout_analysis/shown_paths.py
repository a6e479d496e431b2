"""Paths without GNSS that are shown one by one: worst and typical trials, forced outages, outages of the log."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from icrtool.calibration.run_models import ComparedModels, ComparedRow, Model, models_of
from icrtool.dropout_analysis.starts import counted_ends, standing_states
from icrtool.errors import ConfigError, DataError
from icrtool.estimation.run_filter import set_up_again
from icrtool.kernels.arrays import Bools, Floats, Rows
from icrtool.kernels.ekf import run_ekf
from icrtool.kernels.open_loop import open_loop_errors, open_loop_path
from icrtool.kernels.track import OpenLoopPath, Track, trial_ends
from icrtool.motion.models import RECOMMENDED
from icrtool.motion.recording import Trials
from icrtool.records.choices import Starts
from icrtool.records.dropout_document import ExampleTrial, Outage, OutageDocument, PathErrors, TrialDocument
from icrtool.records.plain_data import finite_or_none
from icrtool.records.rows import row_of
from icrtool.records.run import Run, track_of

WORST_COUNT = 10
"""Number of worst trials."""

WORST_HORIZON_M = 10.0
"""Distance of the worst trials [m]."""

MOST_ON_PATH = 20_000
"""Largest number of trials whose errors are kept for pictures. A picture shows some thousand places."""

EXAMPLE_HORIZON_M = 15.0
"""Distance of the typical trials [m], as in Figs. 33 and 34 of Pentzer 2014."""

ALIKE_RAD = np.radians(10.0)
"""Largest difference from half a turn of a typical cornering trial [rad]."""

STRAIGHT_SHARE, LONGEST_CHORD = 0.05, 1.1
"""Share of the trials that count as straight, and largest ratio of a chord to its distance."""

TYPICAL_OF = 30
"""Approximate number of trials of which the trial with the median error is the typical one."""

LONGEST_SHARE = 0.5
"""Largest share of the moving time in evenly spaced outages. The filter learns in the rest of the time."""

MOST_SPACED = 10
"""Largest number of evenly spaced outages."""

SAME_M = 1e-6
"""Largest difference between the run with forced outages and the original run before the first outage [m]. Both differ
only by rounding."""

FIXES_COMPARED_S = 1.0
"""Time after an outage in which fixes are compared with the open-loop path [s]. The path goes on for this time."""


class StartErrors(NamedTuple):
    """Errors of the trials of one length by start, and the states at which the trials end.

    Attributes
    ----------
    name : row of the trials
    error_m : (n,) error of the trial that starts at each state [m]; NaN if no trial starts there
    end : (n,) state at which this trial ends
    """

    name: str
    horizon_m: float
    error_m: Floats
    end: Rows

    @property
    def on_path(self) -> PathErrors | None:
        """Errors of at most `MOST_ON_PATH` starts, with the largest errors among them; None if there is no trial."""
        start = np.flatnonzero(np.isfinite(self.error_m))
        if not len(start):
            return None
        worst = start[np.argmax(self.error_m[start])]
        start = np.union1d(start[:: -(-len(start) // MOST_ON_PATH)], [worst])
        return PathErrors(self.name, self.horizon_m, start, self.error_m[start])


def _track(run: Run, compared: ComparedModels | None) -> Track:
    """Return the track of a run, where there is one the track that its models were compared on: it is the same."""
    return track_of(run) if compared is None else compared.track


def errors_by_start(
    run: Run, compared: ComparedModels | None = None, horizon_m: float = WORST_HORIZON_M, *, starts: Starts = "moving"
) -> StartErrors:
    """Return the errors of the trials of one length, of row ``recommended`` or else of the momentary ICRs.

    Parameters
    ----------
    compared : the held-out models, with row ``recommended``; None: without them
    horizon_m : length of the trials [m]
    starts : states that trials start from
    """
    track, icrs = _track(run, compared), models_of(run)[0]
    ends = counted_ends(track, np.array([horizon_m]), starts)
    rows = compared.rows if compared is not None else ()
    held_out = next((row for row in rows if row.name == RECOMMENDED), None)
    if compared is not None and held_out is not None:
        sparse = compared.table.trials[0].starts
        errors = np.full(len(ends), np.nan)
        errors[sparse] = held_out.errors_of(Trials(sparse, ends[sparse])).position[:, 0]
    else:
        errors = open_loop_errors(track, icrs.icrs, ends)[:, 0]
    return StartErrors(icrs.name if held_out is None else held_out.name, horizon_m, errors, ends[:, 0])


def worst_trials(
    run: Run, compared: ComparedModels | None = None, horizon_m: float = WORST_HORIZON_M, count: int = WORST_COUNT, *,
    starts: Starts = "moving", further: Sequence[ComparedRow] = (), errors: StartErrors | None = None,
) -> tuple[ExampleTrial, ...]:  # fmt: skip
    """Return the trials with the largest errors that do not overlap, the largest first.

    Parameters
    ----------
    compared, horizon_m, starts : as in `errors_by_start`
    count : largest number of trials
    further : further rows whose paths are shown
    errors : result of `errors_by_start`; default: it is computed
    """
    start_errors = errors_by_start(run, compared, horizon_m, starts=starts) if errors is None else errors
    track, models, ends = _track(run, compared), models_of(run), start_errors.end
    untaken = np.nan_to_num(start_errors.error_m, nan=-1.0)
    chosen: list[int] = []
    while len(chosen) < count and untaken[worst := int(np.argmax(untaken))] >= 0.0:
        chosen.append(worst)
        before_its_end = slice(ends[worst] + 1)
        untaken[before_its_end][ends[before_its_end] >= worst] = -1.0
    rows = (*(compared.rows if compared is not None else ()), *further)
    return tuple(
        _example(run, track, models, rows, start_errors.name, start, int(ends[start]), start_errors.horizon_m)
        for start in chosen
    )


def example_trials(run: Run, horizon_m: float = EXAMPLE_HORIZON_M) -> tuple[ExampleTrial, ...]:
    """Return a typical cornering trial and a typical straight trial; none if no trial is `horizon_m` long.

    Notes
    -----
    Cornering trials are the trials whose change of heading is closest to half a turn. Straight trials are the 5 % of
    the trials that end furthest from their start. The typical trial of each group has the median error of the group,
    with the momentary ICRs.
    """
    track, models = track_of(run), models_of(run)
    ends = trial_ends(track, np.array([horizon_m]))[:, 0]
    # Starts during a stop repeat the same path, so only the last state of each stop is used.
    moving = np.flatnonzero((ends >= 0) & ~standing_states(track))
    if not len(moving):
        return ()
    reached = ends[moving]

    def change(column: Floats) -> Floats:
        return np.asarray(column[reached] - column[moving])

    chord = np.hypot(change(track.north), change(track.east))
    # If a chord is longer than the distance that the wheels rolled, the reference jumped.
    chord[chord > LONGEST_CHORD * horizon_m] = 0.0
    straight = moving[chord >= np.quantile(chord, 1 - STRAIGHT_SHARE)]
    del chord  # A column of a long log is large.
    off_half_turn_rad = np.abs(np.abs(change(track.heading)) - np.pi)
    examples = []
    for group in (moving[off_half_turn_rad <= off_half_turn_rad.min() + ALIKE_RAD], straight):
        sample = group[:: -(-len(group) // TYPICAL_OF)]
        errors = [
            open_loop_errors(track, models[0].icrs, ends[start : start + 1, None], start)[0, 0] for start in sample
        ]
        start = int(sample[np.argsort(errors, kind="stable")[len(sample) // 2]])
        examples.append(_example(run, track, models, (), models[0].name, start, int(ends[start]), horizon_m))
    return tuple(examples)


def _example(
    run: Run, track: Track, models: tuple[Model, ...], rows: Sequence[ComparedRow], drawn_model: str, start: int,
    end: int, horizon_m: float,
) -> ExampleTrial:  # fmt: skip
    paths: dict[str, OpenLoopPath] = {}
    for model in models:
        if row_of(model.name).pictured:
            right, left, x = (float(column[start if len(column) > 1 else 0]) for column in model.icrs)
            paths[model.name] = open_loop_path(track, right, left, x, start, end)
    for row in rows:
        if row_of(row.name).pictured and row.path is not None and (path := row.path(start, end)) is not None:
            paths[row.name] = path
    errors = {
        name: finite_or_none(float(np.hypot(path.north[-1] - track.north[end], path.east[-1] - track.east[end])))
        for name, path in paths.items()
    }
    table = run.table
    columns = (table.t_s, table.heading_rad, table.distance_m)
    duration, turn_rad, driven = (float(column[end] - column[start]) for column in columns)
    document = TrialDocument(
        model=drawn_model, stamp_ns=int(table.stamp_ns[start]), t_s=float(table.t_s[start]),
        north_m=float(table.north_m[start]), east_m=float(table.east_m[start]), horizon_m=horizon_m,
        heading_change_deg=float(np.degrees(turn_rad)), speed_mean_mps=driven / duration if duration > 0 else 0.0,
        errors_m=errors,
    )  # fmt: skip
    shown = slice(start, end + 1)
    return ExampleTrial(document, start, end, table.north_m[shown], table.east_m[shown], paths)


def plan_outages(run: Run, length_s: float, at_s: Sequence[float] = ()) -> tuple[tuple[int, int], ...]:
    """Return outages of one length as half-open spans [ns], in order of time.

    Parameters
    ----------
    length_s : length of the outages
    at_s : starts of the outages, in seconds since the first state; empty: evenly spaced over the moving time

    Raises
    ------
    ConfigError
        An outage does not fit into the drive or before the next outage, or overlaps an outage of the log.
    """
    last = float(run.table.t_s[-1])
    if not length_s > 0:
        raise ConfigError("outage", f"{length_s:g} s is no duration", "give positive seconds")
    begins = sorted(float(t) for t in at_s) if at_s else _spaced(run, length_s)
    for begin in begins:
        if not 0 <= begin <= last - length_s:
            why = f"an outage of {length_s:g} s at {begin:g} s does not fit into the drive"
            raise ConfigError("outage", why, f"the drive lasts {last:.1f} s")
    for begin, following in pairwise(begins):
        if begin + length_s >= following:
            why = f"the outage of {length_s:g} s at {begin:g} s reaches the next outage, at {following:g} s"
            raise ConfigError("outage", why, "place them further apart, so that the filter learns between them")
    for begin in np.array(begins)[_meets(np.array(begins), length_s, _own_outages_s(run))]:
        why = f"the outage of {length_s:g} s at {begin:g} s overlaps an outage of the log itself"
        raise ConfigError("outage", why, "choose another time, because there is no estimate to compare with")
    origin = int(run.table.stamp_ns[0])
    return tuple((origin + round(t * 1e9), origin + round((t + length_s) * 1e9)) for t in begins)


def force_outages(run: Run, spans_ns: Sequence[tuple[int, int]]) -> tuple[Outage, ...]:
    """Return forced outages: the filter runs again without GNSS and heading in the spans, and both runs are compared.

    Parameters
    ----------
    spans_ns : half-open spans, in order of time

    Raises
    ------
    ConfigError
        A span holds fewer than two states of the new run.
    DataError
        The run cannot be made again.
    """
    setup = set_up_again(run, tuple(spans_ns))
    output = run_ekf(*setup)
    # An outage at the start delays the first state of the new run, so rows are counted from the end.
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
            why = f"{(end - begin) / 1e9:g} s from {(begin - origin) / 1e9:g} s on hold fewer than two states"
            advice = "the filter must have begun, and the outage last longer than a wheel sample"
            raise ConfigError("outage", why, advice)
        document = OutageDocument(
            "forced", (begin - origin) / 1e9, (end - origin) / 1e9, float(np.ptp(distance[inside])),
            finite_or_none(float(away[inside][-1])), finite_or_none(float(away[inside].max())),
        )  # fmt: skip
        outages.append(Outage(document, north[inside], east[inside]))
    return tuple(outages)


def _own_outages_s(run: Run) -> Floats:
    """Return the spans (k, 2) [s] of the outages of the log."""
    return np.asarray((run.outages_ns - int(run.table.stamp_ns[0])) / 1e9)


def _meets(begin_s: Floats, length_s: float, spans_s: Floats) -> Bools:
    """Return which outages of a length, with begins (k,) [s], overlap one of the ordered spans (m, 2) [s]."""
    following = np.searchsorted(spans_s[:, 1], begin_s, side="right")
    return np.asarray(np.append(spans_s[:, 0], np.inf)[following] < begin_s + length_s)


def _spaced(run: Run, length_s: float) -> list[float]:
    """Return the starts [s] of outages that are evenly spaced in half of the moving time after convergence.

    No outage begins where it would overlap an outage of the log, a gap in the wheel data or a jump of the reference.
    """
    t, last = run.table.t_s, float(run.table.t_s[-1])
    moves = ~standing_states(track_of(run))[:-1]
    gaps = np.flatnonzero(run.in_gap | run.jumping)
    for spans_s in (_own_outages_s(run), np.column_stack([t[gaps], t[gaps + 1]])):
        moves &= ~_meets(t[:-1], length_s, spans_s)
    moved = np.concatenate([[0.0], np.cumsum(np.diff(t) * moves)])
    before = float(np.interp(min(run.settled_s, last / 4), t, moved))
    rest = float(moved[-1]) - before
    count = min(MOST_SPACED, int(rest * LONGEST_SHARE / length_s))
    if count < 1:
        text = f"{length_s:g} s is too long for a drive of {last:.1f} s, {moved[-1]:.1f} s of it moving"
        raise ConfigError("outage", text, "choose a shorter one")
    free_s = (rest - count * length_s) / (count + 1)
    begins = before + free_s + np.arange(count) * (length_s + free_s)
    # If an outage would begin while the robot stands, it begins when the robot moves again.
    return [float(t[row - 1]) for row in np.searchsorted(moved, begins, side="right")]


def real_outages(run: Run) -> tuple[Outage, ...]:
    """Return the GNSS outages of the log, with the open-loop path by the ICRs of the last fix before each.

    The end error is the distance to the fixes after the outage. The filter has the same error as the open-loop path,
    because it used only the wheels in the outage. Three kinds of outages are left out: outages without an end and
    outages with a gap in the wheel data, because they have no end error, and an outage at the start of the drive,
    because neither position nor ICRs were known before it.
    """
    track, table, fixes = track_of(run), run.table, run.sensors.fixes
    (forward, right), origin = run.sensors.facts.antenna_m, int(table.stamp_ns[0])
    outages = []
    for begin, end in run.outages_ns:
        first, last = (int(row) for row in np.searchsorted(table.stamp_ns, [begin, end]))
        if first == 0 or last >= len(table) or last <= first or run.in_gap[first:last].any():
            continue
        after = int(np.searchsorted(table.stamp_ns, end + round(FIXES_COMPARED_S * 1e9)))
        gaps = np.flatnonzero(run.in_gap[last:after])
        after = last + int(gaps[0]) if len(gaps) else min(after, len(table) - 1)
        path = open_loop_path(track, *table.icrs_at(first), first, after)
        stamps = table.stamp_ns[first : after + 1]
        # The error of each used fix after the outage is its distance from the antenna on the path.
        rows = np.flatnonzero(run.gnss.used & (fixes.stamp_ns >= end) & (fixes.stamp_ns <= max(end, stamps[-1])))
        cos, sin = np.cos(path.heading), np.sin(path.heading)
        fix_s, state_s = (fixes.stamp_ns[rows] - stamps[0]) / 1e9, (stamps - stamps[0]) / 1e9
        north = np.interp(fix_s, state_s, path.north + forward * cos - right * sin) - fixes.north_m[rows]
        east = np.interp(fix_s, state_s, path.east + forward * sin + right * cos) - fixes.east_m[rows]
        error = finite_or_none(float(np.hypot(north.mean(), east.mean())))
        inside = slice(last - first + 1)
        driven_m = float(table.distance_m[last] - table.distance_m[first])
        begin_s, end_s = ((int(stamp_ns) - origin) / 1e9 for stamp_ns in (begin, end))
        document = OutageDocument("real", begin_s, end_s, driven_m, error, error)
        outages.append(Outage(document, path.north[inside], path.east[inside]))
    return tuple(outages)
