"""Classification of fixes (fixed, float, other) by their messages and their motion, and the noise of each class.

A receiver that loses RTK drifts away by decimetres and jumps back when it is fixed again. Its float errors last for
tens of seconds. If they were treated as independent, the filter would follow them. Some drivers still state a
centimetre. Such fixes are found by their noise, most clearly before or after a jump, or between a jump and its return.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from icrtool.alignment.sensor_noise import (
    FEWEST_NOISE_STEPS,
    LARGEST_SANE_GNSS_STD_M,
    NOISIER,
    FixSteps,
    fixes_of,
    unstated_position_std_m,
)
from icrtool.config import Config
from icrtool.kernels.arrays import Bools, Bytes, Floats, Ints
from icrtool.records.measurements import Fixes, FixStatistics
from icrtool.records.notes import Note, note, notes_about
from icrtool.records.samples import FIXED_FIX, FLOAT_FIX, NOT_STATED, OTHER_FIX, RTK_FIX
from icrtool.records.tables import RobotLog

REFERENCE = 0
"""Class of the fixes of a metric reference."""

CLASSES = {REFERENCE: "reference", OTHER_FIX: "other", FLOAT_FIX: "float", FIXED_FIX: "fixed"}
"""Classes by name. A metric pose (lidar, total station, motion capture) is a reference, and has one class."""

FIXED_STD_M = 0.1
"""Largest stated standard deviation of a fixed solution [m]. nmea_navsat_driver states 0.02 m times HDOP for a fixed
solution and 4 m for float."""

SURELY_FIXED_STD_M = 0.05
"""Stated standard deviation below which a fix without a status is a fixed solution [m]."""

NORM_SHARE = 0.5
"""Share of fixed solutions from which on they are the norm. The other fixes are then RTK losses."""

CLASS_STD_M = {OTHER_FIX: 1.0, FLOAT_FIX: 0.4}
"""Smallest standard deviation of fixes that are not fixed, in a log where fixed is the norm [m]."""

CORRELATION_S = 10.0
"""Correlation time of the errors of such fixes [s]."""

SHORTEST_LOSS_S = 2.0
"""Shortest span without a fixed solution that counts as a loss of RTK [s]."""


class GnssQuality(NamedTuple):
    """Classes of the fixes of a log, and their noise.

    Attributes
    ----------
    fixes : fixes with their classes and the variances to use
    statistics : noise of each class
    losses_ns : (k, 2) half-open spans without RTK [ns], in a log where fixed is the norm
    notes : findings about fixes that are not fixed, and about noise
    """

    fixes: Fixes
    statistics: FixStatistics
    losses_ns: Ints
    notes: tuple[Note, ...]


def grade_fixes(log: RobotLog, config: Config, steps: FixSteps, measured_m: float = math.nan) -> GnssQuality:
    """Return the classes of the fixes, and the noise of each class.

    The order of evidence: the status, flags or solution type in the message; the stated variance; the motion of the
    fixes relative to the wheels. A stretch that is noisier than the rest, or lies between two jumps that cancel each
    other, is not a fixed solution. If fixed is the norm, the other fixes get the variance of their class, times the
    number of samples with a common error. Preset ``paper`` takes every fix as it is.

    Parameters
    ----------
    log : the log
    config : the configuration
    steps : steps between the fixes minus the motion of the wheels
    measured_m : as in `icrtool.alignment.sensor_noise.fixes_of`
    """
    gnss, changes = log.gnss, config.filter.rules.measures_noise
    stated = np.sqrt((gnss.var_north_m2 + gnss.var_east_m2) / 2)
    kinds, misreported = _classes(log, stated, steps)
    fixed = kinds == FIXED_FIX
    norm = bool(np.count_nonzero(fixed) >= NORM_SHARE * len(kinds)) and changes
    variance = np.column_stack([gnss.var_north_m2, gnss.var_east_m2])
    white, raised = dict[str, float](), dict[str, float]()
    for code, name in CLASSES.items():
        rows = kinds == code
        std = white[name] = steps.white_std_m(rows)
        if not (changes and rows.any() and math.isfinite(std)):
            continue
        silent_m2 = unstated_position_std_m(config.filter) ** 2
        stated_variance = np.where(np.isfinite(variance[rows]) & (variance[rows] > 0), variance[rows], silent_m2)
        if std**2 > NOISIER**2 * float(np.median(stated_variance)):
            variance[rows], raised[name] = np.maximum(stated_variance, std**2), std
    down = ~fixed & norm
    variance[down] = _of_class(variance, kinds, gnss.stamp_ns)[down]
    if raised or down.any():
        gnss = replace(gnss, var_north_m2=variance[:, 0].copy(), var_east_m2=variance[:, 1].copy())
    fixes = replace(
        fixes_of(gnss, config.filter, measured_m), fix_class=kinds, misreported=misreported, down_weighted=down
    )
    used_std = np.sqrt((gnss.var_north_m2 + gnss.var_east_m2) / 2)
    known_std = {name: used_std[(kinds == code) & np.isfinite(used_std)] for code, name in CLASSES.items()}
    std_m = {name: float(np.median(stds)) if len(stds) else math.nan for name, stds in known_std.items()}
    losses = _losses(gnss.stamp_ns, fixed) if norm else np.empty((0, 2), np.int64)
    notes = _notes(fixes, stated, used_std, raised, changes=changes)
    return GnssQuality(fixes, FixStatistics(std_m, white), losses, notes_about(log.name, notes))


def _classes(log: RobotLog, stated: Floats, steps: FixSteps) -> tuple[Bytes, Bools]:
    """Return the class of each fix (m,), and which fixes are wrongly reported as fixed (m,)."""
    gnss, none = log.gnss, np.zeros(len(stated), np.bool_)
    if log.datum is None:
        return np.full(len(stated), REFERENCE, np.uint8), none
    status = np.full(len(stated), NOT_STATED, np.uint8) if gnss.stated_class is None else gnss.stated_class
    rtk = np.where(stated > FIXED_STD_M, FLOAT_FIX, FIXED_FIX)
    silent = np.where(stated <= SURELY_FIXED_STD_M, FIXED_FIX, OTHER_FIX)
    kinds = np.select([status == RTK_FIX, status == NOT_STATED], [rtk, silent], status)
    misreported = find_misreported(log.gnss.stamp_ns, steps, kinds == FIXED_FIX, status == FIXED_FIX)
    return np.where(misreported, FLOAT_FIX, kinds).astype(np.uint8), misreported


def _of_class(variance: Floats, kinds: Bytes, stamps: Ints) -> Floats:
    """Return the variances (m, 2) of fixes that are not fixed.

    A variance is at least the variance of the class of the fix, times the number of fixes that share one error.
    """
    least = np.select([kinds == code for code in CLASS_STD_M], list(CLASS_STD_M.values()), 0.0)[:, None]
    interval = float(np.median(np.diff(stamps))) / 1e9 if len(stamps) > 1 else 0.0
    group_size = max(1.0, 2.0 * CORRELATION_S / interval) if interval > 0 else 1.0
    own_variance = np.maximum(np.where(np.isfinite(variance), variance, 0.0), least**2)
    # Above the largest accepted value the filter would treat the variance as unknown and the fix as a good one.
    grown: Floats = np.minimum(group_size * own_variance, (LARGEST_SANE_GNSS_STD_M / 2) ** 2)
    return grown


def _losses(stamps: Ints, fixed: Bools) -> Ints:
    """Return the long spans without a fixed solution, from the last fixed fix before to the next fixed fix.

    Fixes that are not fixed at the start or the end of the log also make a span.
    """
    rows = np.flatnonzero(fixed)
    edge = np.concatenate([[-1], rows, [len(stamps)]])
    times = stamps[np.clip(edge, 0, len(stamps) - 1)]
    lost = (np.diff(edge) > 1) & (np.diff(times) > SHORTEST_LOSS_S * 1e9)
    # A span that reaches to the end of the log includes the last fix.
    ends = times[1:] + (edge[1:] == len(stamps))
    return np.column_stack([times[:-1][lost], ends[lost]])


def _notes(fixes: Fixes, stated: Floats, used_std: Floats, raised: dict[str, float], *, changes: bool) -> list[Note]:
    """Return findings on fixes that are not fixed, and on classes whose noise was raised to their scatter.

    Parameters
    ----------
    stated, used_std : (m,) stated standard deviation of each fix, and the one that is used [m]
    raised : raised standard deviation of each class [m]
    changes : whether the preset changes the noise
    """

    def accuracy(rows: Bools, silent: str) -> str:
        stds = stated[rows & np.isfinite(stated) & (stated > 0)]
        return f"±{np.median(stds):.2g} m" if len(stds) else silent

    notes, misreported = [], fixes.misreported
    down = fixes.down_weighted & ~misreported
    count, down_count = (
        f"{np.count_nonzero(rows):,} fixes ({100 * np.count_nonzero(rows) / len(rows):.0f} %)"
        for rows in (misreported, down)
    )
    if misreported.any():
        text = f"{count} state {accuracy(misreported, 'that they are fixed')} but scatter or jump like RTK float"
        notes.append(note("gnss_float_as_fixed", f"{text}{': taken as float' if changes else ''}"))
    if down.any():
        used = f"they are used with ±{np.median(used_std[down]):.2g} m"
        notes.append(note("gnss_not_fixed", f"{down_count} are not RTK fixed, unlike most fixes of this log: {used}"))
    for code, name in CLASSES.items():
        rows = fixes.fix_class == code
        if name in raised and not fixes.down_weighted[rows].all():
            kind = {REFERENCE: "poses", FIXED_FIX: "fixes"}.get(code, f"{name} fixes")
            scatter = f"scatter by {raised[name]:.2g} m: the scatter is used"
            notes.append(note("gnss_noise_raised", f"the {kind} state {accuracy(rows, 'no accuracy')} and {scatter}"))
    return notes


USUAL_M2 = 2 * 0.005**2
"""Smallest variance of a stretch for comparisons, both axes together [m^2]."""

STRETCH_VARIANCE = 9.0
"""Ratio of a stretch's white variance to the usual one from which on it is float, unless its messages state that it is
fixed. The usual variance is measured while the robot moves, since jitter of the stamps then adds noise."""

STRETCHES_PER_SIDE = 5
"""Number of stretches before a jump, and number of stretches after it, that are compared."""

SIDES_VARIANCE = 1.7
"""Ratio of the variances before and after a jump above which the noisier side is float."""

LONGEST_EXCURSION_S = 60.0
"""Longest time between two jumps that cancel each other [s]. The fixes between two such jumps are wrong."""

TAKEN_BACK = 0.25
"""Largest share of the first jump that remains after two jumps that cancel each other."""

MOST_RTK_JUMPS = 500
"""Largest number of jumps of a receiver that sometimes loses RTK. With more, the reference has another kind of
error."""


def find_misreported(stamps: Ints, steps: FixSteps, claimed: Bools, flagged: Bools) -> Bools:
    """Return a mask of the fixes (m,) that are reported as fixed and move like RTK float.

    A jump alone does not show which of its sides is wrong; noise, or a second jump back, shows it. Otherwise the class
    is not changed.

    Parameters
    ----------
    stamps : (m,) stamps of the fixes [ns]
    steps : steps from fix to fix
    claimed : (m,) mask of the fixes that are reported as fixed
    flagged : (m,) mask of the fixes that are reported as fixed by a flag, not only by their variance
    """
    misreported = np.zeros(len(claimed), np.bool_)
    level, moves = steps.stretches(claimed)
    levels, moving = level[np.isfinite(level)], level[np.isfinite(level) & moves]
    if len(levels) < 2:
        return misreported
    usual = max(float(np.median(moving if len(moving) >= 2 else levels)), USUAL_M2)
    with np.errstate(invalid="ignore"):
        noisy = level > STRETCH_VARIANCE * usual
    noisy &= ~flagged[1 : 1 + len(level) * FEWEST_NOISE_STEPS].reshape(-1, FEWEST_NOISE_STEPS).any(axis=1)
    jumps = np.flatnonzero(claimed[steps.jump_row] & claimed[np.maximum(steps.jump_row - 1, 0)])
    averaged, nearby = _moving_mean(level, STRETCHES_PER_SIDE), _moving_mean(level, 3)
    undecided = []
    for jump in jumps.tolist() if len(jumps) <= MOST_RTK_JUMPS else ():
        float_side = _noisy_side(averaged, nearby, moves, (int(steps.jump_row[jump]) - 1) // FEWEST_NOISE_STEPS)
        noisy[float_side] = True
        if float_side.start == float_side.stop:
            undecided.append(jump)
    misreported[1 : 1 + len(level) * FEWEST_NOISE_STEPS] = np.repeat(noisy, FEWEST_NOISE_STEPS)
    for jump, back in pairwise(undecided):
        first, last = steps.jump_row[[jump, back]]
        away, home = steps.step[[first - 1, last - 1]]
        short = back == jump + 1 and stamps[last] - stamps[first] < LONGEST_EXCURSION_S * 1e9
        if short and abs(away + home) < TAKEN_BACK * min(abs(away), abs(home)):
            misreported[first:last] = True
    return misreported & claimed


def _moving_mean(level: Floats, width: int) -> Floats:
    """Return the mean of the finite numbers in a window of `width` about each entry (n,); NaN without such numbers."""
    kernel, is_known = np.ones(width), np.isfinite(level)
    total = np.convolve(np.where(is_known, level, 0.0), kernel, "same")[: len(level)]
    count = np.convolve(is_known.astype(np.float64), kernel, "same")[: len(level)]
    mean = np.full(len(level), np.nan)
    np.divide(total, count, out=mean, where=count > 0.5)
    return mean


def _noisy_side(averaged: Floats, nearby: Floats, moves: Bools, at: int) -> slice:
    """Return the float stretches before or after a jump in stretch `at`; empty where noise does not show the side."""
    before, after = at - 1 - STRETCHES_PER_SIDE // 2, at + 1 + STRETCHES_PER_SIDE // 2
    if before < 0 or after >= len(averaged) or not np.isfinite(averaged[[before, after]]).all():
        return slice(0, 0)
    half = STRETCHES_PER_SIDE // 2
    if moves[before - half : before + half + 1].any() != moves[after - half : after + half + 1].any():
        # While the robot is parked, fixes of all classes have less noise, so that the sides cannot be compared.
        return slice(0, 0)
    left, right = max(float(averaged[before]), USUAL_M2), max(float(averaged[after]), USUAL_M2)
    if max(left, right) < SIDES_VARIANCE * min(left, right):
        return slice(0, 0)
    bound = (left * right) ** 0.5
    with np.errstate(invalid="ignore"):
        quiet = np.flatnonzero(~(nearby >= bound))
    if left > right:
        ends = quiet[quiet < at - 1]
        return slice(int(ends[-1]) + 1 if len(ends) else 0, at + 1)
    ends = quiet[quiet > at + 1]
    return slice(at, int(ends[0]) if len(ends) else len(nearby))
