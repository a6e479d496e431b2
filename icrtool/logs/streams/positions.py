"""Messages that hold the position of the antenna or of the robot: fixes, poses and transforms."""

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
from icrtool.logs.streams.sources import NEVER_MOVES, PositionSource, all_valid, fields_in, number_of, of_topic
from icrtool.records.samples import FIXED_FIX, FLOAT_FIX, NOT_STATED, OTHER_FIX, RTK_FIX
from icrtool.records.text import LogText


class Solution(NamedTuple):
    """A field that states how a position was solved: a number, or a word of NovAtel's (``NARROW_INT``).

    Attributes
    ----------
    codes, otherwise : the class by number, and the class of all other numbers
    mask : the bits of the number that count
    informative : the numbers count only if some fix has carrier phase, because drivers may write 0 for every fix
    """

    name: str
    codes: Mapping[int, int]
    otherwise: int = NOT_STATED
    mask: int = -1
    informative: bool = False

    def of(self, table: TopicTable) -> Bytes | None:
        """Return the class (n,) of each fix; None where the topic states none."""
        if self.name in table.texts:
            numbers, texts = table.words(self.name)
            return np.array([*(_of_word(text) for text in texts), NOT_STATED], np.uint8)[numbers]
        values = table.integers(self.name)
        if values is None:
            return None
        classes = np.full(len(values), self.otherwise, np.uint8)
        for value, code in self.codes.items():
            classes[values & self.mask == value] = code
        return classes if not self.informative or np.isin(classes, (FIXED_FIX, FLOAT_FIX, RTK_FIX)).any() else None


def _of_word(text: str) -> int:
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
"""Words in names of odometry and pose topics, or of their frames, that show a reference, not the robot's own dead
reckoning."""

REFERENCE_FRAMES = {"world", "earth", "ecef", "local_enu", "enu", "camera_init"}
"""Further names of frames of a reference; FAST-LIO and LOAM call their map ``camera_init``."""

GOAL_WORDS = re.compile(r"goal|initial_?pose|cmd|command|desired|setpoint", re.IGNORECASE)
GOAL = "its name is the name of a goal, not of a measurement"

LEAST_DRIVE_WIDTH_M = 1.0
"""Least width of a drive that shows in which plane it lies: a standard deviation of its positions [m]."""

FLAT_RATIO = 0.1
"""Largest ratio of thickness to width of the plane of a drive."""

LARGEST_PLACE_M = 1e8
"""Largest coordinate that is used [m]."""

MOST_PLACES = 2000
"""Largest number of positions that the plane of a drive is computed from."""

LEAST_RADIUS_M = 6.33e6
"""Least distance of a place on earth from the centre [m]. UTM coordinates may reach it, but have a height near 0."""

LARGEST_RADIUS_M = 6.40e6
"""Largest distance of a place on earth from the centre [m]."""

NO_SOLUTION = Solution("", {})

HIGHEST_M = 20_000.0
"""Largest height [m]; a larger height means "unknown", and is replaced by the median of the others."""

FARTHEST_M = 200_000.0
"""Largest distance of a robot from the middle of its fixes [m]."""

STILL_M = 0.5
"""Largest range of the fixes of a receiver that never moves [m], on a base station or a standing robot."""

METRES_PER_DEGREE = 111_000.0
"""Length of a degree of latitude [m]."""

GOOD_STD_M = 0.3
"""Largest standard deviation of a preferred fix [m], which is RTK or nearly so."""

NOT_GOOD = 35.0
"""Subtracted from the worth of fixes that are not preferred."""


@dataclass(frozen=True, slots=True)
class Fix:
    """A message type with positions.

    Attributes
    ----------
    what, worth : what it is called where it is chosen, and how suitable it is as reference
    place : latitude and longitude [deg], height above the ellipsoid [m]; where `metric` x, y, z [m]
    std : standard deviation [m] to the north and to the east; one text for both. All are read by `number_of`
    covariance : the variances to the north and to the east and their covariance, which have precedence
    stated : checks, all of which a stated covariance must pass
    valid : checks, all of which a fix must pass
    solution : how it was solved
    metric : x is taken as east and y as north, in the topic's own frame
    odometry : its name or frame must show that it is a reference
    independent : checks of an independent position; if half of the messages fail, it is fused with the wheels
    """

    what: str
    worth: float
    place: tuple[str, str, str] = ("latitude", "longitude", "altitude")
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
        numbers = (*self.place, *self.std, *self.covariance, self.solution.name)
        return fields_in(numbers, (*self.valid, *self.stated, *self.independent))

    def read(self, table: TopicTable, config: Config) -> PositionSource:
        """Return its positions; usable ones are finite and have a fix.

        Usable geodetic positions also lie on earth, not at 0, 0, and near the others.

        Metric positions of goals, of dead reckoning and of frames whose z is not up are refused.
        """
        first, second = (number_of(table, one, needed=True) for one in self.place[:2])
        third = number_of(table, self.place[2])
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
        places, variance = np.column_stack([first, second, third]), self._variance(table)
        silenced = rejected.get("no fix", 0) == len(table) and bool(np.isfinite(variance[:, :2]).any())
        geodetic = metric = None
        if self.metric:
            metric = np.column_stack([second, first])
            score, why, problem = self.worth, self.what, self._problem(table, places[usable])
        else:
            plausible = np.abs(third) < HIGHEST_M
            known = third[plausible & usable]
            height = np.where(plausible, third, float(np.median(known)) if len(known) else 0.0)
            geodetic = np.column_stack([first, second, height])
            score, why = self._worth(places[usable, :2], variance[usable, :2])
            counts = ", ".join(f"{reason} {count}" for reason, count in rejected.items())
            problem = "" if usable.any() else f"no usable fix ({counts})"
            problem += "; they state an accuracy: topics.gnss_status=ignored uses them" if silenced else ""
        return PositionSource(
            **of_topic(table), geodetic=geodetic, metric=metric, variance=variance, usable=usable, rejected=rejected,
            score=score, why=why, problem=problem, stated_class=self.solution.of(table),
        )  # fmt: skip

    def _variance(self, table: TopicTable) -> Floats:
        """Return north, east, covariance of both [m^2] (n, 3), NaN where not stated.

        A covariance of axes that are not both positive states nothing.
        """
        variance = np.full((len(table), 3), np.nan)
        if self.std:
            north, east = number_of(table, self.std[0]), number_of(table, self.std[-1])
            has_variance = (north > 0) & (east > 0)
            with np.errstate(over="ignore"):
                variance[has_variance] = np.column_stack([north**2, east**2, np.zeros(len(table))])[has_variance]
        if self.covariance:
            diagonal = np.column_stack([number_of(table, one) for one in self.covariance])
            has_variance = (diagonal[:, 0] > 0) & (diagonal[:, 1] > 0) & all_valid(table, self.stated)
            variance[has_variance] = diagonal[has_variance]
        return variance

    def _worth(self, places_deg: Floats, variance: Floats) -> tuple[float, str]:
        """Return how suitable fixes (n, 2) are, and why: less where they are not accurate, or never move."""
        std = float(np.sqrt(np.nanmedian(variance))) if np.isfinite(variance).any() else math.nan
        what, score = self.what, self.worth - (NOT_GOOD if std > GOOD_STD_M else 0.0)
        if len(places_deg) > 1:
            spread = np.ptp(np.percentile(places_deg, [2.5, 97.5], axis=0), axis=0)
            if (spread * METRES_PER_DEGREE < STILL_M).all():  # whatever the latitude
                what, score = f"{what} that never moves", score - NEVER_MOVES
        return score, f"{what}, states ±{std:.2g} m" if math.isfinite(std) else f"{what}, states no accuracy"

    def _problem(self, table: TopicTable, places: Floats) -> str:
        """Return why positions x, y, z (n, 3) are no reference, empty where they may be one."""
        frame = table.text(FRAME_FIELD).lstrip("/")
        is_reference = REFERENCE_WORDS.search(f"{table.topic} {frame}") or frame in REFERENCE_FRAMES
        problem = ""
        if not len(places):
            problem = "no usable fix" if self.valid else "no finite position"
        elif is_fused(table, self.independent):
            problem = "its positions are fused with the wheels; a reference must be independent of them"
        elif LEAST_RADIUS_M < np.linalg.norm(np.median(places, axis=0)) < LARGEST_RADIUS_M:
            problem = "its positions are counted from the centre of the earth (ECEF), which is not read"
        elif not _is_level(places):
            problem = "its positions lie in a plane that stands upright: z is not up, as in a camera's optical frame"
        elif GOAL_WORDS.search(table.topic):
            problem = GOAL
        elif not is_reference and (self.odometry or "odom" in table.topic.lower()):
            problem = (
                "its name and frame do not show a position reference: it may be the wheels' dead reckoning; "
                "topics.gnss names it if it is a reference"
            )
        return problem


def _far_away(latitude_deg: Floats, longitude_deg: Floats, known: Bools) -> Bools:
    """Return which known fixes (n,) lie far from the others: a receiver may send its last place when switched on."""
    far, latitude_deg, longitude_deg = np.zeros(len(known), np.bool_), latitude_deg[known], longitude_deg[known]
    if len(latitude_deg):
        middle_deg = float(np.median(latitude_deg))
        east_deg = np.mod(longitude_deg - longitude_deg[0] + 180.0, 360.0) - 180.0  # no step at the date line
        east_deg = (east_deg - np.median(east_deg)) * math.cos(math.radians(middle_deg))
        away_deg = np.maximum(np.abs(latitude_deg - middle_deg), np.abs(east_deg))
        far[known] = away_deg * METRES_PER_DEGREE > FARTHEST_M
    return far


def is_fused(table: TopicTable, independent: tuple[str, ...]) -> bool:
    """Return whether half of the messages or more do not pass the checks of independent ones."""
    return 2 * int(np.count_nonzero(all_valid(table, independent))) <= len(table)


def _is_level(places_m: Floats) -> bool:
    """Return whether a drive (n, 3) that has an area lies in a plane whose normal is within 45 deg of z."""
    some = places_m[:: max(1, len(places_m) // MOST_PLACES)]
    if len(some) < 3 or not (np.abs(some) < LARGEST_PLACE_M).all():
        return True
    # single jumps do not widen the drive
    kept = np.clip(some, *np.percentile(some, [2.5, 97.5], axis=0))
    _, size, axes = np.linalg.svd(kept - kept.mean(axis=0), full_matrices=False)
    _, across_m, off_m = size / math.sqrt(len(some))
    return bool(across_m < LEAST_DRIVE_WIDTH_M or off_m > FLAT_RATIO * across_m or abs(axes[2, 2]) > math.sqrt(0.5))


TRANSFORM_TYPES = ("tf2_msgs/TFMessage", "tf/tfMessage")
BASE_FRAMES = ("base_link", "base_footprint", "chassis_link", "base")
LARGEST_LEVER_ARM_M = 5.0
"""Largest distance of an antenna from the body origin [m]; a longer transform is ignored."""

LARGEST_TRANSLATION_M = 1e9
"""Largest translation of a transform [m]; a larger one is damaged. UTM coordinates reach 1e7."""

_PREFIX = "transforms[*]."
TRANSFORM_FIELDS = (
    f"{_PREFIX}header.frame_id",
    f"{_PREFIX}child_frame_id",
    *(f"{_PREFIX}transform.translation.{axis}" for axis in "xyz"),
    *(f"{_PREFIX}transform.rotation.{axis}" for axis in "xyzw"),
)
"""Fields of a transform: parent, child, translation, rotation."""

TRANSFORM_STAMP = tuple(f"{_PREFIX}header.stamp.{part}" for part in ("sec", "nanosec"))
_POSE = (*(f"pose.position.{axis}" for axis in "xyz"), *(f"pose.orientation.{axis}" for axis in "xyzw"))

Transforms = dict[str, tuple[str, Floats, Floats]]
"""Child frame to parent frame, and origin (3,) [m] and axes (3, 3) of the child in it."""


def is_static(channel: Channel) -> bool:
    """Return whether a channel carries static transforms."""
    return channel.message_type in TRANSFORM_TYPES and channel.topic.rstrip("/").endswith("tf_static")


def antenna_place(tables: Sequence[TopicTable], antenna_topic: str) -> tuple[float, float] | None:
    """Return the antenna's position in the body frame, forward and right [m]; None where the log has no transform.

    Parameters
    ----------
    antenna_topic : topic of the fixes; its header names the antenna's frame
    """
    frame = next((table.text(FRAME_FIELD).strip("/") for table in tables if table.topic == antenna_topic), "")
    links: dict[str, _Link] = {}
    for table in tables:
        if table.message_type in TRANSFORM_TYPES and all(path in table.columns for path in TRANSFORM_FIELDS):
            links |= _links(table)
    if not frame or frame not in links:
        return None
    # of several messages for one child frame, the last
    turns = np.array([one.turn[-1] for one in links.values()]).T
    axes = np.array([turned_axis(axis, *turns) for axis in range(3)]).transpose(2, 0, 1)
    placed = _in_roots(
        {name: (one.parent, one.place[-1], of) for (name, one), of in zip(links.items(), axes, strict=True)}
    )
    root, place, _ = placed[frame]
    for base in (name for last in BASE_FRAMES for name in sorted(placed) if name.rsplit("/", 1)[-1] == last):
        base_root, origin, base_axes = placed[base]
        if base_root == root:
            forward, left, _up = base_axes @ (place - origin)
            if np.hypot(forward, left) <= LARGEST_LEVER_ARM_M:
                return float(forward), -float(left)
    return None


def _in_roots(transforms: Transforms) -> Transforms:
    """Return each frame's root, and the frame's origin and axes in this root; a frame in a circle is its own root."""
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
            placed |= {one: (one, np.zeros(3), np.eye(3)) for one in below[circle:]}
            del below[circle:]
        root, origin, axes = placed.setdefault(frame, (frame, np.zeros(3), np.eye(3)))
        for one in reversed(below):
            _, translation, turn = transforms[one]
            origin, axes = translation @ axes + origin, turn @ axes
            placed[one] = (root, origin, axes)
    return placed


class _Link(NamedTuple):
    """A frame in its parent: the messages (n,) and places in them (n,), translations (n, 3), quaternions (n, 4)."""

    parent: LogText
    rows: Ints
    places: Ints
    place: Floats
    turn: Floats


def transform_pose(table: TopicTable) -> TopicTable:
    """Return the poses of the robot's base in the root of the transforms, as messages of PoseStamped.

    Where an odometry frame lies between base and root, the root moves against it in steps, as a map does after each
    matched scan. There is one pose, at the first odometry after each step: later poses add only the odometry's motion.

    Raises
    ------
    DefinitionError
        No base frame moves, or the root is no reference.
    """
    base = _base_in_root(table)
    step = base.step
    if not (REFERENCE_WORDS.search(base.root) or base.root in REFERENCE_FRAMES):
        why = f"its root, {base.root}, does not show a position reference: it may be the wheels' dead reckoning"
        raise DefinitionError(table.topic, why)
    if not step.any():
        why = f"its {base.root} never moves against the odometry: that is dead reckoning"
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
    """Poses of the base in the root of the transforms: messages (n,) and places in them (n,), position, quaternion.

    `step` (n,) marks the poses after the root moved with respect to an odometry; all poses where the base is the root's
    own child.
    """

    root: LogText
    rows: Ints
    places: Ints
    place: Floats
    turn: Floats
    step: Bools

    def table_of(self, table: TopicTable, some: Bools) -> TopicTable:
        """Return some of the poses (n,) as messages of PoseStamped."""
        stamps = (table.column(path)[self.rows[some], self.places[some]] for path in TRANSFORM_STAMP)
        frame = np.zeros(np.count_nonzero(some), np.int64)
        values = [*stamps, frame, *self.place[some].T, *self.turn[some].T]
        columns = dict(zip((*STAMPS[0], FRAME_FIELD, *_POSE), values, strict=True))
        return replace(
            table, message_type=LogText("geometry_msgs/PoseStamped"), log_time_ns=table.log_time_ns[self.rows[some]],
            columns=columns, texts={FRAME_FIELD: [self.root]},
        )  # fmt: skip


def _base_in_root(table: TopicTable) -> _BasePoses:
    """Return the poses of the base, through every frame between it and the root.

    Raises
    ------
    DefinitionError
        No base frame moves.
    """
    links = _links(table)
    base = next((one for last in BASE_FRAMES for one in links if one.rsplit("/", 1)[-1] == last), None)
    if base is None:
        raise DefinitionError(table.topic, f"it moves none of the frames {', '.join(BASE_FRAMES)}")
    root, rows, places, place, turn = links.pop(base)
    step = np.zeros(len(rows), np.bool_)
    lowest = True
    while root in links:
        above = links.pop(root)
        held = np.searchsorted(above.rows, rows, side="right") - 1
        known = held >= 0
        rows, places, step, held = rows[known], places[known], step[known], held[known]
        changed = np.diff(above.place, axis=0).any(axis=1) | np.diff(above.turn, axis=0).any(axis=1)
        version = np.append(0, np.cumsum(changed))[held]
        step[1:] |= version[1:] != version[:-1]
        outer, place = above.turn[held], place[known]
        axes = (np.column_stack(turned_axis(axis, *outer.T)) for axis in range(3))
        place = above.place[held] + sum(along[:, None] * axis for along, axis in zip(place.T, axes, strict=True))
        turn = quaternion_product(outer, turn[known])
        root, lowest = above.parent, False
    return _BasePoses(root, rows, places, place, turn, step | lowest)


def _links(table: TopicTable) -> dict[str, _Link]:
    """Return the frames that a topic holds by name, without their leading slash."""
    parents, parent_names = table.words(TRANSFORM_FIELDS[0])
    children, child_names = table.words(TRANSFORM_FIELDS[1])
    numbers = np.stack([table.column(path) for path in TRANSFORM_FIELDS[2:]], axis=-1)
    length, size = (np.abs(part).max(axis=-1) for part in (numbers[..., :3], numbers[..., 3:]))
    sound = (length < LARGEST_TRANSLATION_M) & (size > 0.01) & (size < 100.0)  # a unit quaternion, or nearly
    all_rows, all_places = np.nonzero((children >= 0) & sound)
    order = np.argsort(children[all_rows, all_places], kind="stable")
    ends = np.cumsum(np.bincount(children[all_rows, all_places], minlength=len(child_names)))
    links: dict[str, _Link] = {}
    for name, of_child in zip(child_names, np.split(order, ends[:-1]), strict=True):
        if len(of_child):
            rows, places = all_rows[of_child], all_places[of_child]
            pose = numbers[rows, places]
            parent = LogText(parent_names[parents[rows[-1], places[-1]]].strip("/"))
            turn = pose[:, 3:] / np.linalg.norm(pose[:, 3:], axis=1)[:, None]
            links[name.strip("/")] = _Link(parent, rows, places, pose[:, :3], turn)
    return links
