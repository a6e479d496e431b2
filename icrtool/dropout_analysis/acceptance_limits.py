"""Budgets and acceptance limits: how far an error stays within a bound, and bounds on the dropout numbers for CI."""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable

import numpy as np

from icrtool.dropout_analysis.report import DropoutReport
from icrtool.errors import ConfigError
from icrtool.kernels.trials import Summary
from icrtool.records.dropout import BudgetDistance, Gate, Verdict
from icrtool.records.tables import Floats

_FORM = re.compile(
    r"^\s*(?P<model>\w+(?::\S(?:.*\S)?)?)\.(?P<metric>p50|p95|expected|max)@(?P<horizon>\d+(?:\.\d+)?)\s*m?\s*"
    r"(?P<relation><=|>=|<|>)\s*(?P<bound>[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*m?\s*$"
)
_RELATIONS: dict[str, Callable[[float, float], bool]] = {
    "<=": operator.le, ">=": operator.ge, "<": operator.lt, ">": operator.gt,
}  # fmt: skip


def budget_distances(report: DropoutReport, budget_m: float) -> tuple[BudgetDistance, ...]:
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
        reached = _budget_distance(report.horizons_m, result.summary.p95, budget_m)
        if reached is not None:
            ends = (
                _budget_distance(report.horizons_m, p95, budget_m)
                for p95 in (result.intervals.p95_high, result.intervals.p95_low)
            )
            low, high = (end[0] if end is not None else math.nan for end in ends)
            found.append(BudgetDistance(result.name, result.label, budget_m, *reached, low, high))
    return tuple(found)


def parse_gate(text: str) -> Gate:
    """Read a gate.

    Raises
    ------
    ConfigError
        The text is not of the form ``model.metric@HORIZONm <= bound``.
    """
    match = _FORM.match(text)
    if match is None:
        form = "model.p50|p95|expected|max@HORIZONm <= metres"
        raise ConfigError(f"gate {text!r}", f"not of the form {form}", 'for example "icr.p95@10m <= 3.8"')
    horizon_m, bound_m = float(match["horizon"]), float(match["bound"])
    if not horizon_m > 0:
        raise ConfigError(f"gate {text!r}", "a horizon of 0 m is no drive", "name a distance, for example @10m")
    return Gate(" ".join(text.split()), match["model"], match["metric"], horizon_m, match["relation"], bound_m)


def check_gate(gate: Gate, report: DropoutReport) -> Verdict:
    """Compare a report with an acceptance limit.

    Raises
    ------
    ConfigError
        A model or horizon that the report does not have.
    """
    result = report.result(gate.model)
    if result is None:
        table = report.comparison
        compared = table.summaries if table is not None else {}
        if table is not None and gate.model in compared:
            return _verdict(gate, compared[gate.model], np.array(table.horizons_m), report.name)
        known = ", ".join(dict.fromkeys([*(one.name for one in report.results), *compared]))
        advice = f"this run has {known}; no_slip needs robot.track_width_m"
        raise ConfigError(f"gate {gate.text!r}", f"no model {gate.model}", advice)
    return _verdict(gate, result.summary, report.horizons_m, report.name)


def _verdict(gate: Gate, summary: Summary, horizons_m: Floats, log: str) -> Verdict:
    places = np.flatnonzero(np.isclose(horizons_m, gate.horizon_m))
    if not len(places):
        known = ", ".join(f"{horizon:g}" for horizon in horizons_m)
        raise ConfigError(f"gate {gate.text!r}", f"no horizon of {gate.horizon_m:g} m for {gate.model}", f"use {known}")
    column = {"p50": "p50", "p95": "p95", "expected": "expected", "max": "largest"}[gate.metric]
    value = float(getattr(summary, column)[places[0]])
    margin = gate.bound_m - value if gate.relation.startswith("<") else value - gate.bound_m
    return Verdict(gate, value, margin, _RELATIONS[gate.relation](value, gate.bound_m), log)


def _budget_distance(
    horizons_m: Floats, p95_m: Floats, budget_m: float
) -> tuple[float, bool, tuple[float, float]] | None:
    known = np.isfinite(p95_m)
    if not known.any():
        return None
    distance, p95 = np.concatenate([[0.0], horizons_m[known]]), np.concatenate([[0.0], p95_m[known]])
    over = np.flatnonzero(p95 > budget_m)
    if not len(over):
        return float(distance[-1]), True, (float(distance[-1]), float(distance[-1]))
    i = int(over[0])
    share = (budget_m - p95[i - 1]) / (p95[i] - p95[i - 1])
    low, high = float(distance[i - 1]), float(distance[i])
    return low + float(share) * (high - low), False, (low, high)
