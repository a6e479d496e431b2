"""Readers of messages with the position of the antenna or of the robot: fixes, poses and transforms."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from icrtool.config import Config
from icrtool.errors import DefinitionError
from icrtool.kernels.arrays import Bools, Bytes, Floats, Ints, quaternion_product, turned_axis
from icrtool.logs.containers.container import Channel
from icrtool.logs.messages.topic_table import FRAME_FIELD, STAMPS, TopicTable
from icrtool.logs.streams.sources import (
    NEVER_MOVES_PENALTY,
    PositionSource,
    all_valid,
    fields_in,
    number_of,
    topic_fields,
)
from icrtool.records.samples import FIXED_FIX, FLOAT_FIX, NOT_STATED, OTHER_FIX, RTK_FIX
from icrtool.records.text import LogText


class Solution(NamedTuple):
    """A field that states the solution of a position: a number, or a word of NovAtel (``NARROW_INT``).

    Attributes
    ----------
    name : name of the field
    codes : class of fix (`icrtool.records.samples`) of each number
    otherwise : class of all other numbers
    mask : bits of the number that are compared
    informative : whether the numbers are used only if one fix has a carrier-phase solution, because drivers may write 0
        for every fix
    """

    name: str
    codes: Mapping[int, int]
    otherwise: int = NOT_STATED
    mask: int = -1
    informative: bool = False

    def classes(self, table: TopicTable) -> Bytes | None:
        """Return the class of each fix (n,), uint8; None where the topic states none."""
        if self.name in table.texts:
            numbers, texts = table.words(self.name)
            return np.array([*(_class_of_word(text) for text in texts), NOT_STATED], np.uint8)[numbers]
        values = table.integers(self.name)
        if values is None:
            return None
        classes = np.full(len(values), self.otherwise, np.uint8)
        for value, code in self.codes.items():
            classes[values & self.mask == value] = code
        return classes if not self.informative or np.isin(classes, (FIXED_FIX, FLOAT_FIX, RTK_FIX)).any() else None


def _class_of_word(text: str) -> int:
    """Return the class of fix that a word of NovAtel states."""
    if not text:
        return NOT_STATED
    if text.endswith(("_FLOAT", "RTKFLOAT")):
        return FLOAT_FIX
    return FIXED_FIX if text.endswith(("_INT", "RTKFIXED", "RTK_DIRECT_INS")) else OTHER_FIX


REFERENCE_WORDS = re.compile(
    r"gps|gnss|(?<![a-z])fix|map|icp|lidar|laser|slam|loam|\blio\b|mocap|vicon|optitrack|qualisys|ground|truth|\bgt\b|total|station|"
    r"prism|leica|utm|global|navsat|\bins\b|vectornav|novatel|sbg|ublox",
    re.IGNORECASE,
)
"""Words in names of odometry and pose topics, or of their frames, that show a position reference and not the dead
reckoning of the robot."""

REFERENCE_FRAMES = {"world", "earth", "ecef", "local_enu", "enu", "camera_init"}
"""Other names of frames of a position reference. FAST-LIO and LOAM call their map ``camera_init``."""

GOAL_WORDS = re.compile(r"goal|initial_?pose|cmd|command|desired|setpoint", re.IGNORECASE)
"""Words in names of topics that hold goals or commands."""

GOAL_PROBLEM = "its name is the name of a goal, not of a measurement"
"""Reason for which the topic of a goal is no position."""

LEAST_DRIVE_WIDTH_M = 1.0
"""Smallest width of a drive with which the plane of the drive is found, as a standard deviation of positions [m]."""

FLAT_RATIO = 0.1
"""Largest ratio of thickness to width of the plane of a drive."""

LARGEST_PLACE_M = 1e8
"""Largest coordinate that is used [m]."""

MOST_PLACES = 2000
"""Largest number of positions from which the plane of a drive is computed."""

LEAST_RADIUS_M = 6.33e6
"""Smallest distance of a place on earth from the centre of the earth [m]."""

LARGEST_RADIUS_M = 6.40e6
"""Largest distance of a place on earth from the centre of the earth [m]."""

NO_SOLUTION = Solution("", {})
"""Solution of a message type without a field that states it."""

HIGHEST_M = 20_000.0
"""Largest height that is used [m]. A larger height stands for "unknown", and is replaced by the median of the other
heights."""

FARTHEST_M = 200_000.0
"""Largest distance of a fix from the median of all fixes [m]."""

STILL_M = 0.5
"""Largest range of the fixes of a receiver that never moves, as on a base station [m]."""

METRES_PER_DEGREE = 111_000.0
"""Length of a degree of latitude [m]."""

GOOD_STD_M = 0.3
"""Largest median standard deviation of preferred fixes [m]. RTK fixes have a smaller one."""

INACCURATE_PENALTY = 35.0
"""Number that is subtracted from the worth of fixes with a larger standard deviation."""


@dataclass(frozen=True, slots=True)
class Fix:
    """A message type with positions.

    Attributes
    ----------
    label : name of the data, for the reason of a choice
    worth : score of the type; the source with the highest score is chosen
    coordinates : numbers for `number_of`: latitude and longitude [deg], height above the ellipsoid [m]; if `metric`,
        x, y, z [m]
    std : numbers of the standard deviations to the north and to the east [m], or one number for both
    covariance : numbers of the variances to the north and to the east and of their covariance [m^2]; they are preferred
        to `std`
    stated : checks that a stated covariance passes
    valid : checks that a valid fix passes
    solution : field with the solution of the position
    metric : whether the positions are metric: x to the east and y to the north in the frame of the topic
    odometry : whether the type is an odometry, whose name or frame must show that it is a position reference
    independent : checks that an independent position passes; if half of the messages fail, it is fused with the wheels
    """

    label: str
    worth: float
    coordinates: tuple[str, str, str] = ("latitude", "longitude", "altitude")
    std: tuple[str, ...] = ()
    covariance: tuple[str, ...] = ()
    stated: tuple[str, ...] = ()
    valid: tuple[str, ...] = ()
    solution: Solution = NO_SOLUTION
    metric: bool = False
    odometry: bool = False
    independent: tuple[str, ...] = ()

    @property
    def fields(self) -> tuple[str, ...]:
        """The fields that are read."""
        numbers = (*self.coordinates, *self.std, *self.covariance, self.solution.name)
        return fields_in(numbers, (*self.valid, *self.stated, *self.independent))

    def read(self, table: TopicTable, config: Config) -> PositionSource:
        """Return the positions of a topic.

        A usable position is finite and has a fix. A usable geodetic position also lies on earth, not at latitude and
        longitude 0, and near the other positions. Metric positions have a problem if they are goals, dead reckoning, or
        in a frame whose z axis does not point up.

        Raises
        ------
        DefinitionError
            The type, as the log defines it, lacks the position.
        """
        first, second = (number_of(table, coordinate, needed=True) for coordinate in self.coordinates[:2])
        third = number_of(table, self.coordinates[2])
        status_counts = config.topics.gnss_status == "stated"
        no_fix, finite = ~all_valid(table, self.valid) & status_counts, np.isfinite(first) & np.isfinite(second)
        if self.metric:
            reasons = {"not finite": ~finite, "no fix": no_fix}
        else:
            with np.errstate(invalid="ignore"):
                possible = (np.abs(first) <= 90.0) & (np.abs(second) <= 360.0)
            reasons = {
                "no fix": no_fix,
                "not finite": ~finite,
                "not a place on earth": ~possible,
                "at 0, 0": (first == 0) & (second == 0),
                "far from the others": _far_away(first, second, possible & ~no_fix & finite),
            }
        usable, rejected = np.ones(len(table), np.bool_), dict[str, int]()
        for reason, bad in reasons.items():
            if count := int(np.count_nonzero(bad & usable)):
                rejected[reason] = count
            usable &= ~bad
        coordinates, variance = np.column_stack([first, second, third]), self._variance(table)
        silenced = rejected.get("no fix", 0) == len(table) and bool(np.isfinite(variance[:, :2]).any())
        geodetic = metric = None
        if self.metric:
            metric = np.column_stack([second, first])
            score, why, problem = self.worth, self.label, self._problem(table, coordinates[usable])
        else:
            plausible = np.abs(third) < HIGHEST_M
            known = third[plausible & usable]
            height = np.where(plausible, third, float(np.median(known)) if len(known) else 0.0)
            geodetic = np.column_stack([first, second, height])
            score, why = self._worth(coordinates[usable, :2], variance[usable, :2])
            counts = ", ".join(f"{reason} {count}" for reason, count in rejected.items())
            problem = "" if usable.any() else f"no usable fix ({counts})"
            problem += "; they state an accuracy: topics.gnss_status=ignored uses them" if silenced else ""
        return PositionSource(
            **topic_fields(table), geodetic=geodetic, metric=metric, variance=variance, usable=usable,
            rejected=rejected, score=score, why=why, problem=problem, stated_class=self.solution.classes(table),
        )  # fmt: skip

    def _variance(self, table: TopicTable) -> Floats:
        """Return the variances to the north and east and their covariance (n, 3) [m^2], NaN where not stated.

        Variances that are not both positive count as not stated.
        """
        variance = np.full((len(table), 3), np.nan)
        if self.std:
            north, east = number_of(table, self.std[0]), number_of(table, self.std[-1])
            has_variance = (north > 0) & (east > 0)
            with np.errstate(over="ignore"):
                variance[has_variance] = np.column_stack([north**2, east**2, np.zeros(len(table))])[has_variance]
        if self.covariance:
            diagonal = np.column_stack([number_of(table, entry) for entry in self.covariance])
            has_variance = (diagonal[:, 0] > 0) & (diagonal[:, 1] > 0) & all_valid(table, self.stated)
            variance[has_variance] = diagonal[has_variance]
        return variance

    def _worth(self, places_deg: Floats, variance: Floats) -> tuple[float, str]:
        """Return the score of fixes (n, 2) [deg], lower if they are inaccurate or never move, and the reason."""
        std = float(np.sqrt(np.nanmedian(variance))) if np.isfinite(variance).any() else math.nan
        label, score = self.label, self.worth - (INACCURATE_PENALTY if std > GOOD_STD_M else 0.0)
        if len(places_deg) > 1:
            spread = np.ptp(np.percentile(places_deg, [2.5, 97.5], axis=0), axis=0)
            # A degree of longitude is shorter than a degree of latitude, so that the test is strict for both.
            if (spread * METRES_PER_DEGREE < STILL_M).all():
                label, score = f"{label} that never moves", score - NEVER_MOVES_PENALTY
        return score, f"{label}, states ±{std:.2g} m" if math.isfinite(std) else f"{label}, states no accuracy"

    def _problem(self, table: TopicTable, positions_m: Floats) -> str:
        """Return the reason why positions x, y, z (n, 3) [m] are no reference; empty where they may be one."""
        frame = table.text(FRAME_FIELD).lstrip("/")
        is_reference = REFERENCE_WORDS.search(f"{table.topic} {frame}") or frame in REFERENCE_FRAMES
        problem = ""
        if not len(positions_m):
            problem = "no usable fix" if self.valid else "no finite position"
        elif is_fused(table, self.independent):
            problem = "its positions are fused with the wheels; a reference must be independent of them"
        elif LEAST_RADIUS_M < np.linalg.norm(np.median(positions_m, axis=0)) < LARGEST_RADIUS_M:
            problem = "its positions are counted from the centre of the earth (ECEF), which is not read"
        elif not _is_level(positions_m):
            problem = "its positions lie in a plane that stands upright: z is not up, as in a camera's optical frame"
        elif GOAL_WORDS.search(table.topic):
            problem = GOAL_PROBLEM
        elif not is_reference and (self.odometry or "odom" in table.topic.lower()):
            problem = (
                "its name and frame do not show a position reference: it may be the wheels' dead reckoning; "
                "topics.gnss names it if it is a reference"
            )
        return problem


def _far_away(latitude_deg: Floats, longitude_deg: Floats, known: Bools) -> Bools:
    """Return a mask of the known fixes (n,) that are far from the others.

    A receiver that is switched on may first send the last position of an earlier drive.
    """
    far, latitude_deg, longitude_deg = np.zeros(len(known), np.bool_), latitude_deg[known], longitude_deg[known]
    if len(latitude_deg):
        middle_deg = float(np.median(latitude_deg))
        # Relative to the first fix, longitudes have no step at the date line.
        east_deg = np.mod(longitude_deg - longitude_deg[0] + 180.0, 360.0) - 180.0
        east_deg = (east_deg - np.median(east_deg)) * math.cos(math.radians(middle_deg))
        away_deg = np.maximum(np.abs(latitude_deg - middle_deg), np.abs(east_deg))
        far[known] = away_deg * METRES_PER_DEGREE > FARTHEST_M
    return far


def is_fused(table: TopicTable, independent: tuple[str, ...]) -> bool:
    """Return whether half of the messages or more do not pass the checks `independent`."""
    return 2 * int(np.count_nonzero(all_valid(table, independent))) <= len(table)


def _is_level(places_m: Floats) -> bool:
    """Return whether the plane of a drive (n, 3) has a normal within 45 deg of z; True where the plane is not shown."""
    sample = places_m[:: max(1, len(places_m) // MOST_PLACES)]
    if len(sample) < 3 or not (np.abs(sample) < LARGEST_PLACE_M).all():
        return True
    # Coordinates are clipped so that single outliers do not widen the drive.
    kept = np.clip(sample, *np.percentile(sample, [2.5, 97.5], axis=0))
    _, size, axes = np.linalg.svd(kept - kept.mean(axis=0), full_matrices=False)
    _, across_m, off_m = size / math.sqrt(len(sample))
    return bool(across_m < LEAST_DRIVE_WIDTH_M or off_m > FLAT_RATIO * across_m or abs(axes[2, 2]) > math.sqrt(0.5))


TRANSFORM_TYPES = ("tf2_msgs/TFMessage", "tf/tfMessage")
"""Message types of transforms between frames."""

BASE_FRAMES = ("base_link", "base_footprint", "chassis_link", "base")
"""Names of the frame of the body, the most usual name first."""

LARGEST_LEVER_ARM_M = 5.0
"""Largest distance of an antenna from the body origin [m]. A longer transform is ignored."""

LARGEST_TRANSLATION_M = 1e9
"""Largest translation of a transform [m]. A larger one is damaged; UTM coordinates are below 1e7."""

_PREFIX = "transforms[*]."
TRANSFORM_FIELDS = (
    f"{_PREFIX}header.frame_id",
    f"{_PREFIX}child_frame_id",
    *(f"{_PREFIX}transform.translation.{axis}" for axis in "xyz"),
    *(f"{_PREFIX}transform.rotation.{axis}" for axis in "xyzw"),
)
"""Fields of a transform: name of the parent frame, name of the child frame, translation [m], rotation."""

TRANSFORM_STAMP = tuple(f"{_PREFIX}header.stamp.{part}" for part in ("sec", "nanosec"))
"""Fields of the stamp of a transform."""

_POSE = (*(f"pose.position.{axis}" for axis in "xyz"), *(f"pose.orientation.{axis}" for axis in "xyzw"))

Transforms = dict[str, tuple[str, Floats, Floats]]
"""For each child frame its parent frame, and the origin (3,) [m] and the axes (3, 3) of the child in the parent."""


def is_static(channel: Channel) -> bool:
    """Return whether a channel has static transforms."""
    return channel.message_type in TRANSFORM_TYPES and channel.topic.rstrip("/").endswith("tf_static")


def antenna_place(tables: Sequence[TopicTable], antenna_topic: str) -> tuple[float, float] | None:
    """Return the antenna's position in the body frame, forward and right [m]; None where the log does not state it.

    Parameters
    ----------
    tables : tables of the log, with its transforms
    antenna_topic : topic of the fixes; its header names the frame of the antenna
    """
    frame = next((table.text(FRAME_FIELD).strip("/") for table in tables if table.topic == antenna_topic), "")
    links: dict[str, _Link] = {}
    for table in tables:
        if table.message_type in TRANSFORM_TYPES and all(path in table.columns for path in TRANSFORM_FIELDS):
            links |= _read_links(table)
    if not frame or frame not in links:
        return None
    # The last message for a child frame is used.
    turns = np.array([link.turn[-1] for link in links.values()]).T
    axes = np.array([turned_axis(axis, *turns) for axis in range(3)]).transpose(2, 0, 1)
    placed = _place_in_roots(
        {
            name: (link.parent, link.origin_m[-1], frame_axes)
            for (name, link), frame_axes in zip(links.items(), axes, strict=True)
        }
    )
    root, antenna_m, _ = placed[frame]
    for base in (name for last in BASE_FRAMES for name in sorted(placed) if name.rsplit("/", 1)[-1] == last):
        base_root, origin, base_axes = placed[base]
        if base_root == root:
            forward, left, _up = base_axes @ (antenna_m - origin)
            if np.hypot(forward, left) <= LARGEST_LEVER_ARM_M:
                return float(forward), -float(left)
    return None


def _place_in_roots(transforms: Transforms) -> Transforms:
    """Return the root of each frame, and the origin and axes of the frame in this root.

    Each frame of a circle is its own root.
    """
    placed: Transforms = {}
    for name in transforms:
        chain: dict[str, None] = {}
        frame = name
        while frame in transforms and frame not in placed and frame not in chain:
            chain[frame] = None
            frame = transforms[frame][0]
        below = list(chain)
        if frame in chain:
            circle = below.index(frame)
            placed |= {frame: (frame, np.zeros(3), np.eye(3)) for frame in below[circle:]}
            del below[circle:]
        root, origin, axes = placed.setdefault(frame, (frame, np.zeros(3), np.eye(3)))
        for child in reversed(below):
            _, translation, turn = transforms[child]
            origin, axes = translation @ axes + origin, turn @ axes
            placed[child] = (root, origin, axes)
    return placed


class _Link(NamedTuple):
    """Transforms of one child frame.

    Attributes
    ----------
    parent : name of the parent frame
    rows, elements : (n,) message of each transform, and its index in the message
    origin_m : (n, 3) origin of the child in the parent [m]
    turn : (n, 4) quaternion x, y, z, w of the child in the parent
    """

    parent: LogText
    rows: Ints
    elements: Ints
    origin_m: Floats
    turn: Floats


def transform_pose(table: TopicTable) -> TopicTable:
    """Return the poses of the robot's base in the root of the transforms, as messages of PoseStamped.

    If an odometry frame lies between base and root, the root moves in steps with respect to it, as a map does after
    each matched scan. Only the first pose after each step is returned, because later poses add the motion of the
    odometry alone.

    Raises
    ------
    DefinitionError
        No base frame moves, or the root is no position reference.
    """
    base = _base_in_root(table)
    step = base.step
    if not (REFERENCE_WORDS.search(base.root) or base.root in REFERENCE_FRAMES):
        why = f"its root, {base.root}, does not show a position reference: it may be the wheels' dead reckoning"
        raise DefinitionError(table.topic, why)
    if not step.any():
        why = f"its frame {base.root} never moves with respect to the odometry: its poses are dead reckoning"
        raise DefinitionError(table.topic, why)
    return base.table_of(table, step)


def every_transform_pose(table: TopicTable) -> TopicTable:
    """Return the poses of the robot's base in the root of the transforms, one for each message that moves the base.

    Raises
    ------
    DefinitionError
        No base frame moves.
    """
    base = _base_in_root(table)
    return base.table_of(table, np.ones(len(base.rows), np.bool_))


class _BasePoses(NamedTuple):
    """Poses of the robot's base in the root of the transforms.

    Attributes
    ----------
    root : name of the root frame
    rows, elements : (n,) message of each pose, and the index of its transform in the message
    position_m : (n, 3) position [m]
    turn : (n, 4) quaternion x, y, z, w
    step : (n,) mask of the first pose after each step of the root with respect to an odometry; if the base is a child
        of the root, of all poses
    """

    root: LogText
    rows: Ints
    elements: Ints
    position_m: Floats
    turn: Floats
    step: Bools

    def table_of(self, table: TopicTable, chosen: Bools) -> TopicTable:
        """Return the poses that a mask (n,) chooses as messages of PoseStamped; `table` holds the transforms."""
        stamps = (table.column(path)[self.rows[chosen], self.elements[chosen]] for path in TRANSFORM_STAMP)
        frame = np.zeros(np.count_nonzero(chosen), np.int64)
        values = [*stamps, frame, *self.position_m[chosen].T, *self.turn[chosen].T]
        columns = dict(zip((*STAMPS[0], FRAME_FIELD, *_POSE), values, strict=True))
        return replace(
            table, message_type=LogText("geometry_msgs/PoseStamped"), log_time_ns=table.log_time_ns[self.rows[chosen]],
            columns=columns, texts={FRAME_FIELD: [self.root]},
        )  # fmt: skip


def _base_in_root(table: TopicTable) -> _BasePoses:
    """Return the poses of the base in the root, computed through all frames between base and root.

    Raises
    ------
    DefinitionError
        No base frame moves.
    """
    links = _read_links(table)
    base = next((name for last in BASE_FRAMES for name in links if name.rsplit("/", 1)[-1] == last), None)
    if base is None:
        raise DefinitionError(table.topic, f"it has no transform of a frame {', '.join(BASE_FRAMES)}")
    root, rows, elements, position_m, turn = links.pop(base)
    step = np.zeros(len(rows), np.bool_)
    lowest = True
    while root in links:
        above = links.pop(root)
        held = np.searchsorted(above.rows, rows, side="right") - 1
        known = held >= 0
        rows, elements, step, held = rows[known], elements[known], step[known], held[known]
        changed = np.diff(above.origin_m, axis=0).any(axis=1) | np.diff(above.turn, axis=0).any(axis=1)
        version = np.append(0, np.cumsum(changed))[held]
        step[1:] |= version[1:] != version[:-1]
        outer, position_m = above.turn[held], position_m[known]
        axes = (np.column_stack(turned_axis(axis, *outer.T)) for axis in range(3))
        position_m = above.origin_m[held] + sum(
            along[:, None] * axis for along, axis in zip(position_m.T, axes, strict=True)
        )
        turn = quaternion_product(outer, turn[known])
        root, lowest = above.parent, False
    return _BasePoses(root, rows, elements, position_m, turn, step | lowest)


def _read_links(table: TopicTable) -> dict[str, _Link]:
    """Return the transforms of each child frame of a topic, by its name without a leading slash."""
    parents, parent_names = table.words(TRANSFORM_FIELDS[0])
    children, child_names = table.words(TRANSFORM_FIELDS[1])
    numbers = np.stack([table.column(path) for path in TRANSFORM_FIELDS[2:]], axis=-1)
    length, size = (np.abs(part).max(axis=-1) for part in (numbers[..., :3], numbers[..., 3:]))
    # The largest component of a unit quaternion is between 0.5 and 1; the limits allow for one that is not normalised.
    sound = (length < LARGEST_TRANSLATION_M) & (size > 0.01) & (size < 100.0)
    all_rows, all_elements = np.nonzero((children >= 0) & sound)
    order = np.argsort(children[all_rows, all_elements], kind="stable")
    ends = np.cumsum(np.bincount(children[all_rows, all_elements], minlength=len(child_names)))
    links: dict[str, _Link] = {}
    for name, of_child in zip(child_names, np.split(order, ends[:-1]), strict=True):
        if len(of_child):
            rows, elements = all_rows[of_child], all_elements[of_child]
            pose = numbers[rows, elements]
            parent = LogText(parent_names[parents[rows[-1], elements[-1]]].strip("/"))
            turn = pose[:, 3:] / np.linalg.norm(pose[:, 3:], axis=1)[:, None]
            links[name.strip("/")] = _Link(parent, rows, elements, pose[:, :3], turn)
    return links
