"""Samples of a robot's sensors: typed columns by stamp, and their source."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, Self, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from icrtool.kernels.arrays import Bools, Bytes, Floats, Ints

Role = Literal["wheels", "gnss", "heading"]

ROLE_WORDS: dict[Role, str] = {"wheels": "wheels", "gnss": "position", "heading": "heading"}
"""Names of the roles in messages. ``gnss`` is called position, because a lidar may be its source."""


NOT_STATED, OTHER_FIX, FLOAT_FIX, FIXED_FIX, RTK_FIX = 0, 1, 2, 3, 4
"""Kinds of fixes by the message. In order: not stated; without carrier phase, or unknown; RTK float; RTK fixed; RTK,
fixed or float."""


class Samples:
    """Columns of one sensor, each with one value for each stamp in `stamp_ns`."""

    __slots__ = ()

    stamp_ns: Ints

    def __post_init__(self) -> None:
        lengths = {name: len(column) for name, column in self._columns().items()}
        if any(length != len(self.stamp_ns) for length in lengths.values()):
            raise ValueError(f"columns of {lengths} rows, stamp_ns has {len(self.stamp_ns)}")

    def cut(self, rows: slice | Bools) -> Self:
        """Return the samples in some rows."""
        part: Self = replace(cast(Any, self), **{name: column[rows] for name, column in self._columns().items()})
        return part

    def _columns(self) -> dict[str, NDArray[Any]]:
        values = {field.name: getattr(self, field.name) for field in fields(cast(Any, self))}
        return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}


def without_repeats(column: Floats) -> Floats:
    """Return a column of the same values; a column of equal values then holds the memory of one value."""
    return np.broadcast_to(column[:1].copy(), column.shape) if len(column) and (column == column[0]).all() else column


WheelUnit = Literal["mps", "m", "rad", "counts", "unknown"]
"""Unit of the speeds of the wheels. ``mps``: m/s, with the configured scales applied; ``m``: m/s as sent, without them;
``rad`` and ``counts``: this unit per second; ``unknown``: the messages do not state a unit."""


@dataclass(frozen=True, slots=True)
class WheelSamples(Samples):
    """Speeds of the left and the right side.

    Attributes
    ----------
    stamp_ns : int64 (n,) stamps, strictly increasing [ns]
    left, right : float64 (n,) speed of each side, forward positive, held over [k, k+1); [m/s], or in `unit` per second
    unit : ``mps``: speeds that are ready to use. Another unit: speeds as sent, in this unit per second and without the
        configured scales; `icrtool.alignment.wheel_units` converts them to m/s
    from_position : the log has positions; `left` and `right` are the mean speeds to the next sample
    restarts_ns : stamps of the samples after which the encoder positions started again; the motion in these gaps is not
        known
    """

    stamp_ns: Ints
    left: Floats
    right: Floats
    unit: WheelUnit = "mps"
    from_position: bool = False
    restarts_ns: tuple[int, ...] = ()

    @property
    def v_left_mps(self) -> Floats:
        """Speed of the left side [m/s], (n,).

        Raises
        ------
        ValueError
            The wheels are in another unit than m/s: align the log first.
        """
        return self._in_mps(self.left)

    @property
    def v_right_mps(self) -> Floats:
        """Speed of the right side [m/s], (n,).

        Raises
        ------
        ValueError
            The wheels are in another unit than m/s: align the log first.
        """
        return self._in_mps(self.right)

    def _in_mps(self, speed: Floats) -> Floats:
        if self.unit not in ("mps", "m"):
            raise ValueError(f"wheels in {self.unit} per second, not in m/s: align the log first")
        return speed


@dataclass(frozen=True, slots=True)
class PositionFixes(Samples):
    """Positions of the antenna (or of the tracked reference point) in the local plane.

    Attributes
    ----------
    stamp_ns : int64 (n,) stamps, non-decreasing [ns]
    north_m, east_m : float64 (n,) position in the local plane [m]
    var_north_m2, var_east_m2, cov_north_east_m2 : float64 (n,) variances and covariance [m^2]; NaN where not stated
    stated_class : uint8 (n,), NOT_STATED, OTHER_FIX, FLOAT_FIX, FIXED_FIX or RTK_FIX; None where no message
        states a kind of fix
    """

    stamp_ns: Ints
    north_m: Floats
    east_m: Floats
    var_north_m2: Floats
    var_east_m2: Floats
    cov_north_east_m2: Floats
    stated_class: Bytes | None = None


@dataclass(frozen=True, slots=True)
class HeadingSamples(Samples):
    """Headings, clockwise from north.

    Attributes
    ----------
    stamp_ns : int64 (n,) stamps, non-decreasing [ns]
    heading_rad : float64 (n,) heading, in (-pi, pi] [rad]
    var_rad2 : float64 (n,) variance of the heading [rad^2]; NaN where not stated
    """

    stamp_ns: Ints
    heading_rad: Floats
    var_rad2: Floats


NO_HEADINGS = HeadingSamples(np.empty(0, np.int64), np.empty(0), np.empty(0))
"""Headings of a log without a heading: no row."""


@dataclass(frozen=True, slots=True)
class GyroSamples(Samples):
    """Turn rates, clockwise positive.

    Attributes
    ----------
    topic : topic of the turn rates
    stamp_ns : int64 (n,) stamps, strictly increasing [ns]
    rate_radps : float64 (n,) turn rate [rad/s]
    """

    topic: str
    stamp_ns: Ints
    rate_radps: Floats


@dataclass(frozen=True, slots=True)
class GyroAxes(Samples):
    """Turn rates about the three axes of an inertial unit, as sent.

    Attributes
    ----------
    topic : topic of the turn rates
    stamp_ns : int64 (n,) stamps, strictly increasing [ns]
    rates_radps : float64 (n, 3) turn rates about x, y, z of the sensor [rad/s]
    """

    topic: str
    stamp_ns: Ints
    rates_radps: Floats


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


TWIST_TYPES = frozenset(
    {
        "geometry_msgs/Twist",
        "geometry_msgs/TwistStamped",
        "geometry_msgs/TwistWithCovarianceStamped",
        "nav_msgs/Odometry",
        "scout_msgs/ScoutStatus",
        "bunker_msgs/BunkerStatus",
    }
)
"""Message types that hold a body twist, measured or commanded. Wheel speeds are computed from it with a width.

The turn rate of a twist is the difference of the sides' speeds divided by the width that the controller uses.
"""


OWN_TWIST = " (body twist)"
"""End of the message type of wheels that were read from the named fields of a body twist."""


@dataclass(frozen=True, slots=True)
class StreamChoice:
    """The topic that provides the samples of a role, and the reason.

    Attributes
    ----------
    role : wheels, gnss or heading
    topic : topic name; a left/right pair reads ``/left + /right``
    message_type : type of the messages
    count : number of samples
    rate_hz : 1 / median interval; None where not known
    clock : ``header`` or ``log``: which stamps are used
    jitter_ms : standard deviation of the interval between samples, None where not known
    why : reason of the choice
    """

    role: Role
    topic: str
    message_type: str
    count: int
    rate_hz: float | None
    clock: Literal["header", "log"]
    jitter_ms: float | None
    why: str

    @property
    def samples_text(self) -> str:
        """Text with the number of samples and, where it is known, their rate [Hz]."""
        return f"{self.count} samples" + (f" at {self.rate_hz:.4g} Hz" if self.rate_hz is not None else "")

    @property
    def is_twist(self) -> bool:
        """Whether the wheel speeds were computed from a body twist. A pair of topics or fields holds wheel speeds."""
        if self.message_type.endswith(OWN_TWIST):
            return self.role == "wheels"
        return self.role == "wheels" and self.message_type in TWIST_TYPES and " + " not in self.topic


def are_twist(streams: Iterable[StreamChoice]) -> bool:
    """Return whether the wheel speeds of a log with these streams were computed from a body twist."""
    return any(stream.is_twist for stream in streams)


def rate_and_jitter(stamps: Ints) -> tuple[float | None, float | None]:
    """Return 1 / median interval [Hz] and the standard deviation of the intervals [ms]; None below two stamps."""
    if len(stamps) < 2:
        return None, None
    interval = np.diff(stamps)
    median = float(np.median(interval))
    return (1e9 / median if median > 0 else None), float(interval.std()) / 1e6


@dataclass(frozen=True, slots=True)
class HeadingSensor:
    """The topic that states a heading. `convention` is the convention in which its yaw was read."""

    topic: str
    message_type: str
    convention: Literal["enu", "ned"]


@dataclass(frozen=True, slots=True)
class InputFile:
    """A file that was read.

    Attributes
    ----------
    path : path or address as it was given, without a password or token
    bytes : size of the file
    sha256 : SHA-256 of the content in hexadecimal digits; None where not all of the file was read
    etag, version : tags of the content by an object store or a web server
    address : SHA-256 of the whole address, with the password and token that `path` leaves out
    """

    path: str
    bytes: int
    sha256: str | None
    etag: str | msgspec.UnsetType = msgspec.UNSET
    version: str | msgspec.UnsetType = msgspec.UNSET
    address: str | msgspec.UnsetType = msgspec.UNSET

    @property
    def identity(self) -> tuple[object, ...]:
        """Key that is equal for files of equal content: SHA-256, else size and version, else size and address."""
        if self.sha256 is not None:
            return (self.sha256,)
        version = self.version if self.version is not msgspec.UNSET else self.etag
        # A time of modification is no version, because many files may have the same time.
        is_version = isinstance(version, str) and bool(version) and not version.endswith(" GMT")
        where = self.path if self.address is msgspec.UNSET else self.address
        return (self.bytes, version) if is_version else (self.bytes, where)


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorColumns:
    """Measurements of the sensors on one drive, in the frames of `icrtool`: y right, heading clockwise from north.

    Attributes
    ----------
    wheel_stamp_ns : int64 (n,) stamps of the wheels [ns]
    wheel_position_left_m, wheel_position_right_m : float64 (n,) travel of each side since an arbitrary start [m]
    wheel_v_left_mps, wheel_v_right_mps : float64 (n,) speed of each side, forward positive [m/s]
    gnss_stamp_ns : int64 (m,) stamps of the fixes [ns]
    latitude_deg, longitude_deg : float64 (m,) position, WGS 84 [deg]
    height_m : float64 (m,) height above the ellipsoid [m]
    gnss_std_m : float64 (m,) standard deviation of north and of east [m]; NaN writes a fix with unknown covariance
    gnss_status : int64 (m,) status of NavSatStatus: -1 none, 0 fix, 1 SBAS, 2 GBAS (RTK)
    heading_stamp_ns : int64 (k,) stamps of heading and turn rate [ns]
    heading_rad : float64 (k,) heading, clockwise from north [rad]
    yaw_rate_radps : float64 (k,) turn rate, clockwise positive [rad/s]

    Notes
    -----
    A sensor without rows leaves its topics out of the log. Stamps need not increase: the log is written in their order.
    """

    wheel_stamp_ns: Ints
    wheel_position_left_m: Floats
    wheel_position_right_m: Floats
    wheel_v_left_mps: Floats
    wheel_v_right_mps: Floats
    gnss_stamp_ns: Ints
    latitude_deg: Floats
    longitude_deg: Floats
    height_m: Floats
    gnss_std_m: Floats
    gnss_status: Ints
    heading_stamp_ns: Ints
    heading_rad: Floats
    yaw_rate_radps: Floats

    def __post_init__(self) -> None:
        stamps: Ints = self.wheel_stamp_ns
        for field in fields(self):
            column = getattr(self, field.name)
            if field.name.endswith("stamp_ns"):
                stamps = column
            if column.shape != (len(stamps),):
                raise ValueError(f"SensorColumns.{field.name} has shape {column.shape}, its stamps ({len(stamps)},)")
