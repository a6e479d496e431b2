"""Robust statistics and robust least squares: median absolute deviation, loss weights, Gauss-Newton with priors.

Residuals of overlapping windows are not independent. In comparison with the prior, `overlap` residuals count as one.
The covariance is computed from the spread between groups of residuals (a stretch of distance of one log), and not from
the spread between single residuals.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.elimination import Parts, eliminate, normal_equations

MAD_TO_STD = 1.4826
"""Ratio of the standard deviation to the median absolute deviation, for normal values."""

LOSS_SIGMAS = 2.0
"""Size of a residual at which the loss changes from square to linear, in robust standard deviations."""

SMALLEST_SCALE = 1e-5
"""Smallest robust standard deviation of residuals [m, rad]. No sensor is as exact. With a smaller value, the
information of exact data would exceed the information of a prior by 16 digits, and the covariance of parameters that
the data do not show would be a rounding error."""

LAST_STEP_SIGMAS = 0.03
"""Length of a Gauss-Newton step below which it is the last step, in standard deviations of all parameters together."""

MOST_HALVINGS = 6
"""Largest number of halvings of a Gauss-Newton step."""

FEWEST_CORRELATED_BLOCKS = 8
"""Smallest number of values from which a correlation between neighbours is estimated."""

LARGEST_CORRELATION = 0.9
"""Largest estimated correlation between neighbours."""


def mad_std(values: Floats, centre: float | None = None) -> float:
    """Return the robust standard deviation of values (m,): 1.4826 times their median absolute deviation.

    Parameters
    ----------
    values : (m,) values; they are not changed
    centre : value from which deviations are measured; default: the median. It is 0 for residuals

    Notes
    -----
    Hampel 1974. The result is NaN without values.
    """
    if not len(values):
        return float("nan")
    middle = median_in_place(values.copy()) if centre is None else centre
    return MAD_TO_STD * median_in_place(np.abs(values - middle))


def median_in_place(values: Floats) -> float:
    """Return the median of values (m,), which are reordered; NaN where one of them is NaN.

    For a few hundred values `np.median` takes four times as long, and fits call it thousands of times.
    """
    last, half = len(values) - 1, len(values) // 2
    first = half if len(values) % 2 else half - 1
    values.partition((first, half, last))  # NaN is sorted to the end
    if math.isnan(values[last]):
        return math.nan
    return float(values[half] if first == half else (values[first] + values[half]) / 2.0)


def soft_l1_loss(z: Floats) -> float:
    """Return the sum of the soft-L1 loss of residuals `z` (m,) in standard deviations; see `soft_l1_weights`."""
    return 2.0 * LOSS_SIGMAS**2 * float((np.sqrt(1.0 + (z / LOSS_SIGMAS) ** 2) - 1.0).sum())


def soft_l1_weights(z: Floats) -> Floats:
    """Return the weights (m,) of squared residuals that make the soft-L1 loss; `z` (m,) in standard deviations.

    Notes
    -----
    rho = 2 c^2 (sqrt(1 + (z/c)^2) - 1) with c = `LOSS_SIGMAS` (Charbonnier et al. 1997); the weight is rho'/(2 z).
    """
    weights: Floats = 1.0 / np.sqrt(1.0 + (z / LOSS_SIGMAS) ** 2)
    return weights


@dataclass(frozen=True, kw_only=True)
class Linearised:
    """A robust least squares problem to first order about its minimum: covariances are computed from it.

    Attributes
    ----------
    residuals, jacobian : (m,), (m, k) residuals and their derivatives
    scale : (m,) robust standard deviation of the kind of each residual
    prior : (k, k) information of the prior
    overlap : number of residuals that count as one independent residual
    """

    residuals: Floats
    jacobian: Floats
    scale: Floats
    prior: Floats
    overlap: float = 1.0

    @cached_property
    def weights(self) -> Floats:
        """Weights (m,) of the squared residuals."""
        return robust_weights(self.residuals, self.scale, self.overlap)

    @cached_property
    def data_information(self) -> Floats:
        """Gauss-Newton matrix (k, k) of the data, in which `overlap` residuals count as one."""
        return normal_equations(self.residuals, self.jacobian, self.weights)[0]

    @property
    def information(self) -> Floats:
        """Gauss-Newton matrix (k, k) of data and prior."""
        return self.data_information + self.prior

    def gradients(self, group: Ints) -> Floats:
        """Return the gradient (g, k) of the data of each group; `group` (m,) is the group of each residual."""
        order, first = _grouped(group)
        gradients: Floats = np.add.reduceat((self.jacobian * (self.weights * self.residuals)[:, None])[order], first)
        return gradients


@dataclass(frozen=True, kw_only=True)
class RobustFit(Linearised):
    """The minimum of a robust least squares problem with k shared parameters, and c own parameters of each of p parts.

    `jacobian` and `prior` are reduced to the shared parameters: the own parameters are eliminated (Schur complement,
    `icrtool.kernels.elimination`).

    Attributes
    ----------
    x : (k + p c,) the shared parameters, then the own parameters of part after part
    own_prior, own_prior_gradient : (p, k, k), (p, k) information and gradient by the priors of the own parameters of
        each part, which follow the shared parameters
    gain : (p, c, k) negative derivative of the own parameters of each part by the shared parameters
    """

    x: Floats
    own_prior: Floats
    own_prior_gradient: Floats
    gain: Floats


Evaluate = Callable[[Floats], tuple[Floats, Floats]]
"""Function that returns residuals (m,) and their Jacobian (m, k + c) for parameters (k + p c,)."""


def robust_least_squares(
    evaluate: Evaluate,
    start: Floats,
    prior_mean: Floats,
    prior_std: Floats,
    *,
    kind: Ints | None = None,
    parts: Parts | None = None,
    overlap: float = 1.0,
    most_steps: int = 15,
    settled: float = LAST_STEP_SIGMAS,
) -> RobustFit:
    """Return the minimum of a soft-L1 loss of residuals under a normal prior, by Gauss-Newton steps.

    Parameters
    ----------
    evaluate : returns residuals and Jacobian at some parameters
    start : (k + p c,) parameters at the first step
    prior_mean, prior_std : (k + p c,); an infinite standard deviation is no prior
    kind : (m,) kind of each residual; each kind has its own robust scale. Default: one kind
    parts : parts of the data with their own parameters; default: one part without own parameters
    overlap : number of residuals that count as one independent residual
    most_steps : largest number of steps
    settled : length of a step below which it is the last step, in standard deviations of all parameters together

    Notes
    -----
    Iteratively reweighted Gauss-Newton (Holland and Welsch 1977) with step halving; the scale follows the residuals.
    """
    x, prior_information = np.array(start, np.float64), np.asarray(prior_std, np.float64) ** -2.0
    residuals, jacobian = evaluate(x)
    parts = Parts(np.array([0, len(residuals)])) if parts is None else parts
    for _ in range(most_steps):
        scale = scale_by_kind(residuals, kind)
        weights = robust_weights(residuals, scale, overlap)
        step, decrease, _ = eliminate(residuals, jacobian, weights, parts, prior_information, x - prior_mean)
        if decrease < settled**2:
            # The residuals after a short step are computed to first order, without a further evaluation.
            x, residuals = x + step, residuals + parts.change(jacobian, step)
            break
        before = _cost(residuals / scale, overlap, prior_information, x - prior_mean)
        tried = evaluate(x + step)
        for _ in range(MOST_HALVINGS):
            after = _cost(tried[0] / scale, overlap, prior_information, x + step - prior_mean)
            if after <= before:
                break
            step = step / 2.0
            tried = evaluate(x + step)
        else:
            # No fraction of the step lowers the cost, so this Jacobian gives no better estimate.
            break
        x, (residuals, jacobian) = x + step, tried
        if before - after < settled**2:
            break
    scale = scale_by_kind(residuals, kind)
    solution = eliminate(
        residuals, jacobian, robust_weights(residuals, scale, overlap), parts, prior_information, x - prior_mean
    )
    jacobian = solution.reduced(jacobian, parts)
    k = jacobian.shape[1]
    own, away = (of_all[k:].reshape(solution.gain.shape[:2]) for of_all in (prior_information, x - prior_mean))
    own_prior = np.einsum("pck,pc,pcl->pkl", solution.gain, own, solution.gain)
    own_prior_gradient = -np.einsum("pck,pc->pk", solution.gain, own * away)
    prior = np.diag(prior_information[:k]) + own_prior.sum(axis=0)
    return RobustFit(
        residuals=residuals, jacobian=jacobian, scale=scale, prior=prior, overlap=overlap, x=x, own_prior=own_prior,
        own_prior_gradient=own_prior_gradient, gain=solution.gain,
    )  # fmt: skip


def robust_regression(
    columns: Floats, target: Floats, prior_std: Floats | None = None, overlap: float = 1.0
) -> RobustFit:
    """Return the robust fit of a target (m,) by columns (m, k), with a prior about zero (k,); default: no prior."""
    zero = np.zeros(columns.shape[1])
    std = np.full(len(zero), np.inf) if prior_std is None else prior_std
    return robust_least_squares(lambda x: (columns @ x - target, columns), zero, zero, std, overlap=overlap)


def scale_by_kind(residuals: Floats, kind: Ints | None = None) -> Floats:
    """Return the robust standard deviation about zero (m,) of the kind of each residual; default: one kind."""
    if kind is None:
        return np.full(len(residuals), max(mad_std(residuals, 0.0), SMALLEST_SCALE))
    scale = np.empty(len(residuals))
    # There are few kinds, numbered from zero, so that counting is faster than sorting.
    for number in np.flatnonzero(np.bincount(kind)):
        same_kind = kind == number
        scale[same_kind] = max(mad_std(residuals[same_kind], 0.0), SMALLEST_SCALE)
    return scale


def robust_weights(residuals: Floats, scale: Floats, overlap: float) -> Floats:
    """Return the weights (m,) of squared residuals: the weight of the loss, over `overlap` and the variance."""
    weights: Floats = soft_l1_weights(residuals / scale) / overlap / scale**2
    return weights


def sandwich_covariance(fit: Linearised, group: Ints, group_std: Floats | None = None) -> Floats:
    """Return the covariance (k, k) of a robust fit; no variance is below the one in the inverse information.

    Parameters
    ----------
    fit : the fit
    group : (m,) group of each residual; only residuals of one group depend on each other
    group_std : (k,) expected standard deviation of the parameters of a group about the common parameters, which counts
        as one further group; None: the spread comes from the groups alone

    Notes
    -----
    H^-1 (sum g g^T + P) H^-1 with g the gradient of a group, H the Gauss-Newton matrix and P the prior (White 1982;
    Liang and Zeger 1986 for groups, with their B / (B - 1)). Few groups show too little spread, so no variance is less
    than the variance in H^-1. If T is the covariance of the parameters of a group about the common parameters, and A
    its information, then its gradient has the covariance A T A. This is the spread that `group_std` predicts; it is
    averaged with the spread of the groups.
    """
    expected = None
    if group_std is not None:
        order, first = _grouped(group)
        group_matrices = [
            normal_equations(fit.residuals[rows], fit.jacobian[rows], fit.weights[rows])[0] * group_std
            for rows in np.split(order, first[1:])
        ]
        expected = np.sum([matrix @ matrix.T for matrix in group_matrices], axis=0)
    meat = _spread(fit.gradients(group), expected) + fit.prior
    inverse = np.linalg.inv(fit.information)
    sandwich = inverse @ meat @ inverse
    if not (np.diag(sandwich) > 0.0).all():
        # Weights that differ by hundreds of decades give rounding errors.
        sandwich = inverse
    # Exact data that do not separate the parameters have no finite covariance.
    with np.errstate(over="ignore", invalid="ignore"):
        grown = np.sqrt(np.maximum(1.0, np.diag(inverse) / np.maximum(np.diag(sandwich), 1e-300)))
        covariance: Floats = sandwich * np.outer(grown, grown)
    return (covariance + covariance.T) / 2.0


def _spread(gradients: Floats, expected: Floats | None) -> Floats:
    """Return the variance (k, k) of the sum of independent gradients (g, k).

    An expected variance (k, k) counts as one further gradient.
    """
    count = len(gradients)
    shown: Floats = gradients.T @ gradients * (count / max(count - 1, 1))
    return shown if expected is None else (count * shown + expected) / (count + 1)


def _grouped(group: Ints) -> tuple[Ints, Ints]:
    """Return the rows (m,) in the order of their groups, and the index of the first row of each group (g,)."""
    order = np.argsort(group, kind="stable")
    return order, np.flatnonzero(np.diff(group[order], prepend=group[order[:1]] - 1))


def correlated_covariance(fit: Linearised, group: Ints) -> Floats:
    """Return the covariance (k, k) of a robust fit whose residuals stay correlated beyond a group.

    Parameters
    ----------
    fit : the fit
    group : (m,) stretch of each residual, in order of distance

    Notes
    -----
    The result is `sandwich_covariance` times `long_run_factor`. The series for this factor is the influence of the
    groups on each parameter, in order of distance.
    """
    covariance = sandwich_covariance(fit, group)
    inverse = np.linalg.inv(fit.information)
    series = fit.gradients(group) @ inverse
    prior_variance = np.einsum("ij,j,ij->i", inverse, np.diag(fit.prior), inverse)
    square = (series**2).sum(axis=0)
    data = np.diag(covariance)
    is_shown = data > 0.0
    grown = np.ones(len(data))
    grown[is_shown] = np.maximum(1.0, ((square * long_run_factor(series) + prior_variance)[is_shown] / data[is_shown]))
    size = np.sqrt(grown)
    return np.asarray(covariance * np.outer(size, size), np.float64)


def student_covariance(fit: Linearised, levels: Sequence[Ints]) -> Floats:
    """Return the covariance (k, k) of a robust fit, widened for few groups.

    With it, +-2 standard deviations contain the parameter with a probability of 95.4 %.

    Parameters
    ----------
    fit : the fit
    levels : group of each residual (m,): first independent groups, then larger groups of these; each level has two
        groups or more

    Notes
    -----
    The variance of the gradient is first computed for independent residuals with an overlap. At each level it becomes
    the spread between the groups; the variance of the level below counts as one further group. The spread is an
    estimate, too, so it is multiplied by Student's t (1908), expanded about the normal quantile 2 (Abramowitz and
    Stegun 1964, 26.7.5).
    """
    variance = fit.data_information
    for group in levels:
        gradients = fit.gradients(group)
        count = len(gradients)
        student = 1.0 + 1.25 / count + 1.53 / count**2
        variance = _spread(gradients, variance) * student**2
    inverse = np.linalg.inv(fit.information)
    return np.asarray(inverse @ (variance + fit.prior) @ inverse, np.float64)


def long_run_factor(series: Floats) -> Floats:
    """Return the ratio (k,) of the variance of the sum of correlated values to the sum of their squares.

    Parameters
    ----------
    series : (n, k) values in their order, about zero

    Notes
    -----
    The factor is (1 + rho) / (1 - rho) with a first-order correlation rho (Andrews and Monahan 1992) and Kendall's
    (1954) correction for few values. It is computed for single values and for sums of 2, 4, ... values, and the largest
    factor is returned.
    """
    total = np.maximum((series**2).sum(axis=0), 1e-300)
    factor = np.ones(series.shape[1])
    while (count := len(series)) >= FEWEST_CORRELATED_BLOCKS:
        square = np.maximum((series**2).sum(axis=0), 1e-300)
        rho = (series[1:] * series[:-1]).sum(axis=0) / square
        rho = np.clip(rho + (1.0 + 3.0 * rho) / count, 0.0, LARGEST_CORRELATION)
        factor = np.maximum(factor, square / total * (1.0 + rho) / (1.0 - rho))
        series = series[: count // 2 * 2].reshape(count // 2, 2, -1).sum(axis=1)
    return factor


def _cost(z: Floats, overlap: float, prior_information: Floats, away: Floats) -> float:
    """Return the loss of residuals in standard deviations, prior included; infinite where it is not a number."""
    cost = soft_l1_loss(z) / overlap + float((prior_information * away**2).sum())
    return cost if np.isfinite(cost) else float("inf")
