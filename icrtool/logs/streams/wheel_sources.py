"""Messages that hold the motion of the wheels, in one form: position or speed of two sides, or a body twist."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from icrtool.config import Config
from icrtool.errors import DefinitionError
from icrtool.kernels.arrays import Floats
from icrtool.logs.messages.collectors import DYNAMIC_JOINT_STATE
from icrtool.logs.messages.topic_table import HEADER, TopicTable
from icrtool.logs.streams.position_sources import REFERENCE_WORDS
from icrtool.logs.streams.sources import Sides, Unit, WheelEntry, WheelMotion, motion_of, nonzero, of_topic
from icrtool.logs.streams.wheel_joints import by_name, by_place

COMMANDED = re.compile(r"cmd|command|desired|target|setpoint|reference|joy", re.IGNORECASE)
COMMAND_NOTE = "commanded speeds, not measured ones: what the wheels did not do of them is in the ICRs and delays"
_FUSED = re.compile(
    r"filter|fused|combined|ekf|ukf|visual|(?<![a-z])vi?o(?![a-z])|camera|stereo|zed|realsense|t265|vins|rtab|mavros|amcl",
    re.IGNORECASE,
)
"""Names of odometry and twists that are fused with other sensors: used only where there is nothing better."""

_HALF_COUNTER = 1 << 31
_RPM = 2 * np.pi / 60

SIDEWAYS_SHARE = 0.2
"""A twist with more than this sideways, and no turn, is a velocity in east and north, not in the body frame."""


def _segway(prefix: str, *header: str) -> WheelEntry:
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
    if not nonzero(twist[:, 1]) and across_sum > SIDEWAYS_SHARE * forward_sum:
        problem = "moves sideways and never turns: a velocity in east and north, not in the body frame"
    return motion_of(
        WheelMotion(**of_topic(table), unit="m", twist=twist, score=score, why=why, note=note, problem=problem)
    )


def _scout(table: TopicTable, _: Config) -> WheelMotion:
    """Return the body twist in scout_msgs/ScoutStatus (its motor rpm is integer, and before the gearbox)."""
    why = "the base's own speed and turn rate, converted to wheel speeds with the track width"
    return _twist_motion(table, *_SCOUT, 70.0, why)


def _twist(prefix: str, score: float, what: str = "body twist", fused: float = 45.0) -> WheelEntry:
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
_PUMA = by_name(
    ("drivers_feedback[*].device_name", "drivers_feedback[*].travel", "drivers_feedback[*].speed"),
    90.0, "motor driver feedback by device name",
)  # fmt: skip
# Drive.msg of jackal_msgs and of clearpath_platform_msgs: 0 is left, 1 is right.
_TWO_DRIVERS = by_place(
    ("drivers[*].measured_travel", "drivers[*].measured_velocity"), [0], [1],
    "motor driver feedback: driver 0 left, 1 right",
)  # fmt: skip
_SCOUT = ("linear_velocity", "lateral_velocity", "angular_velocity")
_SEGWAY_BARE, _SEGWAY_STAMPED = _segway(""), _segway("segway.", *HEADER)

WHEEL_TYPES: dict[str, WheelEntry] = {
    "sensor_msgs/JointState": by_name(_JOINTS, 100.0, "wheel joints by name"),
    DYNAMIC_JOINT_STATE: by_name(_JOINTS, 95.0, "wheel joints by name"),
    "foxglove.JointStates": by_name(_JOINT_STATES, 100.0, "wheel joints by name"),
    "jackal_msgs/Feedback": _TWO_DRIVERS,
    "clearpath_platform_msgs/Feedback": _TWO_DRIVERS,
    "clearpath_motor_msgs/LynxMultiFeedback": by_name(_LYNX, 90.0, "motor driver feedback by joint name"),
    "clearpath_motor_msgs/PumaMultiFeedback": _PUMA,
    "puma_motor_msgs/MultiFeedback": _PUMA,
    "leo_msgs/WheelStates": by_place(
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
