"""The noise of fixes and headings, measured from their steps minus the motion of the wheels, for the filter."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from icrtool.config import FilterConfig
from icrtool.kernels.arrays import Bools, Complexes, Floats, Ints
from icrtool.records.measurements import Fixes
from icrtool.records.notes import note
from icrtool.records.samples import HeadingSamples, PositionFixes
from icrtool.records.tables import RobotLog

FEWEST_NOISE_STEPS = 40
"""Smallest number of steps that show noise, and number of fixes in a stretch."""

FEWEST_FIXES = 30
"""Smallest number of fixes whose noise and motion are compared."""

MEDIAN_OF_RAYLEIGH = 1.1774
"""Ratio of the median of a Rayleigh distribution to its scale."""

OUTLIER_SIGMAS = 6.0
"""Size of a step, in robust standard deviations, above which it is not noise."""

JUMP_SIGMAS = 8.0
"""Size of a step, in robust standard deviations, above which it is a jump or a spike."""

SMALLEST_JUMP_M = 0.1
"""Smallest jump of the positions [m]."""

PERSISTS_S = 1.0
"""Time before and after a step over which the median positions are compared [s]."""

PERSISTS_SHARE = 0.5
"""Largest difference between a step and the change of these medians, as a share of the step, at which the step is a
jump. After an outlier the positions come back."""

NOISIER = 1.5
"""Ratio of measured to stated noise above which the measured noise is used."""

MOVES_MPS = 0.05
"""Mean wheel speed above which the robot moves [m/s]. Delays and jitter of stamps add noise only while it moves."""

FROZEN_M, FROZEN_SHARE = 1.0, 0.5
"""Distance of the wheels [m] after which a fix that equals the fix before to the last digit is old; largest share of
the driven distance with old fixes. Above this share the robot does not move, and no fix is left out."""

HOLE_IN_INTERVALS = 5.0
"""Interval between two samples, in usual intervals, above which a stream has a hole."""

SLIP_SHARE = 0.03
"""Standard deviation of slip from window to window of 2 m, as a share of distance and of turn."""

WHEEL_HOLE_S = 1.0
"""Interval between two wheel samples above which the path between them is not known [s]."""


class FixSteps(NamedTuple):
    """Steps between neighbouring fixes, north + j east, minus the motion of wheels and heading.

    Attributes
    ----------
    step : complex (m - 1,) [m], NaN across a gap
    product : (m - 2,) negative product of neighbouring steps [m^2], NaN at gaps and outliers. White noise with variance
        s^2 on each axis gives 2 s^2 on average; errors of the wheels that last for several steps reduce it
    moves : bool (m - 1,), whether the wheels moved
    jump_row : (j,) rows of the first fix after a jump
    """

    step: Complexes
    product: Floats
    moves: Bools
    jump_row: Ints

    def white_std_m(self, rows: Bools) -> float:
        """Return the white noise of the fixes `rows` (m,) on one axis [m]; NaN where there are too few steps."""
        inside = rows[:-2] & rows[1:-1] & rows[2:] & np.isfinite(self.product)
        if np.count_nonzero(inside) < FEWEST_NOISE_STEPS:
            return float("nan")
        return float(np.sqrt(max(float(self.product[inside].mean()) / 2, 0.0)))

    def stretches(self, claimed: Bools) -> tuple[Floats, Bools]:
        """Return the white variance of stretches of `FEWEST_NOISE_STEPS` fixes, and whether the robot mostly moves.

        The variance is the sum over both axes [m^2], of the fixes that are `claimed` (m,); NaN where unknown.
        """
        shape = len(self.product) // FEWEST_NOISE_STEPS, FEWEST_NOISE_STEPS
        inside = claimed[:-2] & claimed[1:-1] & claimed[2:] & np.isfinite(self.product)
        inside[np.clip(np.concatenate([self.jump_row - 2, self.jump_row - 1]), 0, None)] = False
        products, used, moves = (
            column[: shape[0] * shape[1]].reshape(shape)
            for column in (np.where(inside, self.product, 0.0), inside, self.moves)
        )
        count, level = used.sum(axis=1), np.full(shape[0], np.nan)
        np.divide(products.sum(axis=1), count, out=level, where=count > FEWEST_NOISE_STEPS // 2)
        return level, np.asarray(moves.mean(axis=1) > 0.5)


def measure_steps(t: Floats, position: Floats | Complexes, expected: Floats | Complexes) -> FixSteps:
    """Return the steps between fixes minus the motion of the wheels.

    Parameters
    ----------
    t : (m,) stamps of the fixes [s]
    position : complex (m,) positions of the fixes, north + j east [m]; or float64 (m,) headings [rad]
    expected : (m,) positions or headings by the wheels alone, as integrals, in the same unit
    """
    step, dt = np.diff(position - expected).astype(np.complex128), np.diff(t)
    if len(step) < 2:
        unknown = np.full(max(len(step) - 1, 0), np.nan)
        return FixSteps(step, unknown, np.zeros(len(step), np.bool_), np.empty(0, np.int64))
    usual = float(np.median(dt))
    step[is_hole(dt)] = np.nan
    moves = np.abs(np.diff(expected)) > MOVES_MPS * dt
    moving = step[moves & np.isfinite(step)]
    size = np.abs(moving if len(moving) >= FEWEST_NOISE_STEPS else step[np.isfinite(step)])
    scale = max(float(np.median(size)) / MEDIAN_OF_RAYLEIGH, 1e-6) if len(size) else 1e-6
    with np.errstate(invalid="ignore"):
        usual_step = np.where(np.abs(step) <= OUTLIER_SIGMAS * scale, step, np.nan)
    product = -(usual_step[1:] * np.conj(usual_step[:-1])).real
    # A step is a jump if the fixes stay away after it.
    span = max(3, round(PERSISTS_S / usual)) if usual > 0 else 3
    with np.errstate(invalid="ignore"):
        row = np.flatnonzero(np.abs(step) > max(SMALLEST_JUMP_M, JUMP_SIGMAS * scale))
    row = row[(row >= span) & (row + span < len(step))]
    if not len(row):
        return FixSteps(step, product, moves, row)
    level = np.concatenate([[0.0], np.cumsum(np.nan_to_num(step))])
    around = sliding_window_view(level, span)
    # `level[k]` belongs to fix k; step k leads from fix k to fix k + 1.
    before, after = around[row - span + 1], around[row + 1]
    change = np.median(after.real, axis=1) - np.median(before.real, axis=1)
    shift = change + 1j * (np.median(after.imag, axis=1) - np.median(before.imag, axis=1))
    stays = np.abs(shift - step[row]) < PERSISTS_SHARE * np.abs(step[row])
    return FixSteps(step, product, moves, row[stays] + 1)


def is_hole(interval_s: Floats, least_s: float = 1e-6) -> Bools:
    """Return which intervals between the samples of a stream [s] are holes, of at least some length."""
    usual = float(np.median(interval_s)) if len(interval_s) else 0.0
    return np.asarray(interval_s > max(least_s, HOLE_IN_INTERVALS * usual))


def unbroken_intervals(interval_s: Floats) -> Floats:
    """Return intervals between wheel samples [s], zero where an interval is too long to show the motion in it."""
    return np.where(is_hole(interval_s, WHEEL_HOLE_S), 0.0, interval_s)


FIRST_FIXES, BAD_STEP_SPEEDS, BAD_STEP_M = 5, 3.0, 3.0
"""Largest number of first fixes that may be bad; multiple of the wheels' distance, and of the noise, that a step may
have; distance [m] that a step may have in addition, if the noise is smaller. Fixes before a longer step are bad, if no
later step is longer than this."""


def without_bad_start(log: RobotLog) -> RobotLog:
    """Return a log without first fixes that lie apart from all others; the same log if there are none."""
    gnss, wheels = log.gnss, log.wheels
    if len(gnss.stamp_ns) < 4 * FIRST_FIXES or len(wheels.stamp_ns) < 2:
        return log
    if not all(np.isfinite(column).all() for column in (gnss.north_m, gnss.east_m, wheels.left, wheels.right)):
        # A log with damaged positions or speeds is refused later, with the reason.
        return log
    seconds = np.diff(gnss.stamp_ns[: 4 * FIRST_FIXES]) / 1e9
    with np.errstate(over="ignore"):  # In a damaged log a step may be infinite; such a step is a jump.
        step = np.hypot(np.diff(gnss.north_m[: 4 * FIRST_FIXES]), np.diff(gnss.east_m[: 4 * FIRST_FIXES]))
    speed = float(np.quantile(np.abs(wheels.v_left_mps) + np.abs(wheels.v_right_mps), 0.99)) / 2
    noise = NOISIER * (float(np.median(step[FIRST_FIXES:])) + USUAL_POSITION_STD_M)
    jumps = np.flatnonzero(step > BAD_STEP_SPEEDS * speed * seconds + max(BAD_STEP_M, BAD_STEP_SPEEDS * noise))
    if not len(jumps) or jumps[-1] >= FIRST_FIXES:
        return log
    count = int(jumps[-1]) + 1
    rows = slice(count, None)
    text = f"{count} of the first fixes lie {step[jumps].max():.4g} m from the others: left out"
    return replace(log, gnss=gnss.cut(rows), notes=(*log.notes, note("first_fixes_apart", text, log.name)))


def without_frozen(log: RobotLog) -> RobotLog:
    """Return a log without old fixes, which a driver repeats while its receiver has none; else the same log."""
    gnss, wheels = log.gnss, log.wheels
    if log.datum is None or min(len(gnss.stamp_ns), len(wheels.stamp_ns)) < 2:
        return log
    speed = np.abs(wheels.v_left_mps + wheels.v_right_mps)[:-1] / 2
    gone = np.concatenate([[0.0], np.cumsum(speed * unbroken_intervals(np.diff(wheels.stamp_ns) / 1e9))])
    travel = np.interp(gnss.stamp_ns, wheels.stamp_ns, gone)
    moves = (np.diff(axis, prepend=np.nan) != 0.0 for axis in (gnss.north_m, gnss.east_m))
    first = np.flatnonzero(np.logical_or(*moves))
    count = np.diff(first, append=len(travel))
    length = travel[first + count - 1] - travel[first]
    old = length > FROZEN_M
    if not old.any() or float(length[old].sum()) > FROZEN_SHARE * float(travel[-1] - travel[0]):
        return log
    keep = ~np.repeat(old, count)
    keep[first] = True
    text = f"{np.count_nonzero(~keep)} fixes repeat the fix before to the last digit while the wheels move: left out"
    return replace(log, gnss=gnss.cut(keep), notes=(*log.notes, note("fixes_frozen", text, log.name)))


LARGEST_SANE_GNSS_STD_M, LARGEST_SANE_HEADING_STD_RAD = 100.0, math.radians(60.0)
"""Largest stated standard deviation that is used. A larger one means that the noise is unknown (1000 or 1e6)."""

USUAL_POSITION_STD_M, USUAL_HEADING_STD_DEG = 0.01, 1.0
"""Standard deviations of an RTK receiver and of an attitude sensor (Pentzer 2014, Eq. 31)."""

QUIETER = 3.0
"""Ratio of usual to measured noise from which on the measured noise is used. If the measured noise is only slightly
below the usual one, as for lidar poses, errors may be correlated over more than a step."""

LEAST_POSITION_STD_M, LEAST_HEADING_STD_RAD = 1e-4, math.radians(0.01)
"""Smallest standard deviations of a reference. Cameras of motion capture resolve 0.1 mm."""


def unstated_position_std_m(settings: FilterConfig) -> float:
    """Return the noise of fixes that state none [m]: the configured noise, else the usual noise."""
    return USUAL_POSITION_STD_M if settings.gnss_std_m == "auto" else settings.gnss_std_m


def fixes_of(gnss: PositionFixes, settings: FilterConfig, measured_m: float = math.nan) -> Fixes:
    """Return positions as the filter uses them, of one class; preset ``paper`` has the configured noise throughout.

    Parameters
    ----------
    gnss : the fixes of the log
    settings : settings of the filter
    measured_m : result of `reference_noise`; if it is not NaN, every fix has this noise
    """
    # The diagonal plus the covariance's size is never below the full matrix: correlated fixes are not overrated.
    correlated = np.nan_to_num(np.abs(gnss.cov_north_east_m2))
    usual, floor = unstated_position_std_m(settings), settings.gnss_std_floor_m
    north, east = (
        _variance(stated + correlated, settings, usual, LARGEST_SANE_GNSS_STD_M, floor, measured_m, 0.0)
        for stated in (gnss.var_north_m2, gnss.var_east_m2)
    )
    none = np.zeros(len(gnss.stamp_ns), np.bool_)
    return Fixes(
        stamp_ns=gnss.stamp_ns,
        north_m=gnss.north_m,
        east_m=gnss.east_m,
        var_north_m2=north,
        var_east_m2=east,
        fix_class=np.zeros(len(none), np.uint8),
        misreported=none,
        down_weighted=none,
    )


def heading_variance(
    headings: HeadingSamples, settings: FilterConfig, at_least_rad: float = 0.0, measured_rad: float = math.nan
) -> Floats:
    """Return the variances of headings (h,) [rad^2], at least `at_least_rad` squared; the rest as in `fixes_of`."""
    usual_deg = USUAL_HEADING_STD_DEG if settings.heading_std_deg == "auto" else settings.heading_std_deg
    usual, floor = math.radians(usual_deg), math.radians(settings.heading_std_floor_deg)
    largest = LARGEST_SANE_HEADING_STD_RAD
    return _variance(headings.var_rad2, settings, usual, largest, floor, measured_rad, at_least_rad)


def _variance(
    stated: Floats, settings: FilterConfig, usual: float, largest_sane: float, floor: float, measured: float,
    at_least: float,
) -> Floats:  # fmt: skip
    """Return variances: the measured one, else in preset ``paper`` the usual one, else the plausible stated ones."""
    if math.isfinite(measured):
        return np.full(stated.shape, max(measured, at_least) ** 2)
    if not settings.rules.measures_noise:
        return np.full(stated.shape, usual**2)
    sane = np.isfinite(stated) & (stated > 0) & (stated < largest_sane**2)
    return np.maximum(np.where(sane, stated, usual**2), max(floor, at_least) ** 2)


def reference_noise(
    log: RobotLog, settings: FilterConfig, position_steps: FixSteps, turn_steps: FixSteps
) -> tuple[float, float]:
    """Return the measured noise of a reference's positions on one axis [m] and of its headings [rad]; NaN: as stated.

    Parameters
    ----------
    log : the log
    settings : settings of the filter
    position_steps, turn_steps : steps of the positions and of the headings against the wheels

    Notes
    -----
    The noise is measured for poses of a metric reference (motion capture, lidar, total station) that state no noise, if
    no noise is configured. Errors of a receiver's fixes and of an attitude sensor's headings last for seconds, so that
    the steps are smaller than the errors. Preset ``paper`` measures nothing.
    """
    free = settings.rules.measures_noise and settings.gnss_std_m == "auto" and log.datum is None
    place_stated, turn_stated = (
        (np.isfinite(variance) & (variance > 0.0)).any() for variance in (log.gnss.var_north_m2, log.heading.var_rad2)
    )
    if not free or place_stated:
        return math.nan, math.nan
    values = np.concatenate([log.gnss.north_m, log.gnss.east_m])
    std_m = _measured(position_steps, values, LEAST_POSITION_STD_M, USUAL_POSITION_STD_M)
    if math.isnan(std_m) or not log.heading_is_of_position or turn_stated or settings.heading_std_deg != "auto":
        return std_m, math.nan
    # A heading has one axis, but `white_std_m` divides the variance among two axes.
    least, usual = (angle / math.sqrt(2.0) for angle in (LEAST_HEADING_STD_RAD, math.radians(USUAL_HEADING_STD_DEG)))
    return std_m, math.sqrt(2.0) * _measured(turn_steps, log.heading.heading_rad, least, usual)


def _measured(steps: FixSteps, values: Floats, least: float, usual: float) -> float:
    """Return the white noise of values (m,), at least their resolution; NaN if it is not well below `usual`.

    Values that are rounded to multiples of q have an error of q / sqrt(12), even if they do not change.
    """
    white = steps.white_std_m(np.ones(len(steps.step) + 1, np.bool_))
    between = np.diff(np.unique(values))
    resolution = float(between.min()) if len(between) else 0.0
    std = max(white, resolution / math.sqrt(12.0), least)
    return std if QUIETER * std < usual else math.nan
