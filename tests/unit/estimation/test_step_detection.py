"""The step test: its stated rate of false alarms, by simulation, and what it finds."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import norm, poisson

from icrtool.estimation.step_detection import SPANS, find_steps

NOTHING_KNOWN = np.full(3, 1e-6)
SERIES = 400


def wandering(rng: np.random.Generator, correlation: float) -> np.ndarray:
    noise = rng.standard_normal((130, 3))
    return lfilter([1.0], [1.0, -correlation], noise, axis=0)[50:]


@pytest.mark.parametrize(
    "draw",
    [
        pytest.param(lambda rng: rng.standard_normal((40, 3)), id="short"),
        pytest.param(lambda rng: rng.standard_normal((300, 3)), id="long"),
        pytest.param(lambda rng: rng.standard_t(3, (80, 3)), id="heavy tails"),
        pytest.param(lambda rng: wandering(rng, 0.4), id="neighbours alike"),
    ],
)
def test_no_more_false_alarms_than_stated_even_where_only_the_scatter_tells(draw) -> None:  # type: ignore[no-untyped-def]
    rng, stated = np.random.default_rng(1), 0.05
    alarms = sum(len(find_steps(draw(rng), NOTHING_KNOWN, 0.0, stated).steps) for _ in range(SERIES))
    # one-sided: 99 % of the counts with the stated mean are at most this
    assert alarms <= poisson.ppf(0.99, stated * SERIES)


def test_the_known_doubt_alone_keeps_the_rate_too() -> None:
    rng, stated = np.random.default_rng(2), 0.05
    alarms = sum(len(find_steps(rng.standard_normal((60, 3)), np.ones(3), 0.0, stated).steps) for _ in range(SERIES))
    assert alarms <= poisson.ppf(0.99, stated * SERIES)


def test_steps_are_found_at_their_places_among_wrong_values() -> None:
    rng = np.random.default_rng(3)
    values = 0.05 * rng.standard_normal((120, 3))
    values[40:, 0] += 1.0
    values[80:, 2] -= 1.0
    values[rng.choice(120, 6, replace=False)] += 20.0
    found = find_steps(values, np.full(3, 0.05), 0.2, 0.01)
    assert [step.series for step in found.steps] == [0, 2]
    assert [step.place for step in found.steps] == pytest.approx([40, 80], abs=2)
    assert found.steps[0].after[0] - found.steps[0].before[0] == pytest.approx(1.0, abs=0.1)
    assert all(step.score > found.threshold for step in found.steps)


def test_a_known_step_is_not_found_again_and_small_ones_are_none() -> None:
    values = 0.01 * np.random.default_rng(4).standard_normal((80, 3))
    values[40:] += 0.1
    assert len(find_steps(values, np.full(3, 0.01), 0.05, 0.01).steps) == 1
    assert find_steps(values, np.full(3, 0.01), 0.05, 0.01, known=(40,)).steps == ()
    assert find_steps(values, np.full(3, 0.01), 0.2, 0.01).steps == ()


def test_the_threshold_is_bonferronis_and_too_little_is_no_test() -> None:
    found = find_steps(np.zeros((20, 3)), np.ones(3), 0.1, 0.01)
    comparisons = 3 * sum(20 - 2 * span + 1 for span in SPANS if 2 * span <= 20)
    assert found.comparisons == comparisons
    assert found.threshold == pytest.approx(norm.isf(0.01 / comparisons / 2))
    assert find_steps(np.zeros((2 * SPANS[0] - 1, 3)), np.ones(3), 0.1, 0.01).comparisons == 0
