"""The typed tables that packages exchange: what was measured, and what the filter made of it."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from html import escape
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pandas as pd

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Complexes = NDArray[np.complex128]
Bools = NDArray[np.bool_]
Bytes = NDArray[np.uint8]
Role = Literal["wheels", "gnss", "heading"]


NOT_TOLD, OTHER_FIX, FLOAT_FIX, FIXED_FIX, RTK_FIX = 0, 1, 2, 3, 4
"""What a message says of how its position was solved: nothing, without carrier phase (or unknown), RTK float, RTK
fixed, RTK without saying which."""


def _check_lengths(stamp_ns: Ints, *columns: Floats | Bytes) -> None:
    lengths = [len(column) for column in columns]
    if any(length != len(stamp_ns) for length in lengths):
        raise ValueError(f"columns of {lengths} rows, stamp_ns has {len(stamp_ns)}")


@dataclass(frozen=True, slots=True)
class WheelSamples:
    """Speeds of the left and the right side.

    Attributes
    ----------
    stamp_ns : int64 (n,), strictly increasing
    v_left_mps, v_right_mps : float64 (n,), forward positive, each held over [k, k+1)
    """

    stamp_ns: Ints
    v_left_mps: Floats
    v_right_mps: Floats

    def __post_init__(self) -> None:
        _check_lengths(self.stamp_ns, self.v_left_mps, self.v_right_mps)


@dataclass(frozen=True, slots=True)
class PositionFixes:
    """Positions of the antenna (or of the tracked reference point) in the local plane.

    Attributes
    ----------
    stamp_ns : int64 (n,), non-decreasing
    north_m, east_m : float64 (n,)
    var_north_m2, var_east_m2, cov_north_east_m2 : float64 (n,), NaN where the log does not say
    told_class : uint8 (n,), NOT_TOLD, OTHER_FIX, FLOAT_FIX, FIXED_FIX or RTK_FIX; None where no message tells any
    """

    stamp_ns: Ints
    north_m: Floats
    east_m: Floats
    var_north_m2: Floats
    var_east_m2: Floats
    cov_north_east_m2: Floats
    told_class: Bytes | None = None

    def __post_init__(self) -> None:
        told = () if self.told_class is None else (self.told_class,)
        _check_lengths(
            self.stamp_ns, self.north_m, self.east_m, self.var_north_m2, self.var_east_m2, self.cov_north_east_m2, *told
        )

    def cut(self, rows: slice) -> PositionFixes:
        """Return the fixes of some rows."""
        columns = {field.name: getattr(self, field.name) for field in fields(self)}
        return replace(self, **{name: column[rows] for name, column in columns.items() if column is not None})


@dataclass(frozen=True, slots=True)
class HeadingSamples:
    """Headings, clockwise from north.

    Attributes
    ----------
    stamp_ns : int64 (n,), non-decreasing
    heading_rad : float64 (n,), in (-pi, pi]
    var_rad2 : float64 (n,), NaN where the log does not say
    """

    stamp_ns: Ints
    heading_rad: Floats
    var_rad2: Floats

    def __post_init__(self) -> None:
        _check_lengths(self.stamp_ns, self.heading_rad, self.var_rad2)


@dataclass(frozen=True, slots=True)
class GyroSamples:
    """Turn rates, clockwise positive.

    Attributes
    ----------
    topic : where they were read
    stamp_ns : int64 (n,), strictly increasing
    rate_radps : float64 (n,)
    """

    topic: str
    stamp_ns: Ints
    rate_radps: Floats

    def __post_init__(self) -> None:
        _check_lengths(self.stamp_ns, self.rate_radps)


@dataclass(frozen=True, slots=True)
class GyroAxes:
    """Turn rates about the three axes of an inertial unit, as sent.

    Attributes
    ----------
    topic : where they were read
    stamp_ns : int64 (n,), strictly increasing
    rates_radps : float64 (n, 3), about x, y, z of the sensor
    """

    topic: str
    stamp_ns: Ints
    rates_radps: Floats

    def __post_init__(self) -> None:
        _check_lengths(self.stamp_ns, self.rates_radps)


@dataclass(frozen=True, slots=True)
class OtherReceiver:
    """Positions of a further receiver, in the same local plane."""

    topic: str
    fixes: PositionFixes


@dataclass(frozen=True, slots=True)
class Datum:
    """Origin of the local plane: geodetic latitude, longitude [deg, WGS 84] and ellipsoidal height [m]."""

    latitude_deg: float
    longitude_deg: float
    height_m: float


@dataclass(frozen=True, slots=True)
class StreamChoice:
    """Which topic feeds a role, and why.

    Attributes
    ----------
    topic : topic name; a left/right pair reads ``/left + /right``
    rate_hz : 1 / median interval
    clock : ``header`` or ``log``: which stamps are used
    jitter_ms : standard deviation of the interval between samples
    """

    role: Role
    topic: str
    message_type: str
    count: int
    rate_hz: float
    clock: Literal["header", "log"]
    jitter_ms: float
    why: str


@dataclass(frozen=True, slots=True)
class InputFile:
    """A file that was read: path as given, size, SHA-256 (hex)."""

    path: str
    bytes: int
    sha256: str


@dataclass(frozen=True, slots=True, repr=False)
class RobotLog:
    """What a robot measured on one drive: the tables the filter needs, and where they came from.

    Attributes
    ----------
    datum : None where the position reference was metric already (total station, lidar, motion capture)
    rejected_fixes : fixes dropped at the door by reason (``no fix``, ``not finite`` ...)
    warnings : sentences for the user, in the order they were found
    antenna_m : the antenna from the body origin by the log's own transforms, forward and right; None where not told
    gyro : turn rates of an inertial unit, None without one; the filter does not use them
    heading : without a row where no topic states one
    gyros : all inertial units with turn rates, all axes
    other_receivers : further GNSS receivers
    """

    name: str
    wheels: WheelSamples
    gnss: PositionFixes
    heading: HeadingSamples
    datum: Datum | None
    streams: tuple[StreamChoice, ...]
    inputs: tuple[InputFile, ...]
    rejected_fixes: dict[str, int]
    warnings: tuple[str, ...]
    antenna_m: tuple[float, float] | None = None
    gyro: GyroSamples | None = None
    gyros: tuple[GyroAxes, ...] = ()
    other_receivers: tuple[OtherReceiver, ...] = ()

    def __repr__(self) -> str:
        spans = [samples.stamp_ns[[0, -1]] for samples in self._by_role().values() if len(samples.stamp_ns)]
        duration_s = (max(int(span[1]) for span in spans) - min(int(span[0]) for span in spans)) / 1e9 if spans else 0.0
        counts = ", ".join(f"{len(samples.stamp_ns):,} {role}" for role, samples in self._by_role().items())
        return f"<RobotLog {self.name!r}: {duration_s:.1f} s, {counts}, {len(self.warnings)} warnings>"

    def _by_role(self) -> dict[str, WheelSamples | PositionFixes | HeadingSamples]:
        return {"wheels": self.wheels, "gnss": self.gnss, "heading": self.heading}

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><td>{escape(stream.role)}</td><td>{escape(stream.topic)}</td><td>{escape(stream.message_type)}</td>"
            f"<td>{stream.count:,}</td><td>{stream.rate_hz:.1f} Hz</td></tr>"
            for stream in self.streams
        )
        heads = "".join(f"<th>{head}</th>" for head in ("stream", "topic", "type", "samples", "rate"))
        return f"<p>{escape(repr(self))}</p><table><tr>{heads}</tr>{rows}</table>"


@dataclass(frozen=True, slots=True)
class States:
    """Recorded filter states, one per wheel sample. The columns of states.csv, in its order; all of shape (n,).

    Attributes
    ----------
    heading_rad : unwrapped
    std_* : one standard deviation, the square root of the diagonal of P
    v_left_mps, v_right_mps : held until the next state
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

    def frame(self) -> pd.DataFrame:
        """Return the columns as a DataFrame equal to states.csv."""
        import pandas as pd

        return pd.DataFrame(self.columns())

    def __len__(self) -> int:
        return len(self.stamp_ns)
