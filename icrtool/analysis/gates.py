"""Gates: bounds on the dropout numbers, for CI."""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from icrtool.analysis.dropout import DropoutReport
from icrtool.errors import ConfigError

_FORM = re.compile(
    r"^\s*(?P<model>\w+)\.(?P<metric>p50|p95|expected|max)@(?P<horizon>\d+(?:\.\d+)?)\s*m?\s*"
    r"(?P<relation><=|>=|<|>)\s*(?P<bound>[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*m?\s*$"
)
_RELATIONS: dict[str, Callable[[float, float], bool]] = {
    "<=": operator.le, ">=": operator.ge, "<": operator.lt, ">": operator.gt,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Gate:
    """One bound: ``icr.p95@10m <= 3.8``."""

    text: str
    model: str
    metric: str
    horizon_m: float
    relation: str
    bound_m: float


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a gate found: `value_m` is NaN where the log has no trial of that length; `margin_m` > 0 when it passed."""

    gate: Gate
    value_m: float
    margin_m: float
    passed: bool

    def line(self) -> str:
        """Return the verdict in one line."""
        word = "pass" if self.passed else "FAIL"
        if math.isnan(self.value_m):
            return f"{word}  {self.gate.text}: no trial of {self.gate.horizon_m:g} m in this log"
        return f"{word}  {self.gate.text}: {self.value_m:.3f} m, margin {self.margin_m:+.3f} m"


def parse_gate(text: str) -> Gate:
    """Read a gate.

    Raises
    ------
    ConfigError
        The text is not of the form ``model.metric@HORIZONm <= bound``.
    """
    match = _FORM.match(text)
    if match is None:
        raise ConfigError(f"gate {text!r}", "not of the form model.p50|p95|expected|max@HORIZONm <= metres", 'for example "icr.p95@10m <= 3.8"')
    return Gate(
        " ".join(text.split()), match["model"], match["metric"], float(match["horizon"]), match["relation"], float(match["bound"])
    )


def judge_gate(gate: Gate, report: DropoutReport) -> Verdict:
    """Hold a gate against a report.

    Raises
    ------
    ConfigError
        A model or horizon that the report does not have.
    """
    result = report.result(gate.model)
    if result is None:
        known = ", ".join(one.name for one in report.results)
        raise ConfigError(f"gate {gate.text!r}", f"no model {gate.model}", f"this run has {known}; no_slip needs robot.track_width_m")
    places = np.flatnonzero(np.isclose(report.horizons_m, gate.horizon_m))
    if not len(places):
        raise ConfigError(f"gate {gate.text!r}", f"no horizon of {gate.horizon_m:g} m", "add it to dropout.horizons_m")
    column = {"p50": "p50", "p95": "p95", "expected": "expected", "max": "largest"}[gate.metric]
    value = float(getattr(result.summary, column)[places[0]])
    margin = gate.bound_m - value if gate.relation.startswith("<") else value - gate.bound_m
    return Verdict(gate, value, margin, _RELATIONS[gate.relation](value, gate.bound_m))
