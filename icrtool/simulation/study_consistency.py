"""Consistency of the filter's covariance: NEES, NIS and coverage over many seeds, with a true model and the presets."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from icrtool.kernels.arrays import Bools, Floats
from icrtool.simulation.studies import StudyNumber, StudyRequest, StudyResult, statistics, table_of
from icrtool.simulation.study_measures import ICR_NAMES
from icrtool.simulation.study_runs import Progress, StudyRun, run_scenarios, with_start
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
    scenarios = {"model": replace(base, config=start, model_icr_std_m=MODEL_ICR_STD_M)}
    scenarios |= {preset: base_scenario(request, preset) for preset in request.presets}
    found = run_scenarios(
        list(scenarios.values()), request.runs, request.seed, _measure, stops_s=stops, progress=progress
    )
    cases = dict(zip(scenarios, found, strict=True))
    levels = tuple(_level(name, case) for name, case in cases.items())
    curves = {"stops_s": cases["model"]["stops"][0]}
    for level, (name, case) in zip(levels, cases.items(), strict=True):
        curves |= {f"nees {name}": case["all nees"].mean(axis=0), f"coverage {name}": np.array(level["coverage_pct"])}
    low, high = chi2_band(6 * request.runs, request.runs)
    curves["nees_band"] = np.array([low, high])
    columns = table_of([{"series": name} for name in cases], found)
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


def _measure(run: StudyRun) -> dict[str, float | Floats]:
    nees, ratio = errors_over_std(run.x[run.stops] - run.truth[run.stops], run.P)
    settled = _settled(run.t_s[run.stops])
    means = {
        "nees": float(nees[settled].mean()),
        "nis_gnss": float(np.nanmean(run.gnss_nis)),
        "nis_heading": float(np.nanmean(run.heading_nis)),
    }
    at_end = {f"end_error_over_std_{state}": float(error) for state, error in zip(STATES, ratio[-1], strict=True)}
    whole = {"all nees": nees, "all nis_gnss": run.gnss_nis, "all nis_heading": run.heading_nis}
    return {**means, **at_end, **whole, "ratio": ratio, "stops": run.t_s[run.stops]}


def _settled(stops_s: Floats) -> Bools:
    settled: Bools = stops_s >= min(SETTLED_S, stops_s[-1])
    return settled


def _level(name: str, case: dict[str, Floats]) -> dict[str, Any]:
    settled = _settled(case["stops"][0])
    ratio, nees, runs = case["ratio"][:, settled], case["all nees"][:, settled], len(case["nees"])
    level: dict[str, Any] = {
        "series": name,
        "nees": {"mean": float(nees.mean()), "expected": 6.0, "band": chi2_band(6 * runs, runs)},
    }
    low, high = level["nees"]["band"]
    by_stop = nees.mean(axis=0)
    level["nees"]["stops_in_band_pct"] = 100 * float(((by_stop >= low) & (by_stop <= high)).mean())
    for what, degrees in (("gnss", 2), ("heading", 1)):
        finite = case[f"all nis_{what}"][np.isfinite(case[f"all nis_{what}"])]
        band = chi2_band(degrees * len(finite), len(finite))
        level[f"nis_{what}"] = {"mean": float(finite.mean()), "expected": float(degrees), "band": band}
    level["states"] = list(STATES)
    level["coverage_pct"] = [100 * float((np.abs(ratio[..., place]) <= 2).mean()) for place in range(6)]
    level["rms_error_over_std"] = [float(np.sqrt((ratio[..., place] ** 2).mean())) for place in range(6)]
    level["by_run"] = {what: statistics(case[what]) for what in ("nees", "nis_gnss", "nis_heading")}
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
