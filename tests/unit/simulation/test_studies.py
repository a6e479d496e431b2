"""Studies, small: what they find where the answer is known, and that they are consistent over seeds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.special import chdtri

from icrtool.config import Config, load_config
from icrtool.errors import ConfigError
from icrtool.simulation import study_runs
from icrtool.simulation.drives import PathPlan
from icrtool.simulation.studies import STUDIES, default_request, run_study
from icrtool.simulation.study_records import StudyResult, chi2_band, statistics
from icrtool.simulation.study_runs import convergence_time, errors_over_std, settling_time
from support.studies import SMALL, small_study
from support.studies import small_request as request


def level(result: StudyResult, **wanted: Any) -> dict[str, Any]:
    return next(one for one in result.records() if all(one[key] == value for key, value in wanted.items()))


def median(result: StudyResult, metric: str, **wanted: Any) -> float:
    return level(result, **wanted)["metrics"][metric]["p50"]


@pytest.mark.parametrize("name", STUDIES)
def test_every_study_runs_small_and_says_the_same_again(name) -> None:
    result, again = small_study(name), run_study(request(name, 2, **SMALL[name]))
    rows = {len(values) for values in result.columns.values()}
    assert len(rows) == 1
    assert rows != {0}
    assert result.findings
    assert repr(result.records()) == repr(again.records())  # NaN is not itself
    for column, values in result.columns.items():
        np.testing.assert_array_equal(values, again.columns[column])


def test_a_run_depends_neither_on_the_others_nor_on_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    few, many = (run_study(request("rate", runs, 5.0, values=(50.0,))) for runs in (2, 5))
    monkeypatch.setattr(study_runs.os, "cpu_count", lambda: 1)
    alone = run_study(request("rate", 5, 5.0, values=(50.0,)))
    for name in ("error_y_icr_right_m", "nis_gnss"):
        np.testing.assert_array_equal(np.asarray(many.columns[name]), np.asarray(alone.columns[name]))
        np.testing.assert_array_equal(np.asarray(few.columns[name])[:2], np.asarray(many.columns[name])[:2])


def test_progress_goes_from_nothing_to_all() -> None:
    told: list[float] = []
    run_study(request("rate", 2, 5.0, values=(20.0, 50.0)), told.append)
    assert told == sorted(told)
    assert told[-1] == pytest.approx(1.0)


def test_convergence_on_circles_takes_seconds() -> None:
    result = run_study(request("convergence", 40, 30.0, paths=("circle",)))
    assert 0.3 < median(result, "settle_s", value="circle") < 5.0
    assert level(result, value="circle")["metrics"]["settle_s"]["count"] >= 36


def test_inflation_brings_reconvergence_from_minutes_to_seconds() -> None:
    asked = request("icr-change", 2)
    asked = replace(asked, plan=replace(asked.plan, duration_s=350.0))
    result = run_study(asked)
    slow = median(result, "change1_rise_y_icr_right_s", series="paper", value="not inflated")
    fast = median(result, "change1_rise_y_icr_right_s", series="field", value="inflated")
    assert 80.0 < slow < 160.0
    assert fast < 1.0
    assert level(result, series="field", value="inflated")["metrics"]["inverted"]["mean"] == 0.0


def test_wider_turns_take_longer() -> None:
    result = run_study(request("turn-radius", 10, values=(0.0, 1.0, 2.0), presets=("field",)))
    times = [median(result, "settle_x_icr_s", value=radius) for radius in (0.0, 1.0, 2.0)]
    assert times == sorted(times)
    assert times[2] > 2 * times[0]


def test_noise_matters_more_than_bias() -> None:
    errors = {
        name: abs(
            median(run_study(request(name, 8, values=(0.5,), presets=("paper",))), "error_y_icr_right_m", value=0.5)
        )
        for name in ("input-noise", "input-bias")
    }
    assert errors["input-noise"] > 1.5 * errors["input-bias"]


def test_on_a_circle_a_bias_moves_both_icrs_by_bias_over_turn_rate() -> None:
    """Closed form: v_x too large by the bias at one turn rate is a centre of rotation shifted by it over omega."""
    asked = request("input-bias", 6, 100.0, values=(0.02,), presets=("paper",))
    asked = replace(asked, plan=replace(asked.plan, path=PathPlan("circle", speed_mps=0.4, radius_m=1.0)))
    result = run_study(asked)
    for icr in ("y_icr_right", "y_icr_left"):
        assert median(result, f"error_{icr}_m", value=0.02) == pytest.approx(-0.02 / 0.4, abs=0.005)


def test_gnss_noise_costs_accuracy() -> None:
    result = run_study(request("gnss", 3, 120.0, values=(0.01, 0.3)))
    for preset in ("paper", "field"):
        good, bad = (median(result, "rms_y_icr_right_m", series=preset, value=value) for value in (0.01, 0.3))
        assert good < bad
    assert median(result, "blind_icr_10m_p95_m", series="field", value=0.3) < 0.5


def test_logs_of_any_rate_give_the_same_icrs_within_their_stated_doubt() -> None:
    result = run_study(request("rate", 6, presets=("field",)))
    for icr in ("y_icr_right", "y_icr_left", "x_icr"):
        means = [one["metrics"][f"error_{icr}_m"]["mean"] for one in result.records()]
        stated = [one["metrics"][f"std_{icr}_m"]["mean"] for one in result.records()]
        assert max(means) - min(means) < min(stated) / 2
        assert max(stated) < 1.05 * min(stated)


def test_x_icr_is_unbiased_at_the_lowest_rate_and_eulers_is_not() -> None:
    """Euler drives straight on for dt, which is an x_icr of -v dt/2: -0.05 m at 10 Hz and 1 m/s."""
    base = request("rate", 12, values=(10.0,))
    base = replace(base, plan=replace(base.plan, path=replace(base.plan.path, speed_mps=1.0)))
    result = run_study(replace(base, presets=("paper", "field")))
    assert abs(median(result, "error_x_icr_m", series="field")) < 0.006
    assert median(result, "error_x_icr_m", series="paper") == pytest.approx(-0.05, abs=0.01)


def test_a_proper_start_converges_and_an_unguarded_inverted_one_never() -> None:
    result = run_study(request("initial", 4, 30.0, values=(1.0, -1.0)))

    def share(guard: str, right: float, left: float) -> dict[str, Any]:
        return level(result, series=guard, start_y_icr_right_m=right, start_y_icr_left_m=left)

    for guard in ("no guard", "guard, printed derivatives", "guard, true derivatives"):
        assert share(guard, 1.0, -1.0)["converged"] >= 0.75
    assert share("no guard", -1.0, 1.0)["inverted"] == 1.0
    assert share("guard, printed derivatives", -1.0, 1.0)["inverted"] == 0.0


def test_where_the_model_holds_nees_and_nis_stay_in_their_bands() -> None:
    """The 99.9 % band: a right filter fails one in a thousand draws of seeds, and these are fixed."""
    runs = 60
    result = run_study(request("consistency", runs, 40.0, presets=()))
    model = level(result, series="model")
    assert model["nees"]["mean"] == pytest.approx(6.0, abs=3.3 * np.sqrt(12.0 / runs))
    for what, degrees in (("nis_gnss", 2), ("nis_heading", 1)):
        count = {"nis_gnss": 20, "nis_heading": 100}[what] * 40 * runs
        low, high = chdtri(degrees * count, [0.9995, 0.0005]) / count
        assert low < model[what]["mean"] < high
    assert min(model["coverage_pct"]) > 91.0
    assert max(np.abs(np.array(model["rms_error_over_std"]) - 1.0)) < 0.15


def test_the_papers_constants_are_shown_to_be_loose() -> None:
    result = run_study(request("consistency", 20, 40.0, presets=("paper",)))
    paper = level(result, series="paper")
    assert paper["by_run"]["nis_gnss"]["p50"] < 1.8
    assert paper["by_run"]["nees"]["p50"] < 4.0


def test_the_chi_squared_band_is_the_textbooks() -> None:
    # Bar-Shalom, Li, Kirubarajan 2001, Section 5.4.2: 50 runs of NEES of 2 degrees: 1.48 to 2.59
    low, high = chi2_band(100, 50)
    assert (low, high) == pytest.approx((1.48, 2.59), abs=0.01)


@pytest.mark.parametrize(("runs", "accuracy"), [(1, 0.03), (10, 1e-3), (1000, 1e-6)])
def test_the_chi_squared_band_is_that_of_scipy(runs: int, accuracy: float) -> None:
    assert chi2_band(6 * runs, runs) == pytest.approx(chdtri(6 * runs, [0.975, 0.025]) / runs, rel=accuracy)


def test_errors_over_std_of_a_known_gaussian_are_chi_squared() -> None:
    rng = np.random.default_rng(5)
    A = np.diag([1.0, 2.0, 0.01, 0.1, 0.1, 0.2]) @ (np.eye(6) + 0.3 * rng.normal(size=(6, 6)))
    P = A @ A.T
    nees, ratio = errors_over_std(rng.normal(size=(4000, 6)) @ A.T, np.broadcast_to(P, (4000, 6, 6)))
    assert nees.mean() == pytest.approx(6.0, abs=0.2)
    np.testing.assert_allclose(ratio.std(axis=0), 1.0, atol=0.05)


def test_a_ramp_rises_and_settles_when_it_should() -> None:
    t = np.arange(0, 11.0, 0.01)
    value = np.minimum(t / 10.0, 1.0)
    assert convergence_time(t, value, 1.0) == pytest.approx(8.0, abs=0.011)
    assert settling_time(t, value, 1.0) == pytest.approx(9.0, abs=0.011)


def test_what_never_arrives_has_no_time() -> None:
    t = np.arange(0, 10.0, 0.1)
    value = np.vstack([0.5 * t / 10.0, np.full(100, np.nan), np.where(t < 9.9, 1.0, 0.0)])
    value[:, 0] = 0.0
    assert np.isnan([convergence_time(t, one, 1.0) for one in value[:2]]).all()
    assert np.isnan([settling_time(t, one, 1.0) for one in value]).all()


def test_an_estimate_that_starts_on_the_truth_has_settled_at_once() -> None:
    t = np.arange(0, 5.0, 0.1)
    assert settling_time(t, np.full(50, 0.7), 0.7) == 0.0


def test_statistics_pass_over_what_is_missing() -> None:
    told = statistics(np.array([1.0, 2.0, 3.0, np.nan]))
    assert (told["count"], told["mean"], told["p50"]) == (3, 2.0, 2.0)
    assert statistics(np.array([np.nan]))["count"] == 0


@pytest.mark.parametrize(
    ("change", "words"), [({"runs": 0}, "runs: 0 is not"), ({"values": (float("nan"),)}, "values: ")]
)
def test_a_study_that_cannot_be_done_is_refused(change: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError) as refused:
        run_study(replace(default_request("rate", Config()), **change))
    assert str(refused.value).startswith(words)


def test_the_start_of_preset_field_is_the_robots() -> None:
    assert default_request("rate", Config()).config.robot.track_width_m == 0.51
    husky = default_request("rate", load_config(robot="husky-a200"))
    assert husky.config.robot.track_width_m == 0.555


@pytest.mark.parametrize("seconds", [5.0, 20.0])
def test_from_its_start_the_filter_knows_robots_as_well_as_it_states(seconds: float) -> None:
    """NEES of the ICRs of robots that differ as robots do, from wheels that roll to factors of 2.8.

    3 is expected where the model holds. The sensors here are better than preset ``field`` takes them to be, so that the
    mean is below it; 99.9 % of right filters have less than the limits.
    """
    rng, runs = np.random.default_rng(4), 24
    base = request("consistency", 1, seconds, presets=("field",))
    half, nees = float(base.config.robot.track_width_m or 0.0) / 2, []
    for seed in range(runs):
        right, left = rng.uniform(1.0, 2.8, 2) * half
        plan = replace(base.plan, icrs_m=(right, -left, 0.4 * half * rng.standard_normal()), path=PathPlan("curved"))
        sensors = replace(base.sensors, input_noise_mps=0.05)
        found = study_runs._filter_run(study_runs.Scenario(plan, sensors, base.config), 0, seed)
        error = (found.x[-1] - found.truth[-1])[3:]
        nees.append(float(error @ np.linalg.solve(found.P[-1][3:, 3:], error)))
    assert np.mean(nees) < chdtri(3 * runs, 0.001) / runs
    assert np.max(nees) < chdtri(3, 0.001 / runs)
