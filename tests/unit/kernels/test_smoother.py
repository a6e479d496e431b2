"""The smoother compared with a dense batch least squares of the same linearised problem, and over chunk sizes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from icrtool.kernels import ekf, kalman
from icrtool.kernels.ekf import filter_rows, run_ekf, run_smoother, wrap
from icrtool.kernels.filter_records import (
    REFERENCE_STEP_S,
    FilterInputs,
    FilterOutput,
    FilterParameters,
    FilterState,
    Nodes,
)
from support.matrix_filter import state_jacobian

BATCH_TOLERANCE = 1e-7
"""Relative: the dense normal equations are conditioned like 1e8."""

LEVER = (0.2, -0.1)


def parameters(**other: object) -> FilterParameters:
    values: dict[str, object] = {
        "process_variance": (0.04, 0.04, 0.01, 1e-4, 1e-4, 1e-4), "rate_invariant": True, "step_heading": 0.5,
        "gnss_gate": math.inf, "heading_gate": math.inf, "heading_correlation": 3.0,
        "antenna_forward": LEVER[0], "antenna_right": LEVER[1],
        "wheel_gap_s": 0.5, "gap_speed_variance": 4.0, "gap_turn_variance": 1.0, "recovery_count": 5, "recovery_s": 0.2,
        "icr_inflation_m2": 100.0, "least_icr": -math.inf,
    }  # fmt: skip
    return FilterParameters(**(values | other))


def measurements(n: int = 30, seed: int = 0) -> FilterInputs:
    """A robot that turns, fixes between the wheel stamps, headings upon them, and a gap in the wheel data."""
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(n)
    t[n // 2 :] += 1.0
    fix_t = np.arange(0.25, t[-1], 0.2) + 0.013
    return FilterInputs(
        wheel_t=t, v_left=0.6 + 0.4 * np.sin(3 * t), v_right=0.5 + 0.3 * np.cos(2 * t),
        gnss_t=fix_t, gnss_z=np.cumsum(rng.normal(0.1, 0.05, (len(fix_t), 2)), axis=0),
        gnss_r=np.full((len(fix_t), 2), 4e-4),
        heading_t=t[2::3].copy(), heading_z=0.2 * t[2::3] + rng.normal(0, 0.02, len(t[2::3])),
        heading_r=np.full(len(t[2::3]), 4e-4), change_t=np.empty(0),
    )  # fmt: skip


X0 = np.array([0.0, 0.0, 0.1, 0.5, -0.5, 0.05])
P0 = np.diag([1e-2, 1e-2, 1e-2, 0.09, 0.09, 0.04])


def nodes_of(data: FilterInputs, settings: FilterParameters) -> Nodes:
    end = len(data.wheel_t)
    state, out = FilterState.start(0.0, X0, P0), FilterOutput.empty(data, end)
    return filter_rows(data, 0, end, state, settings, out, 0, keep=True)


def test_smoothed_states_are_the_batch_solution() -> None:
    data, settings = measurements(), parameters()
    nodes = nodes_of(data, settings)
    count = len(nodes.row)
    information, vector = np.zeros((6 * count, 6 * count)), np.zeros(6 * count)

    def add(rows: dict[int, np.ndarray], target: np.ndarray, covariance: np.ndarray) -> None:
        """Add sum_i A_i x_i = target with the covariance."""
        weight = np.linalg.inv(covariance)
        for i, A in rows.items():
            vector[6 * i : 6 * i + 6] += A.T @ weight @ target
            for k, B in rows.items():
                information[6 * i : 6 * i + 6, 6 * k : 6 * k + 6] += A.T @ weight @ B

    times, j, h = np.unique(np.concatenate([[0.0], data.wheel_t, data.gnss_t, data.heading_t])), 0, 0
    assert count == len(times)
    for i, t in enumerate(times):
        predicted, P_predicted = nodes.x_predicted[i], nodes.P_predicted[i]
        if i == 0:
            add({0: np.eye(6)}, X0, P0)
        else:
            dt, k = t - times[i - 1], int(np.searchsorted(data.wheel_t, t))
            gap = data.wheel_t[k] - data.wheel_t[k - 1] > settings.wheel_gap_s
            v_left, v_right = data.v_left[k - 1], data.v_right[k - 1]
            F = np.eye(6) if gap else state_jacobian(nodes.x[i - 1], v_left, v_right, dt, settings.step_heading)
            Q = np.diag(settings.process_variance) * REFERENCE_STEP_S * dt
            Q[3:] *= (abs(v_left) + abs(v_right)) / 2.0
            Q += gap * dt * np.diag([4.0, 4.0, 1.0, 0.0, 0.0, 0.0])
            assert np.allclose(F @ nodes.P[i - 1] @ F.T + Q, P_predicted, atol=1e-12)
            add({i: np.eye(6), i - 1: -F}, predicted - F @ nodes.x[i - 1], Q)
        while j < len(data.gnss_t) and data.gnss_t[j] <= t + 1e-12:
            c, s = math.cos(predicted[2]), math.sin(predicted[2])
            a = np.array([LEVER[0] * c - LEVER[1] * s, LEVER[0] * s + LEVER[1] * c])
            H = np.zeros((2, 6))
            H[0, 0] = H[1, 1] = 1.0
            H[:, 2] = [-a[1], a[0]]
            add({i: H}, data.gnss_z[j] - predicted[:2] - a + H @ predicted, np.diag(data.gnss_r[j]))
            j += 1
        while h < len(data.heading_t) and data.heading_t[h] <= t + 1e-12:
            H = np.eye(6)[2:3]
            nu = wrap(data.heading_z[h] - predicted[2])
            add({i: H}, np.array([nu + predicted[2]]), np.array([[3.0 * data.heading_r[h]]]))
            h += 1
    assert (j, h) == (len(data.gnss_t), len(data.heading_t))
    batch = np.linalg.solve(information, vector).reshape(count, 6)
    variance = np.diag(np.linalg.inv(information)).reshape(count, 6)
    smoothed = run_smoother(data, 0.0, X0, P0, settings)
    recorded = nodes.row >= 0
    assert np.allclose(smoothed.x, batch[recorded], rtol=BATCH_TOLERANCE, atol=BATCH_TOLERANCE)
    assert np.allclose(smoothed.variance, variance[recorded], rtol=1e-5, atol=1e-10)


def test_the_forward_pass_is_the_filters() -> None:
    data, settings = measurements(200), parameters(gnss_gate=9.0, heading_gate=9.0)
    nodes = nodes_of(data, settings)
    assert np.array_equal(nodes.x[nodes.row >= 0], run_ekf(data, 0.0, X0, P0, settings).x)


@pytest.mark.parametrize("rows", [1, 7, 64, 200])
def test_chunks_do_not_matter(rows: int) -> None:
    data, settings = measurements(200), parameters(gnss_gate=9.0)
    whole, parts = (run_smoother(data, 0.0, X0, P0, settings, size) for size in (10_000, rows))
    assert np.array_equal(whole.x, parts.x)
    assert np.array_equal(whole.variance, parts.variance)


def test_smoothing_never_adds_variance_and_ends_where_the_filter_does() -> None:
    data, settings = measurements(300), parameters()
    filtered, smoothed = run_ekf(data, 0.0, X0, P0, settings), run_smoother(data, 0.0, X0, P0, settings)
    assert np.all(smoothed.variance <= filtered.variance * (1 + 1e-9) + 1e-15)
    assert np.array_equal(smoothed.x[-1], filtered.x[-1])
    assert smoothed.variance[0, 3] < 0.5 * filtered.variance[0, 3]


def test_a_state_that_is_known_for_certain_stays() -> None:
    data, settings = measurements(200), parameters(process_variance=(0.04, 0.04, 0.01, 0.0, 0.0, 0.0))
    known = P0.copy()
    known[4, :] = known[:, 4] = 0.0
    smoothed = run_smoother(data, 0.0, X0, known, settings)
    assert np.array_equal(smoothed.x[:, 4], np.full(200, X0[4]))
    assert np.array_equal(smoothed.variance[:, 4], np.zeros(200))
    assert np.ptp(smoothed.x[:, 3]) < BATCH_TOLERANCE


def test_kernels_equal_their_python_source(monkeypatch: pytest.MonkeyPatch) -> None:
    data, settings = measurements(25), parameters()
    nodes, smoothed = nodes_of(data, settings), run_smoother(data, 0.0, X0, P0, settings)
    monkeypatch.setattr(ekf, "filter_events", ekf.filter_events.py_func)  # type: ignore[attr-defined]
    assert all(np.allclose(a, b, rtol=1e-12) for a, b in zip(nodes, nodes_of(data, settings), strict=True))
    monkeypatch.setattr(kalman, "step_back", kalman.step_back.py_func)  # type: ignore[attr-defined]
    plain = run_smoother(data, 0.0, X0, P0, settings)
    assert np.allclose(smoothed.x, plain.x, rtol=1e-12)
    assert np.allclose(smoothed.variance, plain.variance, rtol=1e-9, atol=1e-12)
