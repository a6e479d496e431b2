"""Samples of a long drive are joined without a change of any distance."""

from __future__ import annotations

import numpy as np

from icrtool.alignment.log_track import MOST_WHEEL_SAMPLES, track_of_streams
from icrtool.kernels.arrays import Floats
from icrtool.kernels.track import Track
from icrtool.records.samples import NO_HEADINGS, PositionFixes, WheelSamples

ROUNDING_M = 1e-8  # of sums over 200,000 samples


def track_of_wheels(t: Floats, left: Floats, right: Floats) -> Track:
    """Return the track of wheel samples at times (n,) [s], with three fixes."""
    stamps, three = np.round(t * 1e9).astype(np.int64), np.zeros(3)
    fixes = PositionFixes(stamps[[0, len(t) // 2, -1]], *(three for _ in range(5)))
    return track_of_streams(WheelSamples(stamps, left, right), fixes, NO_HEADINGS, same_clock=False)


def test_joined_samples_have_the_distances_and_gaps_of_all() -> None:
    rng = np.random.default_rng(0)
    n, gaps = 2 * MOST_WHEEL_SAMPLES + 3, 50
    interval = rng.uniform(0.009, 0.011, n)
    interval[1 + rng.choice(n - 1, gaps, replace=False)] = 5.0
    t = np.round(np.cumsum(interval), 9)
    left, right = rng.normal(1.0, 0.3, (2, n))
    track = track_of_wheels(t, left, right)
    assert len(track.t) < n / 2
    assert len(track.gap_t) == gaps
    held = np.append(np.where(np.diff(t) < 1.0, np.diff(t), 0.0), 0.0)
    for speed, joined in ((left, track.v_left), (right, track.v_right)):
        path = np.concatenate([[0.0], np.cumsum(held * speed)[:-1]])
        np.testing.assert_allclose(track.cumulate(joined), np.interp(track.t, t - t[0], path), atol=ROUNDING_M)


def test_a_short_drive_keeps_every_sample() -> None:
    t = np.arange(10.0)
    np.testing.assert_array_equal(track_of_wheels(t, t, t).t, t)


def test_a_long_parking_leaves_every_sample_of_the_drive() -> None:
    n = 3 * MOST_WHEEL_SAMPLES
    t, turns = np.arange(float(n)), np.zeros(n, np.bool_)
    turns[n // 2 : n // 2 + 600] = True
    track = track_of_wheels(t, 1.0 * turns, 1.0 * turns)
    assert np.isin(t[turns], track.t).all()
    assert len(track.t) < MOST_WHEEL_SAMPLES + 1_000
