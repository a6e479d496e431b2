from __future__ import annotations

import math
import tracemalloc

import numpy as np
import pytest

from icrtool.kernels import open_loop
from icrtool.kernels.open_loop import open_loop_errors, open_loop_errors_direct, open_loop_path
from icrtool.kernels.track import GAP, OUTAGE, SHORT, FrozenIcrs, Track, count_trials, trial_ends
from support.open_loop_vector import HELD_S, ICRS_M, PATH, V_LEFT_MPS, V_RIGHT_MPS

EQUAL_M = 1e-9  # what the fast algorithm promises against the direct integration
ROUNDING = 1e-12  # two orders of the same few hundred additions of metres and radians
HORIZONS = np.array([0.5, 1.0, 3.0, 10.0])
NO_SLIP = FrozenIcrs.constant(0.3, -0.3, 0.0)


def make_drive(v_left, v_right, icrs, dt=0.01, north0=0.0, east0=0.0, heading0=0.0):
    """Drive the ICR model itself: the reference is what the ICRs of each moment say."""
    n = len(v_left)
    dt_s = np.broadcast_to(np.asarray(dt, dtype=float), n).copy()
    turn = np.abs(icrs.y_icr_left - icrs.y_icr_right)
    omega = (v_left - v_right) / turn
    v_x = (v_left * icrs.y_icr_right - v_right * icrs.y_icr_left) / turn
    v_y = -omega * icrs.x_icr

    def integral(rate):
        return np.concatenate([[0.0], np.cumsum(dt_s * rate)[:-1]])[:n]

    heading = heading0 + integral(omega)
    north = north0 + integral(v_x * np.cos(heading) - v_y * np.sin(heading))
    east = east0 + integral(v_x * np.sin(heading) + v_y * np.cos(heading))
    distance, t = integral(np.hypot(v_x, v_y)), integral(np.ones(n))
    dt_s[-1:] = 0.0
    return Track.of_states(t, dt_s, v_left.copy(), v_right.copy(), north, east, heading, distance)


def winding_drive(n=1500, dt=0.02, seed=0):
    """A drive with curves both ways, reversing, a turn in place and a stop, and ICRs that wander."""
    rng = np.random.default_rng(seed)
    t = dt * np.arange(n)
    speed, turn = 1.0 + 0.3 * np.sin(t), 0.8 * np.sin(0.7 * t)
    speed[n // 5 : n // 4] *= -1.0
    speed[n // 3 : n // 3 + 60], turn[n // 3 : n // 3 + 60] = 0.0, 1.5
    speed[n // 2 : n // 2 + 90], turn[n // 2 : n // 2 + 90] = 0.0, 0.0
    icrs = FrozenIcrs(
        0.7 + np.cumsum(rng.normal(0.0, 1e-3, n)),
        -0.6 + np.cumsum(rng.normal(0.0, 1e-3, n)),
        0.1 + np.cumsum(rng.normal(0.0, 1e-3, n)),
    )
    drive = make_drive(speed - turn * icrs.y_icr_left, speed - turn * icrs.y_icr_right, icrs, dt, 300.0, -200.0, 2.0)
    return drive, icrs


def plain_ends(drive, horizons, kinds=(SHORT, GAP, OUTAGE)):
    """Section 6.4 read aloud: for every start and horizon, look along the drive."""
    short, gap, outage = kinds
    n = len(drive.distance)
    ends = np.empty((n, len(horizons)), dtype=np.int64)
    for k in range(n):
        for h, horizon in enumerate(horizons):
            far = [j for j in range(k, n) if drive.distance[j] - drive.distance[k] >= horizon]
            if not far:
                ends[k, h] = short
            elif (drive.held[k : far[0]] == 0.0).any():
                ends[k, h] = gap
            else:
                ends[k, h] = outage if drive.in_outage[far[0]] else far[0]
    return ends


def plain_errors(drive, icrs, ends):
    """Eqs. 8-12 with the ICRs frozen, in plain Python, in the world frame, one trial at a time."""
    errors = np.full(ends.shape, math.nan)
    for k, h in np.argwhere(ends >= 0):
        y_r, y_l, x = (float(column[k if len(column) > 1 else 0]) for column in icrs)
        north, east, psi = float(drive.north[k]), float(drive.east[k]), float(drive.heading[k])
        for i in range(k, ends[k, h]):
            dt, v_l, v_r = float(drive.held[i]), float(drive.v_left[i]), float(drive.v_right[i])
            omega = (v_l - v_r) / abs(y_l - y_r)
            v_x = (v_l * y_r - v_r * y_l) / abs(y_l - y_r)
            v_y = -omega * x
            north += dt * (v_x * math.cos(psi) - v_y * math.sin(psi))
            east += dt * (v_x * math.sin(psi) + v_y * math.cos(psi))
            psi += dt * omega
        errors[k, h] = math.hypot(north - drive.north[ends[k, h]], east - drive.east[ends[k, h]])
    return errors


def troubled_drive():
    drive, icrs = winding_drive(n=260, dt=0.05)
    drive.held[[77, 150]] = 0.0
    drive.in_outage[100:120] = True
    return drive, icrs


@pytest.mark.parametrize("solve", [open_loop_errors, open_loop_errors_direct])
@pytest.mark.parametrize("constant", [False, True])
def test_errors_equal_a_plain_transcription(solve, constant):
    drive, icrs = troubled_drive()
    icrs = NO_SLIP if constant else icrs
    ends = trial_ends(drive, HORIZONS)
    assert count_trials(ends).trials[:3].all()
    np.testing.assert_allclose(solve(drive, icrs, ends), plain_errors(drive, icrs, ends), rtol=0.0, atol=EQUAL_M)


def test_trial_ends_equal_a_plain_search():
    drive, _ = troubled_drive()
    ends = trial_ends(drive, HORIZONS[::-1])
    np.testing.assert_array_equal(ends, plain_ends(drive, HORIZONS[::-1]))
    assert {SHORT, GAP, OUTAGE} <= set(ends.ravel().tolist())


def test_every_start_is_a_trial_or_counted_as_none():
    drive, _ = troubled_drive()
    ends = trial_ends(drive, HORIZONS)
    counts = count_trials(ends)
    np.testing.assert_array_equal(sum(counts), len(drive.distance))
    np.testing.assert_array_equal(counts.trials, (ends >= 0).sum(axis=0))
    np.testing.assert_array_equal(counts.outage, (ends == OUTAGE).sum(axis=0))


def test_last_window_ends_exactly_on_the_last_state():
    speed = np.full(5, 1.0)
    drive = make_drive(speed, speed, NO_SLIP, dt=0.25)
    assert trial_ends(drive, np.array([1.0, 0.75, 0.7, 1.01])).tolist() == [
        [4, 3, 3, SHORT],
        [SHORT, 4, 4, SHORT],
        [SHORT, SHORT, SHORT, SHORT],
        [SHORT, SHORT, SHORT, SHORT],
        [SHORT, SHORT, SHORT, SHORT],
    ]


def test_gap_or_outage_at_the_border_of_a_window_counts_where_it_is_inside():
    speed = np.full(6, 1.0)
    drive = make_drive(speed, speed, NO_SLIP, dt=0.25)
    drive.held[2] = 0.0  # a gap between the states 2 and 3
    drive.in_outage[5] = True
    assert trial_ends(drive, np.array([0.5])).ravel().tolist() == [2, GAP, GAP, OUTAGE, SHORT, SHORT]


@pytest.mark.parametrize("n", [0, 1, 2])
def test_shortest_drives_have_a_result(n):
    drive = make_drive(np.full(n, 1.0), np.full(n, 1.0), NO_SLIP, dt=1.0)
    ends = trial_ends(drive, np.array([1.0, 5.0]))
    for solve in (open_loop_errors, open_loop_errors_direct):
        errors = solve(drive, NO_SLIP, ends)
        assert errors.shape == (n, 2)
        assert np.isfinite(errors).sum() == (n == 2)


def test_a_robot_that_never_moves_has_no_trials():
    drive = make_drive(np.zeros(300), np.zeros(300), NO_SLIP)
    ends = trial_ends(drive, HORIZONS)
    assert (ends == SHORT).all()
    assert np.isnan(open_loop_errors(drive, NO_SLIP, ends)).all()


def test_the_model_that_drove_makes_no_error():
    n = 3000
    icrs = FrozenIcrs.constant(0.7, -0.5, 0.2)
    v_left = 1.0 + 0.4 * np.sin(0.01 * np.arange(n))
    drive = make_drive(v_left, np.full(n, 0.9), icrs, north0=4e5, east0=-3e5, heading0=900.0)
    errors = open_loop_errors(drive, icrs, trial_ends(drive, HORIZONS))
    assert np.nanmax(errors) < EQUAL_M  # the reference itself is rounded to 6e-11 m so far from the datum


@pytest.mark.parametrize("seed", [0, 1])
def test_fast_equals_direct_over_many_blocks_tiles_and_ranges(monkeypatch, seed):
    drive, icrs = winding_drive(n=7000, seed=seed)
    drive.held[::1777] = 0.0
    ends = trial_ends(drive, HORIZONS)
    direct = open_loop_errors_direct(drive, icrs, ends)
    np.testing.assert_allclose(open_loop_errors(drive, icrs, ends), direct, rtol=0.0, atol=EQUAL_M)
    monkeypatch.setattr(open_loop, "BLOCK", 100)
    monkeypatch.setattr(open_loop, "CONSTANT_BLOCK", 300)
    np.testing.assert_allclose(open_loop_errors(drive, icrs, ends), direct, rtol=0.0, atol=EQUAL_M)
    fast, slow = open_loop_errors(drive, NO_SLIP, ends), open_loop_errors_direct(drive, NO_SLIP, ends)
    np.testing.assert_allclose(fast, slow, rtol=0.0, atol=EQUAL_M)
    for lo, hi in [(0, 1), (3001, 5500), (6990, 7000)]:
        part = trial_ends(drive, HORIZONS, lo, hi)
        np.testing.assert_array_equal(part, ends[lo:hi])
        np.testing.assert_allclose(open_loop_errors(drive, icrs, part, lo), direct[lo:hi], rtol=0.0, atol=EQUAL_M)


def test_icrs_too_wild_for_moments_are_integrated_directly(monkeypatch):
    drive, icrs = winding_drive(n=900)
    rng = np.random.default_rng(5)
    wild = FrozenIcrs(icrs.y_icr_right, icrs.y_icr_right - rng.choice([1e-9, 0.05, 3.0], 900), icrs.x_icr)
    ends = trial_ends(drive, HORIZONS)
    rows = []
    integrate = open_loop.integrate_trials
    monkeypatch.setattr(open_loop, "integrate_trials", lambda *args: (rows.append(args[4:6]), integrate(*args)))
    fast, direct = open_loop_errors(drive, wild, ends), open_loop_errors_direct(drive, wild, ends)
    assert rows
    assert np.isfinite(fast[ends >= 0]).all()
    np.testing.assert_allclose(fast, direct, rtol=0.0, atol=EQUAL_M)


def test_memory_does_not_grow_with_the_window():
    n = 150_000
    rng = np.random.default_rng(0)
    creep = 1e-3 * rng.random(n)  # 100 times slower than a robot drives: every window reaches to the end
    icrs = FrozenIcrs.constant(0.5, -0.5, 0.0)
    drive = make_drive(creep, creep, icrs)
    ends = trial_ends(drive, np.array([0.2]))
    open_loop_errors(drive, icrs, ends)
    tracemalloc.start()
    open_loop_errors(drive, icrs, ends)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < n * 8 + 8e6  # the result, and one block of 32768 starts and as many states


def test_path_is_the_circular_arc_of_closed_form_as_the_step_shrinks():
    icrs = (0.6, -0.5, 0.1)
    v_left, v_right, duration = 1.2, 0.8, 5.0
    omega = (v_left - v_right) / 1.1
    v_x, v_y = (v_left * 0.6 + v_right * 0.5) / 1.1, -omega * 0.1
    angle = omega * duration
    north = (v_x * math.sin(angle) - v_y * (1.0 - math.cos(angle))) / omega
    east = (v_x * (1.0 - math.cos(angle)) + v_y * math.sin(angle)) / omega
    misses = []
    for steps in (500, 1000):
        speeds = np.full(steps + 1, v_left), np.full(steps + 1, v_right)
        drive = make_drive(*speeds, FrozenIcrs.constant(*icrs), dt=duration / steps)
        path = open_loop_path(drive, *icrs, 0, steps)
        assert path.heading[-1] == pytest.approx(angle, abs=ROUNDING)
        misses.append(math.hypot(path.north[-1] - north, path.east[-1] - east))
    assert misses[0] < 0.01  # half a step of 1 cm, turned by less than a right angle twice
    assert misses[1] == pytest.approx(0.5 * misses[0], rel=0.01)  # Euler is of first order


def test_path_begins_at_the_reference_and_ends_as_far_off_as_the_error_says():
    drive, icrs = winding_drive()
    ends = trial_ends(drive, np.array([3.0]))
    errors = open_loop_errors_direct(drive, icrs, ends)
    start, end = 400, int(ends[400, 0])
    path = open_loop_path(drive, *(float(column[start]) for column in icrs), start, end)
    assert len(path.north) == end - start + 1
    assert (path.north[0], path.east[0], path.heading[0]) == (
        drive.north[start],
        drive.east[start],
        drive.heading[start],
    )
    miss = math.hypot(path.north[-1] - drive.north[end], path.east[-1] - drive.east[end])
    assert miss == pytest.approx(errors[start, 0], abs=EQUAL_M)


def test_read_only_and_strided_columns_are_taken():
    drive, icrs = winding_drive(n=400)
    expected = open_loop_errors(drive, icrs, trial_ends(drive, HORIZONS))
    names = ("t", "held", "v_left", "v_right", "north", "east", "heading", "distance")
    table = np.stack([getattr(drive, name) for name in names], axis=1)
    table.flags.writeable = False
    odd = Track.of_states(*table.T)
    np.testing.assert_array_equal(open_loop_errors(odd, icrs, trial_ends(odd, HORIZONS)), expected)


class TestKernelsAgainstTheirPythonFunction:
    def test_direct_integration(self):
        drive, icrs = troubled_drive()
        ends = np.ascontiguousarray(trial_ends(drive, HORIZONS).T)
        errors = np.full(ends.shape, np.nan)
        open_loop.integrate_trials.py_func(open_loop.compiled_columns(drive), icrs, ends, 0, 0, 260, errors)
        np.testing.assert_allclose(errors.T, open_loop_errors_direct(drive, icrs, ends.T), rtol=0.0, atol=ROUNDING)

    def test_fast_algorithm(self, monkeypatch):
        drive, icrs = troubled_drive()
        ends = trial_ends(drive, HORIZONS)
        compiled = open_loop_errors(drive, icrs, ends)
        for name in ("sum_moments", "fill_errors"):
            monkeypatch.setattr(open_loop, name, getattr(open_loop, name).py_func)
        np.testing.assert_allclose(open_loop_errors(drive, icrs, ends), compiled, rtol=0.0, atol=ROUNDING)


def test_every_trial_of_the_shared_vector_ends_where_it_states() -> None:
    origin, n = np.zeros(len(PATH)), len(PATH)
    # The reference stays at the origin: an error is the distance from there.
    track = Track.of_states(
        np.concatenate([[0.0], np.cumsum(HELD_S)[:-1]]), HELD_S, V_LEFT_MPS, V_RIGHT_MPS, origin, origin,
        np.full(n, PATH[0, 2]), np.arange(n, dtype=np.float64),
    )  # fmt: skip
    path = open_loop_path(track, *ICRS_M, 0, n - 1)
    moved = PATH[:, :2] - PATH[0, :2]
    np.testing.assert_allclose(np.column_stack([path.north, path.east]), moved, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(path.heading, PATH[:, 2], rtol=0, atol=ROUNDING)
    ends = np.full((n, n - 1), SHORT)
    ends[0] = np.arange(1, n)
    for errors in (open_loop_errors, open_loop_errors_direct):
        found = errors(track, FrozenIcrs.constant(*ICRS_M), ends)
        np.testing.assert_allclose(found[0], np.hypot(*moved[1:].T), rtol=0, atol=EQUAL_M)
