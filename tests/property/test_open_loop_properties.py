from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from icrtool.kernels import open_loop
from icrtool.kernels.open_loop import open_loop_errors, open_loop_errors_direct
from icrtool.kernels.track import FrozenIcrs, Track, trial_ends

EQUAL_M = 1e-9  # what the fast algorithm promises; moving the world by 1e5 m rounds positions to 1.5e-11 m
HORIZONS = np.array([0.3, 1.0, 2.5, 6.0])
MODES = ("straight", "reverse", "curve", "turn in place", "stand", "jitter")

seeds = st.integers(0, 2**32 - 1)


def sides(mode, length, rng):
    """Speeds of both sides over one stretch of driving."""
    common, apart = rng.uniform(0.2, 2.0), rng.uniform(-1.0, 1.0)
    left, right = {
        "straight": (common, common),
        "reverse": (-common, -common + 0.1 * apart),
        "curve": (common + apart, common - apart),
        "turn in place": (common, -common),
        "stand": (0.0, 0.0),
        "jitter": (0.0, 0.0),
    }[mode]
    noise = 0.0 if mode == "stand" else 0.05
    return left + noise * rng.normal(size=length), right + noise * rng.normal(size=length)


def icr_track(mean, jumps, n, rng):
    """A wandering ICR, with jumps where the filter has just begun or been shaken."""
    steps = rng.normal(0.0, 0.02, n) * (rng.random(n) < 0.2) + rng.normal(0.0, 0.3, n) * (rng.random(n) < jumps)
    return mean + np.cumsum(steps)


@st.composite
def drives(draw, least_separation=0.0):
    """A drive of up to 300 states, with the ICRs each start is to drive with; the reference is any path."""
    rng = np.random.default_rng(draw(seeds))
    stretches = draw(st.lists(st.tuples(st.sampled_from(MODES), st.integers(1, 90)), max_size=6))
    speeds = [sides(mode, length, rng) for mode, length in stretches] or [np.ones((2, draw(st.integers(0, 2))))]
    v_left, v_right = np.concatenate(speeds, axis=1)
    n = len(v_left)
    dt_s = draw(st.sampled_from([0.01, 0.05])) * rng.uniform(0.2, 1.8, n)
    jumps = draw(st.sampled_from([0.0, 0.01, 0.2]))
    y_right, y_left = icr_track(0.6, jumps, n, rng), icr_track(-0.5, jumps, n, rng)
    if least_separation:
        y_left = y_right - np.maximum(y_right - y_left, least_separation)
    elif n and draw(st.booleans()):
        at = rng.integers(0, n, 3)
        y_left[at] = y_right[at] - draw(st.sampled_from([0.0, 1e-7, 1e-3]))
    distance = np.concatenate([np.zeros(1), np.cumsum(dt_s * np.abs(v_left + v_right) / 2.0)])[:n]
    reference = [np.cumsum(rng.normal(0.0, 0.02, n)) for _ in range(3)]
    gap, in_outage = (rng.random(n) < draw(st.sampled_from([0.0, 0.02])) for _ in range(2))
    icrs = FrozenIcrs(y_right, y_left, icr_track(0.1, jumps, n, rng))
    t, held = np.cumsum(dt_s) - dt_s, np.where(gap, 0.0, dt_s)
    return Track.of_states(t, held, v_left, v_right, *reference, distance, in_outage=in_outage), icrs


def assert_equal(errors, expected):
    np.testing.assert_allclose(errors, expected, rtol=0.0, atol=EQUAL_M)


@settings(max_examples=75)
@given(drives(), st.sampled_from([8, 37, 2048]))
def test_fast_equals_direct_integration(drive_and_icrs, block):
    drive, icrs = drive_and_icrs
    ends = trial_ends(drive, HORIZONS)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(open_loop, "BLOCK", block)
        errors = open_loop_errors(drive, icrs, ends)
    assert_equal(errors, open_loop_errors_direct(drive, icrs, ends))
    assert np.array_equal(np.isfinite(errors), ends >= 0)


@settings(max_examples=50)
@given(drives(), st.floats(0.2, 2.0))
def test_fast_equals_direct_integration_for_one_triple(drive_and_icrs, track_width):
    drive, _ = drive_and_icrs
    no_slip = FrozenIcrs.constant(0.5 * track_width, -0.5 * track_width, 0.0)
    ends = trial_ends(drive, HORIZONS)
    assert_equal(open_loop_errors(drive, no_slip, ends), open_loop_errors_direct(drive, no_slip, ends))


@settings(max_examples=50)
@given(drives(least_separation=0.1), st.floats(-20.0, 20.0), st.floats(-1e5, 1e5), st.floats(-1e5, 1e5))
@pytest.mark.parametrize("solve", [open_loop_errors, open_loop_errors_direct])
def test_rotating_and_shifting_the_world_changes_nothing(solve, drive_and_icrs, angle, north, east):
    drive, icrs = drive_and_icrs
    cos, sin = np.cos(angle), np.sin(angle)
    moved = drive._replace(
        north=north + drive.north * cos - drive.east * sin,
        east=east + drive.north * sin + drive.east * cos,
        heading=drive.heading + angle,
    )
    ends = trial_ends(drive, HORIZONS)
    assert_equal(solve(moved, icrs, ends), solve(drive, icrs, ends))


@settings(max_examples=50)
@given(drives(least_separation=0.1))
def test_swapping_left_and_right_mirrors(drive_and_icrs):
    drive, icrs = drive_and_icrs
    mirrored = drive._replace(v_left=drive.v_right, v_right=drive.v_left, east=-drive.east, heading=-drive.heading)
    mirrored_icrs = FrozenIcrs(-icrs.y_icr_left, -icrs.y_icr_right, icrs.x_icr)
    ends = trial_ends(drive, HORIZONS)
    assert_equal(open_loop_errors(mirrored, mirrored_icrs, ends), open_loop_errors(drive, icrs, ends))


@settings(max_examples=50)
@given(drives(least_separation=0.1), st.permutations(range(4)))
def test_order_of_horizons_changes_nothing(drive_and_icrs, order):
    drive, icrs = drive_and_icrs
    ends, shuffled = trial_ends(drive, HORIZONS), trial_ends(drive, HORIZONS[order])
    assert np.array_equal(shuffled, ends[:, order])
    assert_equal(open_loop_errors(drive, icrs, shuffled), open_loop_errors(drive, icrs, ends)[:, order])


@settings(max_examples=50)
@given(drives(least_separation=0.1), st.data())
def test_ranges_of_starts_make_up_the_whole(drive_and_icrs, data):
    drive, icrs = drive_and_icrs
    cut = data.draw(st.integers(0, len(drive.t)))
    whole = open_loop_errors(drive, icrs, trial_ends(drive, HORIZONS))
    parts = [
        open_loop_errors(drive, icrs, trial_ends(drive, HORIZONS, lo, hi), lo)
        for lo, hi in [(0, cut), (cut, len(drive.t))]
    ]
    assert_equal(np.concatenate(parts), whole)
