"""Many window fits to parts of one run: the same minima as `fit_windows`, each in a few evaluations.

Every model is a choice of columns of one set of misses and derivatives. A Gauss-Newton step that takes scale and
weights of the robust loss from where it stands settles within a few marches over the joined wheel samples; an
extended model starts where the plain one of the same part ended. No fit is told anything of the windows left out.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from icrtool.motion.window_fit import (
    HUBER_SIGMAS,
    WindowFit,
    Windows,
    clustered_covariance,
    evaluate_windows,
    prior_of,
    robust_scale,
)
from icrtool.motion.window_models import WindowModel, base_parameters, basis_of
from icrtool.records.tables import Bools, Floats

SETTLED = 1e-4
"""In standard deviations of the prior: a step below this is the last one ..."""

SETTLED_COST = 1e-3
"""... and so is one to gain less than this share of what a stretch of way says: 0.03 of a standard deviation."""

MOST_STEPS = 15
MOST_HALVINGS = 6


class Solution(NamedTuple):
    """A model fitted to some of the windows.

    Attributes
    ----------
    terms : (k,), in the model's order
    parameters : (8,), as `WindowFit` has them
    misses : (2 w,) of all windows, there; `slopes` (2 w, 8) of them by the parameters, one short step before
    weight : (2 w,) of the robust loss, over the scale; 0 for windows left out
    held : (k,) square roots of the prior's information
    scale : robust standard deviation of a miss [m per root metre]
    """

    model: WindowModel
    terms: Floats
    parameters: Floats
    misses: Floats
    slopes: Floats
    weight: Floats
    held: Floats
    scale: float


def solve_windows(windows: Windows, model: WindowModel, kept: Bools, start: Solution | None = None) -> Solution:
    """Fit a model to the windows marked in `kept` (w,).

    Parameters
    ----------
    windows : of `thin_windows`
    model : what is free
    start : another model's fit to the same windows, to start from; default the prior's mean

    Notes
    -----
    Minimises what `fit_windows` does: Gauss-Newton with step halving, reweighted for soft L1 as it goes.
    """
    basis, base = basis_of(model), base_parameters()
    mean, held, std = prior_of(windows, model, kept)
    rows = np.tile(kept, 2)
    # the prior weighs as a stretch does: what its windows, alike as they are, gain together
    alike = float((held[0] * std[0]) ** 2)
    terms: Floats
    if start is None:
        terms = mean
        misses, slopes = evaluate_windows(windows, base + terms @ basis)
    else:
        terms = np.asarray(np.linalg.lstsq(basis.T, start.parameters - base, rcond=None)[0], np.float64)
        misses, slopes = start.misses, start.slopes
    for _ in range(MOST_STEPS):
        weight, _ = _weigh(misses, rows)
        pulled = slopes * weight[:, None]
        H = basis @ (pulled.T @ pulled) @ basis.T + np.diag(held**2)
        g = basis @ (pulled.T @ (weight * misses)) + held**2 * (terms - mean)
        step = np.asarray(-np.linalg.solve(H, g), np.float64)
        if -float(g @ step) < SETTLED_COST * alike or np.all(np.abs(step) < SETTLED * std):
            # too short a step to march for: misses follow it to first order
            terms, misses = terms + step, misses + slopes @ (step @ basis)
            break
        before = _cost(misses, weight, (terms - mean) * held)
        tried = evaluate_windows(windows, base + (terms + step) @ basis)
        for _ in range(MOST_HALVINGS):
            if _cost(tried[0], weight, (terms + step - mean) * held) <= before:
                break
            step = step / 2.0
            tried = evaluate_windows(windows, base + (terms + step) @ basis)
        terms, (misses, slopes) = terms + step, tried
    weight, scale = _weigh(misses, rows)
    return Solution(model, terms, base + terms @ basis, misses, slopes, weight, held, scale)


def drop_windows(solution: Solution, dropped: Bools) -> Floats:
    """Return misses (2 w,) of all windows as they would be without those in `dropped` (w,), to first order.

    Notes
    -----
    At the minimum the gradients of all windows and of the prior sum to zero, so what is left without some windows is
    minus theirs: one step with the curvature of the rest (a downdate, as for studentised residuals).
    """
    basis, rows = basis_of(solution.model), np.tile(dropped, 2)
    out = solution.slopes[rows] * solution.weight[rows, None]
    all_of_them = solution.slopes * solution.weight[:, None]
    H = basis @ (all_of_them.T @ all_of_them - out.T @ out) @ basis.T + np.diag(solution.held**2)
    g = basis @ (out.T @ (solution.weight[rows] * solution.misses[rows]))
    changed: Floats = solution.misses + solution.slopes @ (np.linalg.solve(H, g) @ basis)
    return changed


def fit_of(solution: Solution, windows: Windows) -> WindowFit:
    """Return a solution as a `WindowFit`, with its covariance."""
    rows = solution.weight > 0.0
    basis, base = basis_of(solution.model), base_parameters()
    covariance = clustered_covariance(
        solution.misses[rows] / solution.scale,
        solution.slopes[rows] @ basis.T / solution.scale,
        solution.held,
        np.tile(windows.start_m, 2)[rows],
    )
    return WindowFit(
        model=solution.model,
        terms=solution.terms,
        covariance=covariance,
        parameters=base + solution.terms @ basis,
        parameter_covariance=basis.T @ covariance @ basis,
        residual_m=solution.scale,
        windows=int(np.count_nonzero(rows)) // 2,
    )


def _weigh(misses: Floats, rows: Bools) -> tuple[Floats, float]:
    """Return the weights of soft L1 over the scale, 0 beyond `rows`, and the scale, which is that of the rows."""
    scale = robust_scale(misses[rows])
    weight: Floats = (1.0 + (misses / (HUBER_SIGMAS * scale)) ** 2) ** -0.25 / scale
    return np.where(rows, weight, 0.0), scale


def _cost(misses: Floats, weight: Floats, pull: Floats) -> float:
    cost = float(np.square(weight * misses).sum() + np.square(pull).sum())
    return cost if math.isfinite(cost) else math.inf
