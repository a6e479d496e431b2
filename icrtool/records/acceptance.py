"""Answers of a dropout report: distances with errors within a budget, and verdicts on acceptance limits."""

from __future__ import annotations

import math

from msgspec import UNSET, UnsetType

from icrtool.records.plain_data import Record

DEFAULT_SEED = 20140311
"""Seed of random draws. Its value is arbitrary; it is the same for every run and every model."""

OTHER_GROUND_LAST_M = 20.0
"""Longest distance of the errors on other grounds [m]."""

CHOICE_HORIZON_M = 10.0
"""Distance of the errors in headlines, tables of calibrations and lists of the worst trials [m]."""


METRICS = {
    "expected": "expected_error_m", "p50": "p50_m", "p95": "p95_m", "max": "max_m", "p95_next": "p95_next_high_m",
}  # fmt: skip
"""Names of errors in files, by their names in acceptance limits. ``p95_next`` is the upper end of the interval of the
next drive."""

DISTANCES = {"within": "p95_m", "within_next": "p95_next_high_m"}
"""Names of errors in files, by the names of distances in acceptance limits. Such a distance is the longest one over
which the error stays within a budget."""


NEAR_HORIZONS_M = 1.5
"""Largest distance between horizons at which an interpolated distance is stated without ``about`` [m]."""


class BudgetDistance(Record, frozen=True):
    """Distance [m] over which the 95th percentile of a model's errors stays within a budget [m].

    Attributes
    ----------
    distance_m : interpolated between horizons; the error is 0 m at a distance of 0 m
    beyond : `distance_m` is a lower bound: the error is within the budget at the last horizon with trials
    between_m : the two horizons between which `distance_m` was interpolated
    without_events_m, beyond_without_events : `distance_m` and `beyond` of the trials that touch no slip event; None and
        False where the drive has no slip event
    low_m, high_m : distances at which the upper and the lower end of the interval of p95 leave the budget; None where
        they stay within it, and where there is no interval
    next_low_m, next_high_m : these distances for the next drive of this robot on this kind of ground, in 9 of 10 cases
    other_low_m, other_high_m : these distances on a ground that the calibration was not fitted to, in 9 of 10 cases;
        missing where its grounds were not given
    """

    model: str
    budget_m: float
    distance_m: float
    beyond: bool
    between_m: tuple[float, float]
    low_m: float | None = None
    high_m: float | None = None
    next_low_m: float | None = None
    next_high_m: float | None = None
    without_events_m: float | None = None
    beyond_without_events: bool = False
    other_low_m: float | UnsetType | None = UNSET
    other_high_m: float | UnsetType | None = UNSET

    @property
    def other_text(self) -> str:
        """Distance range of the next drive on another ground, formatted as `next_text`; empty where it is not known."""
        if self.other_low_m is UNSET or self.other_high_m is UNSET:
            return ""
        if self.other_low_m is None:
            return f"more than {OTHER_GROUND_LAST_M:g} m"
        low = f"{self.other_low_m:.1f}"
        return f"{low} m or more" if self.other_high_m is None else f"{low}-{self.other_high_m:.1f} m"

    @property
    def short_text(self) -> str:
        """Distance as ``14.1 m`` or ``more than 20 m``; between far horizons ``about 14 m`` or ``less than 1 m``."""
        if self.beyond:
            return f"more than {self.distance_m:g} m"
        low, high = self.between_m
        if high - low <= NEAR_HORIZONS_M:
            return f"{self.distance_m:.1f} m"
        # The error grows faster than the distance: linear interpolation between far horizons gives too long a distance.
        return f"about {self.distance_m:.0f} m" if self.distance_m >= 1.0 else "less than 1 m"

    @property
    def without_events_text(self) -> str:
        """Distance of the trials that touch no slip event, as ``14.1 m``; empty where the drive has no slip event."""
        if self.without_events_m is None:
            return ""
        return (
            f"more than {self.without_events_m:g} m" if self.beyond_without_events else f"{self.without_events_m:.1f} m"
        )

    @property
    def to_plan_with_m(self) -> float | None:
        """Distance [m] over which 9 of 10 next drives stay within the budget; None where it is not known."""
        if self.next_low_m is None:
            return self.distance_m if self.beyond else None
        return self.next_low_m

    @property
    def next_text(self) -> str:
        """Distance range of the next drive as ``5.1-18 m`` or ``5.1 m or more``; empty where it is not known."""
        if self.next_low_m is None:
            # Even the upper end stays within the budget at the last horizon.
            return f"more than {self.distance_m:g} m" if self.beyond else ""
        low = f"{self.next_low_m:.1f}"
        return f"{low} m or more" if self.next_high_m is None else f"{low}-{self.next_high_m:.1f} m"


class Gate(Record, frozen=True):
    """One acceptance limit: ``icr.p95@10m <= 3.8``, ``icr.p95@10m <= 1.1 * baseline + 0.1 m``, or on a distance.

    Attributes
    ----------
    horizon_m : distance at which an error is bounded [m]; None for a limit on a distance
    budget_m : largest error of a limit on a distance [m]: 0.5 in ``recommended.within@0.5m >= 10``; else None
    bound_m : the constant part of the bound [m], without the part that depends on the baseline
    baseline_factor : factor on the baseline's number; 0 where the limit does not name the baseline
    """

    text: str
    model: str
    metric: str
    horizon_m: float | None
    relation: str
    bound_m: float
    baseline_factor: float = 0.0
    budget_m: float | None = None

    @property
    def relative(self) -> bool:
        """Whether the limit names the baseline."""
        return bool(self.baseline_factor)


class Verdict(Gate, frozen=True, kw_only=True):
    """Whether a log meets an acceptance limit; a number is None where it is not known.

    Attributes
    ----------
    value_m : the log's number [m]; None where the log has no trial of that length
    baseline_m : the baseline's number [m]
    margin_m : distance of the number from the bound [m]; negative where the number violates the bound
    margin_low_m, margin_high_m : 95 % confidence interval of the margin [m], for a limit relative to the baseline
    passed : the limit is met; a limit relative to the baseline is also met where the interval of the difference reaches
        the bound
    value_bound_m : the bound [m], with the part that depends on the baseline
    not_checked : why the limit was not checked; None where it was
    unusable : why the run must not be used; every limit then fails. None for a usable run
    verdict : the printed line about the limit
    """

    value_m: float | None
    baseline_m: float | None = None
    margin_m: float | None = None
    margin_low_m: float | None = None
    margin_high_m: float | None = None
    passed: bool
    value_bound_m: float | None = None
    not_checked: str | None = None
    unusable: str | None = None
    verdict: str

    def line(self, log: str) -> str:
        """Return one line with the verdict, the numbers and the name of the log."""
        word = "pass" if self.passed else "FAIL"
        log = f" (log {log})" if log else ""
        if self.not_checked:
            return f"none  {self.text}: not checked: {self.not_checked}{log}"
        if self.unusable:
            return f"{word}  {self.text}: do not use this run: {self.unusable}{log}"
        if self.value_m is None:
            length = f" of {self.horizon_m:g} m" if self.horizon_m is not None else ""
            return f"{word}  {self.text}: no trial{length} in this log{log}"
        numbers = (self.margin_m, self.value_bound_m, self.baseline_m)
        margin_m, bound_m, baseline_m = (math.nan if number is None else number for number in numbers)
        bound = f"margin {margin_m:+.3g} m"
        if self.relative:
            interval = ", no interval"
            if self.margin_low_m is not None:
                interval = f" (95 %: {self.margin_low_m:+.3g} to {self.margin_high_m:+.3g} m)"
            bound = f"bound {bound_m:.3g} m (baseline {baseline_m:.3g} m), {bound}{interval}"
        return f"{word}  {self.text}: {self.value_m:.3g} m, {bound}{log}"
