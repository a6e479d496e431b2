"""Robust statistics against closed forms, scipy and the spread over seeds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares

from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.elimination import Parts
from icrtool.kernels.robust import (
    LOSS_SIGMAS,
    Linearised,
    RobustFit,
    long_run_factor,
    mad_std,
    median_in_place,
    robust_least_squares,
    robust_weights,
    sandwich_covariance,
    soft_l1_weights,
    student_covariance,
)

TRUTH = np.array([1.5, -0.7])


def bent_line(rng: np.random.Generator, m: int = 400, outliers: float = 0.0) -> tuple[Floats, Floats]:
    """Return t and y = a t + exp(b t) with noise 0.1 and a share of outliers."""
    t = rng.uniform(0.0, 2.0, m)
    y = TRUTH[0] * t + np.exp(TRUTH[1] * t) + rng.normal(0.0, 0.1, m)
    y[rng.random(m) < outliers] += 5.0
    return t, y


def residuals_of(t: Floats, y: Floats, x: Floats) -> tuple[Floats, Floats]:
    bent = np.exp(x[1] * t)
    return x[0] * t + bent - y, np.column_stack([t, t * bent])


START, NO_PRIOR = np.array([1.0, -0.3]), np.full(2, np.inf)


def fitted(data: tuple[Floats, Floats], **options: Any) -> RobustFit:
    return robust_least_squares(lambda x: residuals_of(*data, x), START, START, NO_PRIOR, **options)


def std_of(found: RobustFit, group: Ints | None = None) -> Floats:
    """Return standard deviations (k,); by default each residual is independent."""
    group = np.arange(len(found.residuals)) if group is None else group
    return np.asarray(np.sqrt(np.diag(sandwich_covariance(found, group))))


@pytest.mark.parametrize("count", [1, 2, 3, 10, 301, 1000])
def test_the_median_of_fits_is_numpys(count: int) -> None:
    rng = np.random.default_rng(count)
    for special in ((), (np.nan,), (np.inf,), (-np.inf, np.inf)):
        for _ in range(20):
            values = np.round(rng.normal(size=count), 1) * 10.0 ** rng.uniform(-150.0, 150.0)
            values[rng.integers(0, count, len(special))] = special
            with np.errstate(invalid="ignore"):
                expected, found = np.median(values), median_in_place(values.copy())
            np.testing.assert_array_equal(found, expected)


def test_mad_std_is_the_standard_deviation_of_normal_values_and_ignores_outliers() -> None:
    values = np.random.default_rng(0).normal(3.0, 2.0, 20_001)
    values[:1000] = 1e6
    assert mad_std(values[1000:]) == pytest.approx(2.0, rel=0.03)
    assert mad_std(values) == pytest.approx(2.0, rel=0.1)
    assert mad_std(np.array([1.0, 2.0, 3.0]), 0.0) == pytest.approx(2.0 * 1.4826)
    assert np.isnan(mad_std(np.empty(0)))


def test_weights_are_one_at_zero_and_fall_as_one_over_the_residual() -> None:
    z = np.array([0.0, 1e6, -1e6])
    np.testing.assert_allclose(soft_l1_weights(z), [1.0, LOSS_SIGMAS / 1e6, LOSS_SIGMAS / 1e6], rtol=1e-9)


def test_the_minimum_is_that_of_scipy() -> None:
    t, y = bent_line(np.random.default_rng(1), outliers=0.1)
    found = fitted((t, y), most_steps=50)
    scale = float(found.scale[0])
    theirs = least_squares(
        lambda x: residuals_of(t, y, x)[0] / scale, TRUTH, loss="soft_l1", f_scale=LOSS_SIGMAS, xtol=1e-12, ftol=1e-12
    ).x
    # the weights may lag the last step
    np.testing.assert_allclose(found.x, theirs, atol=0.05 * float(std_of(found).min()))


def test_outliers_move_the_estimate_by_less_than_its_noise() -> None:
    clean, dirty = bent_line(np.random.default_rng(2)), bent_line(np.random.default_rng(2), outliers=0.05)
    plain, robust = fitted(clean), fitted(dirty)
    assert np.all(np.abs(plain.x - TRUTH) < 3.5 * std_of(plain))
    assert np.all(np.abs(robust.x - TRUTH) < 3.5 * std_of(robust))


def test_the_prior_decides_what_the_data_do_not_show() -> None:
    rng = np.random.default_rng(3)
    y = 2.0 + rng.normal(0.0, 0.1, 100)

    def evaluate(x: Floats) -> tuple[Floats, Floats]:
        return x[0] - y, np.column_stack([np.ones(100), np.zeros(100)])

    found = robust_least_squares(evaluate, np.zeros(2), np.array([0.0, 7.0]), np.array([10.0, 0.3]))
    assert found.x == pytest.approx([2.0, 7.0], abs=0.05)
    assert std_of(found)[1] == pytest.approx(0.3)


def test_each_kind_of_residual_has_its_own_scale() -> None:
    rng = np.random.default_rng(4)
    kind = np.repeat([0, 1], 500)
    y = np.where(kind == 0, rng.normal(1.0, 0.01, 1000), rng.normal(3.0, 10.0, 1000))
    found = robust_least_squares(
        lambda x: (x[0] - y, np.ones((1000, 1))), np.zeros(1), np.zeros(1), np.full(1, np.inf), kind=kind
    )
    assert found.x[0] == pytest.approx(1.0, abs=0.003)


@pytest.mark.parametrize("members", [1, 20])
def test_the_covariance_holds_where_members_of_a_group_repeat_one_another(members: int) -> None:
    inside, seeds, independent = 0, 200, 30
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        t, y = (np.repeat(column, members) for column in bent_line(rng, independent))
        group = np.repeat(np.arange(independent), members)
        found = fitted((t, y), overlap=members)
        inside += int(np.count_nonzero(np.abs(found.x - TRUTH) < 2.0 * std_of(found, group)))
    assert 0.90 < inside / (2 * seeds) < 0.99


def test_the_long_run_factor_gives_the_spread_of_the_mean_of_correlated_values() -> None:
    """Witness: the spread of the sums of many series of the same first-order process."""
    rng, rho, count = np.random.default_rng(3), 0.7, 60
    pushes = rng.normal(size=(4000, count + 100))
    series = np.zeros_like(pushes)
    for k in range(1, pushes.shape[1]):
        series[:, k] = rho * series[:, k - 1] + pushes[:, k]
    series = series[:, 100:]
    true = series.sum(axis=1).var() / (series**2).sum(axis=1).mean()
    found = np.median([long_run_factor(one[:, None])[0] for one in series[:300]])
    assert 0.8 * true < found < 2.0 * true
    white = np.median([long_run_factor(rng.normal(size=(count, 1)))[0] for _ in range(300)])
    assert 1.0 <= white < 1.6


def test_weights_that_differ_by_hundreds_of_decades_leave_variances() -> None:
    """Windows before a clock was set by an hour are forgotten: their weight is 1e-294."""
    rng = np.random.default_rng(0)
    jacobian = rng.standard_normal((30, 3))
    jacobian[5:, 0] = 0.0
    scale = np.where(np.arange(30) < 5, 1e147, 1.0)
    for pull in (np.full(3, 1.0), np.full(3, 1e-200)):
        residuals = rng.standard_normal(30)
        one = Linearised(residuals=residuals, jacobian=jacobian, scale=scale, prior=np.diag(pull))
        assert (np.diag(sandwich_covariance(one, np.arange(30) // 5)) > 0.0).all()


def test_parts_with_parameters_of_their_own_give_what_the_dense_jacobian_gives() -> None:
    """Witness: the same problem with every part's own parameters as parameters of all, zeros in between."""
    rng = np.random.default_rng(6)
    first, shared, own = np.array([0, 40, 130, 180]), 3, 2
    part = np.repeat(np.arange(3), np.diff(first))
    x = rng.normal(0.0, 1.0, shared + 3 * own)
    design = rng.normal(0.0, 1.0, (180, shared + own))
    dense = np.zeros((180, len(x)))
    dense[:, :shared] = design[:, :shared]
    for i in range(3):
        columns = slice(shared + own * i, shared + own * (i + 1))
        dense[part == i, columns] = design[part == i, shared:]
    y = np.sinh(0.3 * dense @ x) + 0.1 * rng.standard_t(3, 180)

    def evaluate(x: Floats, jacobian: Floats) -> tuple[Floats, Floats]:
        return np.sinh(0.3 * dense @ x) - y, jacobian * (0.3 * np.cosh(0.3 * dense @ x))[:, None]

    start, mean, std = x + 0.2, np.zeros(len(x)), rng.uniform(0.5, 2.0, len(x))
    group = np.arange(180) // 5
    one, other = (
        robust_least_squares(
            lambda x, jacobian=jacobian: evaluate(x, jacobian), start, mean, std, parts=parts, overlap=2.0
        )
        for jacobian, parts in ((design, Parts(first, own)), (dense, None))
    )
    np.testing.assert_allclose(one.x, other.x, rtol=1e-9)
    np.testing.assert_allclose(one.residuals, other.residuals, atol=1e-9)
    covariances = [sandwich_covariance(found, group)[:shared, :shared] for found in (one, other)]
    np.testing.assert_allclose(*covariances, rtol=1e-6)
    inverse = np.linalg.inv(other.information)[:shared, :shared]
    np.testing.assert_allclose(np.linalg.inv(one.information), inverse, rtol=1e-9)
    # what each part adds, and the prior, are all of the information and of the gradient
    weights = robust_weights(one.residuals, one.scale, 2.0)[:, None]
    of_parts = one.jacobian.T @ (weights * one.jacobian) + one.own_prior.sum(axis=0)
    np.testing.assert_allclose(one.information, of_parts + np.diag(std[:shared] ** -2.0), rtol=1e-9)
    gradient = one.jacobian.T @ (weights[:, 0] * one.residuals) + one.own_prior_gradient.sum(axis=0)
    assert np.all(np.abs(gradient + one.x[:shared] / std[:shared] ** 2) < 0.05 * np.sqrt(np.diag(one.information)))


def test_groups_that_differ_are_covered_where_they_are_few() -> None:
    """Three stretches with means of their own: their spread alone is too often small, the expected one holds it up."""
    rng, size, spread = np.random.default_rng(1), 40, 0.3
    groups = np.repeat(np.arange(3), size)
    z: dict[float | None, list[float]] = {None: [], spread: []}
    for _ in range(400):
        values = rng.normal(0.0, spread, 3)[groups] + rng.normal(0.0, 0.1, 3 * size)
        for expected, errors in z.items():
            residuals = values.mean() - values
            one = Linearised(
                residuals=residuals, jacobian=np.ones((len(groups), 1)), scale=np.full(len(groups), spread),
                prior=np.array([[1e-6]]),
            )  # fmt: skip
            covariance = sandwich_covariance(one, groups, None if expected is None else np.array([expected]))
            errors.append(abs(values.mean()) / np.sqrt(covariance[0, 0]))
    covered = {expected: np.mean(np.array(errors) < 2.0) for expected, errors in z.items()}
    assert covered[None] < 0.88
    assert 0.88 < covered[spread] < 0.99


@pytest.mark.parametrize(("count", "together"), [(3, 0.3), (12, 0.3), (12, -0.3)])
def test_two_standard_deviations_of_few_groups_hold(count: int, together: float) -> None:
    """Residuals of a group that are alike, or that cancel one another: their number alone gives neither variance."""
    rng, size, draws = np.random.default_rng(2), 6, 400
    groups = np.repeat(np.arange(count), size)
    alike = np.linalg.cholesky(np.eye(size) * (1.0 - together * 0.6) + together * 0.6)
    inside = 0
    for _ in range(draws):
        values = (rng.normal(0.0, 0.1, (count, size)) @ alike.T).ravel()
        zero, ones = np.zeros(1), np.ones((len(values), 1))
        found = robust_least_squares(
            lambda x, values=values, ones=ones: (x - values, ones), zero, zero, np.full(1, 1e3)
        )
        inside += abs(found.x[0]) < 2.0 * np.sqrt(student_covariance(found, [groups])[0, 0])
    assert 0.90 < inside / draws < 0.985
