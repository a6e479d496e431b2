"""The tables that packages exchange: a robot's log, which may be made of data frames, and the states of a run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from html import escape
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from icrtool.errors import DataError
from icrtool.kernels.arrays import Bools, Floats, Ints
from icrtool.records.notes import Note, note, warnings_of
from icrtool.records.samples import (
    Datum,
    GyroAxes,
    GyroSamples,
    HeadingSamples,
    HeadingSensor,
    InputFile,
    OtherReceiver,
    PositionFixes,
    Role,
    StreamChoice,
    WheelSamples,
    WheelUnit,
    rate_and_jitter,
)
from icrtool.records.text import LogText

if TYPE_CHECKING:
    import pandas as pd

Icrs = tuple[float, float, float]
"""y_icr_right, y_icr_left, x_icr [m]."""

LARGEST_STATE = 1e30
"""Largest number of a state or a measurement. Squares of larger numbers may overflow."""

WHEEL_COLUMN_UNITS: dict[tuple[str, ...], tuple[WheelUnit, bool]] = {
    ("v_left_mps", "v_right_mps"): ("m", False),
    ("v_left_radps", "v_right_radps"): ("rad", False),
    ("pos_left_m", "pos_right_m"): ("m", True),
    ("pos_left_rad", "pos_right_rad"): ("rad", True),
    ("pos_left_counts", "pos_right_counts"): ("counts", True),
}
"""Columns of wheels in data frames: for each pair its unit, and whether it holds positions."""

POSITION = (("north_m", "east_m"), ("latitude_deg", "longitude_deg"))
POSITION_STD = (("north_std_m", "east_std_m"), ("position_std_m", "position_std_m"))
HEADING_COLUMNS = (("heading_rad",), ("heading_deg",), ("yaw_rad",), ("yaw_deg",))
GYRO_COLUMNS = (("turn_rate_radps",), ("yaw_rate_radps",))
HEADING_STD = (("heading_std_rad", 1.0), ("heading_std_deg", math.pi / 180))
"""Columns of the standard deviation of headings, each with its unit in radians."""

CLOCK_COLUMNS, HEIGHT_COLUMN = (("stamp_ns",), ("t_s",)), "height_m"

TABLE_COLUMNS = {
    HEIGHT_COLUMN, *(name for name, _ in HEADING_STD),
    *(name for group in (*WHEEL_COLUMN_UNITS, *POSITION, *POSITION_STD, *HEADING_COLUMNS, *GYRO_COLUMNS, *CLOCK_COLUMNS)
      for name in group),
}  # fmt: skip
"""Columns of data frames that a log can use."""

LATEST_S = 4e9
"""Limit of stamps, the year 2096: differences of larger stamps may overflow 64 bits of nanoseconds."""

LARGEST_STD = 1e9
"""Largest stated standard deviation that counts [m, rad]; larger values are taken as not known."""


@dataclass(frozen=True, slots=True, repr=False)
class RobotLog:
    """Measurements of a robot on one drive: the tables that the filter needs, and their sources.

    Attributes
    ----------
    datum : origin of the local plane; None where the position reference is metric (total station, lidar, motion
        capture)
    rejected_fixes : number of fixes dropped while reading, by reason (``no fix``, ``not finite`` ...)
    notes : findings, in the order they were made
    antenna_m : position of the antenna from the body origin by the transforms in the log, forward and right [m]; None
        without such a transform
    gyro : turn rates of an inertial unit, None without an inertial unit; the filter does not use them
    heading : headings; no row where no topic states a heading
    gyros : all inertial units with turn rates, all axes
    other_receivers : further GNSS receivers
    other_references : the same log with each other position reference that it holds, and the heading of that reference
    slipping_ns : (k, 2) starts and ends of the slip events in the log, in which the wheels do not show the motion
    heading_sensor : the topic that states the heading, None without a heading
    """

    name: str
    wheels: WheelSamples
    gnss: PositionFixes
    heading: HeadingSamples
    datum: Datum | None
    streams: tuple[StreamChoice, ...]
    inputs: tuple[InputFile, ...]
    rejected_fixes: dict[str, int]
    notes: tuple[Note, ...]
    antenna_m: tuple[float, float] | None = None
    gyro: GyroSamples | None = None
    gyros: tuple[GyroAxes, ...] = ()
    other_receivers: tuple[OtherReceiver, ...] = ()
    other_references: tuple[RobotLog, ...] = ()
    slipping_ns: tuple[tuple[int, int], ...] = ()
    heading_sensor: HeadingSensor | None = None

    @classmethod
    def from_frames(
        cls, wheels: pd.DataFrame, position: pd.DataFrame, heading: pd.DataFrame, gyro: pd.DataFrame | None = None,
        name: str = "table",
    ) -> RobotLog:  # fmt: skip
        """Return a log from one data frame for each sensor, or one frame for several; all stamps on one clock.

        Columns are found by their names, which end with the unit. Stamps are in ``stamp_ns`` or ``t_s`` (seconds). Each
        group needs one of its pairs or columns. A row without numbers in these columns is no sample of the group.

        ======== ======================================================================================================
        wheels   ``v_left_mps, v_right_mps`` · ``v_left_radps, v_right_radps`` · ``pos_left_m, pos_right_m`` ·
                 ``pos_left_rad, pos_right_rad`` · ``pos_left_counts, pos_right_counts`` (forward positive)
        position ``north_m, east_m`` · ``latitude_deg, longitude_deg`` (WGS 84; with ``height_m``, else 0);
                 optional ``north_std_m, east_std_m`` or ``position_std_m``
        heading  ``heading_rad`` · ``heading_deg`` (clockwise from north) · ``yaw_rad`` · ``yaw_deg`` (counter-clockwise
                 from east); optional ``heading_std_rad`` or ``heading_std_deg``
        gyro     ``turn_rate_radps`` (clockwise) · ``yaw_rate_radps`` (counter-clockwise)
        ======== ======================================================================================================

        Parameters
        ----------
        name : name of the log

        Raises
        ------
        DataError
            A column is missing, holds a value that is not a number, or has fewer than two samples; the column is named.
        """
        samples, wheel_columns = _wheels(wheels, name)
        fixes, datum, position_columns = _position(position, name)
        headings, heading_columns = _heading(heading, name)
        rates = None
        if gyro is not None and any(column in gyro for (column,) in GYRO_COLUMNS):
            column = _chosen(gyro, GYRO_COLUMNS, "gyro", name)
            stamps, (rate,) = _rows(gyro, column, "gyro", name)
            rates = GyroSamples(column[0], stamps, rate if column == GYRO_COLUMNS[0] else -rate)
        wheel_kind = "position" if samples.from_position else "speed"
        roles: tuple[tuple[Role, str, pd.DataFrame, tuple[str, ...], Ints, str], ...] = (
            ("wheels", "wheels", wheels, wheel_columns, samples.stamp_ns, wheel_kind),
            ("gnss", "position", position, position_columns, fixes.stamp_ns, "metric" if datum is None else "geodetic"),
            ("heading", "heading", heading, heading_columns, headings.stamp_ns, "clockwise from north"),
        )
        streams, notes = [], []
        for role, group, frame, columns, stamps, kind in roles:
            rate_hz, jitter_ms = rate_and_jitter(stamps)
            why = f"columns; {kind}"
            streams.append(
                StreamChoice(role, " + ".join(columns), "table", len(stamps), rate_hz, "header", jitter_ms, why)
            )
            clock, seconds, sound = _stamped(frame, columns, group, name)
            if back := np.count_nonzero(np.diff(seconds[sound]) < 0):
                text = f"{group}: {clock} goes back at {back} rows; rows are sorted by it"
                notes.append(note("rows_sorted", text, LogText(name)))
        return cls(LogText(name), samples, fixes, headings, datum, tuple(streams), (), {}, tuple(notes), gyro=rates)

    @property
    def warnings(self) -> tuple[str, ...]:
        """The findings as sentences for people."""
        return warnings_of(self.notes)

    def topic(self, role: Role, unknown: str = "") -> str:
        """Return the topic of the stream with a role."""
        return next((stream.topic for stream in self.streams if stream.role == role), unknown)

    @property
    def heading_is_of_position(self) -> bool:
        """Whether heading and position are fields of the same messages."""
        return self.topic("heading") == self.topic("gnss") != ""

    def __repr__(self) -> str:
        stamps = {"wheels": self.wheels.stamp_ns, "gnss": self.gnss.stamp_ns, "heading": self.heading.stamp_ns}
        spans = [of_role[[0, -1]] for of_role in stamps.values() if len(of_role)]
        duration_s = (max(int(span[1]) for span in spans) - min(int(span[0]) for span in spans)) / 1e9 if spans else 0.0
        counts = ", ".join(f"{len(of_role):,} {role}" for role, of_role in stamps.items())
        return f"<RobotLog {self.name!r}: {duration_s:.1f} s, {counts}, {len(self.warnings)} warnings>"

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><td>{escape(stream.role)}</td><td>{escape(stream.topic)}</td><td>{escape(stream.message_type)}</td>"
            f"<td>{stream.count:,}</td><td>{'' if stream.rate_hz is None else f'{stream.rate_hz:.1f} Hz'}</td></tr>"
            for stream in self.streams
        )
        heads = "".join(f"<th>{head}</th>" for head in ("stream", "topic", "type", "samples", "rate"))
        return f"<p>{escape(repr(self))}</p><table><tr>{heads}</tr>{rows}</table>"


def _chosen(frame: pd.DataFrame, options: Sequence[tuple[str, ...]], group: str, name: str) -> tuple[str, ...]:
    """Return the first column group that is complete in the frame.

    Raises
    ------
    DataError
        No group is complete.
    """
    for columns in options:
        if all(column in frame for column in columns):
            return columns
    half = [column for columns in options for column in columns if column in frame]
    names = list(frame.attrs.get("names", frame))[:12]
    problem = f"only {half[0]} of a pair" if half else f"the columns are {', '.join(map(str, names))}"
    wanted = " or ".join(" and ".join(dict.fromkeys(columns)) for columns in options)
    raise DataError(name, f"{group}: no column {wanted}", problem)


def _numbers(frame: pd.DataFrame, column: str, name: str) -> Floats:
    """Return a column (n,) as numbers, NaN for empty cells."""
    try:
        return np.asarray(frame[column], np.float64)
    except (TypeError, ValueError, OverflowError) as err:
        raise DataError(name, f"column {column}: holds a value that is not a number", str(err)) from err


def _values(frame: pd.DataFrame, column: str, name: str) -> Floats:
    """Return a column (n,) of measurements; a number above `LARGEST_STATE` becomes infinite, as in messages."""
    values = _numbers(frame, column, name)
    return np.where(np.abs(values) > LARGEST_STATE, np.copysign(np.inf, values), values)


def _rows(frame: pd.DataFrame, columns: Sequence[str], group: str, name: str) -> tuple[Ints, list[Floats]]:
    """Return stamps (n,), strictly increasing, and columns (n,) of the rows with numbers in all columns."""
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
    return stamps, [np.ascontiguousarray(_values(frame, column, name)[sound][rows]) for column in columns]


def _stamped(frame: pd.DataFrame, columns: Sequence[str], group: str, name: str) -> tuple[str, Floats, Bools]:
    """Return the name of the stamp column, its values (rows,) [s], and which rows (rows,) have all their numbers."""
    (clock,) = _chosen(frame, CLOCK_COLUMNS, group, name)
    seconds = _numbers(frame, clock, name) * (1.0 if clock == "t_s" else 1e-9)
    values = [seconds, *(_values(frame, column, name) for column in columns)]
    return clock, seconds, np.logical_and.reduce(np.isfinite(values))


def _wheels(frame: pd.DataFrame, name: str) -> tuple[WheelSamples, tuple[str, ...]]:
    """Return the wheel samples of a table, in the unit of its columns, and the names of these columns."""
    columns = _chosen(frame, tuple(WHEEL_COLUMN_UNITS), "wheels", name)
    unit, is_position = WHEEL_COLUMN_UNITS[columns]
    stamps, (left, right) = _rows(frame, columns, "wheels", name)
    if is_position:
        interval = np.diff(stamps) / 1e9
        left, right = (np.append(np.diff(side) / interval, 0.0) for side in (left, right))
        left[-1], right[-1] = left[-2], right[-2]
    return WheelSamples(stamps, left, right, unit, is_position), columns


def _position(frame: pd.DataFrame, name: str) -> tuple[PositionFixes, Datum | None, tuple[str, ...]]:
    """Return the positions of a table, the origin of their local plane, and the names of the columns.

    Raises
    ------
    DataError
        A latitude or longitude that is no angle in degrees.
    """
    columns = _chosen(frame, POSITION, "position", name)
    has_std = any(column in frame for pair in POSITION_STD for column in pair)
    stds = _chosen(frame, POSITION_STD, "position", name) if has_std else ()
    further = [column for column in dict.fromkeys((*stds, HEIGHT_COLUMN)) if column in frame]
    stamps, (first, second) = _rows(frame, columns, "position", name)
    extra = {column: _at(frame, column, columns, stamps, name) for column in further}
    unknown, datum, north, east = np.full(len(stamps), np.nan), None, first, second
    if columns == POSITION[1]:
        from pymap3d import geodetic2ned

        if np.any(np.abs(first) > 90) or np.any(np.abs(second) > 360):
            raise DataError(name, "column latitude_deg or longitude_deg: not degrees", "are they in radians, or E7?")
        height = np.nan_to_num(extra.get(HEIGHT_COLUMN, unknown))
        datum = Datum(float(first[0]), float(second[0]), float(height[0]))
        north, east, _ = geodetic2ned(first, second, height, datum.latitude_deg, datum.longitude_deg, datum.height_m)
    # The square of an impossible standard deviation may overflow.
    real = {std: np.where(np.abs(extra[std]) < LARGEST_STD, extra[std], np.nan) for std in stds}
    var_north, var_east = (real[stds[0]] ** 2, real[stds[1]] ** 2) if stds else (unknown, unknown.copy())
    covariance = np.zeros(len(stamps)) if stds else unknown.copy()
    return PositionFixes(stamps, np.asarray(north), np.asarray(east), var_north, var_east, covariance), datum, columns


def _at(frame: pd.DataFrame, column: str, group: Sequence[str], stamps: Ints, name: str) -> Floats:
    """Return an optional column at the stamps (n,) of a group, NaN for empty cells."""
    filled = frame[np.isfinite(_values(frame, column, name))]
    out = np.full(len(stamps), np.nan)
    if len(filled) >= 2:
        at, values = _rows(filled, [*group, column], column, name)
        out[np.searchsorted(stamps, at)] = values[-1]
    return out


def _heading(frame: pd.DataFrame, name: str) -> tuple[HeadingSamples, tuple[str, ...]]:
    """Return the headings of a table, clockwise from north, and the names of the columns."""
    columns = _chosen(frame, HEADING_COLUMNS, "heading", name)
    stamps, (angle,) = _rows(frame, columns, "heading", name)
    angle = np.radians(angle) if columns[0].endswith("_deg") else angle
    heading = math.pi / 2 - angle if columns[0].startswith("yaw") else angle
    std = np.full(len(stamps), np.nan)
    for column, unit in HEADING_STD:
        if column in frame:
            std = unit * _at(frame, column, columns, stamps, name)
            std[np.abs(std) >= LARGEST_STD] = np.nan
            break
    return HeadingSamples(stamps, np.pi - np.mod(np.pi - heading, 2 * np.pi), std**2), columns


@dataclass(frozen=True, slots=True)
class States:
    """Recorded filter states, one for each wheel sample: the columns of states.csv in their order, each of shape (n,).

    Attributes
    ----------
    heading_rad : heading, clockwise from north, unwrapped
    std_* : one standard deviation, the square root of the diagonal of P
    v_left_mps, v_right_mps : wheel speeds, held until the next state
    distance_m : path length since the first state
    """

    stamp_ns: Ints
    t_s: Floats
    north_m: Floats
    east_m: Floats
    heading_rad: Floats
    y_icr_right_m: Floats
    y_icr_left_m: Floats
    x_icr_m: Floats
    std_north_m: Floats
    std_east_m: Floats
    std_heading_rad: Floats
    std_y_icr_right_m: Floats
    std_y_icr_left_m: Floats
    std_x_icr_m: Floats
    v_left_mps: Floats
    v_right_mps: Floats
    distance_m: Floats

    def columns(self) -> dict[str, Floats | Ints]:
        """Return the columns by name, in the order of states.csv."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def changed(self, **columns: Floats | Ints) -> States:
        """Return the states with some columns replaced."""
        return replace(self, **cast(Any, columns))

    def icrs_at(self, row: int) -> Icrs:
        """Return the ICRs at a state."""
        return float(self.y_icr_right_m[row]), float(self.y_icr_left_m[row]), float(self.x_icr_m[row])

    def frame(self) -> pd.DataFrame:
        """Return the columns as a DataFrame equal to states.csv."""
        import pandas as pd

        return pd.DataFrame(self.columns())

    @property
    def fault(self) -> str:
        """Return why these are no states of a filter (no states, not in order, not finite); empty for valid states."""
        if not len(self):
            return "there are no states"
        if np.any(self.stamp_ns[1:] <= self.stamp_ns[:-1]):
            return "its states are not in the order of time"
        if np.any(self.distance_m[1:] < self.distance_m[:-1]):
            return "the distance of its states decreases"
        for name in (field.name for field in fields(self)):
            possible = np.abs(getattr(self, name)) < LARGEST_STATE
            if name != "stamp_ns" and not possible.all():
                fault = f"{name} that is not a finite number below {LARGEST_STATE:g}"
                return f"row {possible.argmin()} of its states has {fault}"
        return ""

    def __len__(self) -> int:
        return len(self.stamp_ns)
