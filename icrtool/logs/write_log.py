"""Writer of robot logs: the messages of each topic from columns of sensors, and the file with these messages.

`icrtool simulate`, the exports, the sample logs and the tests use this module.
"""

from __future__ import annotations

import os
import sqlite3
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np

from icrtool.errors import ConfigError, OutputError
from icrtool.kernels.friction import GRAVITY_MPS2
from icrtool.logs.messages.definitions import bundled_definitions
from icrtool.records.choices import HeadingConvention, WheelMessages
from icrtool.records.process_resources import unfinished
from icrtool.records.samples import SensorColumns

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from rosbags.typesys.store import Typestore

    from icrtool.kernels.arrays import Ints

ContainerKind = Literal["mcap", "bag", "db3"]
Compression = Literal["none", "bz2", "lz4", "zstd", "zstd-file"]

COMPRESSIONS: dict[ContainerKind, tuple[Compression, ...]] = {
    "mcap": ("none", "lz4", "zstd"),
    "bag": ("none", "bz2", "lz4"),
    "db3": ("none", "zstd", "zstd-file"),
}
"""Compressions of each container. In a db3, ``zstd`` compresses each message, and ``zstd-file`` the complete file."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WriteOptions:
    """Format of a written log: container, message types and conventions.

    Attributes
    ----------
    container : ``mcap`` (one ROS 2 file), ``bag`` (one ROS 1 file) or ``db3`` (a ROS 2 directory with sqlite3 storage)
    wheels : messages of the wheels. ``float64_pair`` [m/s] and ``ticks`` (Int32 counters that wrap around) are a topic
        for each side, without a header
    heading : convention of the Imu. ``enu``: REP-103. ``ned``: yaw is the compass heading, body z down, and the frame
        is ``imu_link_ned`` (REP-145)
    compression : compression, one of `COMPRESSIONS` for the container
    wheel_radius_m : wheel radius, for conversion of metres to radians and counts [m]
    track_width_m : track width b, for the angular velocity of a wheel controller [m]
    counts_per_rev : encoder counts of one wheel revolution
    heading_std_deg : standard deviation of the heading, written as covariance of the orientation
    """

    container: ContainerKind = "mcap"
    wheels: WheelMessages = "joint_states"
    heading: HeadingConvention = "enu"
    compression: Compression = "none"
    wheel_radius_m: float
    track_width_m: float
    counts_per_rev: float = 8192.0
    heading_std_deg: float = 1.0

    def __post_init__(self) -> None:
        offered = COMPRESSIONS[self.container]
        if self.compression not in offered:
            why = f"{self.compression} does not exist in a {self.container} log"
            raise ConfigError("compression", why, f"choose {', '.join(offered)}")
        for name in ("wheel_radius_m", "track_width_m", "counts_per_rev"):
            if not getattr(self, name) > 0:
                raise ConfigError(name, f"{getattr(self, name)} is not a positive number")


HEIGHT_STD_RATIO = 2.0
"""Ratio of vertical to horizontal GNSS noise, a usual value for the geometry of the satellites."""

JACKAL_TYPES = ("jackal_msgs/msg/DriveFeedback", "jackal_msgs/msg/Feedback")
"""Message types of the wheels of a Clearpath Jackal: of one driver, and of all drivers."""

ROS1_JACKAL_FEEDBACK = (
    "std_msgs/Header header\njackal_msgs/DriveFeedback[2] drivers\nfloat32 pcb_temperature\n"
    "float32 mcu_temperature\nint8 commanded_mode\nint8 actual_mode\n"
)
"""Definition of jackal_msgs/Feedback in ROS 1. It has two temperatures that the bundled definition of ROS 2 does not
have (docs.ros.org/en/api)."""


@dataclass(frozen=True, slots=True)
class TopicMessages:
    """The serialised messages of a topic.

    Attributes
    ----------
    stamp_ns : (n,) int64, log times [ns]
    payload : (n, size) uint8, a message in each row; or a list of messages if their sizes differ
    """

    topic: str
    message_type: str
    stamp_ns: Ints
    payload: NDArray[np.uint8] | Sequence[bytes]


@dataclass(frozen=True, slots=True)
class TopicPlan:
    """The values of the messages of a topic; a field without a value is zero or empty.

    Attributes
    ----------
    stamp_ns : (n,) stamps of the messages [ns]
    fixed : values that all messages have, by path (``drivers.0.measured_travel``)
    columns : values (n,) of each message, by path
    """

    topic: str
    message_type: str
    stamp_ns: Ints
    fixed: dict[str, object]
    columns: dict[str, NDArray[Any]]


@cache
def load_typestore(*, ros1: bool) -> Typestore:
    """Return the message types of ROS Noetic or of ROS 2 Jazzy, with the types of jackal_msgs."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)
    types = {name: bundled_definitions()[name] for name in JACKAL_TYPES}
    if ros1:
        types |= get_types_from_msg(ROS1_JACKAL_FEEDBACK, "jackal_msgs/msg/Feedback")
    store.register(types)
    return store


def topic_plans(columns: SensorColumns, options: WriteOptions) -> tuple[TopicPlan, ...]:
    """Return the topics of a log in the order of messages with equal stamps: wheels, position, heading."""
    known, enu = np.isfinite(columns.gnss_std_m), options.heading == "enu"
    variance = np.where(known, columns.gnss_std_m, 0.0) ** 2
    place = header_stamps(columns.gnss_stamp_ns) | {
        "status.status": columns.gnss_status.astype(np.int8),
        "latitude": columns.latitude_deg,
        "longitude": columns.longitude_deg,
        "altitude": columns.height_m,
        "position_covariance.0": variance,
        "position_covariance.4": variance,
        "position_covariance.8": variance * HEIGHT_STD_RATIO**2,
        "position_covariance_type": np.where(known, 2, 0).astype(np.uint8),
    }
    receiver: dict[str, object] = {"header.frame_id": "gps_link", "status.service": 1}
    # The convention decides world and body frame: in ENU the z axis of the body points up, in NED down (REP-145).
    yaw = np.pi / 2 - columns.heading_rad if enu else columns.heading_rad
    turned = header_stamps(columns.heading_stamp_ns) | {
        "orientation.z": np.sin(yaw / 2),
        "orientation.w": np.cos(yaw / 2),
        "angular_velocity.z": -columns.yaw_rate_radps if enu else columns.yaw_rate_radps,
    }
    imu: dict[str, object] = {
        "header.frame_id": "imu_link" if enu else "imu_link_ned",
        "orientation_covariance": np.diag([np.radians(options.heading_std_deg) ** 2] * 3).ravel(),
        "linear_acceleration.z": GRAVITY_MPS2 if enu else -GRAVITY_MPS2,
    }
    return (
        *_wheel_plans(columns, options),
        TopicPlan("/gps/fix", "sensor_msgs/msg/NavSatFix", columns.gnss_stamp_ns, receiver, place),
        TopicPlan("/imu/data", "sensor_msgs/msg/Imu", columns.heading_stamp_ns, imu, turned),
    )


def _wheel_plans(columns: SensorColumns, options: WriteOptions) -> Iterator[TopicPlan]:
    """Yield the topics of the wheels."""
    stamps, radius = columns.wheel_stamp_ns, options.wheel_radius_m
    travel = {"left": columns.wheel_position_left_m, "right": columns.wheel_position_right_m}
    speed = {"left": columns.wheel_v_left_mps, "right": columns.wheel_v_right_mps}
    # A wheel controller computes the twist without slip, in a body frame with x forward and y left (REP-103).
    forward, turn = (speed["right"] + speed["left"]) / 2, (speed["right"] - speed["left"]) / options.track_width_m
    changing, fixed = header_stamps(stamps), dict[str, object]()
    match options.wheels:
        case "joint_states":
            joints = {f"{end}_{side}_wheel_joint": side for end in ("front", "rear") for side in travel}
            for joint, side in enumerate(joints.values()):
                changing |= {f"position.{joint}": travel[side] / radius, f"velocity.{joint}": speed[side] / radius}
            fixed = {"name": list(joints), "position": np.zeros(4), "velocity": np.zeros(4)}
            yield TopicPlan("/joint_states", "sensor_msgs/msg/JointState", stamps, fixed, changing)
        case "odometry":
            changing |= {"twist.twist.linear.x": forward, "twist.twist.angular.z": turn}
            fixed = {"header.frame_id": "odom", "child_frame_id": "base_link", "pose.pose.orientation.w": 1.0}
            yield TopicPlan("/wheel_controller/odom", "nav_msgs/msg/Odometry", stamps, fixed, changing)
        case "twist_stamped":
            changing |= {"twist.linear.x": forward, "twist.angular.z": turn}
            fixed = {"header.frame_id": "base_link"}
            yield TopicPlan("/wheel_controller/twist", "geometry_msgs/msg/TwistStamped", stamps, fixed, changing)
        case "jackal_feedback":
            for driver, side in enumerate(travel):
                changing[f"drivers.{driver}.measured_travel"] = (travel[side] / radius).astype(np.float32)
                changing[f"drivers.{driver}.measured_velocity"] = (speed[side] / radius).astype(np.float32)
            yield TopicPlan("/feedback", "jackal_msgs/msg/Feedback", stamps, {}, changing)
        case "ticks":
            per_metre = options.counts_per_rev / (2 * np.pi * radius)
            for side, travelled in travel.items():
                # An Int32 counter wraps around, as numpy's narrowing cast of an integer does.
                counts = np.rint(travelled * per_metre).astype(np.int64).astype(np.int32)
                yield TopicPlan(f"/{side[0]}wheel_ticks", "std_msgs/msg/Int32", stamps, {}, {"data": counts})
        case "float64_pair":
            for side, values in speed.items():
                yield TopicPlan(f"/{side}_drive/velocity", "std_msgs/msg/Float64", stamps, {}, {"data": values})


def header_stamps(stamp_ns: Ints) -> dict[str, NDArray[Any]]:
    """Return the columns of the header of messages that hold their stamps (n,) [ns]."""
    return {
        "header.stamp.sec": (stamp_ns // 1_000_000_000).astype(np.uint32),
        "header.stamp.nanosec": (stamp_ns % 1_000_000_000).astype(np.uint32),
    }


def serialise_topic(plan: TopicPlan, store: Typestore, *, ros1: bool = False) -> TopicMessages:
    """Return the serialised messages of a topic.

    Parameters
    ----------
    plan : values of the messages
    store : definitions of message types, the type of the topic among them
    ros1 : whether to serialise in the format of ROS 1; otherwise CDR

    Raises
    ------
    ValueError
        A column has another type than its field.
    """
    message = blank_message(store, plan.message_type)
    for path, value in plan.fixed.items():
        _put(message, path, value)

    def encode() -> NDArray[np.uint8]:
        encoder = store.serialize_ros1 if ros1 else store.serialize_cdr
        return np.frombuffer(encoder(message, plan.message_type), dtype=np.uint8).copy()

    blank = encode()
    payload = np.tile(blank, (len(plan.stamp_ns), 1))
    for path, values in plan.columns.items():
        # The bytes of the message that change with the number are the place of the number in all messages.
        _put(message, path, np.frombuffer(b"\x11" * values.itemsize, values.dtype)[0])
        changed = np.flatnonzero(encode() != blank)
        _put(message, path, values.dtype.type(0))
        if len(changed) != values.itemsize or changed[-1] - changed[0] != values.itemsize - 1:
            raise ValueError(f"{path} is not a {values.dtype} field of {plan.message_type}")
        little_endian = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
        payload[:, changed[0] : changed[-1] + 1] = little_endian.view(np.uint8).reshape(len(values), -1)
    return TopicMessages(plan.topic, plan.message_type, plan.stamp_ns, payload)


def blank_message(store: Typestore, message_type: str) -> object:
    """Return a message whose numbers are 0, and whose texts and sequences are empty."""
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
    """Set the value at a path of a message, such as ``drivers.0.measured_travel``."""
    *parents, last = path.split(".")
    for step in parents:
        message = message[int(step)] if isinstance(message, list) else getattr(message, step)
    if isinstance(message, np.ndarray):
        message[int(last)] = value
    else:
        setattr(message, last, value)


def write_mcap(
    path: Path,
    topics: Sequence[TopicMessages],
    store: Typestore,
    *,
    compression: Compression,
    metadata: Mapping[str, str] | None = None,
    library: str = "icrtool",
) -> None:
    """Write an MCAP file of ROS 2 messages (CDR), with the definitions of the types that the store has.

    Parameters
    ----------
    metadata : content of the metadata record ``icrtool``; None: no such record
    library : name of the library in the header
    """
    from mcap.writer import CompressionType, Writer

    with path.open("wb") as stream:
        writer: Any = Writer(stream, compression=CompressionType[compression.upper()])
        writer.start(profile="ros2", library=library)
        channels = []
        for topic in topics:
            is_known = topic.message_type in store.fielddefs
            text = store.generate_msgdef(topic.message_type, ros_version=2)[0] if is_known else ""
            schema = writer.register_schema(topic.message_type, "ros2msg" if is_known else "", text.encode())
            channels.append(writer.register_channel(topic.topic, "cdr", schema))
        if metadata is not None:
            writer.add_metadata("icrtool", dict(metadata))
        for index, stamp_ns, data in _in_time_order(topics):
            writer.add_message(channels[index], log_time=stamp_ns, data=data, publish_time=stamp_ns)
        writer.finish()


def write_rosbag(path: Path, topics: Sequence[TopicMessages], store: Typestore, options: WriteOptions) -> None:
    """Write a ROS 1 bag, or a ROS 2 bag directory with sqlite3 storage, by `options.container`."""
    from rosbags import rosbag1, rosbag2

    bag: Any
    if options.container == "bag":
        bag = rosbag1.Writer(path)
        if options.compression != "none":
            bag.set_compression(rosbag1.Writer.CompressionFormat[options.compression.upper()])
    else:
        bag = rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin.SQLITE3)
        if options.compression != "none":
            mode = rosbag2.CompressionMode.MESSAGE if options.compression == "zstd" else rosbag2.CompressionMode.FILE
            bag.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
    with bag:
        connections = [bag.add_connection(topic.topic, topic.message_type, typestore=store) for topic in topics]
        for index, stamp_ns, data in _in_time_order(topics):
            bag.write(connections[index], stamp_ns, data)


def _in_time_order(topics: Sequence[TopicMessages]) -> Iterator[tuple[int, int, bytes]]:
    """Yield index of the topic, stamp [ns] and bytes of each message, sorted by stamp and then by topic."""
    if not topics:
        return
    stamps = np.concatenate([topic.stamp_ns for topic in topics])
    indices = np.repeat(np.arange(len(topics)), [len(topic.stamp_ns) for topic in topics])
    rows = np.concatenate([np.arange(len(topic.stamp_ns)) for topic in topics])
    order = np.argsort(stamps, kind="stable")
    payloads = [topic.payload for topic in topics]
    for index, stamp_ns, row in zip(indices[order].tolist(), stamps[order].tolist(), rows[order].tolist(), strict=True):
        yield index, stamp_ns, bytes(payloads[index][row])


def write_log(path: str | Path, columns: SensorColumns, options: WriteOptions) -> Path:
    """Write columns of sensors as a log in ROS conventions (REP-103, or REP-145 for NED), and return `path`.

    The log is written under another name in the same folder, and renamed when it is complete.

    Parameters
    ----------
    path : path of the file (``mcap``, ``bag``) or of the directory (``db3``); it must not exist
    columns : columns of the sensors in the frames of `icrtool`
    options : container, message types and conventions

    Raises
    ------
    OutputError
        `path` exists, or cannot be written.

    Notes
    -----
    Log times equal the stamps. Topics: ``/imu/data``, ``/gps/fix``, and by `options.wheels` ``/joint_states``,
    ``/wheel_controller/odom``, ``/wheel_controller/twist``, ``/feedback``, ``/left_drive/velocity`` with
    ``/right_drive/velocity``, or ``/lwheel_ticks`` with ``/rwheel_ticks``.
    """
    path = Path(path)
    if os.path.lexists(path):
        raise OutputError(path, "exists already", "remove it or choose another name")
    ros1 = options.container == "bag"
    store = load_typestore(ros1=ros1)
    plans = [plan for plan in topic_plans(columns, options) if len(plan.stamp_ns)]
    topics = [serialise_topic(plan, store, ros1=ros1) for plan in plans]
    try:
        with (
            tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as scratch,
            unfinished(Path(scratch)),
        ):
            partial = Path(scratch) / path.name
            if options.container == "mcap":
                write_mcap(partial, topics, store, compression=options.compression)
            else:
                write_rosbag(partial, topics, store, options)
            partial.rename(path)
    except (OSError, sqlite3.Error) as err:
        reason = err.strerror if isinstance(err, OSError) and err.strerror else str(err)
        raise OutputError(path, "cannot be written", reason) from err
    return path
