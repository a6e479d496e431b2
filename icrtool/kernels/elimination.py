"""Normal equations of parameters that all parts of the data share, without the own parameters of each part.

The own parameters of a part occur in no residual of another part. The normal equations of the part give them for any
values of the shared parameters (Schur complement), so time and memory grow with the number of parts, not with its cube.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icrtool.kernels.arrays import Floats, Ints


class Parts(NamedTuple):
    """Residuals and own parameters of each part of the data.

    Attributes
    ----------
    first : (p + 1,) first residual of each part, and the number of all residuals
    own : number c of own parameters of each part. A Jacobian (m, k + c) has their columns after the columns of the k
        shared parameters; the vector of all parameters (k + p c,) has the shared parameters, then part after part
    """

    first: Ints
    own: int = 0

    def split(self, jacobian: Floats) -> tuple[Floats, Floats]:
        """Return the derivatives by the shared parameters (m, k), and by the own parameters of the part (m, c)."""
        shared = jacobian.shape[1] - self.own
        return jacobian[:, :shared], jacobian[:, shared:]

    def by_residual(self, of_parts: Floats) -> Floats:
        """Return for each residual (m, ...) the entry of its part, from entries by part (p, ...)."""
        return np.repeat(of_parts, np.diff(self.first), axis=0)

    def change(self, jacobian: Floats, step: Floats) -> Floats:
        """Return the change of the residuals (m,) along a step (k + p c,) of all parameters, to first order."""
        shared, own = self.split(jacobian)
        k = shared.shape[1]
        of_own = self.by_residual(step[k:].reshape(len(self.first) - 1, self.own))
        change: Floats = shared @ step[:k] + (own * of_own).sum(axis=1)
        return change


class Elimination(NamedTuple):
    """A Gauss-Newton step, and how the own parameters of the parts follow the shared parameters.

    Attributes
    ----------
    step : (k + p c,) step of all parameters
    decrease : decrease of twice the cost that the normal equations predict
    gain : (p, c, k) a step s of the shared parameters changes the own parameters of a part by -gain s
    """

    step: Floats
    decrease: float
    gain: Floats

    def reduced(self, jacobian: Floats, parts: Parts) -> Floats:
        """Return the derivatives (m, k) by the shared parameters, while the own parameters follow them."""
        shared, own = parts.split(jacobian)
        return shared - np.einsum("mc,mck->mk", own, parts.by_residual(self.gain)) if parts.own else shared


def normal_equations(residuals: Floats, jacobian: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Return J^T W J (q, q) and J^T W r (q,) of a Jacobian (m, q), residuals and weights (m,)."""
    weighted = jacobian * weights[:, None]
    return weighted.T @ jacobian, weighted.T @ residuals


def eliminate(
    residuals: Floats, jacobian: Floats, weights: Floats, parts: Parts, prior_information: Floats, away: Floats
) -> Elimination:
    """Return the step of weighted least squares under a normal prior.

    Parameters
    ----------
    residuals, jacobian, weights : (m,), (m, k + c), (m,)
    parts : parts of the data
    prior_information, away : (k + p c,) information of the prior; parameters minus the mean of the prior
    """
    count, q, c = len(parts.first) - 1, jacobian.shape[1], parts.own
    k = q - c
    matrix, vector = np.empty((count, q, q)), np.empty((count, q))
    for i, (begin, end) in enumerate(zip(parts.first, parts.first[1:], strict=False)):
        rows = slice(begin, end)
        matrix[i], vector[i] = normal_equations(residuals[rows], jacobian[rows], weights[rows])
    gradient = prior_information * away
    vector[:, k:] += gradient[k:].reshape(count, c)
    matrix[:, range(k, q), range(k, q)] += prior_information[k:].reshape(count, c)
    both = np.concatenate([matrix[:, k:, :k], vector[:, k:, None]], axis=2)
    solved = np.linalg.solve(matrix[:, k:, k:], both)
    left = np.concatenate([matrix[:, :k, :k], vector[:, :k, None]], axis=2) - matrix[:, :k, k:] @ solved
    total = left.sum(axis=0)
    reduced = total[:, k] + gradient[:k]
    shared = -np.linalg.solve(total[:, :k] + np.diag(prior_information[:k]), reduced)
    gain, shift = solved[:, :, :k], solved[:, :, k]
    step = np.concatenate([shared, -(shift + gain @ shared).ravel()])
    return Elimination(step, float((vector[:, k:] * shift).sum() - reduced @ shared), gain)
