"""Messages that tell how the wheels move, each brought to one form: two sides, position or speed, or a body twist."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from icrtool.config import Config
from icrtool.logio.sides import side_of, wheel_joints
from icrtool.logio.stamps import StampedRows, stamp_rows
from icrtool.logio.topic_table import TopicTable
from icrtool.tables import Floats, Ints

Unit = Literal["rad", "m", "counts", "unknown"]

COMMANDED = re.compile(r"cmd|command|desired|target|setpoint|reference|joy", re.IGNORECASE)
_NOT_WHEELS = re.compile(
    r"filter|fused|ekf|ukf|visual|\bvo\b|lidar|laser|icp|gps|gnss|\bins\b|vectornav|slam|ground|truth|global|map", re.IGNORECASE
)
_SPEED_WORDS = re.compile(r"vel|speed|rate|rpm|twist", re.IGNORECASE)
_PLACE_WORDS = re.compile(r"tick|count|enc|pos|angle|travel|dist|odo", re.IGNORECASE)
_BITS = {"Int8": 8, "UInt8": 8, "Int16": 16, "UInt16": 16, "Int32": 32, "UInt32": 32, "Int64": 64, "UInt64": 64}
_RPM_TO_RADPS = 2 * np.pi / 60


@dataclass(frozen=True, slots=True)
class WheelMotion:
    """What a topic, or a pair of topics, says of the wheels.

    Attributes
    ----------
    position_left, position_right : (n,) travelled since some start, in `position_unit`; None where not told
    speed_left, speed_right : (n,) in `speed_unit` per second; None where not told
    twist : (n, 2) forward speed [m/s] and turn rate [rad/s, counter-clockwise], where only the body's is told
    score : how well the type suits; `why` says it in words
    problem : why it cannot be used, empty when it can
    """

    topic: str
    message_type: str
    stamps: StampedRows
    position_left: Floats | None = None
    position_right: Floats | None = None
    position_unit: Unit = "rad"
    speed_left: Floats | None = None
    speed_right: Floats | None = None
    speed_unit: Unit = "rad"
    twist: Floats | None = None
    score: float = 0.0
    why: str = ""
    problem: str = ""


def _header(*paths: str) -> tuple[str, ...]:
    return ("header.stamp.sec", "header.stamp.nanosec", "header.frame_id", *paths)


def _side_mean(values: NDArray[Any], places: list[int]) -> Floats | None:
    """Return the mean over the joints of a side that say something; None where none ever does."""
    chosen = np.atleast_2d(values)[:, places] if values.ndim == 2 and places else np.empty((len(values), 0))  # noqa: PLR2004
    told = np.isfinite(chosen)
    if not told.any():
        return None
    count = told.sum(axis=1)
    total = np.where(told, chosen, 0.0).sum(axis=1)
    return np.divide(total, count, out=np.full(len(values), np.nan), where=count > 0)


def _joints(
    table: TopicTable, config: Config, names: str, position: str, speed: str, score: float, what: str
) -> WheelMotion | None:
    """Read messages that list joints by name."""
    codes = table.columns.get(names)
    if codes is None or not len(codes) or codes.shape[1] == 0:
        return None
    texts = table.texts[names]
    left, right = _joint_places(texts, config)
    empty = np.full((len(table), codes.shape[1]), np.nan)
    sides: dict[str, Floats | None] = {}
    for path in (position, speed):
        values = table.columns.get(path, empty)[:, : codes.shape[1]]
        values = np.pad(values, ((0, 0), (0, codes.shape[1] - values.shape[1])), constant_values=np.nan)
        for side, joints in (("left", left), ("right", right)):
            wanted = np.isin(codes, sorted(joints))
            sides[path + side] = _side_mean(np.where(wanted, values, np.nan), list(range(codes.shape[1])))
    if not (left and right):
        return WheelMotion(
            table.topic, table.message_type, stamp_rows(table), score=score,
            problem=f"no left and right wheel among its joints {', '.join(texts)}; name them in wheels.left_joints and wheels.right_joints",
        )  # fmt: skip
    both = {path: sides[path + "left"] is not None and sides[path + "right"] is not None for path in (position, speed)}
    return WheelMotion(
        table.topic,
        table.message_type,
        stamp_rows(table),
        position_left=sides[position + "left"] if both[position] else None,
        position_right=sides[position + "right"] if both[position] else None,
        speed_left=sides[speed + "left"] if both[speed] else None,
        speed_right=sides[speed + "right"] if both[speed] else None,
        score=score,
        why=f"{what}: left {', '.join(texts[i] for i in left)}, right {', '.join(texts[i] for i in right)}",
    )


def _joint_places(texts: list[str], config: Config) -> tuple[list[int], list[int]]:
    if config.wheels.left_joints or config.wheels.right_joints:
        given = (config.wheels.left_joints, config.wheels.right_joints)
        left, right = ([i for i, name in enumerate(texts) if name in names] for names in given)
        return left, right
    return wheel_joints(texts)


def _joint_state(table: TopicTable, config: Config) -> WheelMotion | None:
    return _joints(table, config, "name[*]", "position[*]", "velocity[*]", 100.0, "wheel joints by name")


def _lynx(table: TopicTable, config: Config) -> WheelMotion | None:
    prefix = "drivers_feedback[*]."
    return _joints(
        table, config, f"{prefix}joint_name", f"{prefix}travel", f"{prefix}velocity", 90.0, "motor driver feedback"
    )


def _two_drivers(position: str, speed: str) -> Callable[[TopicTable, Config], WheelMotion | None]:
    """Read messages with drivers[2]: 0 is left, 1 is right (jackal_msgs/Drive.msg, clearpath_platform_msgs/Drive.msg)."""

    def read(table: TopicTable, _: Config) -> WheelMotion | None:
        position_values, speed_values = table.columns.get(position), table.columns.get(speed)
        if position_values is None and speed_values is None:
            return None

        def side(values: NDArray[Any] | None, place: int) -> Floats | None:
            return None if values is None or values.shape[1] < 2 else values[:, place].astype(np.float64)  # noqa: PLR2004

        return WheelMotion(
            table.topic, table.message_type, stamp_rows(table),
            position_left=side(position_values, 0), position_right=side(position_values, 1),
            speed_left=side(speed_values, 0), speed_right=side(speed_values, 1),
            score=90.0, why="motor driver feedback: driver 0 left, 1 right",
        )  # fmt: skip

    return read


def _four_wheels(table: TopicTable, _: Config) -> WheelMotion | None:
    """Read leo_msgs/WheelStates: front left, rear left, front right, rear right."""
    position, speed = table.columns.get("position[*]"), table.columns.get("velocity[*]")
    if position is None or speed is None:
        return None
    return WheelMotion(
        table.topic, table.message_type, stamp_rows(table, "stamp"),
        position_left=_side_mean(position, [0, 1]), position_right=_side_mean(position, [2, 3]),
        speed_left=_side_mean(speed, [0, 1]), speed_right=_side_mean(speed, [2, 3]),
        score=90.0, why="four wheels: front left, rear left, front right, rear right",
    )  # fmt: skip


def _scout(table: TopicTable, _: Config) -> WheelMotion | None:
    """Read scout_msgs/ScoutStatus: the body twist the base reports (its motor rpm is integer, before the gearbox)."""
    return _twist_motion(
        table, "linear_velocity", "angular_velocity", 70.0, "the base's own speed and turn rate"
    )


def _segway(prefix: str) -> Callable[[TopicTable, Config], WheelMotion | None]:
    def read(table: TopicTable, _: Config) -> WheelMotion | None:
        if f"{prefix}left_wheel_velocity" not in table.columns:
            return None
        return WheelMotion(
            table.topic, table.message_type, stamp_rows(table),
            position_left=table.floats(f"{prefix}left_wheel_displacement"),
            position_right=table.floats(f"{prefix}right_wheel_displacement"),
            position_unit="m",
            speed_left=table.floats(f"{prefix}left_wheel_velocity"),
            speed_right=table.floats(f"{prefix}right_wheel_velocity"),
            speed_unit="m",
            score=90.0, why="the base's wheel displacement and speed",
        )  # fmt: skip

    return read


def _twist_motion(table: TopicTable, speed: str, turn: str, score: float, why: str) -> WheelMotion | None:
    if speed not in table.columns or turn not in table.columns:
        return None
    twist = np.column_stack([table.floats(speed), table.floats(turn)])
    if COMMANDED.search(table.topic):
        score, why = score - 40.0, f"{why} (commanded)"
    return WheelMotion(table.topic, table.message_type, stamp_rows(table), twist=twist, score=score, why=why)


def _odometry(table: TopicTable, _: Config) -> WheelMotion | None:
    score = 60.0 - (50.0 if _NOT_WHEELS.search(table.topic) else 0.0)
    why = "twist of the wheel odometry, undone with the track width"
    return _twist_motion(table, "twist.twist.linear.x", "twist.twist.angular.z", score, why)


def _twist(prefix: str, score: float) -> Callable[[TopicTable, Config], WheelMotion | None]:
    def read(table: TopicTable, _: Config) -> WheelMotion | None:
        lowered = score - (45.0 if _NOT_WHEELS.search(table.topic) or "fix" in table.topic else 0.0)
        why = "body twist, undone with the track width"
        return _twist_motion(table, f"{prefix}linear.x", f"{prefix}angular.z", lowered, why)

    return read


WHEEL_TYPES: dict[str, tuple[tuple[str, ...], Callable[[TopicTable, Config], WheelMotion | None]]] = {
    "sensor_msgs/JointState": (_header("name[*]", "position[*]", "velocity[*]"), _joint_state),
    "jackal_msgs/Feedback": (
        _header("drivers[*].measured_travel", "drivers[*].measured_velocity"),
        _two_drivers("drivers[*].measured_travel", "drivers[*].measured_velocity"),
    ),
    "clearpath_platform_msgs/Feedback": (
        _header("drivers[*].measured_travel", "drivers[*].measured_velocity"),
        _two_drivers("drivers[*].measured_travel", "drivers[*].measured_velocity"),
    ),
    "clearpath_motor_msgs/LynxMultiFeedback": (
        _header("drivers_feedback[*].joint_name", "drivers_feedback[*].travel", "drivers_feedback[*].velocity"),
        _lynx,
    ),
    "leo_msgs/WheelStates": (("stamp.sec", "stamp.nanosec", "position[*]", "velocity[*]"), _four_wheels),
    "scout_msgs/ScoutStatus": (_header("linear_velocity", "angular_velocity"), _scout),
    "nav_msgs/Odometry": (_header("twist.twist.linear.x", "twist.twist.angular.z"), _odometry),
    "geometry_msgs/TwistStamped": (_header("twist.linear.x", "twist.angular.z"), _twist("twist.", 50.0)),
    "geometry_msgs/TwistWithCovarianceStamped": (
        _header("twist.twist.linear.x", "twist.twist.angular.z"),
        _twist("twist.twist.", 50.0),
    ),
    "geometry_msgs/Twist": (("linear.x", "angular.z"), _twist("", 40.0)),
}
"""By message type: the fields to take, and how to read them."""

for _name, _prefix in (("segway_rmp/SegwayStatusStamped", "segway."), ("segway_rmp/SegwayStatus", "")):
    WHEEL_TYPES[_name] = (
        _header(*(f"{_prefix}{side}_wheel_{what}" for side in ("left", "right") for what in ("velocity", "displacement"))),
        _segway(_prefix),
    )

PAIR_TYPES = {f"std_msgs/{name}" for name in ("Float32", "Float64", "Int16", "Int32", "Int64", "UInt32")}
"""Types that come as one topic per side."""


def pair_motion(left: TopicTable, right: TopicTable, config: Config) -> WheelMotion:
    """Join a left and a right topic without headers: the right one is taken at the left one's stamps.

    Counters of the type's width are unwrapped. Positions are interpolated, speeds are held.
    """
    name = left.message_type.partition("/")[2]
    stamps = StampedRows(None, left.log_time_ns, "no header", 0)
    topic = f"{left.topic} + {right.topic}"
    values = [_unwrapped(table.columns["data"], _BITS.get(name)) for table in (left, right)]
    commanded = bool(COMMANDED.search(left.topic))
    score, why = 80.0 - (40.0 if commanded else 0.0), "a pair of topics" + (" (commanded)" if commanded else "")
    if not (len(left) and len(right)):
        return WheelMotion(topic, left.message_type, stamps, score=score, problem="one of the two holds no message")
    if _tells_position(left.topic, values[0], config, integer=name in _BITS):
        unit: Unit = "counts" if name in _BITS or config.wheels.quantity == "counts" else "unknown"
        other = np.interp(left.log_time_ns, right.log_time_ns, values[1])
        return WheelMotion(
            topic, left.message_type, stamps, position_left=values[0], position_right=other, position_unit=unit,
            score=score, why=f"{why}: {'ticks' if unit == 'counts' else 'angles or distances'}",
        )  # fmt: skip
    place = np.clip(np.searchsorted(right.log_time_ns, left.log_time_ns + _half_interval(left), side="right") - 1, 0, None)
    return WheelMotion(
        topic, left.message_type, stamps, speed_left=values[0], speed_right=values[1][place], speed_unit="unknown",
        score=score, why=f"{why}: speeds",
    )  # fmt: skip


def _half_interval(table: TopicTable) -> int:
    """Two messages of one control cycle are logged one after the other: half an interval joins them."""
    return int(np.median(np.diff(table.log_time_ns))) // 2 if len(table) > 1 else 0


def _unwrapped(values: NDArray[Any], bits: int | None) -> Floats:
    if bits is None or bits == 64 or not len(values):  # noqa: PLR2004 - float64 holds no more of a 64-bit count
        return values.astype(np.float64)
    span = 1 << bits
    steps = (np.diff(values.astype(np.int64)) + span // 2) % span - span // 2
    return np.concatenate([[0], np.cumsum(steps)]).astype(np.float64) + float(values[0])


def _tells_position(topic: str, values: Floats, config: Config, *, integer: bool) -> bool:
    """Say whether a pair's numbers are travelled positions (ticks, angles), not speeds."""
    if config.wheels.quantity != "auto":
        return config.wheels.quantity in ("position", "counts")
    if _SPEED_WORDS.search(topic):
        return False
    if _PLACE_WORDS.search(topic):
        return True
    finite = values[np.isfinite(values)]
    if len(finite) < 3 or np.ptp(finite) == 0:  # noqa: PLR2004 - too few to tell
        return integer
    # A position's steps add up to about its range; a speed goes up and down around few values.
    return bool(np.abs(np.diff(finite)).sum() < 3.0 * np.ptp(finite) and np.ptp(finite) > 5.0)


def left_topics(topics: list[str]) -> list[str]:
    """Return the topics that may be the left one of a pair, surest first."""
    return sorted(topics, key=lambda topic: (side_of(topic.rsplit("/", 1)[-1]) != "left" and side_of(topic) != "left", topic))


