"""A log cut into windows of driven distance between fixes, for calibration."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from icrtool.config import Config
from icrtool.errors import DataError
from icrtool.estimation.filter_setup import wheel_gap_s
from icrtool.kernels.equal_steps import rows_at_steps
from icrtool.records.tables import Complexes, Floats, Ints, RobotLog

SHORT_WINDOW_M = 1.0
SHORT_WINDOW_IN_GNSS_STD = 12.0
SHORT_WINDOW_IN_VALUES = 12.0
"""A window spans at least so many wheel values. One value held over much of a window would bias the wheel scales."""

LONG_WINDOW = 4.0
"""Long windows are this many times longer. Short ones determine delays and antenna; long ones scales, W and offset."""

LONGEST_WINDOW_S = 40.0
STARTS_A_WINDOW = 3
"""Windows overlap: so many start within one window length."""

HEADING_SMOOTHED_S = 0.2
"""The measured heading is averaged over this time about each sample: its slope is needed."""

FEWEST_WINDOWS = 20


class Evidence(NamedTuple):
    """A log cut into windows.

    Attributes
    ----------
    wheel_t, wheel_dt, v_left, v_right : (n,) wheel samples, `wheel_dt` 0 over gaps
    heading_t, heading : (h,) smoothed, unwrapped [rad]
    fix_t, fix : (m,) [s], complex north + j east [m]
    begin, end : (w,) rows of the fixes; long : (w,) 1 for long windows
    distance_m : (w,) driven distance by the wheels at the window's start
    """

    wheel_t: Floats
    wheel_dt: Floats
    v_left: Floats
    v_right: Floats
    heading_t: Floats
    heading: Floats
    fix_t: Floats
    fix: Complexes
    begin: Ints
    end: Ints
    long: Ints
    distance_m: Floats


class DriveFacts(NamedTuple):
    """Turns, speeds and distance of a drive.

    Attributes
    ----------
    turned_right_rad, turned_left_rad : sum of heading changes in each direction
    fastest_turn_radps : 95th percentile of the turn rate while turning
    speed_mps, speed_std_mps : mean and spread of the speed while moving
    distance_m : mean travel of both sides
    """

    turned_right_rad: float
    turned_left_rad: float
    fastest_turn_radps: float
    speed_mps: float
    speed_std_mps: float
    distance_m: float


def gather(log: RobotLog, config: Config) -> Evidence:
    """Return a log cut into short and long windows of driven distance between fixes, without gaps in the wheel data."""
    streams = {"wheel": log.wheels.stamp_ns, "position": log.gnss.stamp_ns, "heading": log.heading.stamp_ns}
    epoch = int(log.wheels.stamp_ns[0])
    wheel_t, fix_t, heading_t = ((stamps - epoch) / 1e9 for stamps in streams.values())
    interval = np.append(np.diff(wheel_t), 0.0)
    gap = interval > wheel_gap_s(config, wheel_t)
    dt = np.where(gap, 0.0, interval)
    travel = np.concatenate(
        [[0.0], np.cumsum(dt * (np.abs(log.wheels.v_left_mps) + np.abs(log.wheels.v_right_mps)) / 2)]
    )
    at_fix = np.interp(fix_t, wheel_t, travel[:-1])
    gaps_before = np.interp(fix_t, wheel_t, np.concatenate([[0.0], np.cumsum(gap)[:-1]]))
    known = np.sqrt((log.gnss.var_north_m2 + log.gnss.var_east_m2) / 2)
    known = known[np.isfinite(known) & (known < 100.0)]
    noise = float(np.median(known)) if len(known) else config.filter.gnss_std_m
    length = max(SHORT_WINDOW_M, SHORT_WINDOW_IN_GNSS_STD * noise, SHORT_WINDOW_IN_VALUES * _metres_per_value(log, dt))
    inside = (fix_t > max(wheel_t[0], heading_t[0]) + 1.0) & (fix_t < min(wheel_t[-1], heading_t[-1]) - 1.0)
    begins, ends, long = [], [], []
    for kind, size in enumerate((length, LONG_WINDOW * length)):
        begin = rows_at_steps(at_fix - at_fix[0], size / STARTS_A_WINDOW)
        end = np.searchsorted(at_fix, at_fix[np.minimum(begin, len(fix_t) - 1)] + size)
        fine = (begin < len(fix_t)) & (end < len(fix_t))
        begin, end = begin[fine], end[fine]
        whole = inside[begin] & inside[end] & (gaps_before[begin] == gaps_before[end])
        whole &= (fix_t[end] - fix_t[begin] < LONGEST_WINDOW_S) & (at_fix[end] - at_fix[begin] < 2.0 * size)
        begins.append(begin[whole])
        ends.append(end[whole])
        long.append(np.full(np.count_nonzero(whole), kind))
    begin, end, kinds = np.concatenate(begins), np.concatenate(ends), np.concatenate(long)
    if np.count_nonzero(kinds == 0) < FEWEST_WINDOWS:
        raise DataError(
            log.name,
            f"only {np.count_nonzero(kinds == 0)} windows of {length:.1f} m of driven distance",
            "drive longer to calibrate",
        )
    heading = _smoothed(np.unwrap(log.heading.heading_rad), heading_t)
    return Evidence(
        wheel_t, dt, log.wheels.v_left_mps, log.wheels.v_right_mps, heading_t, heading,
        fix_t, log.gnss.north_m + 1j * log.gnss.east_m, begin, end, kinds, at_fix[begin],
    )  # fmt: skip


def _metres_per_value(log: RobotLog, dt: Floats) -> float:
    """Return the mean distance [m] driven while one wheel value lasts; repeated values count once."""
    left, right = log.wheels.v_left_mps, log.wheels.v_right_mps
    travel = dt * (np.abs(left) + np.abs(right)) / 2
    values = sum(int(np.count_nonzero((np.diff(speed) != 0) & (travel[1:] > 0))) for speed in (left, right)) / 2
    return float(travel.sum()) / max(values, 1.0)


def summarise_drive(evidence: Evidence) -> DriveFacts:
    """Return turns, speeds and distance of the drive, from wheels and heading."""
    # Only seconds with samples, not all between the first and the last: a wrong stamp may be decades away.
    t, heading = evidence.heading_t, evidence.heading
    begins = t[0] + np.unique(np.floor(t - t[0]))
    begins = begins[begins + 1.0 <= t[-1]]
    turns = np.interp(begins + 1.0, t, heading) - np.interp(begins, t, heading)
    mean = (evidence.v_left + evidence.v_right) / 2
    moving = (np.abs(evidence.v_left) + np.abs(evidence.v_right)) > 0.05
    turning = np.abs(turns)[np.abs(turns) > math.radians(2)]
    return DriveFacts(
        turned_right_rad=float(turns[turns > 0].sum()),
        turned_left_rad=float(-turns[turns < 0].sum()),
        fastest_turn_radps=float(np.percentile(turning, 95)) if len(turning) else 0.0,
        speed_mps=float(np.abs(mean[moving]).mean()) if moving.any() else 0.0,
        speed_std_mps=float(mean[moving].std()) if moving.any() else 0.0,
        distance_m=float((evidence.wheel_dt * np.abs(mean)).sum()),
    )


def _smoothed(heading: Floats, times: Floats) -> Floats:
    """Return a heading averaged over `HEADING_SMOOTHED_S` about each sample; over less at the ends and at gaps."""
    low = np.searchsorted(times, times - HEADING_SMOOTHED_S / 2)
    high = np.searchsorted(times, times + HEADING_SMOOTHED_S / 2, side="right")
    # as many samples before as after, or the mean would belong to another time
    here = np.arange(len(times))
    reach = np.minimum(here - low, high - 1 - here)
    total = np.concatenate([[0.0], np.cumsum(heading - heading[0])])
    mean: Floats = heading[0] + (total[here + reach + 1] - total[here - reach]) / (2 * reach + 1)
    return mean
