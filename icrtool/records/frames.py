"""A log from data frames, or from one table: columns are found by their names, which end in their units.

Stamps: ``stamp_ns``, or ``t_s`` (seconds). Of each group one pair or column is needed; a row without numbers in it is
no sample of that group.

======== ==============================================================================================================
wheels   ``v_left_mps, v_right_mps`` · ``v_left_radps, v_right_radps`` · ``pos_left_m, pos_right_m`` ·
         ``pos_left_rad, pos_right_rad`` · ``pos_left_counts, pos_right_counts`` (forward positive)
position ``north_m, east_m`` · ``latitude_deg, longitude_deg`` (WGS 84; with ``height_m``, else 0);
         optional ``north_std_m, east_std_m`` or ``position_std_m``
heading  ``heading_rad`` · ``heading_deg`` (clockwise from north) · ``yaw_rad`` · ``yaw_deg`` (counter-clockwise from
         east); optional ``heading_std_rad`` or ``heading_std_deg``
gyro     ``turn_rate_radps`` (clockwise) · ``yaw_rate_radps`` (counter-clockwise)
======== ==============================================================================================================
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from icrtool.errors import DataError
from icrtool.kernels.arrays import Floats, Ints
from icrtool.records.samples import (
    Datum,
    GyroSamples,
    HeadingSamples,
    PositionFixes,
    Role,
    StreamChoice,
    WheelSamples,
    WheelUnit,
    rate_and_jitter,
)

if TYPE_CHECKING:
    import pandas as pd

WHEELS: dict[tuple[str, ...], tuple[WheelUnit, bool]] = {
    ("v_left_mps", "v_right_mps"): ("m", False),
    ("v_left_radps", "v_right_radps"): ("rad", False),
    ("pos_left_m", "pos_right_m"): ("m", True),
    ("pos_left_rad", "pos_right_rad"): ("rad", True),
    ("pos_left_counts", "pos_right_counts"): ("counts", True),
}
"""By names of the columns: unit, and whether they are positions."""

POSITION = (("north_m", "east_m"), ("latitude_deg", "longitude_deg"))
HEADING = (("heading_rad",), ("heading_deg",), ("yaw_rad",), ("yaw_deg",))
GYRO = (("turn_rate_radps",), ("yaw_rate_radps",))

LATEST_S = 4e9
"""Limit of stamps, the year 2096: differences of larger stamps may overflow 64 bits of nanoseconds."""

LARGEST_STD = 1e9
"""A stated standard deviation from here on [m, rad] is taken as not known."""


class Parts(NamedTuple):
    """The parts of a log that data frames give."""

    wheels: WheelSamples
    gnss: PositionFixes
    datum: Datum | None
    heading: HeadingSamples
    gyro: GyroSamples | None
    streams: tuple[StreamChoice, ...]
    warnings: tuple[str, ...]


def parts_from_frames(
    wheels: pd.DataFrame, position: pd.DataFrame, heading: pd.DataFrame, gyro: pd.DataFrame | None, name: str
) -> Parts:
    """Return the samples in one data frame a sensor, with the columns above; all stamps on one clock.

    A frame may be the same for several sensors. `name` is that of the log, for errors.

    Raises
    ------
    DataError
        A column is missing, holds a value that is not a number, or has fewer than two samples; the column is named.
    """
    samples, wheel_columns = _wheels(wheels, name)
    fixes, datum, position_columns = _position(position, name)
    headings, heading_columns = _heading(heading, name)
    streams = (
        _stream("wheels", wheel_columns, samples.stamp_ns, "position" if samples.from_position else "speed"),
        _stream("gnss", position_columns, fixes.stamp_ns, "geodetic" if datum is not None else "metric"),
        _stream("heading", heading_columns, headings.stamp_ns, "clockwise from north"),
    )
    rates = _gyro(gyro, name) if gyro is not None and any(column in gyro for (column,) in GYRO) else None
    chosen = (("wheels", wheels, wheel_columns), ("position", position, position_columns),
              ("heading", heading, heading_columns))  # fmt: skip
    warnings = []
    for group, frame, columns in chosen:
        clock, seconds, sound = _stamped(frame, columns, group, name)
        if back := np.count_nonzero(np.diff(seconds[sound]) < 0):
            warnings.append(f"{name}: {group}: {clock} goes back at {back} rows; rows are sorted by it")
    return Parts(samples, fixes, datum, headings, rates, streams, tuple(warnings))


def _chosen(frame: pd.DataFrame, options: Sequence[tuple[str, ...]], group: str, name: str) -> tuple[str, ...]:
    """Return the first of the column groups of which the frame has all.

    Raises
    ------
    DataError
        No group is complete.
    """
    for columns in options:
        if all(column in frame for column in columns):
            return columns
    half = [column for columns in options for column in columns if column in frame]
    found = f"only {half[0]} of a pair" if half else f"the columns are {', '.join(map(str, list(frame)[:12]))}"
    wanted = " or ".join(" and ".join(columns) for columns in options)
    raise DataError(name, f"{group}: no column {wanted}", found)


def _numbers(frame: pd.DataFrame, column: str, name: str) -> Floats:
    """Return a column (n,), NaN where it is empty."""
    try:
        return np.asarray(frame[column], np.float64)
    except (TypeError, ValueError, OverflowError) as err:
        raise DataError(name, f"column {column}: holds a value that is not a number", str(err)) from err


def _rows(frame: pd.DataFrame, columns: Sequence[str], group: str, name: str) -> tuple[Ints, list[Floats]]:
    """Return stamps (n,), strictly increasing, and columns of the rows that have numbers in all of them."""
    clock, seconds, sound = _stamped(frame, columns, group, name)
    if np.any(np.abs(seconds[sound]) > LATEST_S):
        raise DataError(name, f"column {clock}: a stamp of {np.abs(seconds[sound]).max():.3g} s", "is it in its unit?")
    if clock == "t_s":
        stamps = np.round(seconds[sound] * 1e9).astype(np.int64)
    else:
        stamps = np.asarray(frame[clock])[sound].astype(np.int64)
    # Of equal stamps the last row stays.
    stamps, last = np.unique(stamps[::-1], return_index=True)
    if len(stamps) < 2:
        raise DataError(name, f"{group}: {len(stamps)} rows have numbers in {' and '.join(columns)}", "two are needed")
    rows = len(np.flatnonzero(sound)) - 1 - last
    return stamps, [np.ascontiguousarray(_numbers(frame, column, name)[sound][rows]) for column in columns]


def _stamped(
    frame: pd.DataFrame, columns: Sequence[str], group: str, name: str
) -> tuple[str, Floats, NDArray[np.bool_]]:
    """Return the column of stamps, its values [s] (rows,), and which rows have numbers in it and in `columns`."""
    (clock,) = _chosen(frame, (("stamp_ns",), ("t_s",)), group, name)
    seconds = _numbers(frame, clock, name) * (1.0 if clock == "t_s" else 1e-9)
    values = [seconds, *(_numbers(frame, column, name) for column in columns)]
    return clock, seconds, np.logical_and.reduce(np.isfinite(values))


def _wheels(frame: pd.DataFrame, name: str) -> tuple[WheelSamples, tuple[str, ...]]:
    columns = _chosen(frame, tuple(WHEELS), "wheels", name)
    unit, is_position = WHEELS[columns]
    stamps, (left, right) = _rows(frame, columns, "wheels", name)
    if is_position:
        interval = np.diff(stamps) / 1e9
        left, right = (np.append(np.diff(side) / interval, 0.0) for side in (left, right))
        left[-1], right[-1] = left[-2], right[-2]
    return WheelSamples(stamps, left, right, unit, is_position), columns


def _position(frame: pd.DataFrame, name: str) -> tuple[PositionFixes, Datum | None, tuple[str, ...]]:
    columns = _chosen(frame, POSITION, "position", name)
    stds = next((pair for pair in (("north_std_m", "east_std_m"), ("position_std_m",) * 2) if pair[0] in frame), ())
    beside = [column for column in dict.fromkeys((*stds, "height_m")) if column in frame]
    stamps, (first, second) = _rows(frame, columns, "position", name)
    extra = {column: _at(frame, column, columns, stamps, name) for column in beside}
    unknown, datum, north, east = np.full(len(stamps), np.nan), None, first, second
    if columns == POSITION[1]:
        from pymap3d import geodetic2ned

        if np.any(np.abs(first) > 90) or np.any(np.abs(second) > 360):
            raise DataError(name, "column latitude_deg or longitude_deg: not degrees", "are they in radians, or E7?")
        height = np.nan_to_num(extra.get("height_m", unknown))
        datum = Datum(float(first[0]), float(second[0]), float(height[0]))
        north, east, _ = geodetic2ned(first, second, height, datum.latitude_deg, datum.longitude_deg, datum.height_m)
    # Of a standard deviation that is no real one, the square may overflow.
    real = {std: np.where(np.abs(extra[std]) < LARGEST_STD, extra[std], np.nan) for std in stds}
    var_north, var_east = (real[stds[0]] ** 2, real[stds[1]] ** 2) if stds else (unknown, unknown.copy())
    covariance = np.zeros(len(stamps)) if stds else unknown.copy()
    return PositionFixes(stamps, np.asarray(north), np.asarray(east), var_north, var_east, covariance), datum, columns


def _at(frame: pd.DataFrame, column: str, group: Sequence[str], stamps: Ints, name: str) -> Floats:
    """Return an optional column (n,) at the stamps of a group, NaN where it is empty."""
    filled = frame[np.isfinite(_numbers(frame, column, name))]
    out = np.full(len(stamps), np.nan)
    if len(filled) >= 2:
        at, values = _rows(filled, [*group, column], column, name)
        out[np.searchsorted(stamps, at)] = values[-1]
    return out


def _heading(frame: pd.DataFrame, name: str) -> tuple[HeadingSamples, tuple[str, ...]]:
    columns = _chosen(frame, HEADING, "heading", name)
    stamps, (angle,) = _rows(frame, columns, "heading", name)
    angle = np.radians(angle) if columns[0].endswith("_deg") else angle
    heading = math.pi / 2 - angle if columns[0].startswith("yaw") else angle
    std = np.full(len(stamps), np.nan)
    for column, unit in (("heading_std_rad", 1.0), ("heading_std_deg", math.pi / 180)):
        if column in frame:
            std = unit * _at(frame, column, columns, stamps, name)
            std[np.abs(std) >= LARGEST_STD] = np.nan
            break
    return HeadingSamples(stamps, np.pi - np.mod(np.pi - heading, 2 * np.pi), std**2), columns


def _gyro(frame: pd.DataFrame, name: str) -> GyroSamples:
    columns = _chosen(frame, GYRO, "gyro", name)
    stamps, (rate,) = _rows(frame, columns, "gyro", name)
    return GyroSamples(columns[0], stamps, rate if columns == GYRO[0] else -rate)


def _stream(role: Role, columns: tuple[str, ...], stamps: Ints, why: str) -> StreamChoice:
    rate, jitter = rate_and_jitter(stamps)
    return StreamChoice(role, " + ".join(columns), "table", len(stamps), rate, "header", jitter, f"columns; {why}")
