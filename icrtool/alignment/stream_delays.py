"""Delays of heading and positions against the wheels: as estimated, and as corrected."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from icrtool.alignment.estimator import PRIOR_STD, TP, AlignmentFit
from icrtool.config import Config
from icrtool.records.tables import RobotLog

SIGNIFICANT_SIGMAS = 2.5
SMALLEST_LAG_S, SMALLEST_LEAD_S, LARGEST_STD_S = 0.1, 0.2, 0.1
"""A robot follows its wheels by up to 0.1 s, which is no clock; the standard deviation of a delay holds that. A
stream that leads by little is more often a response that the model lacks than a clock."""


class Delay(NamedTuple):
    """A delay against the wheels and its standard deviation [s], NaN where the drive does not show it."""

    value_s: float
    std_s: float

    @property
    def is_significant(self) -> bool:
        """Whether it is known well, and is not zero."""
        return self.std_s < LARGEST_STD_S and abs(self.value_s) > SIGNIFICANT_SIGMAS * self.std_s

    @property
    def is_clear(self) -> bool:
        """Whether it is certain and more than a robot's response to its wheels."""
        return self.is_significant and _is_large(self.value_s)


UNKNOWN = Delay(math.nan, math.nan)


@dataclass(frozen=True, slots=True)
class StreamDelays:
    """What was found, and what is corrected: what was clear, or is configured.

    Attributes
    ----------
    heading, gnss : as measured; apart : of the position against the heading
    together : position and heading are fields of the same messages
    applied_heading_s, applied_gnss_s : corrected
    """

    heading: Delay
    gnss: Delay
    apart: Delay
    together: bool
    applied_heading_s: float
    applied_gnss_s: float
    warnings: tuple[str, ...]

    @property
    def clock_std_s(self) -> float:
        """What remains unknown of the time between position and heading, where nothing or some of it was corrected [s].

        Clocks agree as often as not. Where they were taken to agree, the deviation is that of the other case, times its
        probability (Bayes factor of Dickey 1971: densities at zero after and before the drive).
        """
        value, std = self.apart
        if self.together or not math.isfinite(std):
            return 0.0
        if self.applied_gnss_s != self.applied_heading_s:
            return std
        agree = PRIOR_STD[TP] / std * math.exp(-0.5 * (value / std) ** 2)
        return math.sqrt((std**2 + value**2) / (1.0 + agree))

    def apply(self, log: RobotLog) -> RobotLog:
        """Return the log with heading and position reference taken earlier; the same log where nothing is applied."""
        heading_s = self.applied_gnss_s if self.together else self.applied_heading_s
        moved: dict[str, Any] = {
            name: replace(stream, stamp_ns=stream.stamp_ns - round(delay_s * 1e9))
            for name, stream, delay_s in (("gnss", log.gnss, self.applied_gnss_s), ("heading", log.heading, heading_s))
            if delay_s != 0.0
        }
        return replace(log, **moved) if moved else log


def find_delays(log: RobotLog, config: Config, fit: AlignmentFit | None) -> StreamDelays:
    """Return the delays of heading and positions against the wheels, and which of them are corrected."""
    field = config.filter.preset == "field"
    found = {"heading": UNKNOWN, "position": UNKNOWN}
    apart = UNKNOWN
    if fit is not None:
        for what in found:
            value, std = fit.estimate(f"{what}_delay")
            found[what] = Delay(value, std) if std < 2 * LARGEST_STD_S else UNKNOWN
        apart = Delay(*fit.estimate("position_after_heading"))
    together = log.heading_is_of_position
    given = {"heading": config.frames.heading_delay_s, "position": config.frames.reference_delay_s}
    applied, notes = {"heading": 0.0, "position": 0.0}, []
    if field and fit is not None and not fit.slips:
        applied = _clear_delays(found["heading"], found["position"], apart, together=together)
        notes = _delay_notes(log.name, applied, {**found, "apart": apart}, given, together=together)
    for what, setting in given.items():
        if field and setting != "auto":
            applied[what] = setting
    if together:
        applied["heading"] = 0.0
    return StreamDelays(
        found["heading"], found["position"], apart, together, applied["heading"], applied["position"], tuple(notes)
    )


def _clear_delays(heading: Delay, position: Delay, apart: Delay, *, together: bool) -> dict[str, float]:
    """Return the delays to correct: of the ways in which streams lag, the likeliest.

    Twice the negative log-likelihood, with a penalty for each delay that is not zero (`SIGNIFICANT_SIGMAS` squared).
    """
    if together:
        common = position.value_s if position.is_clear else 0.0
        return {"heading": common, "position": common}
    if not heading.std_s < LARGEST_STD_S:
        return {"heading": 0.0, "position": 0.0}
    lag, after = heading.value_s, apart.value_s
    # as stamped; both alike; the heading alone; the position alone; each by itself
    free = {(0.0, 0.0): 0, (lag, lag): 1, (lag, 0.0): 1, (0.0, after): 1, (lag, lag + after): 2}

    def cost(delays: tuple[float, float]) -> float:
        misfits = (lag - delays[0]) / heading.std_s, (after - delays[1] + delays[0]) / apart.std_s
        return misfits[0] ** 2 + misfits[1] ** 2 + SIGNIFICANT_SIGMAS**2 * free[delays]

    chosen = min((one for one in free if all(value == 0.0 or _is_large(value) for value in one)), key=cost)
    return dict(zip(("heading", "position"), chosen, strict=True))


def _is_large(delay_s: float) -> bool:
    """Return whether a delay is more than a robot's response to its wheels."""
    return delay_s > SMALLEST_LAG_S or delay_s < -SMALLEST_LEAD_S


def _delay_notes(
    name: str, applied: dict[str, float], found: dict[str, Delay], given: Mapping[str, float | str], *, together: bool
) -> list[str]:
    """Return a line for each stream that was moved."""
    notes = []
    keys = {"heading": "frames.heading_delay_s", "position": "frames.reference_delay_s"}
    alike = not together and applied["heading"] == applied["position"] and given["heading"] == "auto"
    also = "; the position is corrected alike, as nothing shows that its delay differs" if alike else ""
    for what, key in keys.items():
        value = applied[what]
        if value == 0.0 or given[what] != "auto" or (together and what == "heading") or (alike and what == "position"):
            continue
        subject, lags = ("the position and its heading", "lag") if together else (f"the {what}", "lags")
        std = (found[what] if found[what].is_significant else found["apart"]).std_s
        fact = f"{subject} {lags} the wheels" if value > 0 else f"the wheels lag {subject}"
        notes.append(f"{name}: {fact} by {abs(value):.2f} ± {std:.2f} s: corrected; {key} sets it{also}")
    return notes
