"""Studies of a change of the ICRs during a drive: with and without covariance inflation, and by radius of the turn."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import cast

import numpy as np

from icrtool.errors import ConfigError
from icrtool.kernels.arrays import Floats
from icrtool.records.tables import Icrs
from icrtool.simulation.paths import PathPlan
from icrtool.simulation.studies import StudyNumber, StudyRequest, StudyResult, statistics
from icrtool.simulation.study_measures import ICR_NAMES, inverted, measure_times, trace
from icrtool.simulation.study_runs import Progress, Scenario, StudyRun
from icrtool.simulation.study_sweeps import levels_of, run_levels, spread

CHANGE_TIMES_S = (175.0, 350.0)
"""Pentzer 2014, Figs. 8 and 9."""

RADIUS_CHANGE_S = 20.0

ZOOM_S = 10.0
ZOOM_STEPS = 500


def changed(icrs_m: Icrs, number: int) -> Icrs:
    """Return the ICRs after change 1, 2, …: alternately wider and narrower. The paper does not state its values."""
    right, left, x = icrs_m
    width = right - left
    if number % 2:
        return 1.5 * right, 0.7 * left, x + 0.2 * width
    return 0.8 * right, 1.2 * left, x - 0.1 * width


def study_icr_change(request: StudyRequest, progress: Progress | None) -> StudyResult:
    """Return how the filter follows two changes of the ICRs, with and without covariance inflation (Figs. 8, 9)."""
    plan = request.plan
    if not plan.changes:
        icrs = tuple((time, changed(plan.icrs_m, number + 1)) for number, time in enumerate(CHANGE_TIMES_S))
        plan = replace(plan, changes=tuple(change for change in icrs if change[0] < plan.duration_s))
        if not plan.changes:
            why = f"{plan.duration_s:g} s end before the first change, at {CHANGE_TIMES_S[0]:g} s"
            raise ConfigError("duration", why, "drive longer, or give earlier times with --change")
    request = replace(request, plan=plan)
    levels = levels_of(
        request, ("not inflated", "inflated"), lambda base, name: replace(base, inflate=name == "inflated")
    )
    times = [time for time, _ in plan.changes]
    edges = [*times, plan.duration_s]

    def measure(run: StudyRun) -> dict[str, float | Floats]:
        numbers: dict[str, float | Floats] = {"inverted": inverted(run)}
        for number, (begin, end) in enumerate(pairwise(edges), start=1):
            numbers |= {f"change{number}_{name}": value for name, value in measure_times(run, begin, end).items()}
        return {**numbers, "trace": trace(run), "zoom": _zoom(run, times[0])}

    columns, records, found = run_levels(levels, request, measure, progress)
    findings = []
    for level, one in zip(levels, found, strict=True):
        inflated = level.value == "inflated"
        durations = np.concatenate([one[f"change{n}_rise_{icr}_s"] for n in range(1, len(edges)) for icr in ICR_NAMES])
        settles = np.concatenate([one[f"change{n}_settle_s"] for n in range(1, len(edges))])
        paper = "0.03-0.17 s (Fig. 9)" if inflated else "100-140 s (Fig. 8)"
        findings += [
            StudyNumber(f"{level.series}, {level.value}: convergence time (10-90 %)", spread(durations), "s", paper),
            StudyNumber(f"{level.series}, {level.value}: all three stay within 10 % after", spread(settles), "s"),
            StudyNumber(
                f"{level.series}, {level.value}: … in so many of the changes",
                (100 * float(np.isfinite(settles).mean()),),
                "%",
            ),
            StudyNumber(f"{level.series}, {level.value}: ends inverted", (100 * float(one["inverted"].mean()),), "%"),
        ]
    true_icrs = np.array([plan.icrs_m, *(icrs for _, icrs in plan.changes)])
    curves: dict[str, Floats] = {"changes": np.array(times), "true_icrs": true_icrs}
    for level, one in zip(levels, found, strict=True):
        curves |= {
            f"trace {level.series} {level.value}": one["trace"],
            f"zoom {level.series} {level.value}": one["zoom"],
        }
    return StudyResult(request, columns, records, tuple(findings), curves)


def _zoom(run: StudyRun, since_s: float) -> Floats:
    """Return time since the change and the ICRs (k, 4) around it."""
    rows = np.flatnonzero((run.t_s >= since_s - 1.0) & (run.t_s <= since_s + ZOOM_S))
    rows = rows[:: 1 + len(rows) // ZOOM_STEPS]
    return np.column_stack([run.t_s[rows] - since_s, run.x[rows, 3:]])


def study_turn_radius(request: StudyRequest, progress: Progress | None) -> StudyResult:
    """Return the convergence after a change of the ICRs on circles of several radii, with inflation (Fig. 10).

    The faster track keeps one speed: at radius 0 the robot spins, and the wider the circle, the slower it turns.
    """
    path, change = cast(PathPlan, request.plan.path), (RADIUS_CHANGE_S, changed(request.plan.icrs_m, 1))
    outer = abs(request.plan.icrs_m[1])

    def on_circle(base: Scenario, radius: float) -> Scenario:
        speed = path.speed_mps * (radius / (radius + outer) if radius else 1.0)
        circle = replace(path, kind="circle", radius_m=radius, speed_mps=speed)
        plan = replace(base.plan, path=circle, changes=base.plan.changes or (change,))
        return replace(base, plan=plan, inflate=True)

    levels = levels_of(request, request.values, on_circle)
    since = levels[0].scenario.plan.changes[0][0]

    def measure(run: StudyRun) -> dict[str, float | Floats]:
        return {"inverted": inverted(run), **measure_times(run, since)}

    columns, records, found = run_levels(levels, request, measure, progress)
    findings = []
    for level, one in zip(levels, found, strict=True):
        if level.value in (min(request.values), max(request.values)):
            paper = {0.0: "0.1 s (Fig. 10)", 2.0: "1.8 s (Fig. 10)"}.get(float(level.value), "")
            settles = np.concatenate([one[f"settle_{icr}_s"] for icr in ICR_NAMES])
            label = f"{level.series}: radius {level.value:g} m"
            findings += [
                StudyNumber(
                    f"{label}: an ICR stays within 10 % after, mean", (statistics(settles)["mean"],), "s", paper
                ),
                StudyNumber(f"{label}: all three do", spread(one["settle_s"]), "s"),
                StudyNumber(f"{label}: ends inverted", (100 * float(one["inverted"].mean()),), "%"),
            ]
    return StudyResult(request, columns, records, tuple(findings))
