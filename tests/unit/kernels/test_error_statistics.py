from __future__ import annotations

import math
from copy import deepcopy
from functools import cache

import numpy as np
import pytest
from scipy.special import stdtrit

from icrtool.kernels.error_statistics import (
    PRIOR_FREEDOM,
    RankedTrials,
    Spread,
    between_variance,
    block_sums,
    cut_blocks,
    error_intervals,
    error_summary,
    pooled_variance,
    round_bin_width,
    student_factor,
)

STATES_PER_M = 40  # of the drives made here
STEADY = Spread(0.0, 0.3, 0.5, 0.6)
"""What drives along steady noise have, as `errors_along` makes them: 0.43 to 0.50 for paths of 6 to 60 horizons."""

WANDERING = Spread(0.0, 0.3, 1.1, 0.6)
"""The same where the noise wanders over four horizons: 0.95 to 1.20."""

OF_THE_WIDTH = 0.3  # other trials and blocks, against the width of the interval
BINOMIAL_STD = math.sqrt(0.95 * 0.05 / 300)


def errors_along(path_blocks, rng, wander_m=0.0):
    """Errors as overlapping windows of one metre make them: the length of a moving sum of two independent noises.

    `wander_m`: the noise changes linearly between independent values so far apart; 0: from state to state.
    """
    n = STATES_PER_M * path_blocks
    if wander_m:
        path = np.arange(n + STATES_PER_M) / STATES_PER_M
        knots = np.arange(0.0, path[-1] + wander_m, wander_m)
        noise = np.array([np.interp(path, knots, rng.normal(size=len(knots))) for _ in range(2)])
    else:
        noise = rng.normal(size=(2, n + STATES_PER_M))
    walks = np.cumsum(noise, axis=1)
    errors = np.hypot(*(walks[:, STATES_PER_M:] - walks[:, :-STATES_PER_M])) / math.sqrt(STATES_PER_M)
    return errors, np.arange(n) / STATES_PER_M


def interval_of(errors, path, horizon=1.0, spread=STEADY):
    blocks, ranked = cut_blocks(~np.isnan(errors), path, horizon), RankedTrials.from_errors(errors)
    _, _, p50, p95, _ = ranked.summary()
    return error_intervals(errors, blocks, block_sums(errors, blocks, ranked, p50, p95), p50, p95, spread)


class TestSummary:
    def test_equals_numpy_on_the_trials_alone(self):
        rng = np.random.default_rng(0)
        errors = rng.exponential(size=(1003, 4))
        errors[rng.random(errors.shape) < 0.1] = np.nan
        summary = error_summary(errors)
        np.testing.assert_array_equal(summary.trials, np.isfinite(errors).sum(axis=0))
        for column, expected in [
            (summary.expected, np.nanmean(errors, axis=0)),
            (summary.p50, np.nanpercentile(errors, 50, axis=0)),
            (summary.p95, np.nanpercentile(errors, 95, axis=0)),
            (summary.largest, np.nanmax(errors, axis=0)),
        ]:
            np.testing.assert_allclose(column, expected, rtol=1e-14)  # another order of adding

    @pytest.mark.parametrize("scale", [0.0, 1e-300, 1.0, 1e300])
    def test_any_quantile_equals_numpys_whatever_the_errors(self, scale):
        rng = np.random.default_rng(1)
        errors = scale * np.floor(20.0 * rng.exponential(size=500))  # many alike
        for some in (errors, np.append(errors, 1e6 * scale), errors[:1], errors[:2]):
            ranked = RankedTrials.from_errors(some)
            for share in (0.0, 0.05, 0.5, 0.95, 1.0, *rng.random(9)):
                assert ranked.quantile(share) == pytest.approx(np.quantile(some, share), rel=1e-14, abs=0.0)

    def test_of_no_trial_is_nan_and_of_one_is_that_trial(self):
        summary = error_summary(np.array([[np.nan, 2.0], [np.nan, np.nan]]))
        assert summary.trials.tolist() == [0, 1]
        np.testing.assert_array_equal(np.stack(summary[1:]), [[np.nan, 2.0]] * 4)

    def test_of_no_state_is_nan(self):
        assert np.isnan(error_summary(np.empty((0, 3))).p95).all()


@cache
def long_drive() -> tuple[tuple[float, float], np.random.Generator]:
    """Mean and p95 of the errors of 40,000 horizons of slip that wanders over four, and what drew them."""
    rng = np.random.default_rng(8)
    errors, _ = errors_along(40_000, rng, 4.0)
    return (float(errors.mean()), float(np.quantile(errors, 0.95))), rng


class TestIntervals:
    @pytest.mark.parametrize("horizons", [12, 20, 60])
    def test_hold_the_truth_as_often_as_they_say(self, horizons):
        rng = np.random.default_rng(5)
        truth = math.sqrt(math.pi / 2), math.sqrt(-2.0 * math.log(0.05))  # mean and p95 of a Rayleigh variable
        covered = np.zeros(2)
        for _ in range(300):
            interval = interval_of(*errors_along(horizons, rng))
            covered += [interval[0] <= truth[0] <= interval[1], interval[2] <= truth[1] <= interval[3]]
        assert (covered / 300 > 0.95 - 4 * BINOMIAL_STD).all()
        assert (covered / 300 <= 1.0).all()

    @pytest.mark.parametrize(("horizons", "least"), [(6, 0.86), (20, 0.88), (60, 0.90)])
    def test_hold_as_often_where_slip_wanders_over_four_horizons(self, horizons, least):
        (mean, p95), rng = deepcopy(long_drive())
        covered = np.zeros(2)
        for _ in range(300):
            found = interval_of(*errors_along(horizons, rng, 4.0), spread=WANDERING)
            covered += [
                found.expected_low <= mean <= found.expected_high,
                found.p95_low <= p95 <= found.p95_high,
            ]
        assert (covered / 300 > least).all()

    @pytest.mark.parametrize("horizons", [8, 12, 40])
    def test_of_the_next_drive_hold_its_p95_in_nine_of_ten(self, horizons):
        """Truth: a second drive of the same length whose errors are larger or smaller by a factor drawn anew."""
        rng = np.random.default_rng(9)
        held = 0
        for _ in range(400):
            found = interval_of(*errors_along(horizons, rng, 4.0), spread=WANDERING)
            after, _ = errors_along(horizons, rng, 4.0)
            held += (
                found.p95_next_low <= np.quantile(after, 0.95) * math.exp(rng.normal(0.0, 0.3)) <= found.p95_next_high
            )
        assert 0.85 <= held / 400 <= 0.97

    def test_are_possible_whatever_the_blocks(self):
        """The interval of p95 does not go below the median, nor above the interval of the next drive."""
        rng = np.random.default_rng(12)
        for _ in range(200):
            errors, path = errors_along(int(rng.integers(2, 40)), rng, 4.0)
            errors[rng.integers(len(errors)) :] *= 10.0 ** rng.uniform(
                -2.0, 2.0
            )  # one block has nearly all of the error
            found = interval_of(errors, path, spread=WANDERING)
            p50, p95 = np.quantile(errors, [0.5, 0.95])
            assert p50 <= found.p95_low <= p95 <= found.p95_high <= max(found.p95_next_high, p95)
            assert found.p95_next_low <= found.p95_next_high

    @pytest.mark.parametrize(("freedom", "tolerance"), [(2.0, 0.01), (4.0, 1e-3), (9.0, 1e-4), (1e6, 1e-5)])
    def test_have_the_width_of_students_distribution(self, freedom, tolerance):
        assert student_factor(freedom) == pytest.approx(stdtrit(freedom, 0.975), rel=tolerance)

    def test_narrow_as_the_path_grows(self):
        rng = np.random.default_rng(6)
        widths = []
        for horizons in (20, 80, 320):
            of_length = np.array([interval_of(*errors_along(horizons, rng))[:4] for _ in range(20)])
            widths.append(np.median(of_length[:, 1::2] / of_length[:, ::2] - 1.0, axis=0))
        np.testing.assert_array_less(widths[1:], np.array(widths[:2]) / 1.4)  # a half of each, were all else equal

    def test_treating_trials_as_independent_would_be_far_too_sure(self):
        errors, path = errors_along(200, np.random.default_rng(6))
        low, high, *_ = interval_of(errors, path)
        assert high - low > 3.0 * 2 * 1.96 * errors.std() / math.sqrt(len(errors))

    def test_grow_with_the_errors(self):
        errors, path = errors_along(40, np.random.default_rng(7))
        np.testing.assert_allclose(interval_of(3.0 * errors, path), 3.0 * np.array(interval_of(errors, path)))

    def test_path_without_trials_and_standstill_change_little(self):
        errors, path = errors_along(100, np.random.default_rng(10))
        plain = np.array(interval_of(errors, path))[:4]
        path[2000:] += 300.0  # driven without a reference
        errors, path = np.insert(errors, 2000, [np.nan] * 50), np.insert(path, 2000, np.linspace(50.0, 350.0, 50))
        apart = np.array(interval_of(errors, path))[:4]
        np.testing.assert_array_less(np.abs(apart - plain), OF_THE_WIDTH * (plain[1::2] - plain[::2]).repeat(2))

    def test_of_a_path_too_short_for_blocks_are_those_of_other_drives(self):
        """Closed form: normal logarithms, Student's t with the degrees of freedom of what is known of other drives."""
        errors, path = errors_along(4, np.random.default_rng(11))
        found, p95 = interval_of(errors, path), np.quantile(errors, 0.95)
        std = STEADY.horizon_std / math.sqrt(5.0)
        assert math.log(found.p95_high / p95) == pytest.approx(stdtrit(PRIOR_FREEDOM, 0.975) * std + std**2, rel=0.01)
        of_next = math.sqrt(2.0 * std**2 + STEADY.between**2)
        assert math.log(found.p95_next_high / p95) == pytest.approx(stdtrit(PRIOR_FREEDOM, 0.95) * of_next, rel=0.01)

    @pytest.mark.parametrize("errors", [np.empty(0), np.full(9, np.nan)])
    def test_of_no_trial_are_not_available(self, errors):
        assert np.isnan(interval_of(errors, np.zeros(len(errors)))).all()

    def test_of_a_perfect_model_are_zero(self):
        assert interval_of(np.zeros(2000), np.arange(2000) / 100.0) == (0.0,) * 6


class TestHistogram:
    def test_is_percent_of_the_trials_per_bin(self):
        errors = np.array([0.0, 0.05, 0.1, 0.25, np.nan, 0.31])
        bins = RankedTrials.from_errors(errors).histogram(0.1)
        np.testing.assert_allclose(bins.left, [0.0, 0.1, 0.2, 0.3])
        np.testing.assert_allclose(bins.right, [0.1, 0.2, 0.3, 0.4])
        np.testing.assert_allclose(bins.percent, [40.0, 20.0, 20.0, 20.0])

    def test_of_no_trial_is_empty(self):
        assert len(RankedTrials.from_errors(np.array([np.nan])).histogram(0.1).percent) == 0

    @pytest.mark.parametrize(
        ("largest", "width"), [(0.0, 0.01), (math.nan, 0.01), (0.5, 0.01), (0.51, 0.02), (12.0, 0.5), (49.0, 1.0)]
    )
    def test_bin_width_is_round_and_fifty_bins_reach_the_largest(self, largest, width):
        assert round_bin_width(largest) == pytest.approx(width)

    def test_expected_error_is_the_mean_of_the_histogram_as_bins_narrow(self):
        errors = np.random.default_rng(0).exponential(size=5000)
        bins = RankedTrials.from_errors(errors).histogram(0.001)
        middle = 0.5 * (bins.left + bins.right)
        assert np.sum(middle * bins.percent) / 100.0 == pytest.approx(errors.mean(), abs=0.0005)


class TestBetweenVariance:
    def test_of_values_that_differ_by_their_own_deviation_is_near_zero(self):
        rng = np.random.default_rng(1)
        found = [between_variance(rng.normal(0.0, 0.1, 8), np.full(8, 0.01)) for _ in range(400)]
        assert np.mean(found) < 0.004

    def test_is_found_on_average(self):
        rng = np.random.default_rng(2)
        found = []
        for _ in range(400):
            variances = rng.uniform(0.5, 2.0, 10) * 0.01
            found.append(between_variance(rng.normal(0.0, 0.3, 10) + rng.normal(0.0, np.sqrt(variances)), variances))
        assert np.mean(found) == pytest.approx(0.09, rel=0.08)

    def test_of_equal_variances_is_the_closed_form(self):
        values, variance = np.array([1.0, 2.0, 4.0]), 0.2
        expected = values.var(ddof=1) - variance
        assert between_variance(values, np.full(3, variance)) == pytest.approx(expected)

    def test_pools_with_what_is_known_by_degrees_of_freedom(self):
        assert pooled_variance(4.0, 0.0, 1.0) == (1.0, PRIOR_FREEDOM)
        assert pooled_variance(4.0, PRIOR_FREEDOM, 1.0)[0] == pytest.approx(2.5)
