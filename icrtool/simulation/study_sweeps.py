"""Studies of the ICRs that vary one setting: path, input noise or bias, input source, GNSS noise, rates."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar, cast

import numpy as np

from icrtool.kernels.arrays import Floats
from icrtool.simulation.drives import Sensors, drive_plan, sense
from icrtool.simulation.paths import PathPlan
from icrtool.simulation.studies import Column, StudyNumber, StudyRequest, StudyResult, statistics, table_of
from icrtool.simulation.study_measures import ICR_NAMES, measure_errors, measure_times, open_loop_p95, trace
from icrtool.simulation.study_runs import Measure, Progress, Scenario, StudyRun, run_scenarios

PATH_POINTS = 2000

SHOWN_S = 20.0
"""First seconds of a run that the picture of convergence shows."""


@dataclass(frozen=True, slots=True)
class Level:
    """One setting: the series it belongs to, its value (a number or a name), and how it is run."""

    series: str
    value: float | str
    scenario: Scenario


def base_scenario(request: StudyRequest, preset: str) -> Scenario:
    """Return the scenario of a request in a preset, before anything is varied."""
    return Scenario(request.plan, request.sensors, request.config.with_filter(preset=preset), request.vary_path)


Value = TypeVar("Value", bound=float | str)


def levels_of(
    request: StudyRequest, values: Collection[Value], change: Callable[[Scenario, Value], Scenario]
) -> list[Level]:
    """Return a level for each preset and value, with what `change` makes of the preset's scenario."""
    return [
        Level(preset, value, change(base_scenario(request, preset), value))
        for preset in request.presets
        for value in values
    ]


def with_sensors(scenario: Scenario, **changes: Any) -> Scenario:
    """Return a scenario with other sensors."""
    return replace(scenario, sensors=replace(scenario.sensors, **changes))


def run_levels(
    levels: Sequence[Level], request: StudyRequest, measure: Measure, progress: Progress | None
) -> tuple[dict[str, Column], tuple[dict[str, Any], ...], list[dict[str, Floats]]]:
    """Run every level; return the CSV's columns, the levels' statistics, and all columns by level."""
    found = run_scenarios([level.scenario for level in levels], request.runs, request.seed, measure, progress=progress)
    settings: list[dict[str, float | str]] = [{"series": level.series, "value": level.value} for level in levels]
    records = tuple(
        {**setting, "metrics": {name: statistics(values) for name, values in one.items() if values.ndim == 1}}
        for setting, one in zip(settings, found, strict=True)
    )
    return table_of(settings, found), records, found


def spread(values: Floats) -> tuple[float, float, float]:
    """Return the 5th percentile, the median and the 95th percentile."""
    found = statistics(values)
    return found["p5"], found["p50"], found["p95"]


def study_convergence(request: StudyRequest, progress: Progress | None) -> StudyResult:
    """Return the convergence times from the preset's start, by kind of path (Figs. 4, 5)."""
    path = cast(PathPlan, request.plan.path)
    levels = levels_of(
        request, request.paths, lambda base, kind: replace(base, plan=replace(base.plan, path=replace(path, kind=kind)))
    )
    columns, records, found = run_levels(
        levels,
        request,
        lambda run: {**measure_times(run), **measure_errors(run), "trace": trace(run, SHOWN_S)},
        progress,
    )
    findings = [
        StudyNumber(
            f"{level.value} ({level.series}): all three ICRs converged after", spread(one["settle_s"]), "s", paper
        )
        for level, one in zip(levels, found, strict=True)
        for paper in ["2.9-12.8 s, driven (Figs. 15, 17)" if level.value == "circle" else "5-15 s, driven"]
    ]
    shown = next((place for place, level in enumerate(levels) if level.value == path.kind), 0)
    truth = drive_plan(levels[shown].scenario.plan, 0.0)
    curves = {
        "trace": found[shown]["trace"],
        "path": truth.pose[:: 1 + len(truth.pose) // PATH_POINTS, :2],
        "true_icrs": truth.icrs_m,
        "shown": np.array([float(shown)]),
    }
    return StudyResult(request, columns, records, tuple(findings), curves)


def study_input_noise(request: StudyRequest, progress: Progress | None) -> StudyResult:
    """Return the ICR errors by noise of the track speeds (Fig. 12)."""
    return _vary_sensors(request, "input_noise_mps", "Fig. 12's axis: -1 to 1 m", progress)


def study_input_bias(request: StudyRequest, progress: Progress | None) -> StudyResult:
    """Return the ICR errors by bias of both track speeds (Fig. 13)."""
    return _vary_sensors(request, "input_bias_mps", "Fig. 13's axis: -0.1 to 0.02 m", progress)


def _vary_sensors(request: StudyRequest, name: str, paper: str, progress: Progress | None) -> StudyResult:
    levels = levels_of(request, request.values, lambda base, value: with_sensors(base, **{name: value}))
    columns, records, found = run_levels(levels, request, measure_errors, progress)
    findings = [
        StudyNumber(
            f"{preset}: error of {icr} at {max(request.values):g} m/s", spread(one[f"error_{icr}_m"]), "m", paper
        )
        for preset in request.presets
        for level, one in zip(levels, found, strict=True)
        if level.series == preset and level.value == max(request.values)
        for icr in ICR_NAMES
    ]
    return StudyResult(request, columns, records, tuple(findings))


def study_input_source(request: StudyRequest, progress: Progress | None) -> StudyResult:
    """Return the ICR errors with encoders and with commanded speeds (Fig. 11, Section 5.3), on the same drives.

    The motors get commands at a low rate and follow with a lag; the bias is between command and track.
    """
    rate = cast(float, request.plan.command_rate_hz)
    views: dict[str, Sensors] = {
        "encoder": replace(request.sensors, wheels="encoder", input_bias_mps=0.0),
        "commanded": replace(request.sensors, wheels="commanded", wheel_rate_hz=rate),
    }
    levels = levels_of(request, views, lambda base, name: replace(base, sensors=views[name]))
    columns, records, found = run_levels(levels, request, measure_errors, progress)
    findings = [
        StudyNumber(f"{level.series}: error of {icr}, {level.value} speeds", spread(one[f"error_{icr}_m"]), "m")
        for level, one in zip(levels, found, strict=True)
        for icr in ICR_NAMES
    ]
    truth = drive_plan(request.plan, 1.0)
    curves: dict[str, Floats] = {"true_t": truth.t_s, "true_v": truth.v_left_mps}
    for name, sensors in views.items():
        seen = sense(truth, sensors, request.plan.duration_s, np.random.default_rng((request.seed, 0)))
        curves |= {f"{name}_t": seen.wheel_t, f"{name}_v": seen.v_left_mps}
    return StudyResult(request, columns, records, tuple(findings), curves)


def study_gnss(request: StudyRequest, progress: Progress | None) -> StudyResult:
    """Return ICR errors and open-loop errors by noise of the GNSS (Figs. 35-37)."""
    width = cast(float, request.config.robot.track_width_m)

    def measure(run: StudyRun) -> dict[str, float | Floats]:
        return {**measure_errors(run), **measure_times(run), **open_loop_p95(run, width)}

    levels = levels_of(request, request.values, lambda base, value: with_sensors(base, gnss_std_m=value))
    columns, records, found = run_levels(levels, request, measure, progress)
    findings = []
    for level, one in zip(levels, found, strict=True):
        if level.value in (min(request.values), 0.3):
            label = f"{level.series}: GNSS {level.value:g} m"
            paper = "within 3.8 m for 95 % (RTK, tracked, Fig. 29)" if level.value == min(request.values) else ""
            findings.append(
                StudyNumber(f"{label}: open loop after 10 m, p95", spread(one["blind_icr_10m_p95_m"]), "m", paper)
            )
            findings.append(StudyNumber(f"{label}: rms error of y_icr_right", spread(one["rms_y_icr_right_m"]), "m"))
    findings.append(StudyNumber("no slip: open loop after 10 m, p95", spread(found[0]["blind_no_slip_10m_p95_m"]), "m"))
    return StudyResult(request, columns, records, tuple(findings))


def study_rate(request: StudyRequest, progress: Progress | None) -> StudyResult:
    """Return the ICR errors of the same drives recorded at several rates."""

    def at_rate(base: Scenario, rate: float) -> Scenario:
        gnss_rate = min(rate, base.sensors.gnss_rate_hz)
        return with_sensors(base, wheel_rate_hz=rate, heading_rate_hz=rate, gnss_rate_hz=gnss_rate)

    levels = levels_of(request, request.values, at_rate)
    columns, records, found = run_levels(levels, request, measure_errors, progress)
    findings = []
    for preset in request.presets:
        of_preset = [one for level, one in zip(levels, found, strict=True) if level.series == preset]
        for icr in ICR_NAMES:
            means = [float(one[f"error_{icr}_m"].mean()) for one in of_preset]
            stated = [float(np.median(one[f"std_{icr}_m"])) for one in of_preset]
            findings.append(
                StudyNumber(f"{preset}: {icr} differs between rates by at most", (max(means) - min(means),), "m")
            )
            findings.append(
                StudyNumber(f"{preset}: stated std of {icr}, least and greatest", (min(stated), max(stated)), "m")
            )
    return StudyResult(request, columns, records, tuple(findings))
