"""Every message type that is read: a row for each role that it may feed, with its fields, units, validity and worth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Protocol

from icrtool.config import Config
from icrtool.errors import DefinitionError
from icrtool.logs.messages.decoded_values import NMEA_SENTENCE
from icrtool.logs.messages.topic_table import TopicTable
from icrtool.logs.streams import headings, positions, wheels
from icrtool.logs.streams.headings import DEGREE, Bearing, Orientation, degrees
from icrtool.logs.streams.positions import (
    GPSFIX_STATUS,
    NOVATEL_TYPES,
    SEPTENTRIO_MODE,
    STATUS_UNKNOWN,
    UBLOX_CARRIER,
    UBLOX_FLAGS,
    XBOT_FLAGS,
    Fix,
    Pose,
    Solution,
)
from icrtool.logs.streams.sources import Check, Number, Source
from icrtool.logs.streams.wheels import FixedWheels, Joints, Twist, body_twist
from icrtool.records.samples import OTHER_FIX, ROLE_WORDS, RTK_FIX, Role


class Row(Protocol):
    """What a message type carries for one role."""

    @property
    def role(self) -> Role:
        """The role that it feeds."""
        ...

    @property
    def fields(self) -> tuple[str, ...]:
        """The fields to take of its messages, beside those of a header."""
        ...

    @property
    def read(self) -> Callable[[TopicTable, Config], Source]:
        """Return what was read of a topic; raise `DefinitionError` where it lacks a field that is needed."""
        ...


@dataclass(frozen=True, slots=True)
class OwnRow:
    """A row that no other kind describes, and the function that reads it."""

    role: Role
    fields: tuple[str, ...]
    read: Callable[[TopicTable, Config], Source]


_STATUS = Check(("status.status",), least=0, unset=STATUS_UNKNOWN)
_GNSS_FIX = Fix(
    "GNSS fix", 100.0, covariance="position_covariance", valid=(_STATUS,),
    solution=Solution("status.status", {positions.GBAS: RTK_FIX}, OTHER_FIX, informative=True),
)  # fmt: skip

RADIUS_95_IN_STD = 2.45
"""err_horz is a 95 % radius: this many standard deviations of a circular normal distribution."""

_GPSFIX = replace(
    _GNSS_FIX, worth=92.0, std=(Number(("err_horz",), 1.0 / RADIUS_95_IN_STD),),
    solution=Solution("status.status", GPSFIX_STATUS, informative=True),
)  # fmt: skip

_UBLOX = Fix("u-blox position", 85.0, Number(("lat",), 1e-7), Number(("lon",), 1e-7), Number(("height",), 1e-3))
UBX_NO_FIX = frozenset({0, 1, 5})
"""GpsFix of u-blox: none, dead reckoning only, time only."""


def _fine(coarse: Number, *names: str, unit: float) -> Number:
    return coarse._replace(fine=Number(names, unit))


def _septentrio(what: str, worth: float, mode: str, *std: Number) -> Fix:
    """Return the row of a Septentrio block: angles in rad; low bits of the mode 0: no solution."""
    return Fix(
        what, worth, Number(("latitude",), 1.0 / DEGREE), Number(("longitude",), 1.0 / DEGREE), Number(("height",)),
        std, valid=(Check((mode,), refused=frozenset({0}), mask=0x0F), Check(("error",), frozenset({0}))),
        solution=Solution(mode, SEPTENTRIO_MODE, OTHER_FIX, 0x0F),
    )  # fmt: skip


_SEPTENTRIO_UNKNOWN = 65535
_SEPTENTRIO_ENU = "the Septentrio driver's default, use_ros_axis_orientation"
"""Its attitudes are ENU unless that was off, which no message states."""

_SOLVED: frozenset[int | str] = frozenset({"SOL_COMPUTED", 0})
_INS_SOLVED: frozenset[int | str] = frozenset(
    {"INS_SOLUTION_GOOD", "INS_SOLUTION_FREE", "INS_ALIGNMENT_COMPLETE", 3, 6, 7}
)
"""What NovAtel calls a solution, in words (novatel_gps_msgs) and as numbers (novatel_oem7_msgs)."""


def _novatel(
    what: str, worth: float, place: tuple[str, str, str], std: tuple[str, str], valid: Check, kind: str
) -> Fix:
    """Return the row of a NovAtel log; a height above mean sea level comes with the undulation of the geoid."""
    latitude, longitude, height = (Number((name,)) for name in place)
    return Fix(
        what, worth, latitude, longitude, _fine(height, "undulation", unit=1.0), tuple(Number((name,)) for name in std),
        valid=(valid,), solution=Solution(kind, NOVATEL_TYPES, OTHER_FIX),
    )  # fmt: skip


_BESTPOS = _novatel(
    "NovAtel position", 85.0, ("lat", "lon", "hgt"), ("lat_stdev", "lon_stdev"),
    Check(("sol_status.status",), _SOLVED), "pos_type.type",
)  # fmt: skip


def _true(what: str, worth: float, angle: str, std: str = "", *valid: Check) -> Bearing:
    """Return the row of degrees clockwise from north."""
    return Bearing(what, worth, degrees(angle), Number((std,), DEGREE) if std else None, valid=valid)


_INS, _DUAL = "NovAtel INS azimuth", "NovAtel dual antenna heading"
_DUAL_ANTENNA = _true(_DUAL, 90.0, "heading", "heading_sigma", Check(("solution_status",), _SOLVED))

_METRIC = Pose("metric pose", 70.0)
_OF_POSE = Orientation("orientation of the pose", 50.0, "pose.orientation")
_XBOT_INDEPENDENT = (Check(("source",), refused=frozenset({100})),)
"""Source of xbot_msgs/AbsolutePose: 100 is fused with the wheels."""

_AZIMUTH = (OwnRow("heading", headings.AZIMUTH_FIELDS, headings.read_azimuths),)

_JOINTS = Joints("wheel joints by name", 100.0, "name[*]", "position[*]", "velocity[*]")
_PUMA = (
    Joints(
        "motor driver feedback by device name", 90.0,
        "drivers_feedback[*].device_name", "drivers_feedback[*].travel", "drivers_feedback[*].speed",
    ),
)  # fmt: skip
# Drive.msg of jackal_msgs and of clearpath_platform_msgs: 0 is left, 1 is right.
_TWO_DRIVERS = (
    FixedWheels(
        "motor driver feedback: driver 0 left, 1 right", 90.0,
        ("drivers[0].measured_travel", "drivers[1].measured_travel"),
        ("drivers[0].measured_velocity", "drivers[1].measured_velocity"),
    ),
)  # fmt: skip


def _segway(prefix: str) -> tuple[FixedWheels]:
    """Return the row of the status of a Segway RMP: wheel displacement [m] and speed [m/s]."""
    sides = f"{prefix}left_wheel_", f"{prefix}right_wheel_"
    return (
        FixedWheels(
            "the base's wheel displacement and speed", 90.0,
            tuple(f"{side}displacement" for side in sides), tuple(f"{side}velocity" for side in sides), "m",
        ),
    )  # fmt: skip


MESSAGE_TYPES: Mapping[str, tuple[Row, ...]] = {
    # Wheels
    "sensor_msgs/JointState": (_JOINTS,),
    "control_msgs/DynamicJointState": (replace(_JOINTS, worth=95.0),),
    "foxglove.JointStates": (
        replace(_JOINTS, names="joints[*].name", position="joints[*].position", speed="joints[*].velocity"),
    ),
    "jackal_msgs/Feedback": _TWO_DRIVERS,
    "clearpath_platform_msgs/Feedback": _TWO_DRIVERS,
    "clearpath_motor_msgs/LynxMultiFeedback": (
        Joints(
            "motor driver feedback by joint name", 90.0,
            "drivers[*].joint_name", "drivers[*].travel", "drivers[*].velocity",
        ),
    ),
    "clearpath_motor_msgs/PumaMultiFeedback": _PUMA,
    "puma_motor_msgs/MultiFeedback": _PUMA,
    "leo_msgs/WheelStates": (
        FixedWheels(
            "four wheels: front left, rear left, front right, rear right", 90.0,
            ("position[0,1]", "position[2,3]"), ("velocity[0,1]", "velocity[2,3]"),
        ),
    ),
    "xbot_msgs/WheelTick": (OwnRow("wheels", wheels.TICK_FIELDS, wheels.read_ticks),),
    "mavros_msgs/WheelOdomStamped": (OwnRow("wheels", wheels.AUTOPILOT_FIELDS, wheels.read_autopilot),),
    # Its motor rpm is integer, and before the gearbox.
    "scout_msgs/ScoutStatus": (
        Twist("the base's own speed and turn rate", 70.0, "linear_velocity", "lateral_velocity", "angular_velocity"),
    ),
    **dict.fromkeys(
        ("segway_rmp/SegwayStatusStamped", "segway_rmp_ros2/SegwayStatusStamped", "segway_interfaces/Stamped"),
        _segway("segway."),
    ),
    **dict.fromkeys(
        ("segway_rmp/SegwayStatus", "segway_rmp_ros2/SegwayStatus", "segway_interfaces/Segwaystatus"), _segway("")
    ),
    "geometry_msgs/TwistStamped": (body_twist("twist.", 50.0),),
    "geometry_msgs/TwistWithCovarianceStamped": (body_twist("twist.twist.", 50.0),),
    "geometry_msgs/Twist": (body_twist("", 40.0),),
    # Positions
    "sensor_msgs/NavSatFix": (_GNSS_FIX,),
    "gps_common/GPSFix": (_GPSFIX,),
    "gps_msgs/GPSFix": (_GPSFIX,),
    "ublox_msgs/NavPVT": (
        replace(
            _UBLOX, std=(Number(("hAcc", "h_acc"), 1e-3),), valid=(Check(("flags",), frozenset({1}), mask=1),),
            solution=Solution("flags", UBLOX_FLAGS, mask=3 << 6),
        ),
    ),
    "ublox_ubx_msgs/UBXNavPVT": (
        replace(
            _UBLOX, std=(Number(("h_acc",), 1e-3),),
            valid=(
                Check(("gnss_fix_ok",), refused=frozenset({0})), Check(("invalid_llh",), refused=frozenset({1})),
                Check(("gps_fix.fix_type",), refused=UBX_NO_FIX),
            ),
            solution=Solution("carr_soln.status", UBLOX_CARRIER),
        ),
    ),
    "ublox_msgs/NavHPPOSLLH": (
        Fix(
            "u-blox high precision position", 86.0, _fine(_UBLOX.latitude, "latHp", "lat_hp", unit=1e-9),
            _fine(_UBLOX.longitude, "lonHp", "lon_hp", unit=1e-9),
            _fine(_UBLOX.height, "heightHp", "height_hp", unit=1e-4), (Number(("hAcc", "h_acc"), 1e-4),),
            valid=(Check(("invalid_llh", "invalidLlh", "flags"), refused=frozenset({1}), mask=1),),
        ),
    ),
    "septentrio_gnss_driver/PVTGeodetic": (
        _septentrio("Septentrio position", 85.0, "mode", Number(("h_accuracy",), 0.01, _SEPTENTRIO_UNKNOWN - 1)),
    ),
    "novatel_gps_msgs/NovatelPosition": (
        _novatel(
            "NovAtel position", 85.0, ("lat", "lon", "height"), ("lat_sigma", "lon_sigma"),
            Check(("solution_status",), _SOLVED), "position_type",
        ),
    ),
    "novatel_oem7_msgs/BESTPOS": (_BESTPOS,),
    "novatel_oem7_msgs/BESTGNSSPOS": (_BESTPOS,),
    # Positions and headings
    NMEA_SENTENCE: (
        OwnRow("gnss", ("sentence",), positions.read_sentences),
        OwnRow("heading", ("sentence",), headings.read_sentences),
    ),
    "foxglove.LocationFix": (
        _GNSS_FIX,
        Bearing(
            "heading of the GNSS receiver", 88.0, Number(("heading",)), variance=Number(("heading_variance",)),
            known_by="Foxglove: clockwise from north",
        ),
    ),
    "septentrio_gnss_driver/INSNavGeod": (
        _septentrio(
            "Septentrio INS position", 84.0, "gnss_mode", Number(("latitude_std_dev",)), Number(("longitude_std_dev",))
        ),
        Bearing(
            "Septentrio INS attitude", 89.0, degrees("heading"), Number(("heading_std_dev",), DEGREE),
            valid=(Check(("error",), frozenset({0})),), convention="enu", known_by=_SEPTENTRIO_ENU,
        ),
    ),
    "novatel_gps_msgs/Inspvax": (
        _novatel(
            "NovAtel INS position", 84.0, ("latitude", "longitude", "altitude"), ("latitude_std", "longitude_std"),
            Check(("ins_status",), _INS_SOLVED), "position_type",
        ),
        _true(_INS, 92.0, "azimuth", "azimuth_std", Check(("ins_status",), _INS_SOLVED)),
    ),
    "novatel_oem7_msgs/INSPVAX": (
        _novatel(
            "NovAtel INS position", 84.0, ("latitude", "longitude", "height"), ("latitude_stdev", "longitude_stdev"),
            Check(("ins_status.status",), _INS_SOLVED), "pos_type.type",
        ),
        _true(_INS, 92.0, "azimuth", "azimuth_stdev", Check(("ins_status.status",), _INS_SOLVED)),
    ),
    "xbot_msgs/AbsolutePose": (
        Pose(
            "GNSS position of OpenMower", 90.0, "pose.pose", "pose.covariance", (Number(("position_accuracy",)),),
            (Check(("flags",), refused=frozenset({8}), mask=8),), Solution("flags", XBOT_FLAGS, mask=7),
            independent=_XBOT_INDEPENDENT,
        ),
        Bearing(
            "OpenMower's heading", 90.0, Number(("vehicle_heading",)), Number(("orientation_accuracy",)),
            valid=(Check(("orientation_valid",), refused=frozenset({0})),), convention="enu", known_by="REP-103",
            independent=_XBOT_INDEPENDENT,
        ),
    ),
    "geographic_msgs/GeoPoseStamped": (
        Fix(
            "position of an autopilot or navigation filter", 80.0, Number(("pose.position.latitude",)),
            Number(("pose.position.longitude",)), Number(("pose.position.altitude",)),
        ),
        _OF_POSE,
    ),
    "geometry_msgs/PoseStamped": (_METRIC, _OF_POSE),
    "foxglove.PoseInFrame": (_METRIC, _OF_POSE),
    "geometry_msgs/PoseWithCovarianceStamped": (
        replace(_METRIC, path="pose.pose", covariance="pose.covariance"),
        replace(_OF_POSE, path="pose.pose.orientation", covariance="pose.covariance"),
    ),
    "nav_msgs/Odometry": (
        body_twist("twist.twist.", 60.0, "twist of the wheel odometry", fused=50.0),
        Pose("metric position of an odometry message", 60.0, "pose.pose", "pose.covariance", odometry=True),
        Orientation(
            "orientation of an odometry message", 60.0, "pose.pose.orientation", "pose.covariance", odometry=True
        ),
    ),
    # Headings
    "sensor_msgs/Imu": (
        Orientation(
            "orientation of the inertial unit", 100.0, "orientation", "orientation_covariance", 3, "angular_velocity.z"
        ),
    ),
    "geometry_msgs/QuaternionStamped": (
        Orientation("heading of the GNSS receiver (nmea_navsat_driver)", 80.0, "quaternion", stuffed=True),
    ),
    "compass_msgs/Azimuth": _AZIMUTH,
    "compass_interfaces/Azimuth": _AZIMUTH,
    "ublox_msgs/NavRELPOSNED9": (headings.BASELINE,),
    "ublox_msgs/NavRELPOSNED": (OwnRow("heading", headings.BASELINE_FIELDS, headings.read_baselines),),
    "septentrio_gnss_driver/AttEuler": (
        Bearing(
            "Septentrio attitude", 88.0, degrees("heading"), convention="enu", known_by=_SEPTENTRIO_ENU,
            valid=(Check(("error",), frozenset({0})), Check(("mode",), refused=frozenset({0}))),
        ),
    ),
    "novatel_gps_msgs/NovatelDualAntennaHeading": (_DUAL_ANTENNA,),
    "novatel_gps_msgs/NovatelHeading2": (_DUAL_ANTENNA,),
    "novatel_oem7_msgs/HEADING2": (
        _true(_DUAL, 90.0, "heading", "heading_stdev", Check(("sol_status.status",), _SOLVED)),
    ),
    "novatel_gps_msgs/Gphdt": (_true("NovAtel true heading (HDT)", 88.0, "heading"),),
    "novatel_gps_msgs/Inspva": (_true(_INS, 90.0, "azimuth", "", Check(("status",), _INS_SOLVED)),),
    "novatel_oem7_msgs/INSPVA": (_true(_INS, 90.0, "azimuth", "", Check(("status.status",), _INS_SOLVED)),),
}  # fmt: skip


def types_of(role: Role) -> tuple[str, ...]:
    """Return the message types that a role is read from."""
    return tuple(name for name, rows in MESSAGE_TYPES.items() if any(row.role == role for row in rows))


def fields_of(role: Role, message_type: str) -> tuple[str, ...]:
    """Return the fields of a message type that a role is read from, none where it carries nothing for it."""
    row = _row(role, message_type)
    return row.fields if row is not None else ()


def read_source(role: Role, table: TopicTable, config: Config) -> Source:
    """Return what a topic, of one of the types of a role, has for it.

    Raises
    ------
    DefinitionError
        The type, as the log defines it, lacks a field that is needed.
    """
    row = _row(role, table.message_type)
    if row is None:
        raise DefinitionError(table.topic, f"{table.message_type} is not read for {ROLE_WORDS[role]}")
    return row.read(table, config)


def _row(role: Role, message_type: str) -> Row | None:
    return next((row for row in MESSAGE_TYPES.get(message_type, ()) if row.role == role), None)
