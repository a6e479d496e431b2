"""Studies that take a second: the least of each that shows all its columns, numbers and panels."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

from icrtool.config import Config
from icrtool.simulation.studies import default_request, run_study
from icrtool.simulation.study_records import StudyRequest, StudyResult

SMALL: dict[str, dict[str, Any]] = {
    "convergence": {"duration_s": 10.0, "paths": ("circle", "spins")},
    "initial": {"duration_s": 5.0, "values": (1.0, -1.0)},
    "icr-change": {"duration_s": 20.0},
    "turn-radius": {"duration_s": 25.0, "values": (0.0, 2.0)},
    "input-noise": {"duration_s": 10.0, "values": (0.0, 0.1)},
    "input-bias": {"duration_s": 10.0, "values": (0.0, 0.1)},
    "speed": {"duration_s": 10.0, "values": (0.4, 1.6)},
    "input-source": {"duration_s": 10.0},
    "gnss": {"duration_s": 30.0, "values": (0.01, 0.3)},
    "rate": {"duration_s": 10.0, "values": (20.0, 100.0)},
    "consistency": {"duration_s": 15.0},
}


def small_request(name: str, runs: int, duration_s: float | None = None, **changes: Any) -> StudyRequest:
    """Return the usual request of a study, made smaller; the ICRs change twice within `duration_s`."""
    base = default_request(name, Config())
    plan = base.plan if duration_s is None else replace(base.plan, duration_s=duration_s)
    if name == "icr-change" and duration_s is not None:
        plan = replace(plan, changes=((duration_s / 2, (0.7, -0.6, 0.0)), (duration_s * 3 / 4, (0.5, -0.7, 0.1))))
    return replace(base, runs=runs, plan=plan, **changes)


@cache
def small_study(name: str) -> StudyResult:
    """Return the result of a study of two runs."""
    return run_study(small_request(name, 2, **SMALL[name]))
