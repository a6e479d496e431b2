"""Budgets and acceptance limits: how far an error stays within a bound, and bounds on the dropout numbers for CI."""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable

import numpy as np
from msgspec.structs import astuple, replace

from icrtool.dropout_analysis.report import BaselineReport, OpenLoopErrors
from icrtool.errors import ConfigError
from icrtool.kernels.error_statistics import BlockSums, difference_half_width, within_budget
from icrtool.motion.models import FAMILY
from icrtool.records.dropout import METRICS, BudgetDistance, Gate, Verdict
from icrtool.records.dropout_document import ModelResult, column_of
from icrtool.records.plain_data import plain

_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_FORM = re.compile(
    r"^\s*(?P<model>\w+(?::\S(?:.*\S)?)?)\.(?P<metric>p50|p95|expected|max|within)@(?P<at>\d+(?:\.\d+)?)\s*m?\s*"
    rf"(?P<relation><=|>=|<|>)\s*(?:(?P<bound>[+-]?{_NUMBER})\s*m?|"
    rf"(?:(?P<factor>{_NUMBER})\s*\*\s*)?(?P<baseline>baseline)(?:\s*(?P<offset>[+-]\s*{_NUMBER})\s*m?)?)\s*$"
)
_RELATIONS: dict[str, Callable[[float, float], bool]] = {
    "<=": operator.le, ">=": operator.ge, "<": operator.lt, ">": operator.gt,
}  # fmt: skip


FORMER_ROWS = {"multiplier", "window", "extended", *FAMILY} - {"no_slip", "controller", "recommended", "icr"}
"""Rows that reports of earlier versions had."""


def budget_distances(report: OpenLoopErrors, budget_m: float) -> tuple[BudgetDistance, ...]:
    """Return how far the 95th percentile of each model stays within a budget [m]; models without trials are left out.

    Raises
    ------
    ConfigError
        The budget is no length.
    """
    if not (math.isfinite(budget_m) and budget_m > 0):
        raise ConfigError("budget", f"{budget_m:g} m is no length", "give positive metres")
    found = []
    for result in report.results:
        reached = within_budget(report.horizons_m, result.column("p95_m"), budget_m)
        if reached is not None:
            ends = (
                within_budget(report.horizons_m, result.column(name), budget_m) for name in ("p95_high_m", "p95_low_m")
            )
            # An end that stays within the budget as far as there are intervals has no such distance.
            low, high = (None if end is None or end[1] else end[0] for end in ends)
            quiet = column_of(result.without_events, "p95_m")
            free = within_budget(report.horizons_m, quiet, budget_m) if len(quiet) else None
            without = (None, False) if free is None else free[:2]
            found.append(BudgetDistance(result.name, result.label, budget_m, *reached, low, high, *without))
    return tuple(found)


def parse_gate(text: str) -> Gate:
    """Read a gate.

    Raises
    ------
    ConfigError
        The text is neither of the form ``model.metric@HORIZONm <= bound`` nor ``… <= FACTOR * baseline + OFFSET m``.
    """
    match = _FORM.match(text)
    if match is None:
        form = "model.p50|p95|expected|max@HORIZONm <= metres, model.within@ERRORm >= metres, or [FACTOR *] baseline"
        example = 'for example "recommended.p95@10m <= 1.2" or "recommended.within@0.5m >= 10"'
        raise ConfigError(f"gate {text!r}", f"not of the form {form}", example)
    at_m, within = float(match["at"]), match["metric"] == "within"
    if not at_m > 0:
        raise ConfigError(f"gate {text!r}", "0 m is no length", "name one above zero, for example @10m")
    factor = float(match["factor"] or 1.0) if match["baseline"] else 0.0
    bound_m = float((match["bound"] or match["offset"] or "0").replace(" ", ""))
    return Gate(
        " ".join(text.split()), match["model"], match["metric"], None if within else at_m, match["relation"], bound_m,
        factor, at_m if within else None,
    )  # fmt: skip


def check_gate(
    gate: Gate, report: OpenLoopErrors, baseline: BaselineReport | None = None, *, strict: bool = False
) -> Verdict:
    """Compare a report with an acceptance limit.

    Parameters
    ----------
    baseline : what a limit relative to the baseline is compared with; without one such a limit is not checked
    strict : a relative limit is missed by the number alone, not only beyond the interval of the difference

    Raises
    ------
    ConfigError
        A model or horizon that the report, or the baseline, does not have.
    """
    result = _result(gate, report)
    if gate.budget_m is not None:
        reached = within_budget(report.horizons_m, result.column("p95_m"), gate.budget_m)
        value, sums = (math.nan if reached is None else reached[0]), None
    else:
        h = _place(gate, report)
        value, sums = float(result.column(METRICS[gate.metric])[h]), result.block_sums[h]
    if gate.baseline_factor and baseline is None:
        why = "this log is not in the baseline"
        return verdict_on(gate, report.run.log, value_m=value, passed=True, not_checked=why)
    half_width, before = math.nan, math.nan
    if gate.baseline_factor and baseline is not None:
        before, old = _before(gate, baseline)
        half_width = difference_half_width(
            sums, old, gate.metric, gate.baseline_factor, paired=baseline.is_of(report.run)
        )
    bound = gate.bound_m + (gate.baseline_factor * before if gate.baseline_factor else 0.0)
    margin = bound - value if gate.relation.startswith("<") else value - bound
    passed = _RELATIONS[gate.relation](value, bound)
    if not strict and not passed and margin + half_width >= 0.0:
        passed = True
    return verdict_on(
        gate, report.run.log, passed=passed, value_m=value, value_bound_m=bound, baseline_m=before, margin_m=margin,
        margin_low_m=margin - half_width, margin_high_m=margin + half_width,
    )  # fmt: skip


def verdict_on(gate: Gate, log: str, *, passed: bool, **found: float | str | None) -> Verdict:
    """Return a limit that was checked, with the line about it, which names the log.

    Parameters
    ----------
    found : further fields of `Verdict`; a number that is not finite is not known
    """
    fields = {"value_m": None} | {name: plain(value) for name, value in found.items()}
    checked = Verdict(*astuple(gate), passed=passed, verdict="", **fields)
    return replace(checked, verdict=checked.line(log))


def _place(gate: Gate, report: OpenLoopErrors) -> int:
    """Return the place of a gate's horizon among those of the report."""
    places = np.flatnonzero(np.isclose(report.horizons_m, gate.horizon_m or math.nan))
    if not len(places):
        found = ", ".join(f"{horizon:g}" for horizon in report.horizons_m)
        raise ConfigError(f"gate {gate.text!r}", f"no horizon of {gate.horizon_m:g} m", f"use {found}")
    return int(places[0])


def _before(gate: Gate, baseline: BaselineReport) -> tuple[float, BlockSums | None]:
    """Return the baseline's number, and its block sums."""
    if gate.budget_m is None:
        row, sums = baseline.row(gate)
        return float(column_of([row], METRICS[gate.metric])[0]), sums
    horizons_m, p95_m = baseline.p95_of(gate)
    reached = within_budget(horizons_m, p95_m, gate.budget_m)
    return (math.nan if reached is None else reached[0]), None


def _result(gate: Gate, report: OpenLoopErrors) -> ModelResult:
    """Return the result of the model that a gate names."""
    result = report.result(gate.model)
    if result is not None:
        return result
    if gate.model.removesuffix("_gyro") in FORMER_ROWS:
        raise ConfigError(f"gate {gate.text!r}", "no such row", "use recommended")
    found = ", ".join(one.name for one in report.results)
    advice = f"this run has {found}; no_slip needs robot.track_width_m"
    raise ConfigError(f"gate {gate.text!r}", f"no model {gate.model}", advice)
