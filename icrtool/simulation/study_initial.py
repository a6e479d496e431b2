"""Which initial ICRs converge, without the sign guard and with it (Pentzer 2014, Section 5.1, Figs. 6, 7)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from icrtool.kernels.arrays import Floats
from icrtool.kernels.filter_records import GUARDED, PRINTED, UNGUARDED
from icrtool.simulation.studies import StudyNumber, StudyRequest, StudyResult, table_of
from icrtool.simulation.study_measures import ICR_NAMES, inverted, trace
from icrtool.simulation.study_runs import Progress, StudyRun, run_scenarios, with_start
from icrtool.simulation.study_sweeps import base_scenario

GUARDS = {"no guard": UNGUARDED, "guard, printed derivatives": PRINTED, "guard": GUARDED}
"""Eqs. 8-10; Eqs. 32-34 with Eqs. 28-29 as printed; Eqs. 32-34 with their true derivatives, as icrtool uses them."""

CONVERGED_M = 0.1
"""A run has converged where all three ICRs, averaged over its last tenth, are within this distance of the truth [m]."""

LAST_SHARE = 10


def study_initial(request: StudyRequest, progress: Progress | None) -> StudyResult:
    """Return from which points of a grid of initial y ICRs the filter converges, for every guard."""
    preset = request.presets[0]
    base = base_scenario(request, preset)
    settings = request.config.filter
    start_x = settings.initial_x_icr_m if settings.initial_x_icr_m is not None else (1.0 if preset == "paper" else 0.0)
    cells = [(name, right, left) for name in GUARDS for right in request.values for left in request.values]
    scenarios = [
        replace(base, guard=GUARDS[name], config=with_start(base.config, (right, left, start_x)))
        for name, right, left in cells
    ]
    found = run_scenarios(scenarios, request.runs, request.seed, _measure, progress=progress)
    starts: list[dict[str, float | str]] = [
        dict(zip(("series", "start_y_icr_right_m", "start_y_icr_left_m"), cell, strict=True)) for cell in cells
    ]
    levels = tuple(
        {**start, **{fate: float(one[fate].mean()) for fate in ("converged", "inverted", "elsewhere")}}
        for start, one in zip(starts, found, strict=True)
    )
    return StudyResult(
        request, table_of(starts, found), levels, tuple(_findings(levels)), _curves(request, cells, found)
    )


def _measure(run: StudyRun) -> dict[str, float | Floats]:
    last = max(1, len(run.x) // LAST_SHARE)
    error = np.abs(run.x[-last:, 3:] - run.truth[-last:, 3:]).mean(axis=0)
    near, wrong = float((error < CONVERGED_M).all()), inverted(run)
    final = {f"final_{name}_m": run.x[-1, 3 + place] for place, name in enumerate(ICR_NAMES)}
    fates = {"converged": near, "inverted": wrong * (1 - near), "elsewhere": (1 - wrong) * (1 - near)}
    return {**fates, **final, "trace": trace(run)}


def _findings(levels: tuple[dict[str, Any], ...]) -> list[StudyNumber]:
    findings = []
    papers = {
        "no guard": "those with y_icr_right > 0 (Fig. 6)",
        "guard, printed derivatives": "all (Fig. 7)",
        "guard": "all (Fig. 7)",
    }
    for name in GUARDS:
        of_guard = [level for level in levels if level["series"] == name]
        proper = [level for level in of_guard if level["start_y_icr_right_m"] > level["start_y_icr_left_m"]]
        wrong = [level for level in of_guard if level["start_y_icr_right_m"] < level["start_y_icr_left_m"]]
        for label, some in (("proper start", proper), ("inverted start", wrong)):
            if some:
                shares = [100 * float(np.mean([level[fate] for level in some])) for fate in ("converged", "inverted")]
                findings.append(StudyNumber(f"{name}, {label}: converged", (shares[0],), "%", papers[name]))
                findings.append(StudyNumber(f"{name}, {label}: ends inverted", (shares[1],), "%"))
    return findings


def _curves(
    request: StudyRequest, cells: list[tuple[str, float, float]], found: list[dict[str, Floats]]
) -> dict[str, Floats]:
    """Return the maps (values, values) by guard and fate, and y_icr_right over time from every start, one run each."""
    size = len(request.values)
    near = min(sorted(request.values), key=lambda value: abs(value - request.plan.icrs_m[1]))
    curves = {"starts": np.array(request.values), "left_of_curves": np.array([near])}
    for name in GUARDS:
        places = [place for place, cell in enumerate(cells) if cell[0] == name]
        for fate in ("converged", "inverted", "elsewhere"):
            curves[f"{fate} {name}"] = np.array([found[place][fate].mean() for place in places]).reshape(size, size)
        shown = [place for place in places if cells[place][2] == near]
        curves[f"trace {name}"] = np.array([found[place]["trace"][0] for place in shown])
    return curves
