"""Streams that are stamped wrongly by seconds: configured delays, and delays that correlations of speeds show."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple, cast

import numpy as np

from icrtool.alignment.log_track import IMPOSSIBLE_M
from icrtool.alignment.wheel_units import FASTER
from icrtool.config import Config
from icrtool.kernels.arrays import Bools, Floats, Ints, trapezoids, unwrapped
from icrtool.records.measurements import Finding
from icrtool.records.notes import Note, note
from icrtool.records.samples import GyroAxes
from icrtool.records.tables import RobotLog

LONGEST_SHIFT_S, SHORTEST_SHIFT_S = 30.0, 3.0
"""Largest shift that is searched, and smallest shift that is corrected [s]. The alignment itself finds smaller ones."""

GRID_S, MOST_STEPS = 0.1, 100_000
"""Step of the search [s], and largest number of steps of a drive that are compared."""

SPEED_OVER_S = 1.0
"""Time over which speeds and turn rates are averaged [s]. Noise of fixes hides faster changes."""

INDEPENDENT_S = 4.0
"""Time between two speeds of a robot from which on they count as independent [s]."""

DECISIVE_GAIN, RIVAL_GAIN, RIVAL_S = 25.0, 9.0, 3.0
"""Gains in twice the log-likelihood that a shift needs: over no shift, and over any other shift that is further away
than the third value [s]. A drive that repeats itself shows no shift."""

LEAST_CORRELATION = 0.8
"""Smallest correlation of two speeds of one robot. With less, no shift is found."""

LARGEST_R2 = 0.98
"""Upper limit of a squared correlation. A robot follows its wheels with a small, varying delay, so that a larger value
has no further meaning."""

LEAST_CHANGE = 1e-3
"""Smallest variance of the values that overlap at a lag, as a share of the variance of the whole column. With a smaller
variance the rounding errors of Fourier transforms are too large, and the correlation is computed directly."""

LEAP_S = 18.0
"""Time by which GPS time is ahead of UTC since 2017 [s]."""


class Shifts(NamedTuple):
    """Times by which streams are stamped later than the wheels [s], already subtracted from the stamps.

    Attributes
    ----------
    gnss, heading : times of positions and of headings; 0 for a stream that was not moved
    notes : the findings
    """

    gnss: float
    heading: float
    notes: tuple[Note, ...]


NO_SHIFTS = Shifts(0.0, 0.0, ())


def with_configured_delays(log: RobotLog, config: Config) -> tuple[RobotLog, Config, Shifts]:
    """Return a log whose streams are moved by their configured delays.

    Returns
    -------
    log; the configuration in which no configured delay is left; the shifts that were applied
    """
    frames = config.frames
    delays_s: dict[str, float] = {
        key: float(delay)
        for key, delay in (("reference_delay_s", frames.reference_delay_s), ("heading_delay_s", frames.heading_delay_s))
        if delay != "auto"
    }
    gnss, heading = (delays_s.get(key, 0.0) for key in ("reference_delay_s", "heading_delay_s"))
    heading = gnss if log.heading_is_of_position else heading
    if gnss == heading == 0.0:
        return log, config, NO_SHIFTS
    inner = replace(config, frames=replace(frames, **cast("dict[str, Any]", dict.fromkeys(delays_s, 0.0))))
    return _moved(log, config, gnss, heading), inner, Shifts(gnss, heading, ())


def _moved(log: RobotLog, config: Config, gnss_s: float, heading_s: float) -> RobotLog:
    """Return a log whose fixes and headings are stamped earlier by some seconds.

    Turn rates in the messages of the headings are moved by the same time, because they have the same clock. They are
    not moved by `SHORTEST_SHIFT_S` or less: such a shift may be the delay of a filter that only the headings pass.
    """
    moved: dict[str, Any] = {
        name: replace(stream, stamp_ns=stream.stamp_ns - round(by * 1e9))
        for name, stream, by in (("gnss", log.gnss, gnss_s), ("heading", log.heading, heading_s))
    }
    log = replace(log, **moved)
    if abs(heading_s) <= SHORTEST_SHIFT_S or config.frames.gyro_delay_s != "auto":
        return log
    return _with_gyros_moved(log, {log.topic("heading"): heading_s})


def _with_gyros_moved(log: RobotLog, by_s: Mapping[str, float]) -> RobotLog:
    """Return a log whose turn rates are stamped earlier by some seconds for each topic."""

    def at(stamp_ns: Ints, topic: str) -> Ints:
        return stamp_ns - round(by_s.get(topic, 0.0) * 1e9)

    gyros = tuple(replace(gyro, stamp_ns=at(gyro.stamp_ns, gyro.topic)) for gyro in log.gyros)
    gyro = None if log.gyro is None else replace(log.gyro, stamp_ns=at(log.gyro.stamp_ns, log.gyro.topic))
    return replace(log, gyros=gyros, gyro=gyro)


def take_shifts(log: RobotLog, config: Config) -> tuple[RobotLog, Config, Shifts]:
    """Return a log whose streams are moved by their configured delays, or by delays that their speeds show.

    Returns
    -------
    log; the configuration for its alignment, in which no configured delay is left; the shifts that were applied
    """
    frames, notes = config.frames, list[Note]()
    free = frames.reference_delay_s == "auto", frames.heading_delay_s == "auto"
    log, config, configured = with_configured_delays(log, config)
    shifts: dict[str, float] = {}
    own = _Rates.of_wheels(log) if _can_be_compared(log) else None
    for word, key, sought in (("gnss", "reference_delay_s", free[0]), ("heading", "heading_delay_s", free[1])):
        shifts[word] = 0.0
        if own is None or not sought:
            continue
        rates = _Rates.of_fixes(log) if word == "gnss" else _Rates.of_headings(log)
        shifts[word] = find_shift(own, rates)
        if shifts[word] and not (word == "heading" and log.heading_is_of_position):
            notes.append(note("clock_shifted", _sentence(word, shifts[word], key)))
    if log.heading_is_of_position:
        shifts["heading"] = shifts["gnss"]
    if own is not None and config.frames.gyro_delay_s == "auto":
        others = [gyro for gyro in log.gyros if gyro.topic != log.topic("heading")]
        of_gyros = {gyro.topic: shift for gyro in others if (shift := find_shift(own, _Rates.of_gyro(gyro, log)))}
        notes += [note("clock_shifted", _sentence("gyro", shift, "gyro_delay_s")) for shift in of_gyros.values()]
        log = _with_gyros_moved(log, of_gyros) if of_gyros else log
    if not any(shifts.values()):
        return log, config, configured._replace(notes=tuple(notes))
    total = Shifts(configured.gnss + shifts["gnss"], configured.heading + shifts["heading"], tuple(notes))
    return _moved(log, config, shifts["gnss"], shifts["heading"]), config, total


def with_shifts(findings: dict[str, Finding], shifts: Shifts) -> dict[str, Finding]:
    """Return the findings of a log whose streams were moved, counted from the stamps that were sent."""
    by = {
        "position_delay_s": shifts.gnss,
        "heading_delay_s": shifts.heading,
        "position_delay_against_heading_s": shifts.gnss - shifts.heading,
    }

    def moved(finding: Finding, shift: float) -> Finding:
        value = None if finding.value is None else finding.value + shift
        return replace(finding, value=value, applied=finding.applied + shift, why="corrected") if shift else finding

    return {name: moved(finding, by.get(name, 0.0)) for name, finding in findings.items()}


def _sentence(word: str, shift_s: float, key: str) -> str:
    """Return the finding about a stream's clock, and the correction."""
    subject = {"gnss": "positions", "heading": "headings"}.get(word, "the turn rates of the gyro")
    fact = f"{subject} are stamped {abs(shift_s):.1f} s {'later' if shift_s > 0 else 'earlier'} than the wheels"
    leap = abs(abs(shift_s) - LEAP_S) < 2 * GRID_S
    cause = " (GPS time is 18 s ahead of UTC)" if leap else ""
    return f"{fact}, as their speeds show: their clock{cause}; corrected; frames.{key} sets it"


def _can_be_compared(log: RobotLog) -> bool:
    """Return whether wheels and positions hold at least two finite values each; other faults are refused later."""
    wheels, gnss = log.wheels, log.gnss
    if min(len(wheels.stamp_ns), len(gnss.stamp_ns)) < 2:
        return False
    columns = (wheels.left, wheels.right, gnss.north_m, gnss.east_m, log.heading.heading_rad)
    in_order = all((np.diff(stamps) >= 0).all() for stamps in (wheels.stamp_ns, gnss.stamp_ns, log.heading.stamp_ns))
    return in_order and all(bool((np.abs(column) < IMPOSSIBLE_M).all()) for column in columns)


class _Rates(NamedTuple):
    """Speed [m/s] and turn rate [rad/s] on the grid of a log; NaN where not known, None where a stream shows none."""

    speed: Floats | None
    turn: Floats | None

    @classmethod
    def of_wheels(cls, log: RobotLog) -> _Rates:
        wheels = log.wheels
        held = np.diff(wheels.stamp_ns, append=wheels.stamp_ns[-1:]) / 1e9
        left, right = (
            np.cumsum(np.append(0.0, (side * held)[:-1])) for side in (wheels.v_left_mps, wheels.v_right_mps)
        )
        known = _known(wheels.stamp_ns, log)
        speed = np.abs(_rate(wheels.stamp_ns, (left + right) / 2, log))
        return cls(np.where(known, speed, np.nan), np.where(known, _rate(wheels.stamp_ns, left - right, log), np.nan))

    @classmethod
    def of_fixes(cls, log: RobotLog) -> _Rates:
        gnss = log.gnss
        if len(gnss.stamp_ns) < 2:
            return cls(None, None)
        velocity = _rate(gnss.stamp_ns, gnss.north_m, log) + 1j * _rate(gnss.stamp_ns, gnss.east_m, log)
        speed, known = np.abs(velocity), _known(gnss.stamp_ns, log)
        # a jump of the positions has no speed, and would outweigh all others
        jumps = speed > FASTER * max(float(np.abs(side).max()) for side in (log.wheels.left, log.wheels.right))
        known, velocity = known & ~jumps, np.where(jumps, np.nan, velocity)
        # a robot on the spot has no course over ground
        step = max(round(SPEED_OVER_S / GRID_S), 1)
        turned = np.angle(velocity[step:] * np.conj(velocity[:-step])) / SPEED_OVER_S
        turn = np.full(len(speed), np.nan)
        turn[step // 2 : step // 2 + len(turned)] = turned
        clear = known & (speed > 0.5 * float(np.median(speed[known])) if known.any() else known)
        return cls(np.where(known, speed, np.nan), np.where(clear, turn, np.nan))

    @classmethod
    def of_headings(cls, log: RobotLog) -> _Rates:
        heading = log.heading
        if len(heading.stamp_ns) < 2:
            return cls(None, None)
        turn = _rate(heading.stamp_ns, unwrapped(heading.heading_rad), log)
        return cls(None, np.where(_known(heading.stamp_ns, log), turn, np.nan))

    @classmethod
    def of_gyro(cls, gyro: GyroAxes, log: RobotLog) -> _Rates:
        """Return the turn rate about the gyro axis with the most turn."""
        if len(gyro.stamp_ns) < 2:
            return cls(None, None)
        t = (gyro.stamp_ns - gyro.stamp_ns[0]) / 1e9
        angles = [trapezoids(t, rate) for rate in np.nan_to_num(gyro.rates_radps).T]
        known = _known(gyro.stamp_ns, log)
        rates = [np.where(known, _rate(gyro.stamp_ns, angle, log), np.nan) for angle in angles]
        return cls(None, max(rates, key=lambda rate: float(np.nanvar(rate)) if known.any() else 0.0))


def _grid(log: RobotLog) -> Ints:
    """Return the times of the grid [ns]: the time span of the wheels, extended by the largest shift on both sides."""
    first, last = int(log.wheels.stamp_ns[0]), int(log.wheels.stamp_ns[-1])
    count = min(int((last - first) / (GRID_S * 1e9)) + 1, MOST_STEPS)
    around = round(LONGEST_SHIFT_S / GRID_S)
    return first + np.arange(-around, count + around) * round(GRID_S * 1e9)


def _rate(stamps: Ints, values: Floats, log: RobotLog) -> Floats:
    """Return the mean change per second of a column over `SPEED_OVER_S` around each time of the grid."""
    grid, half = _grid(log), round(SPEED_OVER_S * 1e9 / 2)
    t = (stamps - grid[0]) / 1e9
    first, last = ((grid - grid[0] + shift) / 1e9 for shift in (-half, half))
    return np.asarray((np.interp(last, t, values) - np.interp(first, t, values)) / SPEED_OVER_S)


def _known(stamps: Ints, log: RobotLog) -> Bools:
    """Return at which times of the grid a stream was sampled just before and just after."""
    grid, usual = _grid(log), float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    after = np.searchsorted(stamps, grid)
    inside = (after > 0) & (after < len(stamps))
    after = np.clip(after, 1, len(stamps) - 1)
    return np.asarray(inside & (stamps[after] - stamps[after - 1] < max(1.5e9, 3.0 * usual)))


def find_shift(wheels: _Rates, stream: _Rates) -> float:
    """Return the time by which a stream is stamped later than the wheels [s]; 0 where it is below 3 s, or not shown.

    Notes
    -----
    Twice the log-likelihood of a line through n independent pairs is -n log(1 - r^2): the correlations of speeds and of
    turn rates add up. Their signs do not count: sides may be exchanged.
    """
    lags = np.arange(-round(LONGEST_SHIFT_S / GRID_S), round(LONGEST_SHIFT_S / GRID_S) + 1)
    gain, best_r = np.zeros(len(lags)), np.zeros(len(lags))
    for wheel_rate, stream_rate in ((wheels.speed, stream.speed), (wheels.turn, stream.turn)):
        if wheel_rate is None or stream_rate is None:
            continue
        r2, count = _correlations(wheel_rate, stream_rate, lags)
        # the same number of pairs for all lags: a longer overlap of streams is no evidence of a lag
        gain -= count.max() * GRID_S / INDEPENDENT_S * np.log1p(-np.minimum(r2, LARGEST_R2))
        best_r = np.maximum(best_r, np.sqrt(r2))
    at = int(gain.argmax())
    shift = float(lags[at]) * GRID_S
    near = np.abs(lags) * GRID_S <= SHORTEST_SHIFT_S
    rivals = np.abs(lags - lags[at]) * GRID_S > RIVAL_S
    if abs(shift) <= SHORTEST_SHIFT_S or best_r[at] < LEAST_CORRELATION or at in (0, len(lags) - 1):
        return 0.0
    if gain[at] - float(gain[near].max()) < DECISIVE_GAIN or gain[at] - float(gain[rivals].max()) < RIVAL_GAIN:
        return 0.0
    before, peak, behind = gain[at - 1 : at + 2]
    bend = before - 2.0 * peak + behind
    return shift + GRID_S * (0.5 * float((before - behind) / bend) if bend < 0.0 else 0.0)


def _correlations(column: Floats, later_column: Floats, lags: Ints) -> tuple[Floats, Floats]:
    """Return squared correlations (l,) of a column with another column `lags` steps later, and numbers of pairs (l,).

    Notes
    -----
    The sums over pairs of all lags are six cross-correlations, by Fourier transforms (Padfield 2012, "Masked
    Object Registration in the Fourier Domain"). A lag at which a column hardly changes is computed by its pairs alone.
    """
    size = 1 << (len(column) + int(np.abs(lags).max(initial=0))).bit_length()
    of_own, of_seen = (np.fft.rfft(_powers(column), size) for column in (column, later_column))

    def sums(own_power: int, seen_power: int) -> Floats:
        return np.asarray(np.fft.irfft(np.conj(of_own[own_power]) * of_seen[seen_power], size)[lags])

    counts = np.rint(sums(0, 0))
    pairs = np.maximum(counts, 1.0)
    own_mean, seen_mean = sums(1, 0) / pairs, sums(0, 1) / pairs
    own_change, seen_change = sums(2, 0) / pairs - own_mean**2, sums(0, 2) / pairs - seen_mean**2
    clear = (counts > 2) & (np.minimum(own_change, seen_change) > LEAST_CHANGE)
    found = np.zeros(len(lags))
    together = sums(1, 1) / pairs - own_mean * seen_mean
    found[clear] = together[clear] ** 2 / (own_change[clear] * seen_change[clear])
    # A few pairs at the ends of the columns may correlate by chance.
    enough = counts >= 0.5 * counts.max(initial=0.0)
    for row in np.flatnonzero(enough & ~clear):
        found[row] = _correlation(column, later_column, int(lags[row]))
    return np.where(enough, found, 0.0), counts


def _powers(column: Floats) -> Floats:
    """Return powers 0, 1 and 2 (3, n) of a column with mean 0 and standard deviation 1; 0 where it is not known."""
    known = np.isfinite(column)
    if not known.any():
        return np.zeros((3, len(column)))
    centred = np.where(known, column - column[known].mean(), 0.0)
    std = math.sqrt(float(np.square(centred).mean() / known.mean()))
    scaled = centred / std if std > 0.0 else centred
    return np.array([known, scaled, np.square(scaled)], np.float64)


def _correlation(column: Floats, later_column: Floats, lag: int) -> float:
    """Return the squared correlation of a column with another column `lag` steps later; 0 for a constant column."""
    a, b = (column[: len(column) - lag], later_column[lag:]) if lag >= 0 else (column[-lag:], later_column[:lag])
    both = np.isfinite(a) & np.isfinite(b)
    a, b = a[both], b[both]
    if len(a) < 3 or np.ptp(a) == 0.0 or np.ptp(b) == 0.0:
        return 0.0
    a, b = a - a.mean(), b - b.mean()
    scale = math.sqrt(float(np.square(a).sum() * np.square(b).sum()))
    return (float((a * b).sum()) / scale) ** 2 if scale > 0.0 else 0.0
