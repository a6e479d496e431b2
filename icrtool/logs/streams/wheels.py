"""Readers of messages with the motion of the wheels: positions or speeds of two sides, or a body twist."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from icrtool.config import Config
from icrtool.errors import DefinitionError
from icrtool.kernels.arrays import Floats, unwrapped
from icrtool.logs.messages.topic_table import TopicTable
from icrtool.logs.streams.positions import LARGEST_PLACE_M, REFERENCE_WORDS
from icrtool.logs.streams.sources import (
    NEVER_MOVES_PENALTY,
    Sides,
    WheelSource,
    make_wheel_source,
    topic_fields,
    wheels_move,
)
from icrtool.records.notes import Note, note
from icrtool.records.samples import WheelUnit
from icrtool.records.text import listed

ONE_TURN_RAD = 2 * np.pi + 1e-3
"""Largest range of positions that are recorded modulo one turn [rad]."""

LEAST_WRAP_RAD = 1.5 * np.pi
"""Smallest step of a position that passes the end of a turn [rad]."""

FEWEST_WRAPS = 2
"""Smallest number of such steps that show that positions are recorded modulo one turn."""

Quantity = Literal["position", "speed"]

MOST_WHEELS = 32
"""Largest number of wheels of a side. A message that lists more is not of wheels, or is made to fill the memory."""


def average_wheels(
    wheels: Callable[[Quantity], list[NDArray[Any]]], lefts: int, names: Sequence[str], unit: WheelUnit, **others: Any
) -> WheelSource:
    """Return the mean over the wheels of each side; wheels without an encoder, or with a dead encoder, are left out.

    Parameters
    ----------
    wheels : returns the positions or the speeds (n,) of each wheel, the left wheels first; an empty list where they are
        not recorded
    lefts : number of wheels of the left side
    names : names of all wheels
    unit : unit of the positions, and of the speeds per second
    others : further arguments of `make_wheel_source`
    """
    means: dict[Quantity, Sides] = {"position": (None, None), "speed": (None, None)}
    dead: set[int] = set()
    # Positions and speeds are read one after the other, because the columns of all wheels of a long log are large.
    for quantity in means:
        columns = wheels(quantity)
        if columns:
            # Turns are unwound before the mean of a side, because its wheels do not complete a turn at the same time.
            turns_modulo = quantity == "position" and unit == "rad"
            means[quantity], stuck = _side_means([*map(unwind_turns, columns)] if turns_modulo else columns, lefts)
            dead |= stuck
    text = f"{listed([names[i] for i in sorted(dead)])} never turns, but the other wheels of its side do: left out"
    notes = (note("wheel_dead", text),) if dead else ()
    return make_wheel_source(position=means["position"], speed=means["speed"], unit=unit, notes=notes, **others)


def _side_means(columns: Sequence[NDArray[Any]], lefts: int) -> tuple[Sides, set[int]]:
    """Return the mean over the wheels of each side with finite values (None without such a wheel), and the dead wheels.

    A wheel has a dead encoder if its values never change while the values of another wheel of its side do.
    """
    changes = np.array([np.fmax.reduce(column) > np.fmin.reduce(column) for column in columns])
    means: list[Floats | None] = []
    dead: set[int] = set()
    for side in (range(lefts), range(lefts, len(columns))):
        dead |= {wheel for wheel in side if not changes[wheel] and changes[side].any()}
        columns_of_side = [columns[wheel] for wheel in side if wheel not in dead and np.isfinite(columns[wheel]).any()]
        if len(columns_of_side) > 1:
            # Infinite values are replaced by NaN, because infinity minus infinity makes NumPy warn.
            finite = (np.where(np.isinf(column), np.nan, column) for column in columns_of_side)
            means.append(sum(finite, np.zeros(len(columns_of_side[0]))) / len(columns_of_side))
        else:
            means.append(columns_of_side[0].astype(np.float64) if columns_of_side else None)
    return (means[0], means[1]), dead


def unwind_turns(position: Floats) -> Floats:
    """Return positions of a wheel (n,) [rad], unwrapped if they are recorded modulo one turn."""
    # Infinity minus infinity is NaN, which is not within a turn.
    with np.errstate(invalid="ignore"):
        if not np.fmax.reduce(position) - np.fmin.reduce(position) <= ONE_TURN_RAD:
            return position
    finite = np.flatnonzero(np.isfinite(position))
    steps = np.abs(np.diff(position[finite]))
    wraps = steps > np.pi
    if np.count_nonzero(wraps) < FEWEST_WRAPS or float(steps[wraps].min()) <= LEAST_WRAP_RAD:
        return position
    unwound = position.copy()
    unwound[finite] = unwrapped(position[finite])
    return unwound


_ELEMENTS = re.compile(r"\[([\d,]+)\]")


def column_and_elements(path: str) -> tuple[str, list[int]]:
    """Return the column that holds a field, and the indices of its elements: ``data[*]``, [0, 2] for ``data[0,2]``."""
    match = _ELEMENTS.search(path)
    elements = [int(element) for element in match[1].split(",") if element] if match is not None else []
    return _ELEMENTS.sub("[*]", path, count=1), elements


@dataclass(frozen=True, slots=True)
class FixedWheels:
    """A message type that has the wheels of each side in separate fields, or as fixed elements of lists.

    Attributes
    ----------
    label : name of the data, for the reason of a choice
    worth : score of the type; the source with the highest score is chosen
    position, speed : fields of the left and of the right side; for several elements of a list, their mean
    unit : unit of the positions, and of the speeds per second
    factor : factor that converts recorded numbers to `unit`
    """

    label: str
    worth: float
    position: tuple[str, ...] = ()
    speed: tuple[str, ...] = ()
    unit: WheelUnit = "rad"
    factor: float = 1.0

    @property
    def fields(self) -> tuple[str, ...]:
        """The fields that are read."""
        return tuple(column_and_elements(path)[0] for path in (*self.position, *self.speed))

    def read(self, table: TopicTable, _: Config) -> WheelSource:
        """Return the motion of both sides.

        Raises
        ------
        DefinitionError
            A list holds fewer elements than there are wheels.
        """
        paths = {"position": self.position, "speed": self.speed}

        def wheels_of(quantity: Quantity) -> list[NDArray[Any]]:
            wheels: list[NDArray[Any]] = []
            for column, elements in map(column_and_elements, paths[quantity]):
                values = table.find(column)
                if values is None:
                    return []
                if elements and (values.ndim != 2 or max(elements) >= values.shape[1]):
                    raise DefinitionError(table.topic, f"{column} holds fewer than {max(elements) + 1} elements")
                wheels += [values[:, element] * self.factor for element in elements] or [values * self.factor]
            return wheels

        lefts, rights = (len(column_and_elements(path)[1]) or 1 for path in self.position or self.speed)
        names = [f"wheel {i}" for i in range(lefts + rights)]
        return average_wheels(
            wheels_of, lefts, names, self.unit, **topic_fields(table), score=self.worth, why=self.label
        )


_HALF_COUNTER = 1 << 31
"""Half of the modulus of the counters of xbot_msgs/WheelTick."""

TICK_FIELDS = (
    "wheel_tick_factor",
    "valid_wheels",
    *(f"wheel_{field}_{wheel}" for field in ("ticks", "direction") for wheel in ("fl", "fr", "rl", "rr")),
)
"""Fields of xbot_msgs/WheelTick: factor, mask of the wheels, and ticks and direction of each wheel."""


def read_ticks(table: TopicTable, _: Config) -> WheelSource:
    """Return the motion in messages of xbot_msgs/WheelTick: counters that only count up, and directions of the wheels.

    A step has the direction in the message after it, as in OpenMower's xbot_positioning. The driver of OpenMower leaves
    `valid_wheels` at 0; the rear wheels are then used.

    Raises
    ------
    DefinitionError
        The type, as the log defines it, lacks the counters.
    """
    valid = table.integers("valid_wheels")
    bits = int(np.bitwise_or.reduce(valid)) if valid is not None else 0
    axles = [axle for axle, both in (("f", 3), ("r", 12)) if bits & both == both] or ["r"]
    # The median of infinite numbers of both signs is NaN.
    with np.errstate(invalid="ignore"):
        per_metre = float(np.median(table.floats("wheel_tick_factor")))
    has_scale = per_metre > 0
    sides = [np.zeros(len(table)), np.zeros(len(table))]
    for side, axle in product((0, 1), axles):
        name = f"{axle}{'lr'[side]}"
        ticks, direction = table.integers(f"wheel_ticks_{name}"), table.column(f"wheel_direction_{name}")
        if ticks is None:
            why = f"its type {table.message_type} has no field wheel_ticks_{name} with whole numbers"
            raise DefinitionError(table.topic, why)
        steps = np.abs(np.mod(np.diff(ticks) + _HALF_COUNTER, 2 * _HALF_COUNTER) - _HALF_COUNTER)
        sides[side][1:] += np.cumsum(np.where(direction[1:] != 0, -steps, steps)) / len(axles)
    left, right = (side / (per_metre if has_scale else 1.0) for side in sides)
    unit: WheelUnit = "m" if has_scale else "counts"
    why = f"ticks of the {' and '.join({'f': 'front', 'r': 'rear'}[axle] for axle in axles)} wheels"
    return make_wheel_source(**topic_fields(table), position=(left, right), unit=unit, score=90.0, why=why)


COMMANDED = re.compile(r"cmd|command|desired|target|setpoint|reference|joy", re.IGNORECASE)
"""Words in names of topics that hold commanded speeds."""

COMMAND_NOTES = (
    note(
        "wheels_commanded",
        "these are commanded speeds, not measured ones: their difference from the wheel speeds is in ICRs and delays",
    ),
)
"""Findings about wheels whose speeds are commands."""

COMMANDED_PENALTY = 40.0
"""Number that is subtracted from the score of a topic with commanded speeds."""

_FUSED = re.compile(
    r"filter|fused|combined|ekf|ukf|visual|(?<![a-z])vi?o(?![a-z])|camera|stereo|zed|realsense|t265|vins|rtab|mavros|amcl",
    re.IGNORECASE,
)
"""Words in names of odometry and twists that are fused with other sensors. Such a topic gets a lower score."""

SIDEWAYS_SHARE = 0.2
"""Largest ratio of sideways to forward motion of a twist in the body frame. A twist with a larger ratio and without
turns is a velocity in east and north."""


@dataclass(frozen=True, slots=True)
class Twist:
    """A message type with the velocity of the body.

    Attributes
    ----------
    label : name of the data, for the reason of a choice
    worth : score of the type; the source with the highest score is chosen
    path : path of the twist in the message, with a dot at its end
    forward, sideways, turn : fields of the twist: speeds [m/s], and turn rate counter-clockwise [rad/s]
    fused : number that is subtracted from the worth if the name shows a fused topic; 0 for types that only a robot base
        sends
    """

    label: str
    worth: float
    path: str = ""
    forward: str = "linear.x"
    sideways: str = "linear.y"
    turn: str = "angular.z"
    fused: float = 0.0

    @property
    def fields(self) -> tuple[str, ...]:
        """The fields that are read."""
        return tuple(f"{self.path}{field}" for field in (self.forward, self.sideways, self.turn))

    def read(self, table: TopicTable, _: Config) -> WheelSource:
        """Return the twist of a topic; raise `DefinitionError` where the type lacks it."""
        return self.read_twist(table)

    def read_twist(self, table: TopicTable) -> WheelSource:
        """Return the twist of a topic, with a `problem` if it is of a position reference, or in east and north."""
        forward, sideways, turn = (f"{self.path}{field}" for field in (self.forward, self.sideways, self.turn))
        twist = np.column_stack([table.column(forward), table.column(turn)]).astype(np.float64)
        forward_sum, across_sum = (float(np.nansum(np.abs(side))) for side in (twist[:, 0], table.floats(sideways)))
        score, why, known = (
            self.worth,
            f"{self.label}, converted to wheel speeds with the track width",
            tuple[Note, ...](),
        )
        score -= self.fused if _FUSED.search(table.topic) else 0.0
        if COMMANDED.search(table.topic):
            score, why, known = score - COMMANDED_PENALTY, f"{why} (commanded)", COMMAND_NOTES
        problem = ""
        if not wheels_move(twist[:, 1]) and across_sum > SIDEWAYS_SHARE * forward_sum:
            problem = "moves sideways and never turns: it is a velocity in east and north, not in the body frame"
        elif self.fused and REFERENCE_WORDS.search(table.topic):
            problem = "its name is the name of a position reference, not of wheels"
        return make_wheel_source(
            **topic_fields(table), twist=twist, unit="m", score=score, why=why, notes=known, problem=problem
        )


ODOMETRY_POSE_PATH = "pose.pose."
"""Beginning of the fields of the pose in an odometry message."""

ODOMETRY_POSE = tuple(
    f"{ODOMETRY_POSE_PATH}{field}"
    for field in ("position.x", "position.y", *(f"orientation.{axis}" for axis in "xyzw"))
)
"""Fields of the pose of an odometry."""

LEAST_POSE_TRAVEL_M, LEAST_POSE_TURN_RAD = 1.0, 0.5
"""Smallest distance [m] and turn [rad] of a pose that is used in place of a twist that stays 0."""

POSE_PENALTY = 20.0
"""Number that is subtracted from the score of an odometry whose twist stays 0, so that a twist is preferred."""


@dataclass(frozen=True, slots=True)
class OdometryTwist(Twist):
    """A message type with the velocity of the body, and with a pose by the wheels that is used if the velocity is 0."""

    @property
    def fields(self) -> tuple[str, ...]:
        """The fields that are read."""
        return (*(f"{self.path}{field}" for field in (self.forward, self.sideways, self.turn)), *ODOMETRY_POSE)

    def read(self, table: TopicTable, _: Config) -> WheelSource:
        """Return the twist, or, if it stays 0 while the pose moves, the distance and the turn of the pose."""
        wheels = self.read_twist(table)
        if (
            wheels.twist is None
            or wheels_move(wheels.twist)
            or not all(path in table.columns for path in ODOMETRY_POSE)
        ):
            return wheels
        travelled = pose_travel(*(table.floats(path) for path in ODOMETRY_POSE))
        if travelled is None:
            return wheels
        text = (
            f"{table.topic}: its twist stays 0 while its pose moves {travelled[-1, 0]:.1f} m forward: distance and "
            "turn of the pose are used as wheel odometry; topics.wheels sets another topic"
        )
        score = wheels.score + NEVER_MOVES_PENALTY - POSE_PENALTY
        words = "pose of the wheel odometry (its twist stays 0), converted to wheel speeds with the track width"
        return replace(
            wheels, travelled=travelled, score=score, why=words,
            notes=(*wheels.notes, note("wheels_from_pose", text)),
        )  # fmt: skip


def pose_travel(x: Floats, y: Floats, qx: Floats, qy: Floats, qz: Floats, qw: Floats) -> Floats | None:
    """Return distance forward [m] and turn [rad] (n, 2) of poses; None if they do not move and turn.

    The distance of a step is its displacement along the heading in the middle of the step, which is exact on an arc.

    Parameters
    ----------
    x, y : (n,) positions [m]
    qx, qy, qz, qw : (n,) components of the quaternion
    """
    sizes = [np.abs(column) for column in (x, y, qx, qy, qz, qw)]
    # Numbers beyond LARGEST_PLACE_M are refused, so that squares do not overflow; a quaternion of zeros is no rotation.
    sound = np.logical_and.reduce([size < LARGEST_PLACE_M for size in sizes]) & (np.maximum(sizes[4], sizes[5]) > 0.0)
    if len(x) < 2 or not sound.all():
        return None
    yaw = unwrapped(np.arctan2(2.0 * (qw * qz + qx * qy), qw**2 + qx**2 - qy**2 - qz**2))
    middle, turn = (yaw[1:] + yaw[:-1]) / 2.0, np.diff(yaw)
    chord = np.diff(x) * np.cos(middle) + np.diff(y) * np.sin(middle)
    # The chord of an arc is shorter than the arc by the factor sin(turn / 2) / (turn / 2).
    step = chord / np.sinc(turn / (2.0 * np.pi))
    if float(np.abs(step).sum()) < LEAST_POSE_TRAVEL_M or float(np.ptp(yaw)) < LEAST_POSE_TURN_RAD:
        return None
    return np.column_stack([np.append(0.0, np.cumsum(step)), yaw - yaw[0]])


WHEEL_WORDS = re.compile(r"wheel|track(?!er|ing)|sprocket|drive|motor|tire|tyre", re.IGNORECASE)
"""Words in names of joints that are wheels."""

_OTHER_JOINTS = re.compile(
    r"(arm|pan|tilt|lift)\d*|(gripper|flipper|finger|steer|elbow|shoulder|wrist|caster|camera|rocker|bogie|suspension).*"
)
"""Pattern of words in names of joints that are no wheels. It must match a complete word: "panther" is not "pan"."""

_TOKENS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
_LEFT_TOKENS = {"l", "left", "fl", "rl", "bl", "ml", "lf", "lb", "lr", "lm", "lh", "lwheel", "wl"}
_RIGHT_TOKENS = {"r", "right", "fr", "rr", "br", "mr", "rf", "rb", "rm", "rh", "rwheel", "wr"}


def wheel_joints(names: Sequence[str]) -> tuple[list[int], list[int]]:
    """Return the indices of the left and of the right wheel joints among the names in a message."""
    sides = [(i, *side_of(name)) for i, name in enumerate(names)]
    any_named = any(named for _, side, named in sides if side)
    left, right = (
        [i for i, side, named in sides if side == wanted and named >= any_named] for wanted in ("left", "right")
    )
    return left, right


@lru_cache(4096)
def side_of(name: str) -> tuple[Literal["left", "right", ""], bool]:
    """Return the side of a joint that may be a wheel (empty for other joints), and whether its name is of a wheel.

    The words of names such as ``wheel_FL_joint``, ``frontLeftWheel`` and ``panther/rl_wheel_joint`` are separated.
    """
    words = {word.lower() for word in _TOKENS.findall(name.replace("_", " "))}
    left, right = "left" in name.lower(), "right" in name.lower()
    if left == right:
        left, right = bool(words & _LEFT_TOKENS), bool(words & _RIGHT_TOKENS)
    named = bool(WHEEL_WORDS.search(name))
    if left == right or any(_OTHER_JOINTS.fullmatch(word) for word in words):
        return "", named
    return ("left" if left else "right"), named
