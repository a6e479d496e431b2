"""Correction of streams whose stamps are wrong by seconds: configured delays, and delays by correlation of speeds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple, cast

import numpy as np

from icrtool.alignment.log_track import IMPOSSIBLE_M
from icrtool.alignment.wheel_units import LEAST_RESTART_RATIO
from icrtool.config import Config
from icrtool.kernels.arrays import Bools, Floats, Ints, trapezoids, unwrapped
from icrtool.records.measurements import AlignmentEstimate
from icrtool.records.notes import Note, note
from icrtool.records.samples import GyroAxes
from icrtool.records.tables import RobotLog

LONGEST_SHIFT_S, SHORTEST_SHIFT_S = 30.0, 3.0
"""Largest shift that is searched, and smallest shift that is corrected [s]. The estimate of the alignment finds smaller
delays."""

GRID_S, MOST_STEPS = 0.1, 100_000
"""Step of the search [s], and largest number of steps of a drive that are compared."""

SPEED_OVER_S = 1.0
"""Time over which speeds and turn rates are averaged [s]. Noise of fixes hides faster changes."""

INDEPENDENT_S = 4.0
"""Time after which two speeds of a robot count as independent [s]."""

DECISIVE_GAIN, RIVAL_GAIN, RIVAL_S = 25.0, 9.0, 3.0
"""Smallest gain in twice the log-likelihood over no shift, smallest gain over a rival, and smallest distance of a rival
from the shift [s]. A drive that repeats itself has rivals, and shows no shift."""

LEAST_CORRELATION = 0.8
"""Smallest correlation of two speeds of one robot. With less, no shift is found."""

LARGEST_R2 = 0.98
"""Upper limit of a squared correlation. A robot follows its wheels with a small, varying delay, so that larger values
do not mean a better shift."""

LEAST_CHANGE = 1e-3
"""Smallest variance of the values that overlap at a lag, as a share of the variance of the whole column. With a smaller
variance the rounding errors of Fourier transforms are too large, and the correlation is computed directly."""

LEAP_S = 18.0
"""Difference of GPS time minus UTC since 2017 [s]."""


class Shifts(NamedTuple):
    """Times by which streams were stamped later than the wheels, already subtracted from their stamps.

    Attributes
    ----------
    gnss, heading : shift of the positions and of the headings [s]; 0 for a stream that was not moved
    notes : findings about shifts that were found
    """

    gnss: float
    heading: float
    notes: tuple[Note, ...]


NO_SHIFTS = Shifts(0.0, 0.0, ())
"""Shifts of a log whose streams have one clock."""


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
    """Return a log with the stamps of fixes and headings reduced by some seconds.

    Turn rates in the messages of the headings have the same clock and are moved with them. A shift of
    `SHORTEST_SHIFT_S` or less does not move them, because it may be the delay of a filter for headings alone.
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
    """Return a log with the stamps of turn rates reduced by some seconds for each topic."""

    def moved(stamp_ns: Ints, topic: str) -> Ints:
        return stamp_ns - round(by_s.get(topic, 0.0) * 1e9)

    gyros = tuple(replace(gyro, stamp_ns=moved(gyro.stamp_ns, gyro.topic)) for gyro in log.gyros)
    gyro = None if log.gyro is None else replace(log.gyro, stamp_ns=moved(log.gyro.stamp_ns, log.gyro.topic))
    return replace(log, gyros=gyros, gyro=gyro)


def take_shifts(log: RobotLog, config: Config) -> tuple[RobotLog, Config, Shifts]:
    """Return a log whose streams are moved by their configured delays, or by shifts that their speeds show.

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


def with_shifts(estimates: dict[str, AlignmentEstimate], shifts: Shifts) -> dict[str, AlignmentEstimate]:
    """Return estimates in which the delays of moved streams are relative to the stamps that were sent."""
    by = {
        "position_delay_s": shifts.gnss,
        "heading_delay_s": shifts.heading,
        "position_delay_against_heading_s": shifts.gnss - shifts.heading,
    }

    def moved(estimate: AlignmentEstimate, shift: float) -> AlignmentEstimate:
        value = None if estimate.value is None else estimate.value + shift
        return replace(estimate, value=value, applied=estimate.applied + shift, why="corrected") if shift else estimate

    return {name: moved(estimate, by.get(name, 0.0)) for name, estimate in estimates.items()}


def _sentence(word: str, shift_s: float, key: str) -> str:
    """Return a sentence about the shift of a stream and its correction."""
    subject = {"gnss": "positions", "heading": "headings"}.get(word, "the turn rates of the gyro")
    fact = f"{subject} are stamped {abs(shift_s):.1f} s {'later' if shift_s > 0 else 'earlier'} than the wheels"
    leap = abs(abs(shift_s) - LEAP_S) < 2 * GRID_S
    cause = "GPS time is 18 s ahead of UTC" if leap else "another clock"
    return f"by the correlation of their speeds, {fact} ({cause}): corrected; frames.{key} sets the delay"


def _can_be_compared(log: RobotLog) -> bool:
    """Return whether wheels and positions have two finite values each, in order; later steps refuse other logs."""
    wheels, gnss = log.wheels, log.gnss
    if min(len(wheels.stamp_ns), len(gnss.stamp_ns)) < 2:
        return False
    columns = (wheels.left, wheels.right, gnss.north_m, gnss.east_m, log.heading.heading_rad)
    in_order = all((np.diff(stamps) >= 0).all() for stamps in (wheels.stamp_ns, gnss.stamp_ns, log.heading.stamp_ns))
    return in_order and all(bool((np.abs(column) < IMPOSSIBLE_M).all()) for column in columns)


class _Rates(NamedTuple):
    """Speed [m/s] and turn rate [rad/s] of a stream at the times of `_grid` (n,).

    A value is NaN where it is not known; a column is None if the stream does not show it.
    """

    speed: Floats | None
    turn: Floats | None

    @classmethod
    def of_wheels(cls, log: RobotLog) -> _Rates:
        """Return speed and turn rate of the wheels."""
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
        """Return speed, and turn rate of the course over ground, of the fixes."""
        gnss = log.gnss
        if len(gnss.stamp_ns) < 2:
            return cls(None, None)
        velocity = _rate(gnss.stamp_ns, gnss.north_m, log) + 1j * _rate(gnss.stamp_ns, gnss.east_m, log)
        speed, known = np.abs(velocity), _known(gnss.stamp_ns, log)
        # Jumps of the positions are left out, because their speeds would outweigh all others.
        jumps = speed > LEAST_RESTART_RATIO * max(
            float(np.abs(side).max()) for side in (log.wheels.left, log.wheels.right)
        )
        known, velocity = known & ~jumps, np.where(jumps, np.nan, velocity)
        # Slow motion is left out, because its course over ground is mostly noise.
        step = max(round(SPEED_OVER_S / GRID_S), 1)
        turned = np.angle(velocity[step:] * np.conj(velocity[:-step])) / SPEED_OVER_S
        turn = np.full(len(speed), np.nan)
        turn[step // 2 : step // 2 + len(turned)] = turned
        clear = known & (speed > 0.5 * float(np.median(speed[known])) if known.any() else known)
        return cls(np.where(known, speed, np.nan), np.where(clear, turn, np.nan))

    @classmethod
    def of_headings(cls, log: RobotLog) -> _Rates:
        """Return the turn rate of the headings."""
        heading = log.heading
        if len(heading.stamp_ns) < 2:
            return cls(None, None)
        turn = _rate(heading.stamp_ns, unwrapped(heading.heading_rad), log)
        return cls(None, np.where(_known(heading.stamp_ns, log), turn, np.nan))

    @classmethod
    def of_gyro(cls, gyro: GyroAxes, log: RobotLog) -> _Rates:
        """Return the turn rate about the axis of a gyro that turns most."""
        if len(gyro.stamp_ns) < 2:
            return cls(None, None)
        t = (gyro.stamp_ns - gyro.stamp_ns[0]) / 1e9
        angles = [trapezoids(t, rate) for rate in np.nan_to_num(gyro.rates_radps).T]
        known = _known(gyro.stamp_ns, log)
        rates = [np.where(known, _rate(gyro.stamp_ns, angle, log), np.nan) for angle in angles]
        return cls(None, max(rates, key=lambda rate: float(np.nanvar(rate)) if known.any() else 0.0))


def _grid(log: RobotLog) -> Ints:
    """Return the times of the grid (n,) [ns]: the span of the wheels, extended by the largest shift on both sides."""
    first, last = int(log.wheels.stamp_ns[0]), int(log.wheels.stamp_ns[-1])
    count = min(int((last - first) / (GRID_S * 1e9)) + 1, MOST_STEPS)
    around = round(LONGEST_SHIFT_S / GRID_S)
    return first + np.arange(-around, count + around) * round(GRID_S * 1e9)


def _rate(stamps: Ints, values: Floats, log: RobotLog) -> Floats:
    """Return the change of a column per second at each time of the grid, as the mean over `SPEED_OVER_S`."""
    grid, half = _grid(log), round(SPEED_OVER_S * 1e9 / 2)
    t = (stamps - grid[0]) / 1e9
    first, last = ((grid - grid[0] + shift) / 1e9 for shift in (-half, half))
    return np.asarray((np.interp(last, t, values) - np.interp(first, t, values)) / SPEED_OVER_S)


def _known(stamps: Ints, log: RobotLog) -> Bools:
    """Return a mask of the times of the grid at which a stream was sampled shortly before and after."""
    grid, usual = _grid(log), float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    after = np.searchsorted(stamps, grid)
    inside = (after > 0) & (after < len(stamps))
    after = np.clip(after, 1, len(stamps) - 1)
    return np.asarray(inside & (stamps[after] - stamps[after - 1] < max(1.5e9, 3.0 * usual)))


def find_shift(wheels: _Rates, stream: _Rates) -> float:
    """Return the time by which a stream is stamped later than the wheels [s].

    It is 0 if the streams do not show it, or if it is `SHORTEST_SHIFT_S` or less.

    Notes
    -----
    Twice the log-likelihood of a line through n independent pairs is -n log(1 - r^2), summed over the correlations r of
    speeds and of turn rates. The signs of r have no effect, because sides may be exchanged.
    """
    lags = np.arange(-round(LONGEST_SHIFT_S / GRID_S), round(LONGEST_SHIFT_S / GRID_S) + 1)
    gain, best_r = np.zeros(len(lags)), np.zeros(len(lags))
    for wheel_rate, stream_rate in ((wheels.speed, stream.speed), (wheels.turn, stream.turn)):
        if wheel_rate is None or stream_rate is None:
            continue
        r2, count = _correlations(wheel_rate, stream_rate, lags)
        # All lags get the same number of pairs, because a longer overlap of the streams is no evidence of a lag.
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
    The sums over the pairs of all lags are six cross-correlations, computed by Fourier transforms (Padfield 2012,
    "Masked Object Registration in the Fourier Domain"). For a lag at which a column hardly changes, the correlation is
    computed directly.
    """
    size = 1 << (len(column) + int(np.abs(lags).max(initial=0))).bit_length()
    spectra, later_spectra = (np.fft.rfft(_powers(values), size) for values in (column, later_column))

    def sums(power: int, later_power: int) -> Floats:
        return np.asarray(np.fft.irfft(np.conj(spectra[power]) * later_spectra[later_power], size)[lags])

    counts = np.rint(sums(0, 0))
    pairs = np.maximum(counts, 1.0)
    mean, later_mean = sums(1, 0) / pairs, sums(0, 1) / pairs
    variance, later_variance = sums(2, 0) / pairs - mean**2, sums(0, 2) / pairs - later_mean**2
    varies = (counts > 2) & (np.minimum(variance, later_variance) > LEAST_CHANGE)
    squared = np.zeros(len(lags))
    covariance = sums(1, 1) / pairs - mean * later_mean
    squared[varies] = covariance[varies] ** 2 / (variance[varies] * later_variance[varies])
    # Lags with few pairs are left out, because these may correlate by chance.
    enough = counts >= 0.5 * counts.max(initial=0.0)
    for row in np.flatnonzero(enough & ~varies):
        squared[row] = _correlation(column, later_column, int(lags[row]))
    return np.where(enough, squared, 0.0), counts


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
