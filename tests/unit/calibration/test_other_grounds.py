"""A ground that a calibration was not fitted to: each group of recordings left out, and what a report states of it."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec import UNSET
from msgspec.structs import replace

from icrtool.calibration.other_grounds import (
    GROUND_HORIZONS_M,
    leave_grounds_out,
    other_ground_ends,
)
from icrtool.calibration.pooled import calibrate_recordings, predictor
from icrtool.dropout_analysis.report_document import with_other_grounds
from icrtool.kernels.error_statistics import PRIOR_FREEDOM, ground_interval
from icrtool.motion.recording import Recording, cut_trials
from icrtool.records.acceptance import BudgetDistance
from icrtool.records.calibration_document import GroundScore
from icrtool.records.dropout_document import UsedCalibration
from support.recordings import THREE_ICRS, make_recording

GROUNDS = ("grass", "grass", "gravel", "mud")
ROUNDING_M = 1e-9


def of_ground(turn_gain: float, seed: int) -> Recording:
    parameters = THREE_ICRS.prior_mean.copy()
    parameters[THREE_ICRS.terms.index("omega_w")] *= turn_gain
    return make_recording(THREE_ICRS, parameters, seed, 200.0, name=f"log{seed}")


@pytest.fixture(scope="module")
def recordings() -> list[Recording]:
    return [of_ground(gain, seed) for seed, gain in enumerate((1.0, 1.01, 0.8, 1.2))]


@pytest.fixture(scope="module")
def scores(recordings: list[Recording]) -> tuple[GroundScore, ...]:
    return leave_grounds_out(recordings, GROUNDS)


def test_each_ground_is_predicted_by_a_calibration_of_the_others(
    recordings: list[Recording], scores: tuple[GroundScore, ...]
) -> None:
    assert {one.ground for one in scores} == {"grass", "gravel", "mud"}
    assert {one.horizon_m for one in scores} == set(GROUND_HORIZONS_M)
    others = calibrate_recordings(recordings[2:]).calibration
    errors = [predictor(others, one)(cut_trials(one, (10.0,))).position[:, 0] for one in recordings[:2]]
    expected = np.nanpercentile(np.concatenate(errors), 95)
    (found,) = (one for one in scores if (one.model, one.ground, one.horizon_m) == ("recommended", "grass", 10.0))
    assert found.p95_m == pytest.approx(expected, rel=0.02)  # the percentile's rank between two trials


def test_what_adapts_comes_nearer_on_a_ground_that_differs(scores: tuple[GroundScore, ...]) -> None:
    on_mud = {one.model: one.expected_m for one in scores if one.ground == "mud" and one.horizon_m == 10.0}
    assert on_mud["adaptive"] < 0.7 * on_mud["recommended"]


def test_one_ground_shows_nothing_of_another(recordings: list[Recording]) -> None:
    assert leave_grounds_out(recordings[:2], ("grass", "grass")) == ()
    calibration = calibrate_recordings(recordings[:2], grounds=("grass", "grass")).calibration
    assert calibration.other_grounds is UNSET
    assert [log.ground for log in calibration.logs] == ["grass", "grass"]


def test_the_interval_of_a_further_ground_holds_it_in_nine_of_ten() -> None:
    """Robots whose variance between grounds is drawn from what is known of robots: with 6 degrees of freedom."""
    rng = np.random.default_rng(5)
    held = []
    for _ in range(4000):
        std = 0.6 * np.sqrt(PRIOR_FREEDOM / rng.chisquare(PRIOR_FREEDOM))
        *known, further = np.exp(rng.normal(-1.0, std, 4))
        low, high = ground_interval(np.array(known), 0.6)
        held.append(low <= further <= high)
    assert np.mean(held) == pytest.approx(0.90, abs=0.02)


def test_grounds_that_differ_more_give_a_wider_interval_than_other_robots() -> None:
    alike, apart = ground_interval(np.array([0.3, 0.3]), 0.6), ground_interval(np.array([0.1, 0.9]), 0.6)
    assert alike[0] * alike[1] == pytest.approx(apart[0] * apart[1])
    assert apart[1] / apart[0] > alike[1] / alike[0]


def test_a_budget_is_kept_between_the_ends_of_the_interval() -> None:
    scores = [
        GroundScore("adaptive", metres, 0.05 * metres * factor, 0.02 * metres, ground)
        for metres in GROUND_HORIZONS_M
        for ground, factor in (("grass", 0.8), ("gravel", 1.25))
    ]
    ends = other_ground_ends(scores, "adaptive", 0.5)
    assert ends is not None
    low, high = ends
    assert low is not None
    assert low < 10.0  # where 0.05 m a metre, the middle of both grounds, reaches the budget
    assert high is None or high > 10.0
    assert other_ground_ends(scores, "recommended", 0.5) is None
    assert other_ground_ends(scores[::2], "adaptive", 0.5) is None  # one ground


def test_a_report_answers_for_another_ground_where_the_calibration_has_grounds(
    recordings: list[Recording], scores: tuple[GroundScore, ...]
) -> None:
    calibration = calibrate_recordings(recordings[:3], grounds=GROUNDS[:3]).calibration
    assert calibration.other_grounds is not UNSET
    rows = [BudgetDistance(name, 0.5, 8.0, False, (5.0, 10.0)) for name in ("calibration", "adaptive", "recommended")]
    used = UsedCalibration("calibration", "recommended", 3, False, "", calibration=replace(calibration, models={}))
    found = with_other_grounds(rows, [used])
    assert [bool(one.other_text) for one in found] == [True, True, False]
    own = with_other_grounds(rows, [replace(used, fitted_to_this=True)])
    assert not any(one.other_text for one in own)
