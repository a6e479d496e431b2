"""Delays of heading and positions against the wheels: as estimated, and as corrected."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

from icrtool.records.tables import RobotLog

SIGNIFICANT_SIGMAS = 2.5
SMALLEST_LAG_S, SMALLEST_LEAD_S, LARGEST_STD_S = 0.1, 0.2, 0.06
"""A robot answers its wheels late by up to 0.1 s, which is no clock; the standard deviation of a delay holds that. A
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
    heading, gnss : as measured
    applied_heading_s, applied_gnss_s : corrected
    """

    log: RobotLog
    heading: Delay
    gnss: Delay
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
