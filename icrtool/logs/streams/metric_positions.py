"""Messages that hold the robot's position in metres already: poses and odometry, in their own frame."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np

from icrtool.kernels.arrays import Floats
from icrtool.logs.messages.topic_table import HEADER, TopicTable
from icrtool.logs.streams.fix_class import XBOT_FLAGS, class_by_code
from icrtool.logs.streams.sources import PositionEntry, PositionSource, of_topic

REFERENCE_WORDS = re.compile(
    r"gps|gnss|(?<![a-z])fix|map|icp|lidar|laser|slam|loam|\blio\b|mocap|vicon|optitrack|qualisys|ground|truth|\bgt\b|total|station|"
    r"prism|leica|utm|global|navsat|\bins\b|vectornav|novatel|sbg|ublox",
    re.IGNORECASE,
)
"""In names of odometry and pose topics, or of their frames: a reference, not the robot's own dead reckoning."""

REFERENCE_FRAMES = {"world", "earth", "ecef", "local_enu", "enu", "camera_init"}
"""Names of frames that are no such words; FAST-LIO and LOAM call their map ``camera_init``."""

GOAL_WORDS = re.compile(r"goal|initial_?pose|cmd|command|desired|setpoint", re.IGNORECASE)

LEAST_AREA_M, FLAT, LARGEST_PLACE_M, MOST_PLACES = 1.0, 0.1, 1e8, 2000
"""A drive this wide (standard deviation) shows its plane where it is no thicker than a tenth of that."""

LEAST_RADIUS_M, LARGEST_RADIUS_M = 6.33e6, 6.40e6
"""Of the earth; UTM coordinates far from the equator may be as large, but have a height near 0."""

XBOT_FUSED, XBOT_DEAD_RECKONING = 100, 8
"""Source and flag of xbot_msgs/AbsolutePose: fused with the wheels; not by satellites."""


def metric(pose: str, covariance: str, score: float, what: str, *, odometry: bool = False) -> PositionEntry:
    """Return the entry of a pose: x is taken as east and y as north, in the topic's own frame."""

    def read(table: TopicTable) -> PositionSource:
        x, y = (table.column(f"{pose}position.{axis}").astype(np.float64) for axis in "xy")
        variance = np.full((len(table), 3), np.nan)
        if covariance:
            var_x, var_y, cov = (table.floats(f"{covariance}[{i}]") for i in (0, 7, 1))
            positive = (var_x > 0) & (var_y > 0)
            variance[positive] = np.column_stack([var_y, var_x, cov])[positive]
        usable = np.isfinite(x) & np.isfinite(y)
        frame = table.text("header.frame_id").lstrip("/")
        named = bool(REFERENCE_WORDS.search(f"{table.topic} {frame}")) or frame in REFERENCE_FRAMES
        problem = "" if usable.any() else "no finite position"
        places = np.column_stack([x, y, table.floats(f"{pose}position.z")])[usable]
        if len(places) and LEAST_RADIUS_M < np.linalg.norm(np.median(places, axis=0)) < LARGEST_RADIUS_M:
            problem = "its positions are counted from the centre of the earth (ECEF), which is not read"
        elif not _is_level(places):
            problem = "its positions lie in a plane that stands upright: z is not up, as in a camera's optical frame"
        if GOAL_WORDS.search(table.topic):
            problem = problem or "its name is that of a goal, not of a measurement"
        elif not named and (odometry or "odom" in table.topic.lower()):
            problem = (
                problem
                or "its name and frame do not show a position reference: it may be the wheels' dead reckoning; "
                "topics.gnss names it if it is a reference"
            )
        count = int(np.count_nonzero(~usable))
        return PositionSource(
            **of_topic(table), metric=np.column_stack([y, x]), variance=variance, usable=usable,
            rejected={"not finite": count} if count else {}, score=score, why=what, problem=problem,
        )  # fmt: skip

    variances = tuple(f"{covariance}[{i}]" for i in (0, 1, 7) if covariance)
    return (*HEADER, *(f"{pose}position.{axis}" for axis in "xyz"), *variances), read


def _is_level(places_m: Floats) -> bool:
    """Return whether a drive (n, 3) that has an area lies in a plane whose normal is within 45 deg of z."""
    some = places_m[:: max(1, len(places_m) // MOST_PLACES)]
    if len(some) < 3 or not (np.abs(some) < LARGEST_PLACE_M).all():
        return True
    # single jumps are no place
    kept = np.clip(some, *np.percentile(some, [2.5, 97.5], axis=0))
    _, size, axes = np.linalg.svd(kept - kept.mean(axis=0), full_matrices=False)
    _, across_m, off_m = size / math.sqrt(len(some))
    return bool(across_m < LEAST_AREA_M or off_m > FLAT * across_m or abs(axes[2, 2]) > math.sqrt(0.5))


_POSE_FIELDS, _read_pose = metric("pose.pose.", "pose.covariance", 90.0, "GNSS position of OpenMower")


def _absolute_pose(table: TopicTable) -> PositionSource:
    """Return the positions of OpenMower, x east and y north of its datum; its own filter's are refused."""
    pose = _read_pose(table)
    flags, source = table.integers("flags"), table.integers("source")
    std = table.floats("position_accuracy")
    stated = np.where((std > 0)[:, None], np.column_stack([std**2, std**2, np.zeros(len(std))]), np.nan)
    usable = pose.usable
    rejected = dict(pose.rejected)
    if flags is not None:
        dead = (flags & XBOT_DEAD_RECKONING) != 0
        rejected |= {"no fix": int(np.count_nonzero(dead & usable))} if dead.any() else {}
        usable = usable & ~dead
    problem = pose.problem or ("" if usable.any() else "no usable fix")
    if source is not None and len(source) and np.median(source) == XBOT_FUSED:
        problem = "its positions are fused with the wheels; a reference must be independent of them"
    return replace(
        pose,
        variance=np.where(np.isfinite(pose.variance), pose.variance, stated),
        usable=usable,
        rejected=rejected,
        stated_class=class_by_code(None if flags is None else flags & 7, XBOT_FLAGS),
        problem=problem,
    )


ABSOLUTE_POSE: PositionEntry = ((*_POSE_FIELDS, "source", "flags", "position_accuracy"), _absolute_pose)
