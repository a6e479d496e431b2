"""The kernel of window fits against the open-loop oracle, differences and its own Python source."""

from __future__ import annotations

import numpy as np
import pytest

from icrtool.kernels import window_errors as window_fit
from icrtool.kernels.open_loop import open_loop_path
from icrtool.kernels.trials import Drive
from icrtool.kernels.window_errors import NEUTRAL, PARAMETERS, Motion, displace, integrate, march, rates

ROUNDING_M = 1e-10
"""Prefix sums over some hundred metres lose this much to rounding."""

DIFFERENCE_STEP = 1e-6
DIFFERENCE_TOLERANCE = 2e-6
"""Central differences of values of order ten metres at that step."""


def make_drive(n: int = 600, seed: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    dt = rng.uniform(0.02, 0.08, n)
    t = np.concatenate([[0.0], np.cumsum(dt[:-1])])
    left = 0.6 + 0.5 * np.sin(0.7 * t) + 0.05 * rng.standard_normal(n)
    right = 0.6 + 0.5 * np.sin(0.4 * t + 1.0) + 0.05 * rng.standard_normal(n)
    dt[-1] = 0.0
    return t, dt, left, right


LAGS = (0.0, 0.5)
"""Shares of a step after which its heading is taken: Euler, and the middle of the turn."""

P = np.array([0.71, -0.64, 0.11, 1.02, 0.97, -0.2, 0.15])


def test_displacements_equal_the_open_loop_path() -> None:
    t, dt, left, right = make_drive()
    heading = np.linspace(0.3, 4.0, len(t))
    drive = Drive(dt, left, right, 0 * t, 0 * t, heading, t, np.zeros(len(t), bool), np.zeros(len(t), bool))
    p = np.array([0.71, -0.64, 0.11, *NEUTRAL[3:]])
    motion = integrate(t, dt, left, right, p, t)
    start, end = np.array([0, 40, 250]), np.array([100, 41, 599])
    d, _, _ = displace(motion, start, end)
    for k, (s, e) in enumerate(zip(start, end, strict=True)):
        path = open_loop_path(drive, 0.71, -0.64, 0.11, int(s), int(e))
        expected = (path.north[-1] + 1j * path.east[-1]) * np.exp(-1j * heading[s])
        assert abs(d[k] - expected) < ROUNDING_M


def test_a_lag_of_half_a_step_moves_along_the_middle_of_each_turn() -> None:
    t, dt, left, right = make_drive()
    motion = integrate(t, dt, left, right, np.array([0.71, -0.64, 0.11, *NEUTRAL[3:]]), t, 0.5 * dt)
    omega = (left - right) / 1.35
    theta = np.concatenate([[0.0], np.cumsum(dt * omega)[:-1]])
    ahead = (0.71 * left + 0.64 * right) / 1.35
    middle = np.exp(0.5j * (theta[1:] + theta[:-1]))
    place = np.concatenate([[0.0], np.cumsum((dt * (ahead - 0.11j * omega))[:-1] * middle)])
    assert np.allclose(motion.theta, theta, rtol=0, atol=ROUNDING_M)
    assert np.allclose(motion.place, place, rtol=0, atol=ROUNDING_M)


@pytest.mark.parametrize("lag", LAGS)
@pytest.mark.parametrize("column", range(7), ids=PARAMETERS)
def test_derivative_equals_central_differences(column: int, lag: float) -> None:
    t, dt, left, right = make_drive()
    times = np.sort(np.random.default_rng(0).uniform(0, t[-1], 40))
    start, end = np.arange(20), np.arange(20) + 20
    _, by, _ = displace(integrate(t, dt, left, right, P, times, lag * dt), start, end)
    sides = []
    for sign in (1, -1):
        q = P.copy()
        q[column] += sign * DIFFERENCE_STEP
        sides.append(displace(integrate(t, dt, left, right, q, times, lag * dt), start, end)[0])
    assert np.allclose((sides[0] - sides[1]) / (2 * DIFFERENCE_STEP), by[:, column], atol=DIFFERENCE_TOLERANCE)


@pytest.mark.parametrize("lag", LAGS)
def test_derivative_by_a_shift_of_time_equals_central_differences(lag: float) -> None:
    t, dt, left, right = make_drive()
    times = t[5:45] + 0.4 * dt[5:45]
    start, end = np.arange(20), np.arange(20) + 20
    _, _, late = displace(integrate(t, dt, left, right, P, times, lag * dt), start, end)
    ahead, behind = (
        displace(integrate(t, dt, left, right, P, times + s, lag * dt), start, end)[0] for s in (1e-6, -1e-6)
    )
    assert np.allclose((ahead - behind) / 2e-6, late, atol=DIFFERENCE_TOLERANCE)


@pytest.mark.parametrize("lag", LAGS)
def test_kernel_equals_its_python_source(monkeypatch: pytest.MonkeyPatch, lag: float) -> None:
    t, dt, left, right = make_drive(80)
    times = np.linspace(-0.1, t[-1] + 0.1, 30)
    compiled = integrate(t, dt, left, right, P, times, lag * dt)
    m = len(times)
    plain = Motion(np.empty(m), np.empty(m, complex), np.empty((m, 7)), np.empty((m, 7), complex), np.empty(m),
                   np.empty(m, complex))  # fmt: skip
    monkeypatch.setattr(window_fit, "rates", rates.py_func)
    march.py_func(t, dt, lag * dt, left, right, P, times, *plain)
    for one, other in zip(compiled, plain, strict=True):
        assert np.allclose(one, other, rtol=0, atol=1e-12)


def test_nothing_moves_over_a_gap() -> None:
    t = np.array([0.0, 1.0, 5.0, 6.0])
    dt = np.array([1.0, 0.0, 1.0, 0.0])
    motion = integrate(
        t, dt, np.ones(4), np.ones(4), np.array([0.5, -0.5, *NEUTRAL[2:]]), np.array([0.5, 1.0, 3.0, 5.0, 5.5])
    )
    assert np.allclose(motion.place, [0.5, 1.0, 1.0, 1.0, 1.5])
