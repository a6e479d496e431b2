"""Logs of other stacks, written by other libraries with the real definitions: topics are listed, the ICRs found.

One drive of known ICRs, as OpenMower, as ublox_dgnss beside joint states, as an autopilot with NMEA sentences (rosbags,
pynmea2), and in Foxglove's schemas, in Protobuf (mcap-protobuf-support) and in JSON.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable, Iterable, Iterator
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pynmea2
import pytest
from foxglove_schemas_protobuf.JointState_pb2 import JointState
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.json_format import MessageToDict
from google.protobuf.message import Message
from mcap.writer import Writer as McapWriter
from mcap_protobuf.schema import build_file_descriptor_set
from mcap_protobuf.writer import Writer as ProtobufWriter
from pymap3d import ned2geodetic
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from icrtool.config import load_config
from icrtool.kernels.arrays import Floats
from icrtool.logs.read_log import read_log, survey_log
from icrtool.records.samples import FIXED_FIX, FLOAT_FIX
from icrtool.records.tables import RobotLog
from support.drives import ICRS, make_log

DATUM = (48.1, 11.6, 560.0)
GEOID_M = 47.3
TICKS_PER_M = 300
DRIVE = make_log(3, 60.0)
NORTH, EAST = DRIVE.gnss.north_m, DRIVE.gnss.east_m
LATITUDE, LONGITUDE, HEIGHT = ned2geodetic(NORTH, EAST, np.zeros(len(NORTH)), *DATUM)
FIX_STAMPS, WHEEL_STAMPS = DRIVE.gnss.stamp_ns.tolist(), DRIVE.wheels.stamp_ns.tolist()
STEP_S = np.diff(DRIVE.wheels.stamp_ns, append=DRIVE.wheels.stamp_ns[-1]) / 1e9
TRAVELLED = [
    np.concatenate([[0.0], np.cumsum(side * STEP_S)[:-1]])
    for side in (DRIVE.wheels.v_left_mps, DRIVE.wheels.v_right_mps)
]
RADIUS_M = 0.15
CONFIG = load_config(sets=[f"robot.wheel_radius_m={RADIUS_M}"])


class Logged(NamedTuple):
    topic: str
    message_type: str
    stamp_ns: int
    message: Any


class Types:
    """Message types with their real definitions, as rosbags has them and as icrtool bundles them."""

    def __init__(self, *, ros1: bool) -> None:
        self.ros1 = ros1
        self.store: Typestore = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        bundle = resources.files("icrtool.logs.messages").joinpath("definitions")
        for package in ("mavros_msgs", "nmea_msgs", "ublox_ubx_msgs", "xbot_msgs"):
            for file in bundle.joinpath(package).iterdir():
                name = f"{package}/msg/{file.name.removesuffix('.msg')}"
                self.store.register(get_types_from_msg(file.read_text(encoding="utf-8"), name))

    def __call__(self, name: str, /, **fields: Any) -> Any:
        """Return a message; fields that are not given are 0, empty, or made of such."""
        full = name.replace("/", "/msg/")
        values = []
        for field, (node, detail) in self.store.fielddefs[full][1]:
            if field in fields:
                values.append(fields[field])
            elif int(node) == 2:
                values.append(self(detail.replace("/msg/", "/")))
            elif int(node) == 1:
                values.append("" if detail[0] == "string" else 0)
            else:
                (_, inner), count = detail
                values.append(np.zeros(count if int(node) == 3 else 0, inner[0]))
        return self.store.types[full](*values)

    def header(self, stamp_ns: int, frame: str = "") -> Any:
        return self("std_msgs/Header", stamp=self.time(stamp_ns), frame_id=frame)

    def time(self, stamp_ns: int) -> Any:
        return self.store.types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))


def write(path: Path, types: Types, messages: Iterable[Logged]) -> Path:
    """Write messages in the order of their stamps, to a bag of ROS 1 or of ROS 2."""
    if types.ros1:
        writer: Any = Ros1Writer(path.with_suffix(".bag"))
        serialize = types.store.serialize_ros1
    else:
        writer = Ros2Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3)
        serialize = types.store.serialize_cdr
    with writer:
        connections: dict[str, Any] = {}
        for topic, name, stamp_ns, message in sorted(messages, key=lambda one: one.stamp_ns):
            full = name.replace("/", "/msg/")
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, full, typestore=types.store)
            writer.write(connections[topic], stamp_ns, serialize(message, full))
    return path.with_suffix(".bag") if types.ros1 else path


def counted_up(travelled_m: np.ndarray, start: int) -> tuple[list[int], list[int]]:
    """Return counters that count up whatever the direction, near their wrap, and the directions."""
    steps = np.diff(np.round(travelled_m * TICKS_PER_M), prepend=0.0)
    return ((start + np.cumsum(np.abs(steps))) % 2**32).astype(np.int64).tolist(), (steps < 0).astype(int).tolist()


def openmower() -> tuple[Types, list[Logged]]:
    types, messages = Types(ros1=True), []
    left, right = (counted_up(travelled, 2**32 - 500) for travelled in TRAVELLED)
    for i, stamp_ns in enumerate(WHEEL_STAMPS):
        ticks = {"wheel_ticks_rl": left[0][i], "wheel_ticks_rr": right[0][i]}
        directions = {"wheel_direction_rl": left[1][i], "wheel_direction_rr": right[1][i]}
        message = types(
            "xbot_msgs/WheelTick", stamp=types.time(stamp_ns), wheel_tick_factor=TICKS_PER_M, **ticks, **directions
        )
        messages.append(Logged("/ll/wheel_ticks", "xbot_msgs/WheelTick", stamp_ns, message))
    headings = headings_at(FIX_STAMPS)
    for i, stamp_ns in enumerate(FIX_STAMPS):
        position = types("geometry_msgs/Point", x=EAST[i], y=NORTH[i])
        pose = types("geometry_msgs/PoseWithCovariance", pose=types("geometry_msgs/Pose", position=position))
        common = {"header": types.header(stamp_ns, "map"), "pose": pose, "orientation_valid": 1}
        yaw = math.pi / 2 - headings[i]
        gnss = types(
            "xbot_msgs/AbsolutePose", **common, source=1, flags=3 if i % 4 else 5, position_accuracy=0.014,
            orientation_accuracy=0.02, vehicle_heading=yaw, motion_heading=yaw,
        )  # fmt: skip
        fused = types("xbot_msgs/AbsolutePose", **common, source=100, flags=9, position_accuracy=0.01)
        messages.append(Logged("/ll/position/gps", "xbot_msgs/AbsolutePose", stamp_ns, gnss))
        messages.append(Logged("/xbot_positioning/xb_pose", "xbot_msgs/AbsolutePose", stamp_ns, fused))
    return types, messages


def imu(types: Types) -> list[Logged]:
    messages = []
    for stamp_ns, heading in zip(DRIVE.heading.stamp_ns.tolist(), DRIVE.heading.heading_rad.tolist(), strict=True):
        half = (math.pi / 2 - heading) / 2
        orientation = types("geometry_msgs/Quaternion", z=math.sin(half), w=math.cos(half))
        message = types("sensor_msgs/Imu", header=types.header(stamp_ns, "imu"), orientation=orientation)
        messages.append(Logged("/imu/data", "sensor_msgs/Imu", stamp_ns, message))
    return messages


def ublox_dgnss() -> tuple[Types, list[Logged]]:
    types = Types(ros1=False)
    messages = imu(types)
    for i, stamp_ns in enumerate(WHEEL_STAMPS):
        angles = np.array([side[i] / RADIUS_M for side in TRAVELLED])
        joints = types(
            "sensor_msgs/JointState", header=types.header(stamp_ns), name=["left_wheel", "right_wheel"], position=angles
        )
        messages.append(Logged("/joint_states", "sensor_msgs/JointState", stamp_ns, joints))
    for i, stamp_ns in enumerate(FIX_STAMPS):
        fix = types(
            "ublox_ubx_msgs/UBXNavPVT", header=types.header(stamp_ns, "ubx"), h_acc=14, gnss_fix_ok=1,
            gps_fix=types("ublox_ubx_msgs/GpsFix", fix_type=3 if i else 1),
            carr_soln=types("ublox_ubx_msgs/CarrSoln", status=2 if i % 4 else 1),
            lat=round(LATITUDE[i] * 1e7), lon=round(LONGITUDE[i] * 1e7), height=round(HEIGHT[i] * 1e3),
            invalid_llh=int(i == 1),
        )  # fmt: skip
        messages.append(Logged("/ubx_nav_pvt", "ublox_ubx_msgs/UBXNavPVT", stamp_ns, fix))
    return types, messages


def angle(degrees: float, digits: int, sides: str) -> tuple[str, str]:
    """Return an angle as NMEA has it: ``dddmm.mmmmmmm`` and its side."""
    whole, rest = divmod(abs(degrees), 1.0)
    return f"{int(whole):0{digits}d}{60 * rest:010.7f}", sides[int(degrees < 0)]


def sentences(i: int, quality: int, *, gga: bool = True) -> list[str]:
    """Return the sentences of an epoch, written by pynmea2."""
    place = (*angle(LATITUDE[i], 2, "NS"), *angle(LONGITUDE[i], 3, "EW"))
    time = f"{10 + i // 72000:02d}{i // 1200 % 60:02d}{i % 1200 / 20:05.2f}"
    height = f"{HEIGHT[i] - GEOID_M:.3f}"
    heading = f"{math.degrees(headings_at(FIX_STAMPS[i : i + 1])[0]) % 360:.2f}"
    mode = {0: "N", 1: "A", 4: "R", 5: "F"}[quality]
    fix = (time, *place, str(quality), "17", "0.7", height, "M", f"{GEOID_M}", "M", "1.0", "0001")
    told = [
        pynmea2.GGA("GN", "GGA", fix) if gga else pynmea2.GSV("GP", "GSV", ("1", "1", "00")),
        pynmea2.RMC("GN", "RMC", (time, "A" if quality else "V", *place, "0.5", "", "231126", "", "", mode)),
        pynmea2.GST("GN", "GST", (time, "5.0", "0.02", "0.01", "12.0", "0.013", "0.011", "0.02")),
        pynmea2.HDT("GP", "HDT", (heading, "T")),
    ]
    return [str(one) for one in told]


def autopilot(*, gga: bool = True) -> tuple[Types, list[Logged]]:
    types, messages = Types(ros1=False), []
    for i, stamp_ns in enumerate(WHEEL_STAMPS):
        header, data = types.header(stamp_ns), np.array([side[i] for side in TRAVELLED])
        wheels = types("mavros_msgs/WheelOdomStamped", header=header, data=data)
        messages.append(Logged("/mavros/wheel_odometry/distance", "mavros_msgs/WheelOdomStamped", stamp_ns, wheels))
    for i, stamp_ns in enumerate(FIX_STAMPS):
        quality = 0 if i == 5 else 4 if i % 4 else 5
        for late, text in enumerate(sentences(i, quality, gga=gga)):
            sentence = types("nmea_msgs/Sentence", header=types.header(stamp_ns, "gps"), sentence=text + "\r\n")
            messages.append(Logged("/nmea_sentence", "nmea_msgs/Sentence", stamp_ns + 1000 * late, sentence))
    return types, messages


def headings_at(stamps_ns: list[int]) -> Floats:
    return np.interp(stamps_ns, WHEEL_STAMPS, np.unwrap(DRIVE.heading.heading_rad))


def foxglove() -> Iterator[tuple[str, int, Message]]:
    """Yield topic, log time and message of joint states, fixes with a heading, and poses of a motion capture."""

    def time(stamp_ns: int) -> dict[str, int]:
        return dict(zip(("seconds", "nanos"), divmod(stamp_ns, 10**9), strict=True))

    for i, stamp_ns in enumerate(WHEEL_STAMPS):
        joints = [
            JointState(name=f"{name}_wheel_joint", position=side[i] / RADIUS_M)
            for name, side in zip(("left", "right"), TRAVELLED, strict=True)
        ]
        yield "/joints", stamp_ns, JointStates(timestamp=time(stamp_ns), joints=joints)
    headings = headings_at(FIX_STAMPS)
    for i, stamp_ns in enumerate(FIX_STAMPS):
        yield "/fix", stamp_ns, LocationFix(
            timestamp=time(stamp_ns), frame_id="antenna", latitude=LATITUDE[i], longitude=LONGITUDE[i],
            altitude=HEIGHT[i], position_covariance=[0.011**2, 0, 0, 0, 0.013**2, 0, 0, 0, 1],
            position_covariance_type=LocationFix.KNOWN, heading=headings[i],
            metadata=[{"key": "satellites", "value": "17"}],
        )  # fmt: skip
        half = (math.pi / 2 - headings[i]) / 2
        pose = {"position": {"x": EAST[i], "y": NORTH[i]}, "orientation": {"z": math.sin(half), "w": math.cos(half)}}
        yield "/mocap/pose", stamp_ns, PoseInFrame(timestamp=time(stamp_ns), frame_id="world", pose=pose)


def write_protobuf(path: Path) -> Path:
    path = path.with_suffix(".mcap")
    with path.open("wb") as stream, ProtobufWriter(stream) as writer:
        for topic, stamp_ns, message in sorted(foxglove(), key=lambda one: one[1]):
            writer.write_message(topic, message, stamp_ns, stamp_ns)
    return path


def as_json(message: Message) -> dict[str, Any]:
    """Return a message as Foxglove's JSON schemas have it: times are ``sec`` and ``nsec``, enumerations numbers."""
    found = MessageToDict(
        message,
        always_print_fields_with_no_presence=True,
        preserving_proto_field_name=True,
        use_integers_for_enums=True,
    )
    stamp = message.timestamp  # type: ignore[attr-defined]
    return found | {"timestamp": {"sec": stamp.seconds, "nsec": stamp.nanos}}


def json_schema(value: Any) -> dict[str, Any]:
    """Return the schema of a value."""
    if isinstance(value, dict):
        return {"type": "object", "properties": {name: json_schema(one) for name, one in value.items()}}
    if isinstance(value, list):
        return {"type": "array", "items": json_schema(value[0])}
    return {"type": {int: "integer", float: "number", str: "string"}[type(value)]}


def write_json(path: Path, *, schemas: bool = True) -> Path:
    path = path.with_suffix(".mcap")
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start()
        channels: dict[str, int] = {}
        for topic, stamp_ns, message in sorted(foxglove(), key=lambda one: one[1]):
            content = as_json(message)
            if topic not in channels:
                schema = json.dumps(json_schema(content)).encode() if schemas else b"{}"
                number = writer.register_schema(message.DESCRIPTOR.full_name, "jsonschema", schema)
                channels[topic] = writer.register_channel(topic, "json", number)
            writer.add_message(channels[topic], stamp_ns, json.dumps(content).encode(), stamp_ns)
        writer.finish()
    return path


LOGS: dict[str, Callable[[Path], Path]] = {
    "openmower": lambda path: write(path, *openmower()),
    "ublox_dgnss": lambda path: write(path, *ublox_dgnss()),
    "autopilot": lambda path: write(path, *autopilot()),
    "protobuf": write_protobuf,
    "json": write_json,
    "json without schemas": functools.partial(write_json, schemas=False),
}
FOXGLOVE = ("/joints", "/fix", "/fix")
TOPICS = {
    "openmower": ("/ll/wheel_ticks", "/ll/position/gps", "/ll/position/gps"),
    "ublox_dgnss": ("/joint_states", "/ubx_nav_pvt", "/imu/data"),
    "autopilot": ("/mavros/wheel_odometry/distance", "/nmea_sentence", "/nmea_sentence"),
    **dict.fromkeys(("protobuf", "json", "json without schemas"), FOXGLOVE),
}
JOINTS = ("ublox_dgnss", "protobuf", "json", "json without schemas")
NO_CLASS = ("protobuf", "json", "json without schemas")


@pytest.fixture(scope="module")
def place_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """What writes a log once, and returns its place."""
    folder = tmp_path_factory.mktemp("log")
    return functools.cache(lambda name: LOGS[name](folder / name.replace(" ", "_")))


class Written(NamedTuple):
    name: str
    path: Path
    log: RobotLog


@pytest.fixture(scope="module", params=LOGS)
def written(request: pytest.FixtureRequest, place_of: Callable[[str], Path]) -> Written:
    path = place_of(request.param)
    return Written(request.param, path, read_log(path, CONFIG))


def test_the_sensors_of_the_stack_are_chosen(written: Written) -> None:
    assert tuple(stream.topic for stream in written.log.streams) == TOPICS[written.name]


def test_the_positions_are_those_that_were_measured(written: Written) -> None:
    name, fixes = written.name, written.log.gnss
    kept = np.isin(DRIVE.gnss.stamp_ns, fixes.stamp_ns)
    assert len(FIX_STAMPS) - len(fixes.stamp_ns) == {"ublox_dgnss": 2, "autopilot": 1}.get(name, 0)
    resolution_m = 0.012 if name == "ublox_dgnss" else 1e-3  # 1e-7 degrees of latitude
    for found, true in ((fixes.north_m, NORTH[kept]), (fixes.east_m, EAST[kept])):
        np.testing.assert_allclose(found - found[0], true - true[0], atol=resolution_m)
    std = (0.014, 0.014) if name in ("openmower", "ublox_dgnss") else (0.013, 0.011)
    np.testing.assert_allclose(
        np.sqrt(np.column_stack([fixes.var_north_m2, fixes.var_east_m2])), [std] * len(kept[kept]), rtol=1e-6
    )


def test_the_state_of_the_carrier_phase_is_read(written: Written) -> None:
    name, fixes = written.name, written.log.gnss
    if name in NO_CLASS:
        assert fixes.stated_class is None
        return
    expected = [FIXED_FIX if i % 4 else FLOAT_FIX for i in np.flatnonzero(np.isin(FIX_STAMPS, fixes.stamp_ns))]
    assert fixes.stated_class is not None
    assert fixes.stated_class.tolist() == expected


def test_the_wheels_travel_as_far_as_they_did(written: Written) -> None:
    wheels = written.log.wheels
    per_unit = RADIUS_M if written.name in JOINTS else 1.0
    seconds = np.diff(wheels.stamp_ns) / 1e9
    rounding_m = 1.1 / TICKS_PER_M
    for side, true in ((wheels.left, TRAVELLED[0]), (wheels.right, TRAVELLED[1])):
        np.testing.assert_allclose(np.cumsum(side[:-1] * seconds) * per_unit, true[1:] - true[0], atol=rounding_m)


def test_info_lists_the_topics_and_fit_finds_the_icrs(written: Written, icrtool: Callable[..., Any]) -> None:
    name, path, _ = written
    setting = ("--set", f"robot.wheel_radius_m={RADIUS_M}")
    status, out, _ = icrtool("info", path, *setting, "-v")
    assert status == 0
    for topic in TOPICS[name]:
        assert f"-> {topic}:" in out or topic in out
    status, out, err = icrtool("fit", path, *setting, "-o", "run", "--plots", "none", "--json")
    assert status == 0, err
    icr = json.loads(Path("run", "run.json").read_text(encoding="utf-8"))["icr"]["final"]
    found = icr["y_icr_right_m"], icr["y_icr_left_m"], icr["x_icr_m"]
    np.testing.assert_allclose(found, ICRS, atol=0.06)


def test_without_gga_the_fixes_of_rmc_are_used(tmp_path: Path) -> None:
    # RMC has no height: at 560 m a metre is 0.1 mm longer than at 0
    log = read_log(write(tmp_path / "rmc", *autopilot(gga=False)), CONFIG)
    assert len(log.gnss.stamp_ns) == len(FIX_STAMPS) - 1
    np.testing.assert_allclose(
        log.gnss.north_m - log.gnss.north_m[0], NORTH[np.arange(len(NORTH)) != 5] - NORTH[0], atol=3e-3
    )
    assert log.gnss.stated_class is not None
    assert set(log.gnss.stated_class.tolist()) == {FIXED_FIX, FLOAT_FIX}


@pytest.mark.parametrize("kind", ["protobuf", "json"])
def test_poses_in_foxglove_s_schema_are_a_reference_of_position_and_heading(
    place_of: Callable[[str], Path], kind: str
) -> None:
    log = read_log(place_of(kind), load_config(sets=["topics.gnss=/mocap/pose", "topics.heading=/mocap/pose"]))
    assert np.abs(log.gnss.north_m - NORTH).max() < 1e-9
    assert np.abs(log.gnss.east_m - EAST).max() < 1e-9
    turned = log.heading.heading_rad - headings_at(FIX_STAMPS)
    assert np.abs(np.angle(np.exp(1j * turned))).max() < 1e-9
    assert [stream.clock for stream in log.streams] == ["header"] * 3


@pytest.mark.parametrize("kind", ["protobuf", "json"])
def test_wheels_in_two_fields_of_a_message_of_one_s_own_are_found(tmp_path: Path, kind: str) -> None:
    file = descriptor_pb2.FileDescriptorProto(name="own.proto", package="own", syntax="proto3")
    fields = ("left_speed", "right_speed", "voltage")
    state = file.message_type.add(name="WheelState")
    for number, name in enumerate(fields, 1):
        state.field.add(name=name, number=number, type="TYPE_DOUBLE", label="LABEL_OPTIONAL")
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    own = message_factory.GetMessageClass(pool.FindMessageTypeByName("own.WheelState"))
    schema = {"type": "object", "properties": {name: {"type": "number"} for name in fields}}
    path = tmp_path / "own.mcap"
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start()
        described = (
            json.dumps(schema).encode() if kind == "json" else build_file_descriptor_set(own).SerializeToString()
        )
        number = writer.register_schema("own.WheelState", "jsonschema" if kind == "json" else kind, described)
        channel = writer.register_channel("/base/state", kind, number)
        for stamp_ns, left, right in zip(WHEEL_STAMPS, DRIVE.wheels.v_left_mps, DRIVE.wheels.v_right_mps, strict=True):
            values = dict(zip(fields, (left, right, 24.0), strict=True))
            content = json.dumps(values).encode() if kind == "json" else own(**values).SerializeToString()
            writer.add_message(channel, stamp_ns, content, stamp_ns)
        writer.finish()
    (motion,) = survey_log(path).candidates.wheels
    assert motion.topic == "/base/state.left_speed + /base/state.right_speed"
    assert motion.speed is not None
    np.testing.assert_array_equal(motion.speed[0], DRIVE.wheels.v_left_mps)
