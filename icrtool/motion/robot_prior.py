"""The prior of a skid-steer robot before it drives, from the spread of robots in logs and publications."""

from __future__ import annotations

import functools
import tomllib
from dataclasses import replace
from importlib import resources

import numpy as np

from icrtool.kernels.arrays import Floats
from icrtool.motion.adaptive import TURNED_MODEL, WHEELS_MODEL, TermsPrior
from icrtool.motion.models import TERMS, FittedModel

BETWEEN_DRIVES = 0.15
"""Standard deviation of a term between drives of one robot, as a share of its standard deviation between robots.

Ten recorded drives of one robot differ by 0.006 in vx_v, 0.06 in vx_w, 0.008 in omega_w, 0.002 in omega_v and 0.06 in
vy_w; from ground to ground omega_w differs by 0.03.
"""

OTHER_ROBOTS = "other robots"
"""Source of a prior that comes from other robots."""


@functools.cache
def known_robots() -> dict[str, dict[str, float | str]]:
    """Return the terms and the ``source`` of each known robot by name."""
    return tomllib.loads(resources.files("icrtool").joinpath("robot_terms.toml").read_text(encoding="utf-8"))


def prior_of_robots(track_width_m: float, *, without: str = "") -> TermsPrior:
    """Return the prior of a robot of which only the track width is known.

    Parameters
    ----------
    track_width_m : track width b
    without : name of a robot that is left out, to test the prior on it

    Notes
    -----
    Median and variance of each term over the robots of ``robot_terms.toml``. The prior of the term
    (`icrtool.motion.models.TERMS`) counts as one more robot. The median comes from n robots, so a further robot differs
    from it with 1 + 1 / n times the variance.
    """
    robots = [terms for name, terms in known_robots().items() if name != without]
    mean, variance = [], []
    for name in WHEELS_MODEL.terms:
        term = TERMS[name]
        shown = np.array([term.mean, *(float(terms[name]) for terms in robots if name in terms)])
        middle, n = float(np.median(shown)), len(shown)
        mean.append(middle)
        variance.append((float(np.sum((shown - middle) ** 2)) + term.std**2) / n * (1.0 + 1.0 / n))
    return TermsPrior.of_wheels(track_width_m, np.array(mean), np.diag(variance), OTHER_ROBOTS)


def prior_of_model(
    track_width_m: float, fitted_model: FittedModel, gyro_model: FittedModel | None, source: str
) -> TermsPrior:
    """Return the prior for the next drive of a robot from its fitted models.

    Parameters
    ----------
    track_width_m : track width b
    fitted_model, gyro_model : models with wheels alone, and with a gyro; None: without one. Terms that both lack have
        the prior of `prior_of_robots`
    source : source of the prior, in a few words

    Notes
    -----
    The covariance is the sum of the parameters' covariance and the covariance between drives (`between_drives`).
    """
    robots_prior = prior_of_robots(track_width_m)
    mean, covariance = _placed(WHEELS_MODEL.terms, robots_prior.mean, robots_prior.covariance, fitted_model)
    prior = TermsPrior.of_wheels(track_width_m, mean, covariance, source)
    if gyro_model is None:
        return prior
    mean, covariance = _placed(TURNED_MODEL.terms, prior.turned_mean, prior.turned_covariance, gyro_model)
    return replace(prior, turned_mean=mean, turned_covariance=covariance)


def _placed(
    terms: tuple[str, ...], mean: Floats, covariance: Floats, fitted_model: FittedModel
) -> tuple[Floats, Floats]:  # fmt: skip
    """Return mean and covariance of terms; the terms of a fitted model get their prior for a further drive."""
    names = fitted_model.model.terms
    fit_rows = [names.index(name) for name in terms if name in names]
    term_rows = [terms.index(name) for name in terms if name in names]
    mean, covariance = mean.copy(), covariance.copy()
    mean[term_rows] = fitted_model.parameters[fit_rows]
    covariance[term_rows, :] = covariance[:, term_rows] = 0.0
    next_drive = fitted_model.covariance + between_drives(names)
    covariance[np.ix_(term_rows, term_rows)] = next_drive[np.ix_(fit_rows, fit_rows)]
    return mean, covariance


def between_drives(names: tuple[str, ...]) -> Floats:
    """Return the covariance (k, k) of terms between drives of one robot.

    Notes
    -----
    For terms that few drives show (`Term.wide`), the variance between drives is the variance of their prior.
    """
    std = [TERMS[name].std * (1.0 if TERMS[name].wide else BETWEEN_DRIVES) for name in names]
    return np.diag(np.square(std))
