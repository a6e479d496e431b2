"""Table of all message types that are read: for each role a row with fields, units, validity and score of the type.

The attribute ``worth`` of a row is the score: the topic with the highest score is chosen first.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from icrtool.config import Config
from icrtool.errors import DefinitionError
from icrtool.logs.messages.decoded_values import GGA, GST, HDT, NMEA_SENTENCE, RMC
from icrtool.logs.messages.topic_table import TopicTable
from icrtool.logs.streams import headings, wheels
from icrtool.logs.streams.headings import Bearing, Orientation
from icrtool.logs.streams.joints import Joints
from icrtool.logs.streams.positions import Fix, Solution
from icrtool.logs.streams.sources import Source
from icrtool.logs.streams.wheels import FixedWheels, OdometryTwist, Twist
from icrtool.records.samples import FIXED_FIX, FLOAT_FIX, OTHER_FIX, RTK_FIX, Role


@dataclass(frozen=True, slots=True)
class OwnRow:
    """A message type that is read by a function of its own; `fields` are the fields that it needs."""

    fields: tuple[str, ...]
    read: Callable[[TopicTable, Config], Source]


MessageRow = Fix | Bearing | Orientation | Joints | FixedWheels | Twist | OwnRow
"""A message type in a role: the fields that it needs in addition to the header, and the method that reads them."""

# Wheels: in Drive.msg of jackal_msgs and of clearpath_platform_msgs 0 is the left driver and 1 the right one.
_JOINTS = Joints("wheel joints by name", 100.0, "name[*]", "position[*]", "velocity[*]")
_TWO_DRIVERS = FixedWheels(
    "motor driver feedback: driver 0 left, 1 right", 90.0,
    ("drivers[0].measured_travel", "drivers[1].measured_travel"),
    ("drivers[0].measured_velocity", "drivers[1].measured_velocity"),
)  # fmt: skip
_LYNX = Joints(
    "motor driver feedback by joint name", 90.0, "drivers[*].joint_name", "drivers[*].travel", "drivers[*].velocity"
)
_PUMA = Joints(
    "motor driver feedback by device name", 90.0,
    "drivers_feedback[*].device_name", "drivers_feedback[*].travel", "drivers_feedback[*].speed",
)  # fmt: skip
_SEGWAY = FixedWheels(
    "the base's wheel displacement and speed", 90.0, ("left_wheel_displacement", "right_wheel_displacement"),
    ("left_wheel_velocity", "right_wheel_velocity"), "m",
)  # fmt: skip
_SEGWAY_STAMPED = replace(
    _SEGWAY, position=tuple(f"segway.{path}" for path in _SEGWAY.position),
    speed=tuple(f"segway.{path}" for path in _SEGWAY.speed),
)  # fmt: skip

# Wheel 0 is the left one in the configuration that comes with MAVROS; the topic states metres or rpm.
_BOTH = ("data[0]", "data[1]")
_RPM = FixedWheels("wheel speeds [rpm] of the autopilot: 0 left, 1 right", 80.0, speed=_BOTH, factor=2 * np.pi / 60)
_TRAVEL = FixedWheels("wheel distances [m] of the autopilot: 0 left, 1 right", 90.0, _BOTH, unit="m")
_AGILEX = Twist(
    "the base's own speed and turn rate", 70.0, "", "linear_velocity", "lateral_velocity", "angular_velocity"
)
_TWIST = Twist("body twist", 50.0, fused=45.0)

# Positions
_GBAS = 2
"""Status of NavSatStatus that drivers write for a fixed or for a float solution. If no message of a log has it, the
status states nothing about the solution."""

_GPSFIX_STATUS = {
    0: OTHER_FIX, 1: OTHER_FIX, _GBAS: RTK_FIX, 18: OTHER_FIX, 19: FIXED_FIX, 20: FLOAT_FIX, 33: OTHER_FIX,
}  # fmt: skip
"""Class of each GPSStatus of gps_msgs: 18 is DGPS, 19 RTK fixed, 20 RTK float, 33 WAAS."""

_UBLOX_CARRIER = {0: OTHER_FIX, 1: FLOAT_FIX, 2: FIXED_FIX}
"""Class of each ``carrSoln`` of u-blox."""

_UBLOX_FLAGS = {carrier << 6: fix_class for carrier, fix_class in _UBLOX_CARRIER.items()}
"""Class of each ``carrSoln`` of u-blox in bits 6 and 7 of NavPVT.flags."""

_NMEA_QUALITY = {1: OTHER_FIX, 2: OTHER_FIX, 3: OTHER_FIX, 4: FIXED_FIX, 5: FLOAT_FIX, 8: OTHER_FIX, 9: OTHER_FIX}
"""Class of each quality of GGA: 1 single, 2 differential, 3 PPS, 4 RTK fixed, 5 RTK float, 8 simulated, 9 NovAtel SBAS.

Other qualities are no fixes: 0 no fix, 6 dead reckoning, 7 manual input.
"""

_XBOT_FLAGS = {0: OTHER_FIX, 1: OTHER_FIX, 2: FIXED_FIX, 3: FIXED_FIX, 4: FLOAT_FIX, 5: FLOAT_FIX}
"""Class by the low bits of the flags of xbot_msgs/AbsolutePose: 1 corrections, 2 RTK fixed, 4 RTK float."""

_SEPTENTRIO_MODE = {1: OTHER_FIX, 2: OTHER_FIX, 4: FIXED_FIX, 5: FLOAT_FIX, 6: OTHER_FIX, 7: FIXED_FIX, 8: FLOAT_FIX}
"""Class by the low bits of Septentrio's mode: 1 stand-alone, 2 DGPS, 4 RTK fixed, 5 RTK float, 6 SBAS, 7 fixed and 8
float with a moving base."""

_NOVATEL_TYPES = {32: FLOAT_FIX, 33: FLOAT_FIX, 34: FLOAT_FIX, 48: FIXED_FIX, 49: FIXED_FIX, 50: FIXED_FIX,
                 51: FIXED_FIX, 55: FLOAT_FIX, 56: FIXED_FIX}  # fmt: skip
"""Class of each position type of NovAtel, numbered as in novatel_oem7_msgs. Other types have neither fixed nor float
ambiguities."""

# Covariance type 0 means unknown: drivers leave the numbers at 0, or write arbitrary ones. Status -2 is the default of
# ROS 2's NavSatStatus. The field err_horz is a radius of 95 %, which is 2.45 standard deviations.
_NAVSATFIX = Fix(
    "GNSS fix", 100.0, covariance=("position_covariance[4]", "position_covariance[0]", "position_covariance[1]"),
    stated=("position_covariance_type != 0",), valid=("status.status >= 0 unless -2",),
    solution=Solution("status.status", {_GBAS: RTK_FIX}, OTHER_FIX, informative=True),
)  # fmt: skip
_GPSFIX = replace(
    _NAVSATFIX, worth=92.0, std=("err_horz * 0.40816326530612246",),
    solution=Solution("status.status", _GPSFIX_STATUS, informative=True),
)  # fmt: skip
_UBLOX = Fix("u-blox position", 85.0, ("lat * 1e-7", "lon * 1e-7", "height * 1e-3"), ("hAcc|h_acc * 1e-3",))
# If the low bits of the mode are 0, there is no solution.
_SEPTENTRIO = Fix(
    "Septentrio position", 85.0, ("latitude * rad", "longitude * rad", "height"), ("h_accuracy < 65535 * 0.01",),
    valid=("mode & 15 != 0", "error == 0"), solution=Solution("mode", _SEPTENTRIO_MODE, OTHER_FIX, 15),
)  # fmt: skip
# The height is above mean sea level; with the undulation of the geoid it is above the ellipsoid.
_SOLVED = "SOL_COMPUTED|0"
_INS_SOLVED = "INS_SOLUTION_GOOD|INS_SOLUTION_FREE|INS_ALIGNMENT_COMPLETE|3|6|7"
"""States of NovAtel with a solution, as words (novatel_gps_msgs) and as numbers (novatel_oem7_msgs)."""

_WORD_SOLUTION, _NUMBER_SOLUTION = (
    Solution(name, _NOVATEL_TYPES, OTHER_FIX) for name in ("position_type", "pos_type.type")
)
_BESTPOS = Fix(
    "NovAtel position", 85.0, ("lat", "lon", "hgt + undulation"), ("lat_stdev", "lon_stdev"),
    valid=(f"sol_status.status == {_SOLVED}",), solution=_NUMBER_SOLUTION,
)  # fmt: skip
_INSPVAX = Fix(
    "NovAtel INS position", 84.0, ("latitude", "longitude", "height + undulation"),
    ("latitude_stdev", "longitude_stdev"), valid=(f"ins_status.status == {_INS_SOLVED}",), solution=_NUMBER_SOLUTION,
)  # fmt: skip
_METRIC = Fix("metric pose", 70.0, ("pose.position.x", "pose.position.y", "pose.position.z"), metric=True)
_METRIC_OF_POSE = replace(
    _METRIC, coordinates=("pose.pose.position.x", "pose.pose.position.y", "pose.pose.position.z"),
    covariance=("pose.covariance[7]", "pose.covariance[0]", "pose.covariance[1]"),
)  # fmt: skip
_XBOT_INDEPENDENT = ("source != 100",)
"""Check for poses of xbot_msgs/AbsolutePose that are not fused with the wheels; source 100 is fused."""

_GST_NEAR_NS = 1_500_000_000
"""Largest time between a fix and the GST sentence with its standard deviations [ns]. Receivers send GST with each fix
or once a second."""

_SENTENCE_FIX = Fix(
    "GNSS fix", 84.0, std=("north_std", "east_std"), valid=(f"quality == {'|'.join(map(str, _NMEA_QUALITY))}",),
    solution=Solution("quality", _NMEA_QUALITY),
)  # fmt: skip


def _read_fixes(table: TopicTable, config: Config) -> Source:
    """Return the fixes of GGA, or of RMC without GGA, with the standard deviations of the nearest GST."""
    sentences = table.column("sentence_kind").astype(np.int64)
    fix_sentence, name = (GGA, "GGA") if (sentences & GGA).any() else (RMC, "RMC")
    fixes, deviations = table.rows((sentences & fix_sentence) > 0), table.rows((sentences & GST) > 0)
    if not len(fixes):
        raise DefinitionError(table.topic, "none of its sentences is GGA or RMC")
    if len(deviations):
        times_ns = deviations.log_time_ns
        nearest = np.searchsorted(times_ns[:-1] + np.diff(times_ns) // 2, fixes.log_time_ns)
        near = np.abs(times_ns[nearest] - fixes.log_time_ns) < _GST_NEAR_NS
        stds = {name: np.where(near, deviations.column(name)[nearest], np.nan) for name in ("north_std", "east_std")}
        fixes = replace(fixes, columns=fixes.columns | stds)
    return replace(_SENTENCE_FIX, label=f"{_SENTENCE_FIX.label} ({name})").read(fixes, config)


# Headings
_OF_POSE = Orientation("orientation of the pose", 50.0, "pose.orientation")
_TRUE_HEADING = Bearing(
    "heading of the GNSS receiver (NMEA)", 88.0, std="heading_std * deg", known_by="NMEA: clockwise from true north"
)


def _read_true_headings(table: TopicTable, config: Config) -> Source:
    """Return the true headings of HDT, THS and UNIHEADINGA."""
    true = table.rows((table.column("sentence_kind").astype(np.int64) & HDT) > 0)
    if not len(true):
        raise DefinitionError(table.topic, "none of its sentences is HDT, THS or UNIHEADINGA")
    return _TRUE_HEADING.read(true, config)


_AZIMUTH_ROW = OwnRow(headings.AZIMUTH_FIELDS, headings.read_azimuths)
# The convention is ENU unless `use_ros_axis_orientation` was off, which no message states.
_ATTITUDE = Bearing(
    "Septentrio attitude", 88.0, valid=("error == 0", "mode != 0"), convention="enu",
    known_by="the Septentrio driver's default, use_ros_axis_orientation",
)  # fmt: skip
_DUAL = Bearing(
    "NovAtel dual antenna heading", 90.0, std="heading_sigma * deg", valid=(f"solution_status == {_SOLVED}",)
)
_INSPVA = Bearing("NovAtel INS azimuth", 90.0, "azimuth < 720 * deg", valid=(f"status == {_INS_SOLVED}",))

MESSAGE_TYPES: Mapping[Role, Mapping[str, MessageRow]] = {
    "wheels": {
        "sensor_msgs/JointState": _JOINTS,
        "control_msgs/DynamicJointState": replace(_JOINTS, worth=95.0),
        "foxglove.JointStates": replace(
            _JOINTS, names="joints[*].name", position="joints[*].position", speed="joints[*].velocity"
        ),
        "jackal_msgs/Feedback": _TWO_DRIVERS,
        "clearpath_platform_msgs/Feedback": _TWO_DRIVERS,
        "clearpath_motor_msgs/LynxMultiFeedback": _LYNX,
        "clearpath_motor_msgs/PumaMultiFeedback": _PUMA,
        "puma_motor_msgs/MultiFeedback": _PUMA,
        "leo_msgs/WheelStates": FixedWheels(
            "four wheels: front left, rear left, front right, rear right", 90.0,
            ("position[0,1]", "position[2,3]"), ("velocity[0,1]", "velocity[2,3]"),
        ),
        "xbot_msgs/WheelTick": OwnRow(wheels.TICK_FIELDS, wheels.read_ticks),
        "mavros_msgs/WheelOdomStamped": OwnRow(
            ("data[*]",), lambda table, config: (_RPM if "rpm" in table.topic.lower() else _TRAVEL).read(table, config)
        ),
        "segway_rmp/SegwayStatusStamped": _SEGWAY_STAMPED,
        "segway_rmp_ros2/SegwayStatusStamped": _SEGWAY_STAMPED,
        "segway_interfaces/Stamped": _SEGWAY_STAMPED,
        "segway_rmp/SegwayStatus": _SEGWAY,
        "segway_rmp_ros2/SegwayStatus": _SEGWAY,
        "segway_interfaces/Segwaystatus": _SEGWAY,
        # The motor speed of this type is not used: it is a whole number of rpm before the gearbox.
        "scout_msgs/ScoutStatus": _AGILEX,
        "bunker_msgs/BunkerStatus": _AGILEX,
        "nav_msgs/Odometry": OdometryTwist("twist of the wheel odometry", 60.0, "twist.twist.", fused=50.0),
        "geometry_msgs/TwistStamped": replace(_TWIST, path="twist."),
        "geometry_msgs/TwistWithCovarianceStamped": replace(_TWIST, path="twist.twist."),
        "geometry_msgs/Twist": replace(_TWIST, worth=40.0),
    },
    "gnss": {
        "sensor_msgs/NavSatFix": _NAVSATFIX,
        "foxglove.LocationFix": _NAVSATFIX,
        "gps_common/GPSFix": _GPSFIX,
        "gps_msgs/GPSFix": _GPSFIX,
        "ublox_msgs/NavPVT": replace(
            _UBLOX, valid=("flags & 1 == 1",), solution=Solution("flags", _UBLOX_FLAGS, mask=192)
        ),
        # The fix types 0 (none), 1 (dead reckoning) and 5 (time only) have no position.
        "ublox_ubx_msgs/UBXNavPVT": replace(
            _UBLOX, std=("h_acc * 1e-3",),
            valid=("gnss_fix_ok != 0", "invalid_llh != 1", "gps_fix.fix_type != 0|1|5"),
            solution=Solution("carr_soln.status", _UBLOX_CARRIER),
        ),
        "ublox_msgs/NavHPPOSLLH": Fix(
            "u-blox high precision position", 86.0,
            ("lat * 1e-7 + latHp|lat_hp * 1e-9", "lon * 1e-7 + lonHp|lon_hp * 1e-9",
             "height * 1e-3 + heightHp|height_hp * 1e-4"),
            ("hAcc|h_acc * 1e-4",),
            valid=("invalid_llh|invalidLlh|flags & 1 != 1",),
        ),
        NMEA_SENTENCE: OwnRow(("sentence",), _read_fixes),
        "septentrio_gnss_driver/PVTGeodetic": _SEPTENTRIO,
        "septentrio_gnss_driver/INSNavGeod": replace(
            _SEPTENTRIO, label="Septentrio INS position", worth=84.0, std=("latitude_std_dev", "longitude_std_dev"),
            valid=("gnss_mode & 15 != 0", "error == 0"),
            solution=Solution("gnss_mode", _SEPTENTRIO_MODE, OTHER_FIX, 15),
        ),
        "novatel_gps_msgs/NovatelPosition": replace(
            _BESTPOS, coordinates=("lat", "lon", "height + undulation"), std=("lat_sigma", "lon_sigma"),
            valid=(f"solution_status == {_SOLVED}",), solution=_WORD_SOLUTION,
        ),
        "novatel_gps_msgs/Inspvax": replace(
            _INSPVAX, coordinates=("latitude", "longitude", "altitude + undulation"),
            std=("latitude_std", "longitude_std"),
            valid=(f"ins_status == {_INS_SOLVED}",), solution=_WORD_SOLUTION,
        ),
        "novatel_oem7_msgs/BESTPOS": _BESTPOS,
        "novatel_oem7_msgs/BESTGNSSPOS": _BESTPOS,
        "novatel_oem7_msgs/INSPVAX": _INSPVAX,
        "geographic_msgs/GeoPoseStamped": Fix(
            "position of an autopilot or navigation filter", 80.0,
            ("pose.position.latitude", "pose.position.longitude", "pose.position.altitude"),
        ),
        "geometry_msgs/PoseStamped": _METRIC,
        "foxglove.PoseInFrame": _METRIC,
        "geometry_msgs/PoseWithCovarianceStamped": _METRIC_OF_POSE,
        "xbot_msgs/AbsolutePose": replace(
            _METRIC_OF_POSE, label="GNSS position of OpenMower", worth=90.0, std=("position_accuracy",),
            valid=("flags & 8 == 0",), solution=Solution("flags", _XBOT_FLAGS, mask=7), independent=_XBOT_INDEPENDENT,
        ),
        "nav_msgs/Odometry": replace(
            _METRIC_OF_POSE, label="metric position of an odometry message", worth=60.0, odometry=True
        ),
    },
    "heading": {
        "sensor_msgs/Imu": Orientation(
            "orientation of the inertial unit", 100.0, "orientation", "orientation_covariance[8]",
            "orientation_covariance[0]", "angular_velocity.z",
        ),
        "geographic_msgs/GeoPoseStamped": _OF_POSE,
        "geometry_msgs/PoseStamped": _OF_POSE,
        "foxglove.PoseInFrame": _OF_POSE,
        "geometry_msgs/PoseWithCovarianceStamped": replace(
            _OF_POSE, path="pose.pose.orientation", variance="pose.covariance[35]"
        ),
        "nav_msgs/Odometry": Orientation(
            "orientation of an odometry message", 60.0, "pose.pose.orientation", "pose.covariance[35]", odometry=True
        ),
        "geometry_msgs/QuaternionStamped": Orientation(
            "heading of the GNSS receiver (nmea_navsat_driver)", 80.0, "quaternion", compass_as_yaw=True
        ),
        "foxglove.LocationFix": Bearing(
            "heading of the GNSS receiver", 88.0, "heading", variance="heading_variance",
            known_by="Foxglove: clockwise from north",
        ),
        NMEA_SENTENCE: OwnRow(("sentence",), _read_true_headings),
        "xbot_msgs/AbsolutePose": Bearing(
            "OpenMower's heading", 90.0, "vehicle_heading", "orientation_accuracy", valid=("orientation_valid != 0",),
            convention="enu", known_by="REP-103", independent=_XBOT_INDEPENDENT,
        ),
        "compass_msgs/Azimuth": _AZIMUTH_ROW,
        "compass_interfaces/Azimuth": _AZIMUTH_ROW,
        "ublox_msgs/NavRELPOSNED9": headings.BASELINE,
        "ublox_msgs/NavRELPOSNED": OwnRow(headings.BASELINE_FIELDS, headings.read_baselines),
        "septentrio_gnss_driver/AttEuler": _ATTITUDE,
        "septentrio_gnss_driver/INSNavGeod": replace(
            _ATTITUDE, label="Septentrio INS attitude", worth=89.0, std="heading_std_dev * deg", valid=("error == 0",)
        ),
        "novatel_gps_msgs/NovatelDualAntennaHeading": _DUAL,
        "novatel_gps_msgs/NovatelHeading2": _DUAL,
        "novatel_oem7_msgs/HEADING2": replace(
            _DUAL, std="heading_stdev * deg", valid=(f"sol_status.status == {_SOLVED}",)
        ),
        "novatel_gps_msgs/Gphdt": Bearing("NovAtel true heading (HDT)", 88.0),
        "novatel_gps_msgs/Inspva": _INSPVA,
        "novatel_oem7_msgs/INSPVA": replace(_INSPVA, valid=(f"status.status == {_INS_SOLVED}",)),
        "novatel_gps_msgs/Inspvax": replace(
            _INSPVA, worth=92.0, std="azimuth_std * deg", valid=(f"ins_status == {_INS_SOLVED}",)
        ),
        "novatel_oem7_msgs/INSPVAX": replace(
            _INSPVA, worth=92.0, std="azimuth_stdev * deg", valid=(f"ins_status.status == {_INS_SOLVED}",)
        ),
    },
}  # fmt: skip
"""Rows by role and message type. ``lat|latitude * 1e-7 + lat_hp * 1e-9`` describes a number (`sources.terms_of`),
``flags & 1 == 1`` a check (`sources.check_of`)."""

KNOWN_TYPES = frozenset[str]().union(*MESSAGE_TYPES.values())
"""Message types with a row in the table. The fields of other types are searched by their names."""
