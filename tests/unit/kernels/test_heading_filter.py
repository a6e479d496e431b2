"""The Kalman filter of headings against least squares, and what it does to outliers and to states that are kept."""

from __future__ import annotations

import math

import numpy as np
import pytest

from icrtool.kernels.kalman import HeadingEvents, HeadingModel, filter_headings, smooth_headings


def events(n: int = 30, seed: int = 6, k: int = 3) -> HeadingEvents:
    rng = np.random.default_rng(seed)
    h = np.zeros((n, k))
    h[:, 0] = 1.0
    return HeadingEvents(
        np.full(n, 0.5), rng.normal(0.0, 0.2, n), np.zeros(n), rng.normal(0.0, 0.05, n), h, np.full(n, 0.05**2),
        np.zeros(n, np.bool_),
    )  # fmt: skip


def model(k: int = 3, q: tuple[float, ...] = (), decay: tuple[float, ...] = ()) -> HeadingModel:
    std = np.array([1.0, 0.1, 0.1, 0.3])[:k]
    return HeadingModel(
        np.zeros(k), np.diag(std**2), np.array(q or (0.0,) * k), np.array(decay or (0.0,) * k), np.zeros(k, np.bool_)
    )


def test_the_filter_knows_nothing_of_later_events() -> None:
    all_events = events(40)
    some = model(q=(1e-4, 1e-6, 0.0))
    whole, half = filter_headings(all_events, some), filter_headings(all_events.cut(20), some)
    np.testing.assert_array_equal(whole.x[:20], half.x)
    np.testing.assert_array_equal(whole.P[:20], half.P)


def test_the_smoother_is_the_least_squares_solution_of_all_events() -> None:
    """Without process noise the smoothed state is constant: the weighted normal equations, solved another way."""
    one = events()
    since, turned = np.cumsum(one.dt), np.cumsum(one.turn)
    truth = np.array([0.3, 0.01, 0.02])
    design = np.column_stack([np.ones(30), -since, turned])
    one = one._replace(z=design @ truth + turned + one.z)
    states, covariances = smooth_headings(one, model(), filter_headings(one, model()))
    information = design.T @ design / 0.05**2 + np.linalg.inv(model().P)
    expected = np.linalg.solve(information, design.T @ (one.z - turned) / 0.05**2)
    assert states[-1, 1:] == pytest.approx(expected[1:], abs=1e-9)
    assert states[-1, 0] == pytest.approx(
        expected[0] - since[-1] * expected[1] + turned[-1] * (1 + expected[2]), abs=1e-9
    )
    assert covariances[0, 1:, 1:] == pytest.approx(np.linalg.inv(information)[1:, 1:], abs=1e-12)


def test_a_decaying_state_keeps_its_variance_and_forgets() -> None:
    """First-order error of 0.3 and 2 s: its variance stays, its correlation over a step is exp(-dt/tau)."""
    tau = 2.0
    one = events(k=4)._replace(r=np.full(30, 1e12))
    out = filter_headings(one, model(4, (0.0, 0.0, 0.0, 2.0 * 0.3**2 / tau), (0.0, 0.0, 0.0, 1.0 / tau)))
    assert out.P[:, 3, 3] == pytest.approx(0.3**2)
    started = model(4, decay=(0.0, 0.0, 0.0, 1.0 / tau))
    started.x[3] = 1.0
    assert filter_headings(one, started).x[-1, 3] == pytest.approx(math.exp(-15.0 / tau), rel=1e-6)


def test_a_state_that_is_kept_counts_with_its_uncertainty() -> None:
    """An unknown constant that is measured along with the heading: its variance stays in the heading's."""
    one = events(k=4)
    one.h[:, 3] = 1.0
    kept = model(4)._replace(fixed=np.array([False, False, False, True]))
    out = filter_headings(one, kept)
    assert out.x[:, 3] == pytest.approx(0.0, abs=0.0)
    assert out.P[:, 3, 3] == pytest.approx(0.3**2)
    assert out.P[-1, 0, 0] > 0.3**2


def test_the_influence_of_an_outlier_is_bounded() -> None:
    clean = events()
    ends = []
    for error in (1.0, 100.0):
        z = clean.z.copy()
        z[15] += error
        ends.append(filter_headings(clean._replace(z=z), model()).x[-1, 0])
    without = filter_headings(clean, model()).x[-1, 0]
    assert abs(ends[1] - ends[0]) < 1e-3
    assert abs(ends[1] - without) < 0.05
