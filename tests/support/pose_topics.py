"""Logs with poses of a localisation beside the sensors, written with the messages of ROS 2."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pymap3d import ned2geodetic

from icrtool.kernels.arrays import Floats, Ints
from icrtool.logs.write_log import (
    TopicMessages,
    TopicPlan,
    WriteOptions,
    header_stamps,
    load_typestore,
    serialise_topic,
    topic_plans,
    write_mcap,
)
from icrtool.records.samples import SensorColumns
from support.drives import make_log

DATUM = (48.1, 11.6, 560.0)
WIDTH_M, RADIUS_M = 0.9, 0.15
SETS = [f"robot.track_width_m={WIDTH_M}", f"robot.wheel_radius_m={RADIUS_M}"]
SECONDS = 240.0
WHEELS_VARY = 0.02


class Poses(NamedTuple):
    """Stamps, position x and y [m], and yaw counter-clockwise from x [rad], (n,) each."""

    stamp_ns: Ints
    x: Floats
    y: Floats
    yaw: Floats

    def some(self, rows: slice | Ints) -> Poses:
        return Poses(self.stamp_ns[rows], self.x[rows], self.y[rows], self.yaw[rows])


def true_poses() -> Poses:
    """Return where the robot was, 20 times a second, in a frame of REP-103: x east, y north."""
    log = make_log(3, SECONDS, gnss_std=0.0, heading_std_deg=0.0)
    stamps, fixes = log.heading.stamp_ns, log.gnss
    rows = np.searchsorted(stamps, fixes.stamp_ns)
    return Poses(fixes.stamp_ns, fixes.east_m, fixes.north_m, np.pi / 2 - np.unwrap(log.heading.heading_rad)[rows])


def dead_reckoned(poses: Poses, turn_scale: float, noise_radps: float, seed: int = 1) -> Poses:
    """Return the path of a robot whose turns are scaled, with a random walk of the heading, from a start of its own."""
    rng = np.random.default_rng(seed)
    step = np.diff(poses.x + 1j * poses.y) * np.exp(-1j * (poses.yaw[:-1] + np.diff(poses.yaw) / 2))
    dt = np.diff(poses.stamp_ns) / 1e9
    turns = turn_scale * np.diff(poses.yaw) + noise_radps * np.sqrt(dt) * rng.normal(size=len(dt))
    yaw = np.append(0.0, np.cumsum(turns))
    place = np.append(0.0, np.cumsum(step * np.exp(1j * (yaw[:-1] + turns / 2))))
    return Poses(poses.stamp_ns, place.real, place.imag, yaw)


def measured(poses: Poses, std_m: float, std_rad: float, seed: int = 2) -> Poses:
    """Return poses with white noise, as of a filter that fuses GNSS."""
    rng, n = np.random.default_rng(seed), len(poses.x)
    return Poses(
        poses.stamp_ns, poses.x + std_m * rng.normal(size=n), poses.y + std_m * rng.normal(size=n),
        poses.yaw + std_rad * rng.normal(size=n),
    )  # fmt: skip


PREFIXES = {
    "nav_msgs/msg/Odometry": "pose.pose.",
    "geometry_msgs/msg/PoseStamped": "pose.",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose.pose.",
}


def pose_plan(topic: str, message_type: str, poses: Poses, frame: str = "odom") -> TopicPlan:
    prefix = PREFIXES[message_type]
    columns = header_stamps(poses.stamp_ns) | {
        f"{prefix}position.x": poses.x,
        f"{prefix}position.y": poses.y,
        f"{prefix}orientation.z": np.sin(poses.yaw / 2),
        f"{prefix}orientation.w": np.cos(poses.yaw / 2),
    }
    return TopicPlan(topic, message_type, poses.stamp_ns, {"header.frame_id": frame}, columns)


def transforms(topic: str, links: Sequence[tuple[str, str, Poses]]) -> TopicMessages:
    """Return moving transforms, each a parent, a child, and the child's poses in it; one transform a message."""
    store = load_typestore(ros1=False)
    types = {name.rpartition("/")[2]: kind for name, kind in store.types.items()}
    messages: list[tuple[int, bytes]] = []
    for parent, child, poses in links:
        for stamp_ns, x, y, yaw in zip(*(column.tolist() for column in poses), strict=True):
            header = types["Header"](types["Time"](*divmod(stamp_ns, 10**9)), parent)
            turn = types["Quaternion"](0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2))
            transform = types["Transform"](types["Vector3"](x, y, 0.0), turn)
            message = types["TFMessage"]([types["TransformStamped"](header, child, transform)])
            messages.append((stamp_ns, bytes(store.serialize_cdr(message, "tf2_msgs/msg/TFMessage"))))
    messages.sort(key=lambda one: one[0])
    stamps = np.array([stamp_ns for stamp_ns, _ in messages])
    return TopicMessages(topic, "tf2_msgs/msg/TFMessage", stamps, [data for _, data in messages])


def write_pose_log(
    path: Path, plans: Sequence[TopicPlan], further: Sequence[TopicMessages] = (), *, radius_m: float = RADIUS_M
) -> Path:
    """Write wheels, RTK fixes and an orientation of one drive, and beside them topics of poses.

    Each side goes further or less far than its encoders report by `WHEELS_VARY` of it (rms), differently every 5 s.
    """
    log = make_log(3, SECONDS)
    fixes, heading = log.gnss, log.heading
    rng, since = np.random.default_rng(9), (log.wheels.stamp_ns - log.wheels.stamp_ns[0]) / 1e9
    knots = np.arange(0.0, SECONDS + 5.0, 5.0)
    left, right = (1.0 + WHEELS_VARY * np.interp(since, knots, rng.normal(size=len(knots))) for _ in range(2))
    wheels = replace(log.wheels, left=log.wheels.v_left_mps * left, right=log.wheels.v_right_mps * right)
    step = np.diff(wheels.stamp_ns, append=wheels.stamp_ns[-1:]) / 1e9
    left, right = (np.append(0.0, np.cumsum(side * step)[:-1]) for side in (wheels.v_left_mps, wheels.v_right_mps))
    latitude, longitude, height = ned2geodetic(fixes.north_m, fixes.east_m, np.zeros(len(fixes.north_m)), *DATUM)
    columns = SensorColumns(
        wheel_stamp_ns=wheels.stamp_ns,
        wheel_position_left_m=left,
        wheel_position_right_m=right,
        wheel_v_left_mps=wheels.v_left_mps,
        wheel_v_right_mps=wheels.v_right_mps,
        gnss_stamp_ns=fixes.stamp_ns,
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=height,
        gnss_std_m=np.full(len(latitude), 0.014),
        gnss_status=np.full(len(latitude), 2),
        heading_stamp_ns=heading.stamp_ns,
        heading_rad=heading.heading_rad,
        yaw_rate_radps=np.gradient(np.unwrap(heading.heading_rad), (heading.stamp_ns - heading.stamp_ns[0]) / 1e9),
    )
    options = WriteOptions(track_width_m=WIDTH_M, wheel_radius_m=radius_m)
    store = load_typestore(ros1=False)
    all_plans = [*topic_plans(columns, options), *plans]
    write_mcap(path, [*(serialise_topic(plan, store) for plan in all_plans), *further], store, compression="zstd")
    return path
