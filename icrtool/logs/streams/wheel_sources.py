"""Messages that hold the motion of the wheels, in one form: position or speed of two sides, or a body twist."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from icrtool.config import Config
from icrtool.errors import DefinitionError
from icrtool.kernels.arrays import Bools, Floats, Ints
from icrtool.logs.containers.channel import some_of
from icrtool.logs.messages.collectors import DYNAMIC_JOINT_STATE
from icrtool.logs.messages.topic_table import HEADER, TopicTable
from icrtool.logs.streams.metric_positions import REFERENCE_WORDS
from icrtool.logs.streams.sources import NEVER_MOVES, Source, of_topic
from icrtool.logs.streams.wheel_names import wheel_joints

Unit = Literal["rad", "m", "counts", "unknown"]

COMMANDED = re.compile(r"cmd|command|desired|target|setpoint|reference|joy", re.IGNORECASE)
COMMAND_NOTE = "commanded speeds, not measured ones: what the wheels did not do of them is in the ICRs and delays"
_FUSED = re.compile(
    r"filter|fused|combined|ekf|ukf|visual|(?<![a-z])vi?o(?![a-z])|camera|stereo|zed|realsense|t265|vins|rtab|mavros|amcl",
    re.IGNORECASE,
)
"""Names of odometry and twists that are fused with other sensors: used only where there is nothing better."""

ONE_TURN_RAD, LEAST_WRAP_RAD, FEWEST_WRAPS = 2 * np.pi + 1e-3, 1.5 * np.pi, 2
"""Positions that stay within one turn, and jump by nearly one turn this often, are recorded modulo a turn."""

MOST_WHEELS = 32
"""Of a side. A message that lists more is not of wheels, or was made to take time."""

_HALF_COUNTER = 1 << 31
_RPM = 2 * np.pi / 60

SIDEWAYS_SHARE = 0.2
"""A twist with more than this sideways, and no turn, is a velocity in east and north, not in the body frame."""


Pair = tuple[Floats, Floats]
"""Of the left and of the right side, (n,) each."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WheelMotion(Source):
    """The motion of the wheels in a topic, or in a pair of topics.

    Attributes
    ----------
    position : travelled since some start, in `unit`; None where not recorded
    speed : in `unit` per second; None where not recorded
    twist : (n, 2) forward speed [m/s] and turn rate [rad/s, counter-clockwise], where only that of the body is recorded
    joints : the joints that its messages list by name, where they do
    note : what a user must know of it
    """

    position: Pair | None = None
    speed: Pair | None = None
    unit: Unit = "rad"
    twist: Floats | None = None
    joints: tuple[str, ...] = ()
    note: str = ""

    @property
    def is_empty(self) -> bool:
        """Whether no row can be used, even where the topic is configured."""
        return self.twist is None and self.position is None and self.speed is None


_Paths = tuple[str, str, str]
"""Of the joints' names, positions and speeds."""

Sides = tuple[Floats | None, Floats | None]
Reader = Callable[[TopicTable, Config], WheelMotion]
Entry = tuple[tuple[str, ...], Reader]
"""The fields of a message type to take, and how to read them."""


def motion_of(motion: WheelMotion, position: Sides = (None, None), speed: Sides = (None, None)) -> WheelMotion:
    """Return a motion with what left and right recorded; without what one side lacks, or has no finite value of."""
    motion = replace(motion, position=_of_both(position), speed=_of_both(speed))
    if motion.is_empty:
        return replace(motion, problem=motion.problem or "has neither position nor speed of both sides")
    changes = any(float(np.ptp(side[np.isfinite(side)])) > 0.0 for side in motion.position or ())
    if changes or any(_nonzero(values) for values in (*(motion.speed or ()), motion.twist) if values is not None):
        return motion
    return replace(motion, score=motion.score - NEVER_MOVES, why=f"{motion.why}, never moves")


def _of_both(sides: Sides) -> Pair | None:
    left, right = sides
    if left is None or right is None or not (np.isfinite(left).any() and np.isfinite(right).any()):
        return None
    return left, right


def _nonzero(values: Floats) -> bool:
    return bool(np.any(values[np.isfinite(values)] != 0.0))


def _side_means(values: NDArray[Any], left: list[int], right: list[int]) -> tuple[Sides, list[int]]:
    """Return the mean over the joints of each side that have finite values, None where none has; and the dead joints.

    A joint that never changes while another one of its side does has a dead encoder, and is left out.
    """
    means: list[Floats | None] = []
    dead = _dead_joints(values, left, right)
    for places in (left, right):
        finite = [place for place in places if place not in dead and np.isfinite(values[:, place]).any()]
        if len(finite) == 1:
            means.append(values[:, finite[0]].astype(np.float64, copy=False))
        elif finite:
            of_side = values.T[finite].astype(np.float64, copy=False)
            of_side[np.isinf(of_side)] = np.nan  # infinity less infinity would warn
            means.append(of_side.mean(axis=0))
        else:
            means.append(None)
    return (means[0], means[1]), dead


def _dead_joints(values: NDArray[Any], left: list[int], right: list[int]) -> list[int]:
    """Return the places of the joints that never change while another one of their side does."""
    with np.errstate(invalid="ignore"):  # infinite ones are left out later
        changes = np.fmax.reduce(values, axis=0) > np.fmin.reduce(values, axis=0)
    return [place for side in (left, right) for place in side if not changes[place] and changes[side].any()]


def _dead_note(names: Sequence[str]) -> str:
    return f"{some_of(names)} never turns while the other wheels of its side do: left out" if names else ""


def _unwound(positions: Floats) -> Floats:
    """Return joint positions [rad] (n, k); those recorded modulo one turn are unwrapped.

    This is done before a side is averaged: a front and a rear wheel do not begin a turn at the same time.
    """
    unwound = positions
    with np.errstate(invalid="ignore"):  # infinite ones are left out later
        spread = np.fmax.reduce(positions, axis=0, initial=-np.inf) - np.fmin.reduce(positions, axis=0, initial=np.inf)
    for place in np.flatnonzero(spread <= ONE_TURN_RAD).tolist():
        column = positions[:, place]
        finite = np.flatnonzero(np.isfinite(column))
        steps = np.abs(np.diff(column[finite]))
        wraps = steps > np.pi
        if np.count_nonzero(wraps) >= FEWEST_WRAPS and float(steps[wraps].min()) > LEAST_WRAP_RAD:
            unwound = unwound.copy("K") if unwound is positions else unwound
            unwound[finite, place] = np.unwrap(column[finite])
    return unwound


def _joints(table: TopicTable, config: Config, paths: _Paths, score: float, what: str) -> WheelMotion:
    """Return the motion of messages that list joints by name, in any order; other joints may be listed in between."""
    codes, texts = table.words(paths[0])
    left, right = _wheels_among(texts, config)
    if not (left and right):
        advice = "name them in wheels.{left,right}_joints"
        named = f"no left and right wheel among its joints {some_of(texts)}; {advice}"
        return WheelMotion(**of_topic(table), problem=named if texts else "lists no joints")
    lefts, rights = len(left), len(right)
    if max(lefts, rights) > MOST_WHEELS:
        problem = f"lists {lefts} left and {rights} right wheels; at most {MOST_WHEELS} of a side are read"
        return WheelMotion(**of_topic(table), problem=problem)
    # Joints by their place among the wheels, left ones first; -1 for all others.
    wheel = np.full(len(texts) + 1, -1)
    wheel[left + right] = np.arange(lefts + rights)
    # All messages list the same joints in the same order: one row stands for them.
    same = codes.strides[0] == 0
    wheels = np.broadcast_to(wheel[codes[:1]], codes.shape) if same else wheel[codes]
    alike = _rows_alike(wheels[:1] if same else wheels, lefts, rights)
    if not alike.any():
        return WheelMotion(**of_topic(table), problem="left and right wheels come in different messages")
    if not alike.all():
        table, wheels = table.rows(alike), wheels[alike]
    sides = [*range(lefts)], [*range(lefts, lefts + rights)]
    # One after the other: the columns of all wheels of a long log are large.
    position, stuck = _side_means(_unwound(_by_wheel(table.find(paths[1]), wheels, lefts + rights)), *sides)
    speed, still = _side_means(_by_wheel(table.find(paths[2]), wheels, lefts + rights), *sides)
    why = f"{what}: left {some_of([texts[i] for i in left])}, right {some_of([texts[i] for i in right])}"
    note = _dead_note([texts[(left + right)[place]] for place in sorted({*stuck, *still})])
    return motion_of(WheelMotion(**of_topic(table), score=score, why=why, note=note), position, speed)


def _wheels_among(texts: Sequence[str], config: Config) -> tuple[list[int], list[int]]:
    left, right = wheel_joints(texts)
    given = config.wheels
    if given.left_joints:
        left = [i for i, name in enumerate(texts) if name in given.left_joints]
    if given.right_joints:
        right = [i for i, name in enumerate(texts) if name in given.right_joints]
    return left, right


def _rows_alike(wheels: Ints, lefts: int, rights: int) -> Bools:
    """Return the rows (n,) that list the set of wheels most rows list, of those sets with both sides.

    A mean over wheels that changes its members would jump.
    """
    listed = np.zeros((lefts + rights, len(wheels)), np.bool_).T
    for rows, wheel, _ in _listed_wheels(wheels):
        listed[rows, wheel] = True
    both: Bools = np.logical_and(listed[:, :lefts].any(axis=1), listed[:, lefts:].any(axis=1))
    sets = listed[both]
    if len(sets) and np.any(sets != sets[0]):
        _, which, count = np.unique(sets, axis=0, return_inverse=True, return_counts=True)
        both[both] = which.reshape(-1) == int(np.argmax(count))
    return both


def _by_wheel(values: NDArray[Any] | None, wheels: Ints, count: int) -> Floats:
    """Return the value of each wheel in each message (n, count), NaN where it is not listed."""
    by_wheel = np.full((count, len(wheels)), np.nan).T
    if values is not None:
        for rows, wheel, place in _listed_wheels(wheels[:, : values.shape[1]]):
            by_wheel[rows, wheel] = values[rows, place]
    return by_wheel


def _listed_wheels(wheels: Ints) -> Iterator[tuple[slice | Ints, int | Ints, int]]:
    """Yield rows, the wheel that they list (one, or one per row), and its position in the list."""
    for place, listed in enumerate(wheels.T):
        if len(listed) and (listed.strides[0] == 0 or (listed == listed[0]).all()):
            if listed[0] >= 0:
                yield slice(None), int(listed[0]), place
        else:
            rows = np.flatnonzero(listed >= 0)
            yield rows, listed[rows], place


def _by_name(paths: _Paths, score: float, what: str) -> Entry:
    def read(table: TopicTable, config: Config) -> WheelMotion:
        return replace(_joints(table, config, paths, score, what), joints=tuple(table.words(paths[0])[1]))

    return (*HEADER, *paths), read


def _by_place(
    paths: tuple[str, str], left: list[int], right: list[int], why: str, stamp: str = "header.stamp"
) -> Entry:
    """Return the entry of messages whose lists of positions and of speeds have each side at fixed positions."""
    length = max(left + right) + 1

    def read(table: TopicTable, _: Config) -> WheelMotion:
        position, speed = (table.column(path) for path in paths)
        if min(position.shape[1], speed.shape[1]) < length:
            raise DefinitionError(table.topic, f"{paths[0]} holds fewer than {length} elements")
        travelled, stuck = _side_means(_unwound(position.astype(np.float64)), left, right)
        turning, still = _side_means(speed, left, right)
        note = _dead_note([f"wheel {place}" for place in sorted({*stuck, *still})])
        return motion_of(WheelMotion(**of_topic(table, stamp), score=90.0, why=why, note=note), travelled, turning)

    return (f"{stamp}.sec", f"{stamp}.nanosec", *paths), read


def _segway(prefix: str, *header: str) -> Entry:
    """Return the entry of the status of a Segway RMP: wheel displacement [m] and speed [m/s]."""

    def read(table: TopicTable, _: Config) -> WheelMotion:
        def sides(quantity: str) -> Sides:
            left, right = (table.floats(f"{prefix}{side}_wheel_{quantity}") for side in ("left", "right"))
            return left, right

        why = "the base's wheel displacement and speed"
        base = WheelMotion(**of_topic(table), unit="m", score=90.0, why=why)
        return motion_of(base, sides("displacement"), sides("velocity"))

    fields = (f"{prefix}{side}_wheel_{what}" for side in ("left", "right") for what in ("velocity", "displacement"))
    return (*header, *fields), read


def _wheel_ticks(table: TopicTable, _: Config) -> WheelMotion:
    """Return the motion in xbot_msgs/WheelTick: counters that count up, with the direction of each wheel beside them.

    A step counts with the direction stated behind it, as in OpenMower's own xbot_positioning. Its driver leaves
    `valid_wheels` at 0, and the rear wheels are meant.
    """
    valid = table.integers("valid_wheels")
    bits = int(np.bitwise_or.reduce(valid)) if valid is not None else 0
    axles = [place for place, both in (("f", 3), ("r", 12)) if bits & both == both] or ["r"]

    def travelled(place: str) -> Floats:
        ticks, direction = table.integers(f"wheel_ticks_{place}"), table.column(f"wheel_direction_{place}")
        if ticks is None:
            raise DefinitionError(table.topic, f"its {table.message_type} has no whole numbers wheel_ticks_{place}")
        steps = np.abs(np.mod(np.diff(ticks) + _HALF_COUNTER, 2 * _HALF_COUNTER) - _HALF_COUNTER)
        return np.concatenate([[0.0], np.cumsum(np.where(direction[1:] != 0, -steps, steps))])

    per_metre = float(np.median(table.floats("wheel_tick_factor")))
    known = per_metre > 0
    sides = [sum(travelled(f"{axle}{side}") for axle in axles) / len(axles) for side in "lr"]
    left, right = (np.asarray(side) / (per_metre if known else 1.0) for side in sides)
    unit: Unit = "m" if known else "counts"
    why = f"ticks of the {' and '.join({'f': 'front', 'r': 'rear'}[axle] for axle in axles)} wheels"
    return motion_of(WheelMotion(**of_topic(table, "stamp"), unit=unit, score=90.0, why=why), (left, right))


def _autopilot_wheels(table: TopicTable, _: Config) -> WheelMotion:
    """Return the motion in mavros_msgs/WheelOdomStamped: travelled metres or rpm of each wheel, as its topic states.

    Wheel 0 is the left one in the configuration that comes with MAVROS.
    """
    values = table.column("data[*]").astype(np.float64)
    if values.shape[1] < 2:
        raise DefinitionError(table.topic, "its messages hold fewer than two wheels")
    sides = values[:, 0], values[:, 1]
    if "rpm" in table.topic.lower():
        rpm = WheelMotion(**of_topic(table), score=80.0, why="wheel speeds [rpm] of the autopilot: 0 left, 1 right")
        return motion_of(rpm, speed=(sides[0] * _RPM, sides[1] * _RPM))
    why = "wheel distances [m] of the autopilot: 0 left, 1 right"
    return motion_of(WheelMotion(**of_topic(table), unit="m", score=90.0, why=why), sides)


def _twist_motion(table: TopicTable, speed: str, sideways: str, turn: str, score: float, why: str) -> WheelMotion:
    twist = np.column_stack([table.column(speed), table.column(turn)]).astype(np.float64)
    note = ""
    if COMMANDED.search(table.topic):
        score, why, note = score - 40.0, f"{why} (commanded)", COMMAND_NOTE
    across = table.floats(sideways)
    forward_sum, across_sum = (float(np.nansum(np.abs(side))) for side in (twist[:, 0], across))
    problem = ""
    if not _nonzero(twist[:, 1]) and across_sum > SIDEWAYS_SHARE * forward_sum:
        problem = "moves sideways and never turns: a velocity in east and north, not in the body frame"
    return motion_of(
        WheelMotion(**of_topic(table), unit="m", twist=twist, score=score, why=why, note=note, problem=problem)
    )


def _scout(table: TopicTable, _: Config) -> WheelMotion:
    """Return the body twist in scout_msgs/ScoutStatus (its motor rpm is integer, and before the gearbox)."""
    why = "the base's own speed and turn rate, converted to wheel speeds with the track width"
    return _twist_motion(table, *_SCOUT, 70.0, why)


def _twist(prefix: str, score: float, what: str = "body twist", fused: float = 45.0) -> Entry:
    """Return the entry of a body twist; `fused` is subtracted from the score of a topic named as fused with others."""
    paths = (f"{prefix}linear.x", f"{prefix}linear.y", f"{prefix}angular.z")

    def read(table: TopicTable, _: Config) -> WheelMotion:
        lowered = score - (fused if _FUSED.search(table.topic) else 0.0)
        why = f"{what}, converted to wheel speeds with the track width"
        motion = _twist_motion(table, *paths, lowered, why)
        if REFERENCE_WORDS.search(table.topic) and not motion.problem:
            return replace(motion, problem="its name is that of a position reference, not of wheels")
        return motion

    return (*(HEADER if prefix else ()), *paths), read


_JOINTS = ("name[*]", "position[*]", "velocity[*]")
_JOINT_STATES = ("joints[*].name", "joints[*].position", "joints[*].velocity")
_LYNX = ("drivers[*].joint_name", "drivers[*].travel", "drivers[*].velocity")
_PUMA = _by_name(
    ("drivers_feedback[*].device_name", "drivers_feedback[*].travel", "drivers_feedback[*].speed"),
    90.0, "motor driver feedback by device name",
)  # fmt: skip
# Drive.msg of jackal_msgs and of clearpath_platform_msgs: 0 is left, 1 is right.
_TWO_DRIVERS = _by_place(
    ("drivers[*].measured_travel", "drivers[*].measured_velocity"), [0], [1],
    "motor driver feedback: driver 0 left, 1 right",
)  # fmt: skip
_SCOUT = ("linear_velocity", "lateral_velocity", "angular_velocity")
_SEGWAY_BARE, _SEGWAY_STAMPED = _segway(""), _segway("segway.", *HEADER)

WHEEL_TYPES: dict[str, Entry] = {
    "sensor_msgs/JointState": _by_name(_JOINTS, 100.0, "wheel joints by name"),
    DYNAMIC_JOINT_STATE: _by_name(_JOINTS, 95.0, "wheel joints by name"),
    "foxglove.JointStates": _by_name(_JOINT_STATES, 100.0, "wheel joints by name"),
    "jackal_msgs/Feedback": _TWO_DRIVERS,
    "clearpath_platform_msgs/Feedback": _TWO_DRIVERS,
    "clearpath_motor_msgs/LynxMultiFeedback": _by_name(_LYNX, 90.0, "motor driver feedback by joint name"),
    "clearpath_motor_msgs/PumaMultiFeedback": _PUMA,
    "puma_motor_msgs/MultiFeedback": _PUMA,
    "leo_msgs/WheelStates": _by_place(
        ("position[*]", "velocity[*]"), [0, 1], [2, 3],
        "four wheels: front left, rear left, front right, rear right", "stamp",
    ),
    "xbot_msgs/WheelTick": (
        ("stamp.sec", "stamp.nanosec", "wheel_tick_factor", "valid_wheels",
         *(f"wheel_{what}_{place}" for what in ("ticks", "direction") for place in ("fl", "fr", "rl", "rr"))),
        _wheel_ticks,
    ),
    "mavros_msgs/WheelOdomStamped": ((*HEADER, "data[*]"), _autopilot_wheels),
    "scout_msgs/ScoutStatus": ((*HEADER, *_SCOUT), _scout),
    **dict.fromkeys(("segway_rmp/SegwayStatusStamped", "segway_rmp_ros2/SegwayStatusStamped"), _SEGWAY_STAMPED),
    "segway_interfaces/Stamped": _SEGWAY_STAMPED,
    **dict.fromkeys(("segway_rmp/SegwayStatus", "segway_rmp_ros2/SegwayStatus"), _SEGWAY_BARE),
    "segway_interfaces/Segwaystatus": _SEGWAY_BARE,
    "nav_msgs/Odometry": _twist("twist.twist.", 60.0, "twist of the wheel odometry", fused=50.0),
    "geometry_msgs/TwistStamped": _twist("twist.", 50.0),
    "geometry_msgs/TwistWithCovarianceStamped": _twist("twist.twist.", 50.0),
    "geometry_msgs/Twist": _twist("", 40.0),
}  # fmt: skip
"""By message type: the fields to take, and how to read them."""
