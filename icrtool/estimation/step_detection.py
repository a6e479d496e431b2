"""A test for steps in the level of series: medians of moving spans before and after every place.

Between value tau - 1 and value tau, and for several spans h, the statistic is

    (median of tau .. tau + h - 1) - (median of tau - h .. tau - 1), over its standard error,

which is what the difference usually is along the series, or what its values are known to err. The medians bear wrong
values, and the error, that of most places, bears the steps themselves. With means in their place this is the MOSUM test
(Eichinger and Kirch 2018).
"""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from icrtool.records.tables import Floats

SPANS = (5, 10, 20, 40)
"""Values on either side of a step, each twice the one before."""

MEDIAN_VARIANCE = math.pi / 2
"""Variance of the median of h normal values, times h over theirs; less for small h."""

NORMAL_MAD = 1.4826
"""Standard deviation of normal values over their median absolute deviation."""

LONG_SERIES = 6
"""A series this many times longer than a span tells itself how much medians over it differ."""

LARGEST_SCORE, SMALLEST_P = 37.0, 1e-298
"""Beyond, a probability is zero in floating point."""


class Step(NamedTuple):
    """A step between the values before `place` and those from it on.

    Attributes
    ----------
    place : index of the first value after it; span : values on either side that were compared
    series : which series shows it best
    score : how many standard deviations of a normal variable are as improbable
    before, after : (c,) the medians
    """

    place: int
    span: int
    series: int
    score: float
    before: Floats
    after: Floats


class StepTest(NamedTuple):
    """Steps in order of place, the score a step must exceed, and how many comparisons that allows for."""

    steps: tuple[Step, ...]
    threshold: float
    comparisons: int


def find_steps(
    values: Floats, least_std: Floats, least_step: float, false_alarms: float, known: tuple[int, ...] = ()
) -> StepTest:
    """Find the steps in the common level of series.

    Parameters
    ----------
    values : (n, c) one row per block, c series
    least_std : (c,) what a value is never known better than
    least_step : smaller steps are none, in the unit of the values
    false_alarms : steps that may be found, in the mean, where there are none
    known : places at which a step is known: none is looked for across them

    Notes
    -----
    A step must be improbable (Bonferroni over all places, spans and series) both against `least_std`, a normal
    variable, and against how much neighbouring medians differ all along the series: a Student variable with n / 4
    degrees of freedom, for that is what the median absolute difference is worth. What medians over the narrowest span
    differ by falls with the square root of the span, or less where a long series says so: values that wander are
    allowed for as far as the spans go. Narrow spans come first: they place a step best and see no other.
    """
    from scipy.special import ndtr, stdtr

    n, c = values.shape
    spans = [span for span in SPANS if 2 * span <= n]
    comparisons = c * sum(n - 2 * span + 1 for span in spans)
    if not comparisons:
        return StepTest((), math.inf, 0)
    threshold = _score(min(false_alarms / comparisons, 1.0))
    freedom, found, taken = max(n / 4, 1.0), list[Step](), list(known)
    own = np.zeros(c)
    for span in spans:
        median = np.median(np.lib.stride_tricks.sliding_window_view(values, span, axis=0), axis=2)
        before, after = median[: n - 2 * span + 1], median[span:]
        step = np.abs(after - before)
        own *= math.sqrt(0.5)
        if span == spans[0] or n >= LONG_SERIES * span:
            own = np.maximum(own, NORMAL_MAD * np.median(step, axis=0))
        least = math.sqrt(2.0 * MEDIAN_VARIANCE / span) * least_std
        with np.errstate(divide="ignore", invalid="ignore"):
            p = np.maximum(2 * ndtr(-step / least), 2 * stdtr(freedom, -step / own))
        p[(step < least_step) | np.isnan(p)] = 1.0
        for i in np.argsort(p.min(axis=1), kind="stable"):
            series, place = int(p[i].argmin()), int(i) + span
            score = _score(float(p[i, series]))
            if score <= threshold:
                break
            if all(abs(place - other) >= span for other in taken):
                taken.append(place)
                found.append(Step(place, span, series, score, before[i], after[i]))
    return StepTest(tuple(sorted(found)), threshold, comparisons)


def _score(p: float) -> float:
    """Return the score of a two-sided probability."""
    return min(-NormalDist().inv_cdf(p / 2), LARGEST_SCORE) if p > SMALLEST_P else LARGEST_SCORE
