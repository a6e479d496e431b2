"""Delays of heading and positions against the wheels: as estimated, and as corrected."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from icrtool.alignment.estimator import AlignmentFit
from icrtool.config import Config
from icrtool.records.tables import HeadingSamples, PositionFixes, RobotLog

SIGNIFICANT_SIGMAS = 2.5
SAME_CLOCK_SIGMAS = 2.0
"""Heading and position whose delays differ by less lag or lead together: it is the wheels' clock then."""

SMALLEST_LAG_S, SMALLEST_LEAD_S, LARGEST_STD_S = 0.1, 0.2, 0.06
"""A robot follows its wheels by up to 0.1 s, which is no clock; the standard deviation of a delay holds that. A
stream that leads by little is more often a response that the model lacks than a clock."""


class Delay(NamedTuple):
    """A delay against the wheels and its standard deviation [s], NaN where the drive does not show it."""

    value_s: float
    std_s: float

    @property
    def is_clear(self) -> bool:
        """Whether it is certain and large enough to be corrected."""
        certain = self.std_s < LARGEST_STD_S and abs(self.value_s) > SIGNIFICANT_SIGMAS * self.std_s
        return certain and (self.value_s > SMALLEST_LAG_S or self.value_s < -SMALLEST_LEAD_S)


UNKNOWN = Delay(math.nan, math.nan)


@dataclass(frozen=True, slots=True)
class StreamDelays:
    """What was found, and the log with what was clear, or configured, corrected.

    Attributes
    ----------
    heading, gnss : as measured; apart : of the position against the heading
    together : position and heading are fields of the same messages
    applied_heading_s, applied_gnss_s : corrected
    """

    log: RobotLog
    heading: Delay
    gnss: Delay
    apart: Delay
    together: bool
    applied_heading_s: float
    applied_gnss_s: float
    warnings: tuple[str, ...]

    def heading_summary(self) -> dict[str, Any]:
        """Return the heading's numbers for run.json."""
        known = math.isfinite(self.heading.value_s)
        return {
            "delay_s": self.heading.value_s if known else None,
            "delay_std_s": self.heading.std_s if known else None,
            "applied_delay_s": self.applied_heading_s,
        }

    def gnss_summary(self) -> dict[str, Any]:
        """Return the fixes' numbers for run.json; what was applied stands with the filter, as reference_delay_s."""
        known = math.isfinite(self.gnss.value_s)
        return {
            "delay_s": self.gnss.value_s if known else None,
            "delay_std_s": self.gnss.std_s if known else None,
        }


def find_delays(log: RobotLog, config: Config, fit: AlignmentFit | None) -> StreamDelays:
    """Return the delays of heading and positions against the wheels, with what is clear, or configured, corrected."""
    field = config.filter.preset == "field"
    found = {"heading": UNKNOWN, "position": UNKNOWN}
    apart = UNKNOWN
    if fit is not None:
        for what in found:
            value, std = fit.estimate(f"{what}_delay")
            found[what] = Delay(value, std) if std < 2 * LARGEST_STD_S else UNKNOWN
        apart = Delay(*fit.estimate("position_after_heading"))
    topics = {stream.role: stream.topic for stream in log.streams}
    together = "gnss" in topics and topics["gnss"] == topics.get("heading")
    given = {"heading": config.frames.heading_delay_s, "position": config.frames.reference_delay_s}
    applied, notes = {}, []
    for what, key in (("heading", "frames.heading_delay_s"), ("position", "frames.reference_delay_s")):
        setting, delay = given[what], found[what]
        applied[what] = 0.0
        if field and setting != "auto":
            applied[what] = setting
        elif field and what == "position" and applied["heading"] and _on_one_clock(fit, delay):
            applied[what] = applied["heading"]
            notes.append(f"{log.name}: the position is corrected alike: nothing shows that its delay differs")
        elif field and delay.is_clear and (what == "heading" or together or applied["heading"] or _differs(apart)):
            applied[what] = delay.value_s
            lags = ("lag" if together else "lags") if delay.value_s > 0 else ("lead" if together else "leads")
            subject = "the position and its heading" if together else f"the {what}"
            if not (together and what == "heading"):
                notes.append(
                    f"{log.name}: {subject} {lags} the wheels by {abs(delay.value_s):.2f} ± {delay.std_s:.2f} s: "
                    f"corrected; {key} sets it"
                )
    if together:
        applied["heading"] = 0.0
    shifted = delayed(log, applied["position"])
    if applied["heading"] and not together:
        shift = round(applied["heading"] * 1e9)
        moved: HeadingSamples = replace(shifted.heading, stamp_ns=shifted.heading.stamp_ns - shift)
        shifted = replace(shifted, heading=moved)
    return StreamDelays(
        shifted, found["heading"], found["position"], apart, together,
        applied["heading"], applied["position"], tuple(notes),
    )  # fmt: skip


def _differs(apart: Delay) -> bool:
    """Return whether the position has a delay of its own: the heading, which has none, shares a robot's response."""
    return abs(apart.value_s) > SIGNIFICANT_SIGMAS * apart.std_s


def delayed(log: RobotLog, delay_s: float) -> RobotLog:
    """Return the log with the position reference taken `delay_s` earlier.

    The heading goes with it where both come from the same messages.
    """
    if delay_s == 0.0:
        return log
    shift = round(delay_s * 1e9)
    gnss: PositionFixes = replace(log.gnss, stamp_ns=log.gnss.stamp_ns - shift)
    topics = {stream.role: stream.topic for stream in log.streams}
    heading: HeadingSamples = log.heading
    if topics.get("gnss") == topics.get("heading", ""):
        heading = replace(heading, stamp_ns=heading.stamp_ns - shift)
    return replace(log, gnss=gnss, heading=heading)


def _on_one_clock(fit: AlignmentFit | None, position: Delay) -> bool:
    """Return whether a delay of the heading is one of the wheels: the position shows none of its own."""
    if fit is None or position.is_clear:
        return False
    apart, std = fit.estimate("position_after_heading")
    return abs(apart) < SAME_CLOCK_SIGMAS * std
