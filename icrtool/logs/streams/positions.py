"""Messages that hold the robot's position: geodetic fixes, and poses that are metric already, in their own frame."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from icrtool.config import Config
from icrtool.errors import DefinitionError
from icrtool.kernels.arrays import Bools, Bytes, Floats
from icrtool.logs.messages.decoded_values import GGA, GST, RMC
from icrtool.logs.messages.topic_table import FRAME, TopicTable
from icrtool.logs.streams.sources import NEVER_MOVES, PositionSource, all_valid, fields_in, number, of_topic
from icrtool.records.samples import FIXED_FIX, FLOAT_FIX, NOT_STATED, OTHER_FIX, RTK_FIX

GBAS = 2
"""NavSatStatus: 2 is fixed or float, drivers differ. A log without any of these states nothing about the solution."""

GPSFIX_STATUS = {
    0: OTHER_FIX, 1: OTHER_FIX, GBAS: RTK_FIX, 18: OTHER_FIX, 19: FIXED_FIX, 20: FLOAT_FIX, 33: OTHER_FIX,
}  # fmt: skip
"""GPSStatus of gps_msgs: 18 DGPS, 19 and 20 RTK, 33 WAAS."""

UBLOX_CARRIER = {0: OTHER_FIX, 1: FLOAT_FIX, 2: FIXED_FIX}
"""carrSoln of u-blox."""

UBLOX_FLAGS = {carrier << 6: fix_class for carrier, fix_class in UBLOX_CARRIER.items()}
"""Bits 6 and 7 of NavPVT.flags: the same."""

NMEA_QUALITY = {1: OTHER_FIX, 2: OTHER_FIX, 3: OTHER_FIX, 4: FIXED_FIX, 5: FLOAT_FIX, 8: OTHER_FIX, 9: OTHER_FIX}
"""Quality of GGA: single, differential, PPS, RTK fixed and float, simulated, SBAS of NovAtel.

The others are no fixes: 0 none, 6 dead reckoning, 7 typed in.
"""

XBOT_FLAGS = {0: OTHER_FIX, 1: OTHER_FIX, 2: FIXED_FIX, 3: FIXED_FIX, 4: FLOAT_FIX, 5: FLOAT_FIX}
"""Low bits of the flags of xbot_msgs/AbsolutePose: 1 corrections, 2 RTK fixed, 4 RTK float."""

SEPTENTRIO_MODE = {1: OTHER_FIX, 2: OTHER_FIX, 4: FIXED_FIX, 5: FLOAT_FIX, 6: OTHER_FIX, 7: FIXED_FIX, 8: FLOAT_FIX}
"""Low bits of the mode: stand-alone, DGPS, RTK fixed and float, SBAS, moving-base fixed and float."""

NOVATEL_TYPES = {32: FLOAT_FIX, 33: FLOAT_FIX, 34: FLOAT_FIX, 48: FIXED_FIX, 49: FIXED_FIX, 50: FIXED_FIX,
                 51: FIXED_FIX, 55: FLOAT_FIX, 56: FIXED_FIX}  # fmt: skip
"""Position types of NovAtel, numbered as in novatel_oem7_msgs; all others have neither fixed nor float ambiguities."""


class Solution(NamedTuple):
    """A field that states how a position was solved: a number, or a word of NovAtel's (``NARROW_INT``).

    Attributes
    ----------
    codes, otherwise : the class by number, and that of all others
    mask : the bits of the number that count
    informative : the topic states no class unless some fix is one with carrier phase: drivers write 0 for every fix
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


NO_SOLUTION = Solution("", {})
COVARIANCE_TYPE = "position_covariance_type"


def stated_variance(table: TopicTable, covariance: tuple[str, ...], std: tuple[str, ...]) -> Floats:
    """Return north, east, covariance of both [m^2] (n, 3), NaN where not stated.

    Parameters
    ----------
    covariance : its fields, which have precedence; those of axes that are not both positive state nothing
    std : standard deviation to the north and to the east; one for both
    """
    variance = np.full((len(table), 3), np.nan)
    if std:
        north, east = number(std[0]).of(table), number(std[-1]).of(table)
        stated = (north > 0) & (east > 0)
        with np.errstate(over="ignore"):
            variance[stated] = np.column_stack([north**2, east**2, np.zeros(len(table))])[stated]
    if covariance:
        found = np.column_stack([table.floats(path) for path in covariance])
        # COVARIANCE_TYPE_UNKNOWN: drivers leave the numbers at 0, or write arbitrary ones.
        stated = (found[:, 0] > 0) & (found[:, 1] > 0) & (table.floats(COVARIANCE_TYPE) != 0)
        variance[stated] = found[stated]
    return variance


def _reject(table: TopicTable, reasons: Mapping[str, Bools]) -> tuple[Bools, dict[str, int]]:
    """Return the rows (n,) that no reason excludes, and how many each one excludes of those that are left."""
    usable, rejected = np.ones(len(table), np.bool_), dict[str, int]()
    for reason, bad in reasons.items():
        if count := int(np.count_nonzero(bad & usable)):
            rejected[reason] = count
        usable = usable & ~bad
    return usable, rejected


HIGHEST_M = 20_000.0
"""A height beyond this means "unknown"; it is replaced by the median of the others."""

FARTHEST_M = 200_000.0
"""No robot drives further from the middle of its fixes."""

STILL_M, METRES_PER_DEGREE = 0.5, 111_000.0
"""A receiver whose fixes stay within this is that of a base station, or of a robot that stands."""

GOOD_STD_M, NOT_GOOD = 0.3, 35.0
"""A fix with a smaller standard deviation is RTK or nearly so, and preferred as reference; taken off of others."""


@dataclass(frozen=True, slots=True)
class Fix:
    """A message type with geodetic positions.

    Attributes
    ----------
    what, worth : what it is called where it is chosen, and how suitable it is as reference
    latitude, longitude : to degrees; height : to m above the ellipsoid
    std : standard deviation [m] to the north and to the east; one for both. These are as `number` reads them
    covariance : the fields of the variances to the north and to the east and of their covariance, which have precedence
    valid : checks that all must pass for a fix
    solution : how it was solved
    """

    what: str
    worth: float
    latitude: str = "latitude"
    longitude: str = "longitude"
    height: str = "altitude"
    std: tuple[str, ...] = ()
    covariance: tuple[str, ...] = ()
    valid: tuple[str, ...] = ()
    solution: Solution = NO_SOLUTION

    @property
    def fields(self) -> tuple[str, ...]:
        """The fields that are read; an empty one is none."""
        numbers = fields_in((self.latitude, self.longitude, self.height, *self.std), self.valid)
        return (*numbers, *self.covariance, COVARIANCE_TYPE if self.covariance else "", self.solution.name)

    def read(self, table: TopicTable, _: Config) -> PositionSource:
        """Return its positions; rows without a fix, not finite, far from the others or at 0, 0 are not usable."""
        latitude, longitude = (number(one).of(table, needed=True) for one in (self.latitude, self.longitude))
        variance = stated_variance(table, self.covariance, self.std)
        no_fix, finite = ~all_valid(table, self.valid), np.isfinite(latitude) & np.isfinite(longitude)
        with np.errstate(invalid="ignore"):
            possible = (np.abs(latitude) <= 90.0) & (np.abs(longitude) <= 360.0)
        places = np.column_stack([latitude, longitude])
        usable, rejected = _reject(
            table,
            {
                "no fix": no_fix,
                "not finite": ~finite,
                "not a place on earth": ~possible,
                "at 0, 0": (latitude == 0) & (longitude == 0),
                "far from the others": _far_away(places, possible & ~no_fix & finite),
            },
        )
        height = number(self.height).of(table)
        plausible = np.abs(height) < HIGHEST_M
        known = height[plausible & usable]
        height = np.where(plausible, height, float(np.median(known)) if len(known) else 0.0)
        std = float("nan")
        if np.isfinite(variance[usable, :2]).any():
            std = float(np.sqrt(np.nanmedian(variance[usable, :2])))
        what, score = self.what, self.worth - (NOT_GOOD if std > GOOD_STD_M else 0.0)
        if _is_still(places[usable]):
            what, score = f"{what} that never moves", score - NEVER_MOVES
        counts = ", ".join(f"{reason} {count}" for reason, count in rejected.items())
        return PositionSource(
            **of_topic(table),
            geodetic=np.column_stack([latitude, longitude, height]),
            variance=variance, usable=usable, rejected=rejected, score=score,
            why=f"{what}, states ±{std:.2g} m" if np.isfinite(std) else f"{what}, states no accuracy",
            problem="" if usable.any() else f"no usable fix ({counts})",
            stated_class=self.solution.of(table),
        )  # fmt: skip


def _far_away(places_deg: Floats, known: Bools) -> Bools:
    """Return the known fixes (n,) of another place: a receiver that was switched on may send where it was last."""
    far, places_deg = np.zeros(len(known), np.bool_), places_deg[known]
    if len(places_deg):
        away_deg = places_deg - places_deg[0]
        away_deg[:, 1] = np.mod(away_deg[:, 1] + 180.0, 360.0) - 180.0  # not across the date line
        away_deg -= np.median(away_deg, axis=0)
        away_deg[:, 1] *= math.cos(math.radians(float(np.median(places_deg[:, 0]))))
        far[known] = (np.abs(away_deg) * METRES_PER_DEGREE > FARTHEST_M).any(axis=1)
    return far


def _is_still(places_deg: Floats) -> bool:
    """Return whether 95 % of the fixes (n, 2) lie within `STILL_M`, whatever the latitude."""
    if len(places_deg) < 2:
        return False
    ends = np.percentile(places_deg, [2.5, 97.5], axis=0)
    return bool((np.diff(ends, axis=0) * METRES_PER_DEGREE < STILL_M).all())


GST_NEAR_NS = 1_500_000_000
"""Receivers send GST with each fix, or once a second."""

SENTENCE_FIX = Fix(
    "GNSS fix", 84.0, std=("north_std", "east_std"), valid=(f"quality == {'|'.join(map(str, NMEA_QUALITY))}",),
    solution=Solution("quality", NMEA_QUALITY),
)  # fmt: skip


def read_sentences(table: TopicTable, config: Config) -> PositionSource:
    """Return the fixes of GGA, with the deviations of the nearest GST; of RMC where there is no GGA."""
    kinds = table.column("sentence_kind")
    kind, name = (GGA, "GGA") if (kinds == GGA).any() else (RMC, "RMC")
    fixes, deviations = table.rows(kinds == kind), table.rows(kinds == GST)
    if not len(fixes):
        raise DefinitionError(table.topic, "none of its sentences is GGA or RMC")
    if len(deviations):
        times_ns = deviations.log_time_ns
        nearest = np.searchsorted(times_ns[:-1] + np.diff(times_ns) // 2, fixes.log_time_ns)
        near = np.abs(times_ns[nearest] - fixes.log_time_ns) < GST_NEAR_NS
        stds = {one: np.where(near, deviations.column(one)[nearest], np.nan) for one in ("north_std", "east_std")}
        fixes = replace(fixes, columns=fixes.columns | stds)
    return replace(SENTENCE_FIX, what=f"{SENTENCE_FIX.what} ({name})").read(fixes, config)


REFERENCE_WORDS = re.compile(
    r"gps|gnss|(?<![a-z])fix|map|icp|lidar|laser|slam|loam|\blio\b|mocap|vicon|optitrack|qualisys|ground|truth|\bgt\b|total|station|"
    r"prism|leica|utm|global|navsat|\bins\b|vectornav|novatel|sbg|ublox",
    re.IGNORECASE,
)
"""In names of odometry and pose topics, or of their frames: a reference, not the robot's own dead reckoning."""

REFERENCE_FRAMES = {"world", "earth", "ecef", "local_enu", "enu", "camera_init"}
"""Names of frames that are no such words; FAST-LIO and LOAM call their map ``camera_init``."""

GOAL_WORDS = re.compile(r"goal|initial_?pose|cmd|command|desired|setpoint", re.IGNORECASE)
GOAL = "its name is that of a goal, not of a measurement"

LEAST_AREA_M, FLAT, LARGEST_PLACE_M, MOST_PLACES = 1.0, 0.1, 1e8, 2000
"""A drive this wide (standard deviation) shows its plane where it is no thicker than a tenth of that."""

LEAST_RADIUS_M, LARGEST_RADIUS_M = 6.33e6, 6.40e6
"""Of the earth; UTM coordinates far from the equator may be as large, but have a height near 0."""


@dataclass(frozen=True, slots=True)
class Pose:
    """A message type with metric positions: x is taken as east and y as north, in the topic's own frame.

    Attributes
    ----------
    what, worth, covariance, std, valid, solution : as of `Fix`
    path : the field of the pose
    odometry : its name or frame must show that it is a reference
    independent : where half of the messages or more do not pass, they are fused with the wheels
    """

    what: str
    worth: float
    path: str = "pose"
    covariance: tuple[str, ...] = ()
    std: tuple[str, ...] = ()
    valid: tuple[str, ...] = ()
    solution: Solution = NO_SOLUTION
    odometry: bool = False
    independent: tuple[str, ...] = ()

    @property
    def fields(self) -> tuple[str, ...]:
        """The fields that are read; an empty one is none."""
        places = (f"{self.path}.position.{axis}" for axis in "xyz")
        numbers = fields_in(self.std, (*self.valid, *self.independent))
        return (*places, *self.covariance, *numbers, self.solution.name)

    def read(self, table: TopicTable, _: Config) -> PositionSource:
        """Return its positions; those of goals, of dead reckoning and of frames whose z is not up are refused."""
        x, y = (table.column(f"{self.path}.position.{axis}").astype(np.float64) for axis in "xy")
        usable, rejected = _reject(
            table,
            {"not finite": ~(np.isfinite(x) & np.isfinite(y)), "no fix": ~all_valid(table, self.valid)},
        )
        places = np.column_stack([x, y, table.floats(f"{self.path}.position.z")])[usable]
        return PositionSource(
            **of_topic(table), metric=np.column_stack([y, x]),
            variance=stated_variance(table, self.covariance, self.std),
            usable=usable, rejected=rejected, score=self.worth, why=self.what, problem=self._problem(table, places),
            stated_class=self.solution.of(table),
        )  # fmt: skip

    def _problem(self, table: TopicTable, places: Floats) -> str:
        """Return why positions x, y, z (n, 3) are no reference, empty where they may be one."""
        frame = table.text(FRAME).lstrip("/")
        named = REFERENCE_WORDS.search(f"{table.topic} {frame}") or frame in REFERENCE_FRAMES
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
        elif not named and (self.odometry or "odom" in table.topic.lower()):
            problem = (
                "its name and frame do not show a position reference: it may be the wheels' dead reckoning; "
                "topics.gnss names it if it is a reference"
            )
        return problem


def is_fused(table: TopicTable, independent: tuple[str, ...]) -> bool:
    """Return whether half of the messages or more do not pass the checks of independent ones."""
    return 2 * int(np.count_nonzero(all_valid(table, independent))) <= len(table)


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
