"""Consistency of the filter's covariance: NEES, NIS and coverage over many seeds, with a true model and the presets."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np

from icrtool.alignment.align import sensors_as_sent
from icrtool.estimation.filter_setup import FilterSetup, set_up_filter
from icrtool.kernels.arrays import Bools, Floats
from icrtool.kernels.filter.batch_filter import model_states, run_batch
from icrtool.kernels.filter.ekf_step import PLACES
from icrtool.simulation.drives import Readings, Sensors, sample_times
from icrtool.simulation.paths import PathPlan, plan_body, track_speeds
from icrtool.simulation.studies import Column, StudyNumber, StudyRequest, StudyResult, statistics
from icrtool.simulation.study_measures import ICR_NAMES
from icrtool.simulation.study_runs import (
    Chunk,
    Progress,
    Scenario,
    chunks,
    joined,
    on_all_cores,
    readings_log,
    run_scenarios,
    stack,
    with_start,
)
from icrtool.simulation.study_sweeps import base_scenario

STATES = ("north", "east", "heading", *ICR_NAMES)

MODEL_ICR_STD_M = 0.1
"""Initial standard deviation of the ICRs in case ``model``: small enough for an EKF to be nearly linear."""

STOP_EVERY_S = 5.0
SETTLED_S = 10.0
"""Only stops after this time count: before, the initial values of the presets still have an effect."""

PROBABILITY = 0.95

LEAST_STD = 1e-12
"""Avoids division by zero."""

WORDS = {"nees": "NEES", "nis_gnss": "NIS of fixes", "nis_heading": "NIS of headings"}


def study_consistency(request: StudyRequest, progress: Progress | None) -> StudyResult:
    """Return the errors of the filter in its own standard deviations: NEES, NIS and coverage.

    Notes
    -----
    Case ``model``: the truth obeys Eq. 14 with process noise drawn from Q (Eq. 30) and measurements drawn from R
    (Eq. 31), and the filter starts from the prior of the truth. Then NEES and NIS are chi-squared (Bar-Shalom, Li,
    Kirubarajan 2001, Section 5.4). Cases ``paper`` and ``field``: constant ICRs and exact kinematics, preset's start.
    """
    stops = tuple(np.arange(STOP_EVERY_S, request.plan.duration_s, STOP_EVERY_S))
    base = base_scenario(request, "paper")
    start = with_start(base.config, request.plan.icrs_m, MODEL_ICR_STD_M)
    share = 1.0 / (1 + len(request.presets))

    def part(number: int) -> Progress | None:
        return (lambda done: progress((number + done) * share)) if progress is not None else None

    cases = {"model": _run_model(replace(base, config=start), request, np.array(stops), part(0))}
    for number, preset in enumerate(request.presets, start=1):
        cases[preset] = run_scenarios(
            [base_scenario(request, preset)], request.runs, request.seed, _measure, stops_s=stops, progress=part(number)
        )[0]
    columns: dict[str, Column] = {
        "series": [name for name in cases for _ in range(request.runs)],
        "run": np.tile(np.arange(request.runs), len(cases)),
    }
    for name in ("nees", "nis_gnss", "nis_heading"):
        columns[name] = np.concatenate([_per_run(case, name) for case in cases.values()])
    for place, state in enumerate(STATES):
        columns[f"end_error_over_std_{state}"] = np.concatenate(
            [case["ratio"][:, -1, place] for case in cases.values()]
        )
    levels = tuple(_level(name, case) for name, case in cases.items())
    curves = {"stops_s": cases["model"]["stops"][0]}
    for level, (name, case) in zip(levels, cases.items(), strict=True):
        curves |= {f"nees {name}": case["nees"].mean(axis=0), f"coverage {name}": np.array(level["coverage_pct"])}
    low, high = chi2_band(6 * request.runs, request.runs)
    curves["nees_band"] = np.array([low, high])
    return StudyResult(request, columns, levels, tuple(_findings(levels)), curves)


def chi2_band(degrees: int, runs: int) -> tuple[float, float]:
    """Return the 95 % band of the mean of `runs` chi-squared values that together have `degrees` degrees of freedom."""
    from scipy.stats import chi2

    low, high = chi2.ppf([(1 - PROBABILITY) / 2, (1 + PROBABILITY) / 2], degrees)
    return float(low) / runs, float(high) / runs


def errors_over_std(error: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """Return NEES (...) and error over its std (..., 6), of errors (..., 6) with covariances (..., 6, 6).

    Notes
    -----
    The heading error is wrapped. The covariance is scaled to correlations first: metres and radians differ by orders.
    """
    error = error.copy()
    error[..., 2] = np.angle(np.exp(1j * error[..., 2]))
    std = np.sqrt(np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), LEAST_STD**2))
    ratio = error / std
    correlation = covariance / (std[..., :, None] * std[..., None, :])
    nees = (ratio * np.linalg.solve(correlation, ratio[..., None])[..., 0]).sum(axis=-1)
    return nees, ratio


def _measure(chunk: Chunk) -> dict[str, Floats]:
    rows = np.searchsorted(chunk.t_s, chunk.stops_s)
    truth = np.concatenate(
        [chunk.true_pose, np.broadcast_to(chunk.true_icrs_m[rows], (*chunk.true_pose.shape[:2], 3))], axis=2
    )
    return _reduced(chunk.x[:, rows] - truth, chunk.P, chunk.stops_s, chunk.gnss_nis, chunk.heading_nis)


def _reduced(
    error: Floats, covariance: Floats, stops_s: Floats, gnss_nis: Floats, heading_nis: Floats
) -> dict[str, Floats]:
    nees, ratio = errors_over_std(error, covariance)
    return {
        "stops": np.tile(stops_s, (len(error), 1)),
        "nees": nees,
        "ratio": ratio,
        "nis_gnss": gnss_nis,
        "nis_heading": heading_nis,
    }


def _per_run(case: dict[str, Floats], name: str) -> Floats:
    if name == "nees":
        mean: Floats = case["nees"][:, _settled(case)].mean(axis=1)
        return mean
    return cast(Floats, np.nanmean(case[name], axis=1))


def _settled(case: dict[str, Floats]) -> Bools:
    stops = case["stops"][0]
    settled: Bools = stops >= min(SETTLED_S, stops[-1])
    return settled


def _level(name: str, case: dict[str, Floats]) -> dict[str, Any]:
    settled = _settled(case)
    ratio, nees, runs = case["ratio"][:, settled], case["nees"][:, settled], len(case["nees"])
    level: dict[str, Any] = {
        "series": name,
        "nees": {"mean": float(nees.mean()), "expected": 6.0, "band": chi2_band(6 * runs, runs)},
    }
    low, high = level["nees"]["band"]
    by_stop = nees.mean(axis=0)
    level["nees"]["stops_in_band_pct"] = 100 * float(((by_stop >= low) & (by_stop <= high)).mean())
    for what, degrees in (("gnss", 2), ("heading", 1)):
        finite = case[f"nis_{what}"][np.isfinite(case[f"nis_{what}"])]
        band = chi2_band(degrees * len(finite), len(finite))
        level[f"nis_{what}"] = {"mean": float(finite.mean()), "expected": float(degrees), "band": band}
    level["states"] = list(STATES)
    level["coverage_pct"] = [100 * float((np.abs(ratio[..., place]) <= 2).mean()) for place in range(6)]
    level["rms_error_over_std"] = [float(np.sqrt((ratio[..., place] ** 2).mean())) for place in range(6)]
    level["by_run"] = {what: statistics(_per_run(case, what)) for what in ("nees", "nis_gnss", "nis_heading")}
    return level


def _findings(levels: tuple[dict[str, Any], ...]) -> list[StudyNumber]:
    findings = []
    for level in levels:
        name = level["series"]
        for what in ("nees", "nis_gnss", "nis_heading"):
            low, high = level[what]["band"]
            expected = f"{level[what]['expected']:g}, {low:.3f}-{high:.3f} in 95 %"
            findings.append(StudyNumber(f"{name}: {WORDS[what]}, mean", (level[what]["mean"],), "", expected))
            findings.append(StudyNumber(f"{name}: {WORDS[what]}, median run", (level["by_run"][what]["p50"],), ""))
        covered = level["coverage_pct"]
        for what, part in (("pose", covered[:3]), ("ICRs", covered[3:])):
            label = f"{name}: {what} within 2 sigma, least and most"
            findings.append(StudyNumber(label, (min(part), max(part)), "%", "95.4 %"))
    return findings


def _run_model(
    scenario: Scenario, request: StudyRequest, stops_s: Floats, progress: Progress | None
) -> dict[str, Floats]:
    """Run the case in which the truth obeys the filter's model."""
    plan, sensors = request.plan, replace(request.sensors, wheels="ideal", heading_resolution_rad=0.0)
    wheel_t = sample_times(sensors.wheel_rate_hz, plan.duration_s)
    v_left, v_right = track_speeds(*plan_body(cast(PathPlan, plan.path), wheel_t, plan.icrs_m), plan.icrs_m)
    blank = _readings(np.zeros((len(wheel_t), 6)), wheel_t, v_left, v_right, sensors, np.random.default_rng(0))
    setup = set_up_filter(sensors_as_sent(readings_log(blank, sensors), scenario.config), scenario.config)

    def work(runs: range) -> dict[str, Floats]:
        return _model_chunk(runs, request, setup, sensors, (wheel_t, v_left, v_right), stops_s)

    return joined(on_all_cores(work, chunks(request.runs, len(wheel_t)), progress))


def _model_chunk(
    runs: range, request: StudyRequest, setup: FilterSetup, sensors: Sensors, drive: tuple[Floats, Floats, Floats],
    stops_s: Floats,
) -> dict[str, Floats]:  # fmt: skip
    wheel_t, v_left, v_right = drive
    std = np.sqrt(np.array(setup.parameters.process_variance))
    truths, readings = [], []
    for run in runs:
        rng = np.random.default_rng((request.seed, run))
        icrs = np.array(request.plan.icrs_m) + rng.normal(0.0, MODEL_ICR_STD_M, 3)
        x0 = np.array([0.0, 0.0, request.plan.start_heading_rad, *icrs])
        noise = rng.normal(0.0, 1.0, (len(wheel_t), 6))
        truths.append(model_states(x0, wheel_t, v_left, v_right, std, setup.parameters.rate_invariant, noise))
        readings.append(_readings(truths[-1], wheel_t, v_left, v_right, sensors, rng))
    stops = np.append(np.searchsorted(wheel_t, stops_s, side="right") - 1, len(wheel_t) - 1)
    out = run_batch(stack(readings, setup, stops), setup.parameters)
    error = out.x[:, stops - (len(wheel_t) - out.x.shape[1])] - np.array(truths)[:, stops]
    return _reduced(error, out.P[..., PLACES], wheel_t[stops], out.gnss_nis, out.heading_nis)


def _readings(
    states: Floats, wheel_t: Floats, v_left: Floats, v_right: Floats, sensors: Sensors, rng: np.random.Generator
) -> Readings:
    """Measure states (n, 6) at the wheel stamps that fall together with a fix or a heading."""
    fix, sample = (
        np.arange(0, len(wheel_t), max(1, round(sensors.wheel_rate_hz / rate)))
        for rate in (sensors.gnss_rate_hz, sensors.heading_rate_hz)
    )
    return Readings(
        wheel_t, v_left, v_right, v_left, v_right,
        wheel_t[fix], states[fix, :2] + rng.normal(0.0, sensors.gnss_std_m, (len(fix), 2)),
        wheel_t[sample], states[sample, 2] + rng.normal(0.0, sensors.heading_std_rad, len(sample)),
        np.zeros(len(sample)),
    )  # fmt: skip
