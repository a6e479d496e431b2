"""Small logs of a drive whose wheels, places and headings are known, written message by message as robots do."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.writer import Writer
from pymap3d import ned2geodetic
from rosbags.typesys import Stores, get_typestore

from icrtool.kernels.arrays import Floats, Ints
from support.drives import EPOCH_NS, ICRS
from support.matrix_filter import drive_states

STORE = get_typestore(Stores.ROS2_HUMBLE)
RADIUS_M, WIDTH_M = 0.165, 0.55
DATUM = (48.1, 11.6, 500.0)
ROBOT = (f"robot.track_width_m={WIDTH_M}", f"robot.wheel_radius_m={RADIUS_M}")


class Drive(NamedTuple):
    """A drive of curves to both sides; every column is (n,) at `stamp_ns`.

    Attributes
    ----------
    left, right : angle of the wheels [rad]; left_radps, right_radps : their speed, held until the next stamp
    north, east : [m]; heading : [rad] clockwise from north; turn : [rad/s] clockwise
    """

    stamp_ns: Ints
    left: Floats
    right: Floats
    left_radps: Floats
    right_radps: Floats
    north: Floats
    east: Floats
    heading: Floats
    turn: Floats


class Message(NamedTuple):
    """A message as it is logged; its content may be encoded already."""

    log_ns: int
    topic: str
    kind: str
    content: Any


def make_drive(seconds: float = 60.0, rate: float = 20.0, *, slower: float = 1.0) -> Drive:
    """Drive with the ICRs `support.drives.ICRS`, at 0.5 m/s times `slower`."""
    t = np.arange(0.0, seconds, 1.0 / rate)
    v_left = slower * (0.5 + 0.4 * np.sin(0.5 * slower * t))
    v_right = slower * (0.5 + 0.4 * np.sin(0.31 * slower * t + 1.0))
    x = drive_states(np.array([0.0, 0.0, 0.3, *ICRS]), v_left, v_right, 1.0 / rate)
    speeds = v_left / RADIUS_M, v_right / RADIUS_M
    angles = (np.append(0.0, np.cumsum(speed[:-1]) / rate) for speed in speeds)
    turn = np.append(np.diff(x[:, 2]) * rate, 0.0)
    return Drive(EPOCH_NS + np.round(t * 1e9).astype(np.int64), *angles, *speeds, *x[:, :3].T, turn)


def made(kind: str, **fields: Any) -> Any:
    """Return a message; fields that are not given are 0 or empty, and belong to all messages of the type."""
    return STORE.types[kind](**_blank(kind) | fields)


@functools.cache
def _blank(kind: str) -> dict[str, Any]:
    values = {}
    for name, (node, detail) in STORE.fielddefs[kind][1]:
        if int(node) == 2:
            values[name] = made(detail)
        elif int(node) == 1:
            values[name] = "" if detail[0] == "string" else 0
        else:
            (_, inner), count = detail
            numbers = isinstance(inner, tuple) and inner[0] != "string"
            values[name] = np.zeros(count if int(node) == 3 else 0, inner[0]) if numbers else []
    return values


def header(stamp_ns: int, frame: str = "base_link") -> Any:
    """Return a header."""
    stamp = made("builtin_interfaces/msg/Time", sec=int(stamp_ns) // 10**9, nanosec=int(stamp_ns) % 10**9)
    return made("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def joint_states(drive: Drive, topic: str = "/joint_states") -> Iterator[Message]:
    """Yield the angles and speeds of two wheels."""
    kind = "sensor_msgs/msg/JointState"
    for i, stamp_ns in enumerate(drive.stamp_ns.tolist()):
        both = np.array([drive.left[i], drive.right[i]]), np.array([drive.left_radps[i], drive.right_radps[i]])
        names = ["left_wheel", "right_wheel"]
        message = made(kind, header=header(stamp_ns), name=names, position=both[0], velocity=both[1])
        yield Message(stamp_ns, topic, kind, message)


def fixes(drive: Drive, topic: str = "/gps/fix", every: int = 4, *, status: int = 2) -> Iterator[Message]:
    """Yield fixes without noise that state 12 mm."""
    kind = "sensor_msgs/msg/NavSatFix"
    latitude, longitude, _ = ned2geodetic(drive.north, drive.east, 0.0 * drive.north, *DATUM)
    for i in range(0, len(drive.stamp_ns), every):
        stamp_ns = int(drive.stamp_ns[i])
        message = made(
            kind, header=header(stamp_ns, "gps"), latitude=float(latitude[i]), longitude=float(longitude[i]),
            altitude=DATUM[2], position_covariance=np.diag([0.012**2] * 3).ravel(), position_covariance_type=2,
            status=made("sensor_msgs/msg/NavSatStatus", status=status, service=1),
        )  # fmt: skip
        yield Message(stamp_ns, topic, kind, message)


def imus(
    drive: Drive, topic: str = "/imu/data", *, unit: float = 1.0, noise: float = 0.0, oriented: bool = True
) -> Iterator[Message]:
    """Yield orientations, and turn rates times `unit` with some noise [rad/s] (standard deviation)."""
    absent = np.zeros(9) if oriented else np.array([-1.0, *[0.0] * 8])
    kind, rng = "sensor_msgs/msg/Imu", np.random.default_rng(3)
    rates = -drive.turn + rng.normal(0.0, noise, len(drive.turn)) if noise else -drive.turn
    for i, stamp_ns in enumerate(drive.stamp_ns.tolist()):
        half = (np.pi / 2 - drive.heading[i]) / 2
        turned = made("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=float(np.sin(half)), w=float(np.cos(half)))
        rate = made("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=float(rates[i] * unit))
        message = made(
            kind, header=header(stamp_ns, "imu"), orientation=turned, angular_velocity=rate,
            orientation_covariance=absent,
        )  # fmt: skip
        yield Message(stamp_ns, topic, kind, message)


def numbers(
    topic: str, kind: str, stamps_ns: Sequence[int] | Ints, values: Sequence[Any] | Floats | Ints
) -> Iterator[Message]:
    """Yield messages of ``std_msgs`` that hold a number."""
    for stamp_ns, value in zip(np.asarray(stamps_ns).tolist(), np.asarray(values).tolist(), strict=True):
        yield Message(stamp_ns, topic, f"std_msgs/msg/{kind}", made(f"std_msgs/msg/{kind}", data=value))


_references: dict[int, tuple[Drive, list[Message]]] = {}


def reference(drive: Drive) -> list[Message]:
    """Return `fixes` and `imus` of a drive, encoded once for all logs of this drive: encoding takes longest."""
    if id(drive) not in _references:
        messages = [
            one._replace(content=bytes(STORE.serialize_cdr(one.content, one.kind)))
            for one in (*fixes(drive), *imus(drive))
        ]
        _references[id(drive)] = drive, messages  # a drive that is kept keeps its id
    return _references[id(drive)][1]


def write_messages(
    path: Path,
    *streams: Iterable[Message],
    definitions: Mapping[str, str] | Callable[[str], str] | None = None,
) -> Path:
    """Write an MCAP file.

    Parameters
    ----------
    definitions : texts by type, or what is made of the text of every type
    """
    messages = sorted((one for stream in streams for one in stream), key=lambda one: one.log_ns)
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channels: dict[tuple[str, str], int] = {}
        for log_ns, topic, kind, content in messages:
            if (topic, kind) not in channels:
                text = STORE.generate_msgdef(kind, ros_version=2)[0]
                if callable(definitions):
                    text = definitions(text)
                elif definitions is not None:
                    text = definitions.get(kind, text)
                schema = writer.register_schema(kind, "ros2msg", text.encode())
                channels[topic, kind] = writer.register_channel(topic, "cdr", schema)
            data = content if isinstance(content, bytes) else bytes(STORE.serialize_cdr(content, kind))
            writer.add_message(channels[topic, kind], log_ns, data, log_ns)
        writer.finish()
    return path
