"""How a robot would have recorded sensor columns: the options of the log writer, and the messages that it makes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np

from icrtool.errors import ConfigError
from icrtool.logs.messages.definitions import bundled_definitions

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from rosbags.typesys.store import Typestore

    from icrtool.kernels.arrays import Ints
    from icrtool.records.samples import SensorColumns

Container = Literal["mcap", "bag", "db3"]
WheelMessages = Literal["joint_states", "odometry", "float64_pair", "ticks", "jackal_feedback", "twist_stamped"]
Compression = Literal["none", "bz2", "lz4", "zstd", "zstd-file"]

COMPRESSIONS: dict[Container, tuple[Compression, ...]] = {
    "mcap": ("none", "lz4", "zstd"),
    "bag": ("none", "bz2", "lz4"),
    "db3": ("none", "zstd", "zstd-file"),
}
"""Compressions of each container. For db3, ``zstd`` compresses message by message, ``zstd-file`` the closed file."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WriteOptions:
    """How a log is recorded: container, message types and conventions.

    Attributes
    ----------
    container : ``mcap`` (one ROS 2 file), ``bag`` (one ROS 1 file) or ``db3`` (a ROS 2 directory, sqlite3 storage)
    wheels : message type of the wheels. ``float64_pair`` [m/s] and ``ticks`` (Int32, wraps) are pairs without header
    heading : convention of the Imu. ``enu``: REP-103. ``ned``: yaw is the compass heading, body z down, and the frame
        is ``imu_link_ned`` (REP-145)
    namespace : put before every topic (``/j100_0042``)
    compression : one of `COMPRESSIONS` of the container
    wheel_radius_m : converts metres to radians and counts
    track_width_m : b, by which a wheel controller divides for its angular velocity [m]
    counts_per_rev : encoder counts of one wheel revolution
    heading_std_deg : written as the orientation's covariance
    definitions : False: only the names of the types are written, as in ROS 2 Humble and older (not in a ROS 1 bag)
    """

    container: Container = "mcap"
    wheels: WheelMessages = "joint_states"
    heading: Literal["enu", "ned"] = "enu"
    namespace: str = ""
    compression: Compression = "none"
    wheel_radius_m: float
    track_width_m: float
    counts_per_rev: float = 8192.0
    heading_std_deg: float = 1.0
    definitions: bool = True

    def __post_init__(self) -> None:
        offered = COMPRESSIONS[self.container]
        if self.compression not in offered:
            why = f"{self.compression} does not exist in a {self.container} log"
            raise ConfigError("compression", why, f"choose {', '.join(offered)}")
        if not self.definitions and self.container == "bag":
            raise ConfigError("definitions", "a ROS 1 bag always carries them", "choose mcap or db3 to leave them out")
        for name in ("wheel_radius_m", "track_width_m", "counts_per_rev"):
            if not getattr(self, name) > 0:
                raise ConfigError(name, f"{getattr(self, name)} is not a positive number")


GRAVITY_MPS2 = 9.81
HEIGHT_STD_RATIO = 2.0
"""Vertical over horizontal GNSS noise, a rule of thumb of GNSS geometry."""

FRONT_AND_REAR_JOINTS = (
    "front_left_wheel_joint",
    "front_right_wheel_joint",
    "rear_left_wheel_joint",
    "rear_right_wheel_joint",
)

JACKAL_TYPES = ("jackal_msgs/msg/DriveFeedback", "jackal_msgs/msg/Feedback")
ROS1_JACKAL_FEEDBACK = (
    "std_msgs/Header header\njackal_msgs/DriveFeedback[2] drivers\nfloat32 pcb_temperature\n"
    "float32 mcu_temperature\nint8 commanded_mode\nint8 actual_mode\n"
)
"""The ROS 1 form has two temperatures that the ROS 2 form, which is bundled, does not have (docs.ros.org/en/api)."""


@dataclass(frozen=True, slots=True)
class TopicMessages:
    """All messages of a topic, serialised.

    Attributes
    ----------
    stamp_ns : int64 (n,)
    payload : uint8 (n, size), one message a row; or the messages, where their sizes differ
    """

    topic: str
    message_type: str
    stamp_ns: Ints
    payload: NDArray[np.uint8] | Sequence[bytes]


@dataclass(frozen=True, slots=True)
class TopicPlan:
    """One topic: `fixed` values and per-message `columns`, both by dotted path (``drivers.0.measured_travel``).

    `stamp_ns` (n,) and each column (n,) have a row for each message. A field of neither is zero or empty.
    """

    topic: str
    message_type: str
    stamp_ns: Ints
    fixed: dict[str, object]
    columns: dict[str, NDArray[Any]]


@cache
def load_typestore(*, ros1: bool) -> Typestore:
    """Return the message types of ROS Noetic or of ROS 2 Jazzy, with those of jackal_msgs."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)
    types = {name: bundled_definitions()[name] for name in JACKAL_TYPES}
    if ros1:
        types |= get_types_from_msg(ROS1_JACKAL_FEEDBACK, "jackal_msgs/msg/Feedback")
    store.register(types)
    return store


def serialise_topics(columns: SensorColumns, options: WriteOptions, store: Typestore) -> tuple[TopicMessages, ...]:
    """Return the messages of every topic that has any, in the order wheels, position, heading.

    Messages with equal stamps are written in this order.
    """
    plans = (*WHEEL_PLANS[options.wheels](columns, options), _plan_position(columns), _plan_heading(columns, options))
    prefix = "/" + options.namespace.strip("/") if options.namespace.strip("/") else ""
    ros1 = options.container == "bag"
    return tuple(serialise_topic(plan, store, prefix=prefix, ros1=ros1) for plan in plans if len(plan.stamp_ns))


def _plan_joint_states(columns: SensorColumns, options: WriteOptions) -> tuple[TopicPlan, ...]:
    radius = options.wheel_radius_m
    changing = header_stamps(columns.wheel_stamp_ns)
    for joint, name in enumerate(FRONT_AND_REAR_JOINTS):
        left = "left" in name
        travel = columns.wheel_position_left_m if left else columns.wheel_position_right_m
        speed = columns.wheel_v_left_mps if left else columns.wheel_v_right_mps
        changing[f"position.{joint}"] = travel / radius
        changing[f"velocity.{joint}"] = speed / radius
    fixed: dict[str, object] = {"name": list(FRONT_AND_REAR_JOINTS), "position": np.zeros(4), "velocity": np.zeros(4)}
    return (TopicPlan("/joint_states", "sensor_msgs/msg/JointState", columns.wheel_stamp_ns, fixed, changing),)


def _wheel_controller_twist(columns: SensorColumns, options: WriteOptions, where: str) -> dict[str, NDArray[Any]]:
    """Return the body twist as wheel controllers report it: no slip, body x forward and y left (REP-103)."""
    right, left = columns.wheel_v_right_mps, columns.wheel_v_left_mps
    return header_stamps(columns.wheel_stamp_ns) | {
        f"{where}.linear.x": (right + left) / 2,
        f"{where}.angular.z": (right - left) / options.track_width_m,
    }


def _plan_odometry(columns: SensorColumns, options: WriteOptions) -> tuple[TopicPlan, ...]:
    changing = _wheel_controller_twist(columns, options, "twist.twist")
    fixed: dict[str, object] = {
        "header.frame_id": "odom",
        "child_frame_id": "base_link",
        "pose.pose.orientation.w": 1.0,
    }
    return (TopicPlan("/wheel_controller/odom", "nav_msgs/msg/Odometry", columns.wheel_stamp_ns, fixed, changing),)


def _plan_twist_stamped(columns: SensorColumns, options: WriteOptions) -> tuple[TopicPlan, ...]:
    changing = _wheel_controller_twist(columns, options, "twist")
    topic, message_type = "/wheel_controller/twist", "geometry_msgs/msg/TwistStamped"
    return (TopicPlan(topic, message_type, columns.wheel_stamp_ns, {"header.frame_id": "base_link"}, changing),)


def _plan_float64_pair(columns: SensorColumns, _: WriteOptions) -> tuple[TopicPlan, ...]:
    sides = {"/left_drive/velocity": columns.wheel_v_left_mps, "/right_drive/velocity": columns.wheel_v_right_mps}
    return _plan_pair("std_msgs/msg/Float64", columns.wheel_stamp_ns, sides)


def _plan_pair(message_type: str, stamp_ns: Ints, sides: dict[str, NDArray[Any]]) -> tuple[TopicPlan, ...]:
    return tuple(TopicPlan(topic, message_type, stamp_ns, {}, {"data": values}) for topic, values in sides.items())


def _plan_ticks(columns: SensorColumns, options: WriteOptions) -> tuple[TopicPlan, ...]:
    per_metre = options.counts_per_rev / (2 * np.pi * options.wheel_radius_m)
    sides = {"/lwheel_ticks": columns.wheel_position_left_m, "/rwheel_ticks": columns.wheel_position_right_m}
    # An Int32 counter wraps around, as numpy's narrowing cast of an integer does.
    counts = {topic: np.rint(side * per_metre).astype(np.int64).astype(np.int32) for topic, side in sides.items()}
    return _plan_pair("std_msgs/msg/Int32", columns.wheel_stamp_ns, counts)


def _plan_jackal_feedback(columns: SensorColumns, options: WriteOptions) -> tuple[TopicPlan, ...]:
    changing = header_stamps(columns.wheel_stamp_ns)
    sides = (
        (columns.wheel_position_left_m, columns.wheel_v_left_mps),
        (columns.wheel_position_right_m, columns.wheel_v_right_mps),
    )
    for driver, (travel, speed) in enumerate(sides):
        changing[f"drivers.{driver}.measured_travel"] = (travel / options.wheel_radius_m).astype(np.float32)
        changing[f"drivers.{driver}.measured_velocity"] = (speed / options.wheel_radius_m).astype(np.float32)
    return (TopicPlan("/feedback", "jackal_msgs/msg/Feedback", columns.wheel_stamp_ns, {}, changing),)


WHEEL_PLANS: dict[WheelMessages, Callable[[SensorColumns, WriteOptions], tuple[TopicPlan, ...]]] = {
    "joint_states": _plan_joint_states,
    "odometry": _plan_odometry,
    "twist_stamped": _plan_twist_stamped,
    "jackal_feedback": _plan_jackal_feedback,
    "ticks": _plan_ticks,
    "float64_pair": _plan_float64_pair,
}


def _plan_position(columns: SensorColumns) -> TopicPlan:
    known = np.isfinite(columns.gnss_std_m)
    variance = np.where(known, columns.gnss_std_m, 0.0) ** 2
    changing = header_stamps(columns.gnss_stamp_ns) | {
        "status.status": columns.gnss_status.astype(np.int8),
        "latitude": columns.latitude_deg,
        "longitude": columns.longitude_deg,
        "altitude": columns.height_m,
        "position_covariance.0": variance,
        "position_covariance.4": variance,
        "position_covariance.8": variance * HEIGHT_STD_RATIO**2,
        "position_covariance_type": np.where(known, 2, 0).astype(np.uint8),
    }
    fixed: dict[str, object] = {"header.frame_id": "gps_link", "status.service": 1}
    return TopicPlan("/gps/fix", "sensor_msgs/msg/NavSatFix", columns.gnss_stamp_ns, fixed, changing)


def _plan_heading(columns: SensorColumns, options: WriteOptions) -> TopicPlan:
    # World and body frame change together: in ENU the body's z is up, in NED it is down (REP-145).
    enu = options.heading == "enu"
    yaw = np.pi / 2 - columns.heading_rad if enu else columns.heading_rad
    changing = header_stamps(columns.heading_stamp_ns) | {
        "orientation.z": np.sin(yaw / 2),
        "orientation.w": np.cos(yaw / 2),
        "angular_velocity.z": -columns.yaw_rate_radps if enu else columns.yaw_rate_radps,
    }
    variance = np.radians(options.heading_std_deg) ** 2
    fixed: dict[str, object] = {
        "header.frame_id": "imu_link" if enu else "imu_link_ned",
        "orientation_covariance": np.diag([variance] * 3).ravel(),
        "linear_acceleration.z": GRAVITY_MPS2 if enu else -GRAVITY_MPS2,
    }
    return TopicPlan("/imu/data", "sensor_msgs/msg/Imu", columns.heading_stamp_ns, fixed, changing)


def header_stamps(stamp_ns: Ints) -> dict[str, NDArray[Any]]:
    """Return the columns of a message's header that hold its stamp."""
    return {
        "header.stamp.sec": (stamp_ns // 1_000_000_000).astype(np.uint32),
        "header.stamp.nanosec": (stamp_ns % 1_000_000_000).astype(np.uint32),
    }


def serialise_topic(plan: TopicPlan, store: Typestore, *, prefix: str = "", ros1: bool = False) -> TopicMessages:
    """Return the messages of one topic.

    Parameters
    ----------
    plan : its values
    store : holds the definition of its message type
    prefix : put before the topic
    ros1 : serialise as ROS 1 does, else as CDR
    """
    message = blank_message(store, plan.message_type)
    for path, value in plan.fixed.items():
        _put(message, path, value)

    def encode() -> NDArray[np.uint8]:
        encoder = store.serialize_ros1 if ros1 else store.serialize_cdr
        return np.frombuffer(encoder(message, plan.message_type), dtype=np.uint8).copy()

    slots = {path: _find_slot(encode, message, path, values.dtype) for path, values in plan.columns.items()}
    payload = np.tile(encode(), (len(plan.stamp_ns), 1))
    for path, slot in slots.items():
        values = plan.columns[path]
        little_endian = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
        payload[:, slot] = little_endian.view(np.uint8).reshape(len(values), -1)
    return TopicMessages(prefix + plan.topic, plan.message_type, plan.stamp_ns, payload)


def blank_message(store: Typestore, message_type: str) -> object:
    """Return a message of zeros, empty strings and empty sequences."""
    from rosbags.interfaces import Nodetype

    values: dict[str, Any] = {}
    for name, (kind, detail) in cast("list[tuple[str, tuple[Any, Any]]]", store.fielddefs[message_type][1]):
        if kind == Nodetype.NAME:
            values[name] = blank_message(store, detail)
        elif kind == Nodetype.BASE:
            values[name] = "" if detail[0] == "string" else np.zeros((), dtype=detail[0])[()]
        else:
            (element_kind, element), length = detail
            length = length if kind == Nodetype.ARRAY else 0
            if element_kind == Nodetype.NAME:
                values[name] = [blank_message(store, element) for _ in range(length)]
            else:
                values[name] = [""] * length if element[0] == "string" else np.zeros(length, dtype=element[0])
    return store.types[message_type](**values)


def _put(message: object, path: str, value: object) -> None:
    *parents, last = path.split(".")
    for step in parents:
        message = message[int(step)] if isinstance(message, list) else getattr(message, step)
    if isinstance(message, np.ndarray):
        message[int(last)] = value
    else:
        setattr(message, last, value)


def _find_slot(encode: Callable[[], NDArray[np.uint8]], message: object, path: str, dtype: np.dtype[Any]) -> slice:
    """Return the byte range of the scalar at `path`, which is zero before and after: the bytes that change with it."""
    blank = encode()
    _put(message, path, np.frombuffer(b"\x11" * dtype.itemsize, dtype=dtype)[0])
    changed = np.flatnonzero(encode() != blank)
    _put(message, path, dtype.type(0))
    if len(changed) != dtype.itemsize or changed[-1] - changed[0] != dtype.itemsize - 1:
        raise ValueError(f"{path} is not a {dtype} field of {type(message).__name__}")
    return slice(int(changed[0]), int(changed[-1]) + 1)
