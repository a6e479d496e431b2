"""Facts about the wheels: scales of the sides; dead, copied, held and fused encoders.

Wheel speeds from another filter are low-passed, or contain a turn rate from another sensor. If wheels slip, the
difference between their turn and the heading's grows like a random walk. If a filter smooths or delays the turn, or
corrects it by an absolute heading, the difference stays bounded for any duration.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from icrtool.alignment.estimator import EVIDENCE_SIGMAS, AlignmentFit, residuals_by_estimate
from icrtool.alignment.ground_change import find_changes, find_exchange
from icrtool.alignment.log_track import FEWEST_ALIGNMENT_WINDOWS
from icrtool.alignment.sensor_noise import unbroken_intervals
from icrtool.alignment.sparse_reference import spans_of_measured
from icrtool.alignment.wheel_limits import find_clock_rate, find_limit
from icrtool.alignment.wheel_units import Scale, radius_hint, wrong_size
from icrtool.config import Config
from icrtool.kernels.arrays import Bools, Ints, rows_at_steps, unwrapped
from icrtool.kernels.robust import robust_regression, sandwich_covariance
from icrtool.kernels.track import Track
from icrtool.records.measurements import Fixes, WheelFacts
from icrtool.records.notes import Note, note
from icrtool.records.plain_data import finite_or_none
from icrtool.records.samples import WheelSamples
from icrtool.records.tables import RobotLog

SMALLEST_TURN_RAD = math.radians(20.0)
"""Smallest range of the heading at which the robot turned [rad]."""

NEVER_MOVES_SHARE = 0.02
"""Ratio of the sides' distances below which the slower side has a dead encoder."""

DEAD_M = 10.0
"""Distance over which this ratio is compared [m]. No robot turns about one side for this distance."""

HELD_SHARE = 0.65
"""Share of wheel samples that repeat the sample before, while moving, from which on the values count as held."""

LARGEST_SCALE_STD = 0.1
"""Largest standard deviation of a scale that is corrected or reported."""

USUAL_SCALE_STD = 0.04
"""Prior of a wheel scale: with probability 0.5 exactly 1, otherwise normal about 1 with this standard deviation. After
the drive the more likely case is taken. In the second case the correction is the posterior mean."""

SMALLEST_SIDE_DIFFERENCE = 0.005
"""Smallest relative difference of the sides that is corrected. A robot with such a difference veers where both sides
report the same speed."""

LARGEST_SCALE_CORRECTION = 0.15
"""Largest correction of a scale that tyres and soil explain."""

LONGEST_BRIDGE_S = 5.0
"""Longest gap that is bridged [s]. In a longer gap the robot may have stopped and turned."""

CONTRADICTED_SIGMAS, CONTRADICTED_SHARE = 3.0, 0.5
"""Difference of the distances of wheels and fixes in a gap above which they contradict each other: in standard
deviations, and as a share of the wheels' distance, because speed and turn vary within a gap. Both must be exceeded."""

FUSED_CORRELATION = 0.9995
"""Correlation of the turn rates of wheels and gyro above which the wheels' turn rate may have been computed from the
gyro's."""

FUSED_SLOPE = 0.003
"""Largest difference from 1 of the ratio of wheel turn to gyro turn that interpolation between stamps may cause."""

SHARED_NOISE = 0.9
"""Correlation of the second differences of both turn rates above which one rate is a copy of the other. Second
differences are mostly noise."""


def configured_scales(config: Config) -> tuple[float, float]:
    """Return the configured scales of the sides as they are named; ``auto`` is 1."""
    left, right = config.wheels.left_scale, config.wheels.right_scale
    return 1.0 if left == "auto" else left, 1.0 if right == "auto" else right


def with_scaled_wheels(log: RobotLog, left_factor: float, right_factor: float) -> RobotLog:
    """Return the log with the speeds of its sides multiplied; the same log where both factors are 1."""
    if left_factor == right_factor == 1.0:
        return log
    wheels = log.wheels
    return replace(
        log, wheels=replace(wheels, left=left_factor * wheels.v_left_mps, right=right_factor * wheels.v_right_mps)
    )


def _contradicted(wheels: WheelSamples, begin: Ints, fixes: Fixes) -> Bools:
    """Return in which intervals (k,) the fixes move further than the wheels, or much less, beyond their noise.

    In a gap the robot may drive along an arc, so that the chord is shorter than the distance. The difference of the
    sides gives the turn of this arc.

    Parameters
    ----------
    begin : (k,) samples at which the intervals begin
    """
    if len(fixes.stamp_ns) < 2:
        return np.zeros(len(begin), np.bool_)
    stamps = wheels.stamp_ns[np.stack([begin, begin + 1])]
    seconds = (stamps[1] - stamps[0]) / 1e9
    left, right = wheels.v_left_mps[begin] * seconds, wheels.v_right_mps[begin] * seconds
    at = [np.interp(stamps, fixes.stamp_ns, axis) for axis in (fixes.north_m, fixes.east_m)]
    chord = np.hypot(*(after - before for before, after in at))
    next_fix = np.clip(np.searchsorted(fixes.stamp_ns, stamps), 1, len(fixes.stamp_ns) - 1)
    to_next, since_last = np.abs(fixes.stamp_ns[next_fix] - stamps), np.abs(stamps - fixes.stamp_ns[next_fix - 1])
    seen = (np.minimum(to_next, since_last) < 10**9).all(axis=0)
    along, across = np.abs(left + right) / 2, np.abs(left - right) / 2
    noise = CONTRADICTED_SIGMAS * math.sqrt(2.0 * float(np.median(fixes.var_north_m2 + fixes.var_east_m2)))
    slack = CONTRADICTED_SHARE * np.maximum(along, across) + noise
    apart = (chord > along + across + slack) | ((along > chord + across + slack) & (along > 2.0 * chord + noise))
    return np.asarray(apart & seen)


def bridge_gaps(wheels: WheelSamples, gap_s: float, fixes: Fixes) -> tuple[WheelSamples, Note | None]:
    """Return wheels that report positions with samples in their gaps, and a finding.

    Parameters
    ----------
    wheels : the wheel samples
    gap_s : longest interval between samples that is no gap [s]
    fixes : a gap in which the fixes contradict the wheel positions is not filled

    Notes
    -----
    The positions before and after a gap give the distance of each side in the gap. The added samples drive this
    distance at constant speed, in steps as long as the usual interval.
    """
    interval = np.diff(wheels.stamp_ns) / 1e9
    usual = float(np.median(interval)) if len(interval) else math.inf
    steps = np.ones(len(wheels.stamp_ns), np.int64)
    filled = (interval > gap_s) & (interval <= LONGEST_BRIDGE_S) & (interval >= 2.0 * usual)
    gaps = np.flatnonzero(filled)
    if not (wheels.from_position and len(gaps)):
        return wheels, None
    filled[gaps] = ~np.isin(wheels.stamp_ns[gaps], wheels.restarts_ns) & ~_contradicted(wheels, gaps, fixes)
    if not filled.any():
        return wheels, None
    steps[:-1][filled] = np.round(interval[filled] / usual).astype(np.int64)
    row = np.repeat(np.arange(len(steps)), steps)
    within = np.arange(len(row)) - np.repeat(np.cumsum(steps) - steps, steps)
    length = np.append(np.diff(wheels.stamp_ns), 0)
    stamps = wheels.stamp_ns[row] + length[row] * within // steps[row]
    finding = note(
        "wheel_gaps_bridged",
        f"{np.count_nonzero(filled)} gaps in the wheel data, {interval[filled].sum():.1f} s in all, are bridged "
        "with the distance that the wheel positions show",
    )
    return replace(wheels, stamp_ns=stamps, left=wheels.left[row], right=wheels.right[row]), finding


def dead_or_copied(log: RobotLog) -> list[Note]:
    """Return a warning where a side never moves while the other does, or copies the other while the robot turns."""
    left, right = log.wheels.v_left_mps, log.wheels.v_right_mps
    seconds = (log.wheels.stamp_ns - log.wheels.stamp_ns[0]) / 1e9
    interval = unbroken_intervals(np.diff(seconds, append=seconds[-1:]))
    for side, still, moving in (("left", left, right), ("right", right, left)):
        still_m, gone = np.cumsum(still * interval), np.cumsum(np.abs(moving) * interval)
        # The longest distance of one side over which the other side hardly moves, searched in steps of a metre.
        rows = np.append(rows_at_steps(gone, 1.0), len(gone) - 1)
        moves = np.flatnonzero(np.abs(np.diff(still_m[rows])) > NEVER_MOVES_SHARE * np.diff(gone[rows]))
        begins, ends = rows[np.append(0, moves + 1)], rows[np.append(moves, len(rows) - 1)]
        longest = int(np.argmax(gone[ends] - gone[begins]))
        begin, end = begins[longest], ends[longest]
        if (distance := gone[end] - gone[begin]) > DEAD_M:
            span = f"from {seconds[begin]:.0f} s to {seconds[end]:.0f} s, while the others go {distance:.0f} m"
            meaning = "if so, do not use the ICRs: topics.wheels chooses others, --from and --to read the rest"
            text = f"the {side} wheels hardly ever move {span}: is their encoder dead? {meaning}"
            return [note("side_dead", text)]
    if np.array_equal(left, right) and float(np.ptp(unwrapped(log.heading.heading_rad))) > SMALLEST_TURN_RAD:
        cause = "one is a copy of the other, or the robot steers as a car does, and has no track ICRs"
        return [note("sides_equal", f"left and right wheels are equal throughout while the robot turns: {cause}")]
    return []


def align_wheels(
    log: RobotLog, config: Config, fit: AlignmentFit | None, configured: tuple[float, float], *, sound: bool
) -> tuple[WheelFacts, tuple[float, float], list[Note]]:
    """Return the facts about the wheels, the factors of the left and the right speeds, and findings.

    Parameters
    ----------
    log : with the configured scales (left, right) already applied; the factors are in addition to them
    config : the configuration
    fit : alignment of the log, None where the drive is too short
    sound : no side is dead or a copy of the other
    """
    wheels, notes, applied = log.wheels, list[Note](), (1.0, 1.0)
    change = None if fit is None or not sound else find_changes(fit)
    exchanged_s = None if fit is None or not sound or change is not None else find_exchange(fit)
    clock = None if fit is None or not sound or exchanged_s is not None else find_clock_rate(fit)
    limit = None if fit is None or not sound or exchanged_s is not None else find_limit(wheels, fit)
    has_cause = any(one is not None for one in (change, exchanged_s, clock, limit))
    filtered = "" if fit is None or not sound or has_cause else find_filtering(fit)
    if fit is not None and not filtered and exchanged_s is None:
        applied, notes = _find_scales(fit, config, log, sound=sound)
    moving = (np.abs(wheels.v_left_mps) + np.abs(wheels.v_right_mps))[1:] > 0
    same = (np.diff(wheels.v_left_mps) == 0) & (np.diff(wheels.v_right_mps) == 0)
    share = float(same[moving].mean()) if np.count_nonzero(moving) >= FEWEST_ALIGNMENT_WINDOWS else 0.0
    if share > HELD_SHARE:
        rate = (1.0 - share) * 1e9 / float(np.median(np.diff(wheels.stamp_ns)))
        text = f"wheel values are held: they change {rate:.1f} times a second while moving"
        notes.append(note("wheel_values_held", text))
    scale, std = (math.nan, math.nan) if fit is None else fit.estimate("scale")
    windows = 0 if fit is None else len(fit.windows.begin)
    turn_unexplained, turn_unexplained_std = (math.nan, math.nan) if fit is None else unexplained_turn_variance(fit)
    facts = WheelFacts(
        scale=finite_or_none(scale),
        scale_std=finite_or_none(std),
        applied_scale=(applied[0] + applied[1]) / 2,
        applied_left_scale=applied[0] * abs(configured[0]),
        applied_right_scale=applied[1] * abs(configured[1]),
        held_share=share,
        filtered=filtered or None,
        windows=windows,
        stretches=0 if fit is None else len(np.union1d(fit.windows.group, fit.windows.turn_group)),
        residual_m=None if fit is None else finite_or_none(math.hypot(*fit.solution.scale[[0, windows]].tolist())),
        turn_unexplained=finite_or_none(turn_unexplained),
        turn_unexplained_std=finite_or_none(turn_unexplained_std),
        ground_change_s=None if change is None else change.times_s[0],
        ground_stretches=() if change is None else change.stretches,
        exchanged_s=exchanged_s,
        clock_rate=None if clock is None else clock.value,
        clock_rate_std=None if clock is None else clock.std,
        limit_mps=None if limit is None else limit.speed_mps,
    )
    notes += [] if change is None else [note("ground_changed", change.text)]
    duration_s = float(np.ptp(wheels.stamp_ns)) / 1e9
    notes += [] if clock is None else [note("wheel_clock_differs", clock.sentence(duration_s))]
    notes += [] if limit is None else [note("wheels_limited", limit.text)]
    return facts, applied, [*notes, *_fused_note(log, config.wheels.twist_width_m or config.robot.track_width_m)]


def unexplained_turn_variance(fit: AlignmentFit) -> tuple[float, float]:
    """Return the share of the variance of the turns that the wheels do not explain, 1 - R^2, and its deviation.

    Notes
    -----
    The deviation comes from a jackknife over stretches of distance (Efron and Stein 1981). NaN without two stretches
    that turn.
    """
    residuals = residuals_by_estimate(fit)
    groups, row = np.unique(fit.windows.turn_group, return_inverse=True)
    unexplained, turned = (
        np.bincount(row, turns**2, len(groups)) for turns in (residuals.turn_after, residuals.turn_rad)
    )
    if len(groups) < 2 or not (turned > 0.0).sum() >= 2:
        return math.nan, math.nan
    without = (unexplained.sum() - unexplained) / (turned.sum() - turned)
    count = len(groups)
    std = math.sqrt((count - 1) * float(np.mean((without - without.mean()) ** 2)))
    return float(unexplained.sum() / turned.sum()), std


def _find_scales(
    fit: AlignmentFit, config: Config, log: RobotLog, *, sound: bool
) -> tuple[tuple[float, float], list[Note]]:
    """Return the factors to apply to the speeds of the left and of the right side, and findings.

    Notes
    -----
    The difference of the sides is the ratio of the turn rate's asymmetry to its gain. With such a difference a robot
    veers where both sides report one speed. The mean of the two factors is the scale.

    `with_right_size` has corrected a wrong wheel size before, where enough spans are straight or bend little. On other
    paths, as tight curves, the size is found here: the estimator's windows show the distance along any path.
    """
    if fit.slips:
        apart = f"their distance differs by {100 * fit.distance_scatter:.0f} % from the robot's"
        slip = f"over {fit.windows.length_m[0]:.0f} m {apart}, their turns by {100 * fit.turn_slip:.0f} %"
        return (1.0, 1.0), [note("wheels_slip", f"the wheels slip: {slip}; no scale and no delay is corrected")]
    configured = config.wheels.left_scale != "auto" or config.wheels.right_scale != "auto"
    may_correct = config.filter.rules.corrects and sound and not configured
    factor, notes = 1.0, list[Note]()
    scale, std = fit.estimate("scale")
    error, weight = abs(scale - 1.0), USUAL_SCALE_STD**2 / (USUAL_SCALE_STD**2 + std**2)
    # The sum is twice the log-likelihood with a free scale, minus twice the log-likelihood with scale 1.
    if std <= LARGEST_SCALE_STD and (error / std) ** 2 * weight + math.log1p(-weight) > 0.0:
        if small := error <= LARGEST_SCALE_CORRECTION:
            scale = 1.0 + (scale - 1.0) * weight
        text = f"the robot goes {100 * scale:.1f} ± {100 * std:.1f} % of the distance that the wheels report"
        check = f"{radius_hint(log, config, scale)}wheel radius, encoder resolution and units"
        if may_correct and small:
            factor = scale
            done = "corrected; wheels.left_scale and right_scale set it"
            notes.append(note("wheel_scale_corrected", f"{text}: {done}"))
        elif may_correct and (finding := wrong_size(Scale(scale, std), log, config)) is not None:
            factor = scale
            notes.append(finding)
        else:
            notes.append(note("wheel_scale_differs", f"{text}: {check}"))
    (asymmetry, asymmetry_std), (turn, turn_std) = fit.estimate("asymmetry"), fit.estimate("turn")
    if turn <= 0.0:
        return (factor, factor), notes
    # Ratio of the left to the right scale, minus 1, to first order.
    difference, std = asymmetry / turn, math.hypot(asymmetry_std, asymmetry * turn_std / turn) / turn
    if abs(difference) <= max(SMALLEST_SIDE_DIFFERENCE, EVIDENCE_SIGMAS * std):
        return (factor, factor), notes
    side, other_side = ("left", "right") if difference < 0 else ("right", "left")
    text = f"the {side} side goes {100 * abs(difference):.1f} ± {100 * std:.1f} % less far than the {other_side} one"
    text = f"{text} where both report the same distance"
    if not may_correct:
        return (factor, factor), [*notes, note("side_scale_differs", f"{text}: check wheel radii and tyre pressures")]
    notes.append(note("side_scale_corrected", f"{text}: corrected; wheels.left_scale and right_scale set it"))
    return (factor * (1.0 + difference / 2), factor * (1.0 - difference / 2)), notes


def _fused_note(log: RobotLog, width_m: float | None) -> list[Note]:
    """Return a warning for wheels that are another filter's output: their turn rate is the gyro's.

    The turn of a copy is 1.00 of the gyro's turn, and a copy has the gyro's noise. The turn of wheels that slip by 1 %
    is 1.01 of the gyro's turn. `width_m` is the width that the body twist was converted with.
    """
    stream = next((choice for choice in log.streams if choice.is_twist), None)
    if stream is None or log.gyro is None or width_m is None:
        return []
    t = (log.wheels.stamp_ns - log.gyro.stamp_ns[0]) / 1e9
    rate = np.interp(t, (log.gyro.stamp_ns - log.gyro.stamp_ns[0]) / 1e9, log.gyro.rate_radps)
    turn = (log.wheels.v_left_mps - log.wheels.v_right_mps) / width_m
    if not (np.ptp(rate) > 0.1 and np.ptp(turn) > 0 and float(np.corrcoef(rate, turn)[0, 1]) > FUSED_CORRELATION):
        return []
    varies = float(rate.std())
    slope = float(np.cov(rate, turn, bias=True)[0, 1]) / varies**2
    std = float((turn - turn.mean() - slope * (rate - rate.mean())).std()) / (varies * math.sqrt(len(rate)))
    if abs(abs(slope) - 1.0) > max(FUSED_SLOPE, EVIDENCE_SIGMAS * std):
        return []
    noise, shared = np.diff(rate, 2), np.diff(turn, 2)
    if not (noise.any() and shared.any() and abs(float(np.corrcoef(noise, shared)[0, 1])) > SHARED_NOISE):
        return []
    ratio = f"{abs(slope):.4f} ± {max(std, 0.0001):.4f} of the gyro's turns"
    fact = f"{stream.topic} turns by {ratio}, with the same noise: it is fused with a gyro, or does not slip at all"
    return [note("wheels_fused", f"{fact}; name the wheels' own topic with topics.wheels")]


STARTS_A_SPAN, FEWEST_SPANS = 4, 6
"""Number of windows of turns that start within one window, and smallest number of windows without overlap."""


class Turns(NamedTuple):
    """Turns of the heading and of the wheels over windows of one length.

    Attributes
    ----------
    ratio, ratio_std : turn of the heading per turn of the wheels, and its standard deviation
    residual_rad : robust scatter of the heading's turn about this ratio [rad]
    turn_rad : rms turn of the heading [rad]
    """

    ratio: float
    ratio_std: float
    residual_rad: float
    turn_rad: float


def compare_turns(track: Track, width_m: float, delay_s: float, windows_s: Sequence[float]) -> list[Turns]:
    """Return the turns of heading and wheels for each length of windows; empty if a length has too few windows.

    Parameters
    ----------
    track : the drive
    width_m : the track width b [m]
    delay_s : lag of the heading behind the wheels [s]
    windows_s : lengths of the windows [s]
    """
    t, travel, comparisons = track.t, track.travel, list[Turns]()
    turned = track.cumulate(2.0 * track.half_difference / width_m)
    for window_s in windows_s:
        first, last = max(t[0] + delay_s, track.heading_t[0]), min(t[-1] + delay_s, track.heading_t[-1])
        if track.measured_t is None:
            begin = np.arange(first, last - window_s, window_s / STARTS_A_SPAN)
            end, a_span = begin + window_s, np.arange(len(begin)) // STARTS_A_SPAN
        else:
            begin, end = spans_of_measured(track.measured_t, window_s, 1)
            inside = (begin >= first) & (end <= last) & (end - begin < 2.0 * window_s)
            begin, end = begin[inside], end[inside]
            a_span = np.floor((begin - first) / window_s).astype(np.int64)
        by_wheels, by_heading = (
            np.interp(end - shift, times, angle) - np.interp(begin - shift, times, angle)
            for shift, times, angle in ((delay_s, t, turned), (0.0, track.heading_t, track.heading))
        )
        moved = np.interp(end - delay_s, t, travel) > np.interp(begin - delay_s, t, travel)
        usable = np.flatnonzero(track.clear(begin - delay_s, end - delay_s) & moved)
        by_wheels, by_heading = by_wheels[usable], by_heading[usable]
        if len(np.unique(a_span[usable])) < FEWEST_SPANS or not by_wheels.any():
            return []
        fit = robust_regression(by_wheels[:, None], by_heading)
        variance = sandwich_covariance(fit, a_span[usable])[0, 0]
        turn = math.sqrt(float(np.mean(by_heading**2)))
        comparisons.append(Turns(float(fit.x[0]), math.sqrt(float(variance)), float(fit.scale[0]), turn))
    return comparisons


NOISE_S, SHORT_S, MIDDLE_S, LONGEST_S = 0.3, 1.0, 5.0, 40.0
"""Times over which turns are compared [s]. Turns over the first one are mostly noise."""

SHORTEST_LONG_S, LONG_WINDOWS = 15.0, 8.0
"""Shortest duration of the long windows [s], and number of long windows in a drive."""

RESOLVED_INTERVALS, MIDDLE_IN_SHORT = 2.0, 2.5
"""Where headings are rare: the shortest time over which turns are compared, in intervals between headings; and the
shortest middle time, in short times."""

SMALLEST_CHANGE = 0.1
"""Smallest significant change of the ratio of turn to wheels' turn from short to long windows."""

AS_THE_ROBOT = 0.1
"""Largest difference from 1 of the ratio over long windows at which the wheels' turn was computed with the heading. The
ratio of wheels that slip in turns differs more."""

LARGE_SHARE, LARGE_RAD = 0.25, math.radians(3.0)
"""Smallest difference of the wheels' turn from the heading's in a second that shows a filter: as a share of the turn,
and in rad, which is more than the error of attitude sensors."""

BOUNDED = 1.5
"""Largest growth of the difference of the turns, from 5 s to long windows, that counts as bounded. The difference by a
random walk grows by a factor of 2 from 5 to 20 s and of 2.8 from 5 to 40 s."""


def find_filtering(fit: AlignmentFit) -> str:
    """Return the evidence that the wheels of a drive are filtered or fused; empty without any."""
    track, delay = fit.windows.track, fit.estimate("heading_delay")[0]
    long_s = min(LONGEST_S, float(track.t[-1]) / LONG_WINDOWS)
    if long_s < SHORTEST_LONG_S:
        return ""
    measured = track.seen_heading_t
    resolved_s = RESOLVED_INTERVALS * float(np.median(np.diff(measured))) if track.measured_t is not None else 0.0
    noise_s, short_s = max(NOISE_S, resolved_s), max(SHORT_S, resolved_s)
    middle_s = max(MIDDLE_S, MIDDLE_IN_SHORT * short_s) if track.measured_t is not None else MIDDLE_S
    if long_s < SHORTEST_LONG_S / MIDDLE_S * middle_s:
        # The reference has too few headings to show the effect of a filter on turns.
        return ""
    comparisons = compare_turns(track, fit.width_m, delay, (noise_s, short_s, middle_s, long_s))
    if not comparisons:
        return ""
    noise, short, middle, long = comparisons
    change, std = long.ratio - short.ratio, math.hypot(short.ratio_std, long.ratio_std)
    if abs(long.ratio - 1.0) < AS_THE_ROBOT and change > max(EVIDENCE_SIGMAS * std, SMALLEST_CHANGE * long.ratio):
        ratios = f"{short.ratio:.2f} ± {short.ratio_std:.2f} over {short_s:g} s and {long.ratio:.2f} ± "
        return f"the robot turns by {ratios}{long.ratio_std:.2f} over {long_s:.0f} s of the turn that they show"
    at_middle, at_end = (
        math.sqrt(max(residual.residual_rad**2 - noise.residual_rad**2, 0.0)) for residual in (middle, long)
    )
    least = max(LARGE_SHARE * short.turn_rad, LARGE_RAD)
    if at_middle > least and at_end < BOUNDED * at_middle:
        angles = f"{math.degrees(at_middle):.0f}° over {middle_s:g} s and by no more than {math.degrees(at_end):.0f}°"
        return f"their turn differs from the robot's by {angles} over {long_s:.0f} s; slip would add up"
    return ""
