"""Samples of a long drive are joined without a change of any distance."""

from __future__ import annotations

import numpy as np

from icrtool.alignment import drive_windows


def test_joined_samples_have_the_distances_and_gaps_of_all() -> None:
    rng = np.random.default_rng(0)
    n, gaps = 2 * drive_windows.MOST_WHEEL_SAMPLES + 3, 50
    t = np.cumsum(rng.uniform(0.009, 0.011, n))
    dt = np.append(np.diff(t), 0.0)
    dt[rng.choice(n - 1, gaps, replace=False)] = 0.0
    left, right = rng.normal(1.0, 0.3, (2, n))
    parts = drive_windows._joined(t, dt, left, right, np.ones(n, np.bool_))
    times, interval, one, other = parts
    assert len(times) < n / 2
    assert np.count_nonzero(interval[:-1] == 0.0) == gaps
    for all_of_it, joined in ((left, one), (right, other)):
        path = np.concatenate([[0.0], np.cumsum(dt * all_of_it)[:-1]])
        np.testing.assert_allclose(
            np.concatenate([[0.0], np.cumsum(interval * joined)[:-1]]), np.interp(times, t, path), atol=1e-8
        )


def test_a_short_drive_keeps_every_sample() -> None:
    t = np.arange(10.0)
    assert drive_windows._joined(t, t, t, t, np.ones(10, np.bool_))[0] is t


def test_a_long_parking_leaves_every_sample_of_the_drive() -> None:
    n = 3 * drive_windows.MOST_WHEEL_SAMPLES
    t, turns = np.arange(float(n)), np.zeros(n, np.bool_)
    turns[n // 2 : n // 2 + 600] = True
    dt = np.append(np.diff(t), 0.0)
    times = drive_windows._joined(t, dt, 1.0 * turns, 1.0 * turns, turns)[0]
    assert np.isin(t[turns], times).all()
    assert len(times) < drive_windows.MOST_WHEEL_SAMPLES + 1_000
