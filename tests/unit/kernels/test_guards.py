"""Each sign guard compared with complex-step differences, the covariance at stops, and motion by the filter's model."""

from __future__ import annotations

import math

import numpy as np
import pytest

from icrtool.kernels.ekf import run_ekf
from icrtool.kernels.filter_records import GUARDED, PRINTED, UNGUARDED, FilterInputs, FilterOutput, FilterParameters
from icrtool.kernels.kalman import propagate
from icrtool.kernels.kinematics import model_states, step_jacobian
from support.matrix_filter import step_state

DERIVATIVE_TOLERANCE = 1e-12

PARAMETERS = FilterParameters(
    process_variance=(0.04, 0.04, math.radians(5.0) ** 2, 1e-4, 1e-4, 1e-4),
    rate_invariant=False,
    step_heading=0.0,
    gnss_gate=math.inf,
    heading_gate=math.inf,
    heading_correlation=1.0,
    antenna_forward=0.0,
    antenna_right=0.0,
    wheel_gap_s=math.inf,
    gap_speed_variance=4.0,
    gap_turn_variance=1.0,
    recovery_count=10,
    recovery_s=1.0,
    icr_inflation_m2=100.0,
    least_icr=-math.inf,
)


def filtered(
    icrs: tuple[float, float, float], parameters: FilterParameters = PARAMETERS, rows: int = 600,
    stops: tuple[int, ...] = (), change_s: float = 8.0,
) -> FilterOutput:  # fmt: skip
    rng = np.random.default_rng(3)
    t = np.arange(600) / 50
    fix = np.arange(0, 600, 5)
    v_left = 0.4 + 0.2 * np.sin(0.7 * t) + rng.normal(0, 0.01, 600)
    v_right = 0.4 + 0.2 * np.sin(0.5 * t) + rng.normal(0, 0.01, 600)
    x0 = np.array([0.0, 0.0, 0.0, 0.5, -0.75, -0.25])
    truth = model_states(x0, t, v_left, v_right, np.zeros(6), False, np.zeros((600, 6)))
    data = FilterInputs(
        t[:rows], v_left[:rows], v_right[:rows],
        t[fix], truth[fix, :2] + rng.normal(0, 0.01, (len(fix), 2)), np.full((len(fix), 2), 1e-4),
        t, truth[:, 2] + rng.normal(0, math.radians(1), 600), np.full(600, math.radians(1) ** 2), np.array([change_s]),
    )  # fmt: skip
    x0[3:] = icrs
    P0 = np.diag([1e-4, 1e-4, math.radians(1) ** 2, 0.25, 0.25, 0.25])
    return run_ekf(data, 0.0, x0, P0, parameters, stops)


def predict(x: np.ndarray, P: np.ndarray, v_left: float, v_right: float, guard: int) -> None:
    """Take an Euler step of 0.01 s, in place."""
    G = np.empty((3, 4))
    turn, _ = step_jacobian(x, v_left, v_right, 0.01, 0.0, guard, G)
    propagate(G, P, np.empty((3, 6)), 3, 2, 4, 6)
    x[:3] += G[1, 0], -G[0, 0], turn


def test_the_covariance_at_a_stop_is_that_of_a_run_that_ends_there() -> None:
    icrs = (0.6, -0.6, 0.0)
    out = filtered(icrs, stops=(100, 250, 599))
    np.testing.assert_array_equal(out.P_at_stops, [filtered(icrs, rows=rows).P for rows in (101, 251, 600)])
    np.testing.assert_array_equal(out.x, filtered(icrs).x)


@pytest.mark.parametrize("guard", [UNGUARDED, PRINTED])
def test_all_guards_agree_while_the_icrs_are_proper(guard: int) -> None:
    icrs, never = (0.6, -0.6, 0.0), 100.0
    other = filtered(icrs, PARAMETERS._replace(guard=guard), change_s=never)
    np.testing.assert_array_equal(filtered(icrs, change_s=never).x, other.x)


@pytest.mark.parametrize("guard", [UNGUARDED, PRINTED])
def test_guards_differ_where_the_icrs_are_inverted(guard: int) -> None:
    icrs = (-0.5, 0.4, 0.1)
    guarded, other = filtered(icrs), filtered(icrs, PARAMETERS._replace(guard=guard))
    assert np.abs(guarded.x[20] - other.x[20]).max() > 1e-3


def unguarded_step(x: np.ndarray, v_left: float, v_right: float, dt: float) -> np.ndarray:
    """Eqs. 8-10 and 14 as they stand."""
    N, E, psi, y_r, y_l, x_v = x
    v_x = (v_right * y_l - v_left * y_r) / (y_l - y_r)
    v_y = (v_left - v_right) * x_v / (y_l - y_r)
    omega = -(v_left - v_right) / (y_l - y_r)
    c, s = np.cos(psi), np.sin(psi)
    return np.array([N + dt * (v_x * c - v_y * s), E + dt * (v_x * s + v_y * c), psi + dt * omega, y_r, y_l, x_v])


@pytest.mark.parametrize("icrs", [(0.5, -0.75, -0.25), (-0.3, 0.4, 0.1)])
@pytest.mark.parametrize(("guard", "step"), [(UNGUARDED, unguarded_step), (GUARDED, step_state)])
def test_a_guards_covariance_is_propagated_with_its_own_derivatives(guard, step, icrs) -> None:
    x = np.array([3.0, -2.0, 0.7, *icrs])
    F = np.column_stack([np.imag(step(x + 1j * 1e-30 * np.eye(6)[i], 0.31, 0.52, 0.01)) / 1e-30 for i in range(6)])
    A = np.random.default_rng(1).normal(size=(6, 6))
    P = A @ A.T
    moved = x.copy()
    predict(moved, P, 0.31, 0.52, guard)
    np.testing.assert_allclose(P, F @ A @ A.T @ F.T, atol=DERIVATIVE_TOLERANCE * 100)
    np.testing.assert_allclose(moved, np.real(step(x, 0.31, 0.52, 0.01)), atol=DERIVATIVE_TOLERANCE)


def test_printed_derivatives_are_those_of_the_proper_branch() -> None:
    """Eq. 28 with the difference of Eqs. 32-34 put in keep the proper sign for an inverted state."""
    x = np.array([0.0, 0.0, 0.0, -0.3, 0.4, 0.0])
    P = np.diag([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    predict(x, P, 0.5, 0.3, PRINTED)
    # d psi / d y_r = -dt omega / W, as where y_r is right of y_l
    assert P[2, 3] == pytest.approx(-0.01 * (0.2 / 0.7) / 0.7, rel=1e-12)


def test_model_states_without_noise_are_euler_steps() -> None:
    t = np.arange(50) / 10
    v_left, v_right = np.sin(t), np.cos(t)
    x0 = np.array([1.0, 2.0, 0.3, 0.5, -0.75, -0.25])
    states = model_states(x0, t, v_left, v_right, np.ones(6), False, np.zeros((50, 6)))
    x = x0
    for k in range(49):
        x = step_state(x, v_left[k], v_right[k], t[k + 1] - t[k])
    np.testing.assert_allclose(states[-1], x, rtol=1e-12)


@pytest.mark.parametrize(("rate_invariant", "scale"), [(False, 0.1), (True, math.sqrt(0.01 * 0.1))])
def test_model_states_are_disturbed_as_the_filter_expects(rate_invariant: bool, scale: float) -> None:
    noise = np.random.default_rng(0).normal(size=(20_000, 6))
    t = np.arange(20_000) / 10
    std = np.array([0.2, 0.2, 0.1, 0.0, 0.0, 0.0])
    x0 = np.array([0.0, 0.0, 0.0, 0.5, -0.75, -0.25])
    states = model_states(x0, t, np.zeros(20_000), np.zeros(20_000), std, rate_invariant, noise)
    np.testing.assert_allclose(np.diff(states, axis=0).std(axis=0), scale * std, rtol=0.02)
