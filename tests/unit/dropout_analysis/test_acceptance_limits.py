"""Gates and budgets."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import isotonic_regression

from icrtool.dropout_analysis.dropout_report import dropout, dropout_report
from icrtool.dropout_analysis.report import DropoutReport, budget_distances, check_gate, parse_gate
from icrtool.errors import ConfigError
from icrtool.kernels.error_statistics import never_falling, within_budget
from icrtool.records.run import Run
from support.documents import with_summary
from support.reports import with_models, with_numbers

METRICS = {"p50": "p50_m", "p95": "p95_m", "expected": "expected_error_m", "max": "max_m"}


@pytest.fixture(scope="module")
def report(run: Run) -> DropoutReport:
    return dropout(run, [1.0, 2.5, 10.0])


@pytest.mark.parametrize("model", ["icr", "no_slip", "icr_final"])
@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("relation", ["<=", "<", ">=", ">"])
def test_a_gate_holds_its_number_against_its_bound(
    report: DropoutReport, model: str, metric: str, relation: str
) -> None:
    result = report.result(model)
    assert result is not None
    value = float(result.column(METRICS[metric])[1])
    above, below = value + 0.25, value - 0.25
    for bound in (above, below):
        verdict = check_gate(parse_gate(f"{model}.{metric}@2.5m {relation} {bound}"), report)
        assert verdict.value_m == value
        assert verdict.passed == ((bound == above) == (relation[0] == "<"))
        assert verdict.margin_m == pytest.approx(0.25 if verdict.passed else -0.25)


@pytest.mark.parametrize(("relation", "passes"), [("<=", True), (">=", True), ("<", False), (">", False)])
def test_a_number_on_its_bound_passes_only_where_equality_is_allowed(
    report: DropoutReport, relation: str, passes: bool
) -> None:
    value = float(report.results[0].column("p95_m")[0])
    verdict = check_gate(parse_gate(f"icr.p95@1m{relation}{value!r}"), report)
    assert verdict.passed is passes
    assert verdict.margin_m == 0.0


@pytest.mark.parametrize(
    ("text", "horizon", "bound"),
    [
        ("icr.p95@10m <= 3.8", 10.0, 3.8),
        ("  icr.p95@10 m<=3.8 m ", 10.0, 3.8),
        ("icr.p95@2.5<=.5", 2.5, 0.5),
        ("icr.p95@10m <= 1e-1", 10.0, 0.1),
    ],
)
def test_gates_are_read_with_or_without_units_and_spaces(text: str, horizon: float, bound: float) -> None:
    gate = parse_gate(text)
    assert (gate.model, gate.metric, gate.horizon_m, gate.relation, gate.bound_m) == (
        "icr",
        "p95",
        horizon,
        "<=",
        bound,
    )
    assert gate.text == " ".join(text.split())


@pytest.mark.parametrize(
    "text",
    ["", "icr.p95", "icr.p90@10m <= 1", "p95@10m <= 1", "icr.p95@10m = 1", "icr.p95@10m <=", "icr.p95@10km <= 1",
     "icr.p95@0m <= 1", "icr.p95@-5m <= 1", "icr.p95@10m <= nan", "icr.p95@10m <= 1 and more"],
)  # fmt: skip
def test_text_that_is_no_gate_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        parse_gate(text)
    assert refusal.value.what == f"gate {text!r}"
    assert "\n" not in str(refusal.value)


def test_an_unknown_model_or_horizon_is_an_error_that_names_what_there_is(report: DropoutReport) -> None:
    with pytest.raises(ConfigError, match="no model calibrated; this run has icr, no_slip, icr_final"):
        check_gate(parse_gate("calibrated.p95@1m <= 1"), report)
    with pytest.raises(ConfigError, match="no horizon of 7 m"):
        check_gate(parse_gate("icr.p95@7m <= 1"), report)


def test_a_gate_without_trials_fails_and_says_so(run: Run) -> None:
    report = dropout(run, [900.0])
    for relation in ("<=", ">="):
        verdict = check_gate(parse_gate(f"icr.p95@900m {relation} 1"), report)
        assert not verdict.passed
        assert verdict.value_m is None
        assert verdict.verdict.startswith(f"FAIL  icr.p95@900m {relation} 1: no trial of 900 m in this log")


def test_the_verdict_names_number_bound_and_margin(report: DropoutReport) -> None:
    value = float(report.results[0].column("p95_m")[0])
    line = check_gate(parse_gate("icr.p95@1m <= 3"), report).verdict
    assert line.startswith(f"pass  icr.p95@1m <= 3: {value:.3g} m, margin {3 - value:+.3g} m")
    assert report.name in line


def with_p95(report: DropoutReport, *p95: float) -> DropoutReport:
    """The report of one model with these p95 at 1, 2.5 and 10 m."""
    return with_models(report, with_numbers(report.results[0], p95_m=p95))


@pytest.mark.parametrize(
    ("budget", "p95", "distance", "beyond"),
    [
        (0.05, (0.1, 0.4, 2.0), 0.5, False),
        (0.1, (0.1, 0.4, 2.0), 1.0, False),
        (0.2, (0.1, 0.4, 2.0), 1.5, False),
        (1.2, (0.1, 0.4, 2.0), 6.25, False),
        (2.0, (0.1, 0.4, 2.0), 10.0, True),
        (9.0, (0.1, 0.4, 2.0), 10.0, True),
        (0.3, (0.1, 0.5, 0.2), 2.2, False),
        (0.3, (0.1, 0.2, math.nan), 2.5, True),
        (0.3, (math.nan, 0.6, 1.0), 1.25, False),
    ],
)
def test_a_budget_is_interpolated_between_horizons_from_zero(
    report: DropoutReport, budget: float, p95: tuple[float, ...], distance: float, beyond: bool
) -> None:
    (found,) = budget_distances(with_p95(report, *p95), budget)
    assert found.distance_m == pytest.approx(distance)
    assert (found.model, found.budget_m, found.beyond) == ("icr", budget, beyond)


def test_a_budget_without_trials_is_left_out_and_no_length_is_refused(report: DropoutReport) -> None:
    assert budget_distances(with_p95(report, math.nan, math.nan, math.nan), 1.0) == ()
    for budget in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ConfigError, match="budget"):
            budget_distances(report, budget)


@pytest.mark.parametrize(
    ("high", "low", "text"),
    [
        ((0.2, 0.5, 2.5), (0.05, 0.2, 1.0), "1.5-3.4 m"),
        ((0.2, 0.5, math.nan), (0.05, 0.2, math.nan), "1.5 m or more"),
        ((0.2, math.nan, math.nan), (0.05, math.nan, math.nan), ""),
    ],
)
def test_an_interval_of_a_budget_ends_where_its_knowledge_ends(
    report: DropoutReport, high: tuple[float, ...], low: tuple[float, ...], text: str
) -> None:
    one = with_p95(report, 0.1, 0.4, 2.0)
    between = with_numbers(one.results[0], p95_next_low_m=low, p95_next_high_m=high)
    (found,) = budget_distances(with_models(one, between), 0.3)
    assert found.distance_m == pytest.approx(1.0 + 1.5 * 0.2 / 0.3)
    assert found.next_text == text


def test_errors_that_never_fall_are_those_of_isotonic_regression() -> None:
    """Witness: scipy's pool-adjacent-violators."""
    rng = np.random.default_rng(3)
    for n in (1, 2, 5, 20):
        for _ in range(20):
            values = rng.exponential(1.0, n) * np.arange(1, n + 1) ** rng.uniform(-1.0, 1.0)
            np.testing.assert_allclose(never_falling(values), isotonic_regression(values).x, rtol=1e-12)


def test_a_short_distance_that_is_worse_than_a_longer_one_does_not_end_the_reach() -> None:
    horizons, p95 = np.array([1.0, 2.0, 5.0, 10.0]), np.array([0.55, 0.3, 0.4, 0.9])
    reached = within_budget(horizons, p95, 0.5)
    assert reached is not None
    assert 5.0 < reached[0] < 10.0
    assert not reached[1]


def test_a_limit_on_the_distance_within_a_budget(report: DropoutReport) -> None:
    reached = next(one for one in budget_distances(report, 0.2) if one.model == "icr")
    for bound, passed in ((reached.distance_m - 0.01, True), (reached.distance_m + 0.01, False)):
        verdict = check_gate(parse_gate(f"icr.within@0.2m >= {bound}"), report)
        assert (verdict.passed, verdict.value_m) == (passed, pytest.approx(reached.distance_m))
    wide = check_gate(parse_gate("icr.within@99 >= 1"), report)
    assert wide.value_m == report.horizons_m[np.isfinite(report.results[0].column("p95_m"))][-1]


def test_every_limit_fails_on_a_run_that_is_not_usable(run: Run) -> None:
    bad = with_summary(run, usable=False, unusable_because="the robot did not move")
    gates = ["icr.p95@5m <= 100", "recommended.within@0.5m >= 0.1"]
    report = dropout_report(bad, horizons_m=[5.0], gates=gates)
    assert [result.name for result in report.results] == ["icr", "no_slip", "icr_final"]
    assert (report.document.budgets, report.calibration) == ((), None)
    assert [verdict.passed for verdict in report.document.gates] == [False, False]
    assert all("the robot did not move" in verdict.verdict for verdict in report.document.gates)
    allowed = dropout_report(bad, horizons_m=[5.0], gates=gates, allow_unusable=True)
    assert allowed.result("recommended") is not None
    assert allowed.document.gates[0].passed


def test_a_limit_on_the_next_drive_is_about_the_end_that_9_of_10_drives_reach(report: DropoutReport) -> None:
    one = with_p95(report, 0.1, 0.4, 2.0)
    ahead = with_numbers(one.results[0], p95_next_low_m=(0.05, 0.2, 1.0), p95_next_high_m=(0.2, 0.5, 2.5))
    found = with_models(one, ahead)
    (reached,) = budget_distances(found, 0.3)
    distance, error = (
        check_gate(parse_gate(f"{one.results[0].name}.{text}"), found)
        for text in ("within_next@0.3m >= 1.2", "p95_next@1m <= 0.25")
    )
    assert distance.value_m == pytest.approx(reached.next_low_m)
    assert error.value_m == pytest.approx(0.2)
    assert distance.passed
    assert error.passed
    assert not check_gate(parse_gate(f"{one.results[0].name}.within_next@0.3m >= 2"), found).passed
