"""The true motion against closed forms, and against the limit of Euler steps."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from icrtool.kernels import kinematics as simulate
from icrtool.kernels.kinematics import body_velocity
from support.matrix_filter import step_state

EXACT = 1e-9
"""Arcs are exact; what is left is rounding over some ten thousand steps [m, rad]."""

ICRS = np.array([0.5, -0.75, -0.25])
NO_CHANGE = ICRS[None, :]


def drive(seconds: float, v_left: float, v_right: float, step: float = 0.01, start=(0.0, 0.0, 0.0)) -> np.ndarray:
    t = np.arange(round(seconds / step) + 1) * step
    speeds = np.full(len(t), v_left), np.full(len(t), v_right)
    return simulate.drive(t, *speeds, NO_CHANGE, np.zeros(len(t), np.int64), np.array(start))


def test_a_circle_has_the_radius_that_the_icrs_give_it() -> None:
    v_left, v_right = 0.6, 0.3
    omega = (v_left - v_right) / 1.25
    v_x = (v_left * 0.5 + v_right * 0.75) / 1.25
    pose = drive(2 * math.pi / omega, v_left, v_right, step=2 * math.pi / omega / 5000)
    # The body turns about a point to its right by v_x / omega, and in front by x_icr.
    centre = np.array([-0.25, v_x / omega])
    radius = math.hypot(-0.25, v_x / omega)
    np.testing.assert_allclose(np.hypot(*(pose[:, :2] - centre).T), radius, atol=EXACT)
    np.testing.assert_allclose(pose[-1], [0.0, 0.0, 2 * math.pi], atol=EXACT)


def test_a_spin_in_place_leaves_the_icr_where_it_is() -> None:
    omega = 0.8
    pose = drive(20.0, 0.75 * omega, -0.5 * omega, start=(3.0, -2.0, 1.0))
    icr = pose[:, :2] - 0.25 * np.column_stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])])
    np.testing.assert_allclose(icr, np.tile(icr[0], (len(icr), 1)), atol=EXACT)
    assert pose[-1, 2] == pytest.approx(1.0 + 16.0, abs=EXACT)


def test_equal_speeds_drive_straight() -> None:
    pose = drive(10.0, 0.4, 0.4, start=(0.0, 0.0, 0.3))
    np.testing.assert_allclose(pose[-1], [4 * math.cos(0.3), 4 * math.sin(0.3), 0.3], atol=EXACT)


@settings(suppress_health_check=[HealthCheck.too_slow])  # its first draw loads modules
@given(
    st.floats(-2, 2), st.floats(-2, 2), st.floats(1e-4, 5.0), st.floats(0.01, 0.99), st.floats(-7, 7)
)  # fmt: skip
def test_a_step_cut_in_two_ends_in_the_same_place(
    v_left: float, v_right: float, dt: float, share: float, psi: float
) -> None:
    def drive_until(*times: float) -> np.ndarray:
        t = np.array([0.0, *times])
        speeds = np.full(len(t), v_left), np.full(len(t), v_right)
        return simulate.drive(t, *speeds, NO_CHANGE, np.zeros(len(t), np.int64), np.array([1.0, 2.0, psi]))[-1]

    np.testing.assert_allclose(drive_until(share * dt, dt), drive_until(dt), atol=EXACT)


def test_euler_steps_close_in_on_the_arc_with_first_order() -> None:
    exact = drive(2.0, 0.7, 0.2)[-1]
    misses = []
    for steps in (200, 400, 800):
        x = np.array([0.0, 0.0, 0.0, *ICRS])
        for _ in range(steps):
            x = step_state(x, 0.7, 0.2, 2.0 / steps)
        misses.append(np.hypot(*(x[:2] - exact[:2])))
    assert misses[0] / misses[1] == pytest.approx(2.0, rel=0.02)
    assert misses[1] / misses[2] == pytest.approx(2.0, rel=0.02)


def test_poses_between_and_at_the_grid_lie_on_the_arcs() -> None:
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.001, 0.02, 200))
    v_left, v_right = rng.uniform(-1, 1, (2, 200))
    icrs = np.array([ICRS, [0.8, -0.4, 0.1]])
    which = (t > t[100]).astype(np.int64)
    pose = simulate.drive(t, v_left, v_right, icrs, which, np.zeros(3))
    found = simulate.poses_at(t, t, v_left, v_right, icrs, which, pose)
    np.testing.assert_allclose(found, pose, atol=0.0)
    before_next = simulate.poses_at(t[1:] - 1e-9, t, v_left, v_right, icrs, which, pose)
    np.testing.assert_allclose(before_next, pose[1:], atol=1e-8)


def test_a_lagging_track_closes_in_on_its_command_exponentially() -> None:
    t = np.arange(300) * 0.01
    command = np.where(t < 1.0, 0.0, 0.5)
    speed = simulate.follow(command, t, 0.25)
    late = t >= 1.0
    np.testing.assert_allclose(speed[late], 0.5 * (1 - np.exp(-(t[late] - 1.0) / 0.25)), atol=EXACT)


def test_the_kernel_equals_its_python_function() -> None:
    kept = np.random.default_rng(0).uniform(0.0, 1.0, 49)
    compiled, plain = np.sin(np.arange(50.0)), np.sin(np.arange(50.0))
    simulate.lag(compiled, kept)
    simulate.lag.py_func(plain, kept)  # type: ignore[attr-defined]
    np.testing.assert_allclose(compiled, plain, rtol=1e-12)


def test_on_a_steady_circle_inverted_icrs_explain_the_motion_as_well_as_the_true_ones() -> None:
    """Why the guard alone cannot bring an inverted filter back there (docs/paper.md, Fig. 10)."""
    v_left, v_right = 0.6, 0.3
    v_x, _, omega = body_velocity(v_left, v_right, 0.5, -0.75, -0.25)
    width = 1.25
    y_right = (v_x + v_right) * width / (v_left - v_right)
    assert body_velocity(v_left, v_right, y_right, y_right + width, -0.25)[::2] == pytest.approx((v_x, omega))
