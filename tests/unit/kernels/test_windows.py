"""Windows of distance: their motion on a circle, where it is known, and what they keep clear of."""

from __future__ import annotations

import numpy as np
import pytest

from icrtool.kernels.track import Track, Windows, cut

RADIUS_M, STEP_M, LENGTHS_M = 4.0, 0.05, (1.0, 3.0)
ROUNDING = 1e-9
"""Radians and metres, of sums over a thousand steps."""


def circle(*, slipping: slice = slice(0), reversed_heading: bool = False) -> Track:
    """A clockwise circle from north, driven at 1 m/s; the heading is along it, or turned about."""
    t = STEP_M * np.arange(1001)
    heading = t / RADIUS_M + (np.pi if reversed_heading else 0.0)
    slips = np.zeros(len(t), np.bool_)
    slips[slipping] = True
    held, speed = np.append(np.diff(t), 0.0), np.ones(len(t))
    north, east = RADIUS_M * np.sin(t / RADIUS_M), RADIUS_M * (1.0 - np.cos(t / RADIUS_M))
    return Track.of_states(t, held, speed, speed, north, east, heading, t, slipping=slips)


@pytest.mark.parametrize("reversed_heading", [False, True])
def test_windows_of_a_circle_turn_by_their_length_and_end_on_its_chord(reversed_heading: bool) -> None:
    windows = cut(circle(reversed_heading=reversed_heading), LENGTHS_M, 0.5)
    went_m = windows.over(windows.track.distance)
    assert set(windows.length_m) == set(LENGTHS_M)
    assert ((went_m >= windows.length_m - ROUNDING) & (went_m < windows.length_m + STEP_M + ROUNDING)).all()
    angle = went_m / RADIUS_M
    chord = RADIUS_M * (np.sin(angle) + 1j * (1.0 - np.cos(angle))) * (-1.0 if reversed_heading else 1.0)
    np.testing.assert_allclose(windows.turned, angle, atol=ROUNDING)
    np.testing.assert_allclose(windows.moved, chord, atol=ROUNDING)
    np.testing.assert_allclose(np.abs(windows.seen), 2.0 * RADIUS_M * np.sin(angle / 2.0), atol=ROUNDING)


def test_joined_wheel_samples_leave_the_motion_of_the_reference() -> None:
    windows = cut(circle(), LENGTHS_M, 0.5)
    joined = Windows(windows.track.joined(np.arange(0, 1001, 8)), windows.begin, windows.end, windows.length_m)
    np.testing.assert_array_equal(joined.moved, windows.moved)
    np.testing.assert_array_equal(joined.turned, windows.turned)


def test_no_window_spans_an_interval_that_slips() -> None:
    """One that ends where the slip begins stays, as one that begins where it ends."""
    begin, end = 400, 440
    clear, some = cut(circle(), LENGTHS_M, STEP_M), cut(circle(slipping=slice(begin, end)), LENGTHS_M, STEP_M)
    expected = (clear.end <= begin) | (clear.begin >= end)
    np.testing.assert_array_equal(some.begin, clear.begin[expected])
    np.testing.assert_array_equal(some.end, clear.end[expected])
    assert begin in some.end
    assert end in some.begin
