"""The compiled filter against its matrix twin, and both against a transcription of the paper."""

from __future__ import annotations

import math

import numpy as np
import pytest

from icrtool.kernels.ekf import run_ekf, wrap
from icrtool.kernels.filter_records import GATED, PRINTED, RECOVERED, UNSEEN, USED, FilterInputs, FilterParameters
from support.matrix_filter import drive_states, run_ekf_plain, state_jacobian, step_state

PAPER_Q = (0.2**2, 0.2**2, math.radians(5.0) ** 2, 1e-4, 1e-4, 1e-4)
TWIN_TOLERANCE = 1e-9
"""Joint and one-by-one updates round differently; states are of order 1 to 100 [m, rad]."""
TRANSCRIPTION_TOLERANCE = 1e-6
"""What the method asks of preset `paper`, in every column."""
INVERTED_S, INVERTED_STD_M = 1.5, 0.02
"""An inverted start is compared for this time [s], with this standard deviation [m]: W halves, and is not yet 0."""
COMPLEX_STEP = 1e-30
DERIVATIVE_TOLERANCE = 1e-12


def parameters(**changes: object) -> FilterParameters:
    values: dict[str, object] = {
        "process_variance": PAPER_Q,
        "rate_invariant": True,
        "step_heading": 0.5,
        "gnss_gate": math.inf,
        "heading_gate": math.inf,
        "heading_correlation": 1.0,
        "antenna_forward": 0.0,
        "antenna_right": 0.0,
        "wheel_gap_s": 0.5,
        "gap_speed_variance": 4.0,
        "gap_turn_variance": 1.0,
        "recovery_count": 10,
        "recovery_s": 1.0,
        "icr_inflation_m2": 100.0,
        "least_icr": -math.inf,
    }
    return FilterParameters(**(values | changes))  # type: ignore[arg-type]


def drive(
    seed: int, seconds: float = 30.0, rate: float = 50.0, icrs: tuple[float, float, float] = (0.5, -0.75, -0.25),
    *, coincident: bool = False,
) -> tuple[FilterInputs, np.ndarray]:  # fmt: skip
    """Simulate a drive of known ICRs with the paper's sensors; return measurements and true states at wheel stamps."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 1.0 / rate)
    if not coincident:
        t = np.sort(t + rng.uniform(0, 0.3 / rate, len(t)))
    v_left = 0.4 + 0.25 * np.sin(0.5 * t + rng.uniform(0, 6))
    v_right = 0.4 + 0.25 * np.sin(0.7 * t + rng.uniform(0, 6))
    x = drive_states(np.array([3.0, -2.0, 2.5, *icrs]), v_left, v_right, np.diff(t), 0.5)

    def at(times: np.ndarray) -> np.ndarray:
        return np.column_stack([np.interp(times, t, column) for column in x.T])

    gnss_t = t if coincident else np.sort(rng.uniform(0, t[-1], int(seconds * 20)))
    heading_t = t if coincident else np.sort(rng.uniform(0, t[-1], int(seconds * rate)))
    gnss_z = at(gnss_t)[:, :2] + rng.normal(0, 0.01, (len(gnss_t), 2))
    heading_z = np.array([wrap(h) for h in at(heading_t)[:, 2] + rng.normal(0, math.radians(1), len(heading_t))])
    return FilterInputs(
        t, v_left, v_right, gnss_t, gnss_z, np.full((len(gnss_t), 2), 1e-4), heading_t, heading_z,
        np.full(len(heading_t), math.radians(1) ** 2), np.empty(0),
    ), x  # fmt: skip


def start(data: FilterInputs, icrs: tuple[float, float, float] = (0.6, -0.6, 0.0), icr_std: float = 0.5):  # type: ignore[no-untyped-def]
    t0 = max(data.wheel_t[0], data.gnss_t[0], data.heading_t[0])
    z = data.gnss_z[np.searchsorted(data.gnss_t, t0, side="right") - 1]
    psi = data.heading_z[np.searchsorted(data.heading_t, t0, side="right") - 1]
    return t0, np.array([*z, psi, *icrs]), np.diag([1e-4, 1e-4, math.radians(1) ** 2, *([icr_std**2] * 3)])


def assert_twins(data: FilterInputs, settings: FilterParameters, **kwargs: object) -> None:
    t0, x0, P0 = start(data, **kwargs)  # type: ignore[arg-type]
    fast, plain = run_ekf(data, t0, x0, P0, settings), run_ekf_plain(data, t0, x0, P0, settings)
    for name in fast._fields:
        np.testing.assert_allclose(
            getattr(fast, name), getattr(plain, name), rtol=TWIN_TOLERANCE, atol=TWIN_TOLERANCE, err_msg=name
        )


def test_the_compiled_filter_equals_its_matrix_twin() -> None:
    data, _ = drive(1)
    assert_twins(data, parameters())


def test_twins_agree_with_lever_arm_gates_and_paper_noise() -> None:
    data, _ = drive(2)
    data.gnss_z[50::17] += 4.0
    data.heading_z[80::23] += 1.0
    settings = parameters(
        antenna_forward=0.3, antenna_right=-0.2, gnss_gate=18.4, heading_gate=15.1, heading_correlation=40.0
    )
    assert_twins(data, settings)
    assert_twins(data, settings._replace(rate_invariant=False, step_heading=0.0))


def test_twins_agree_through_gaps_changes_and_inverted_starts() -> None:
    data, _ = drive(3)
    keep = (data.wheel_t < 10) | (data.wheel_t > 12)
    data = data._replace(
        wheel_t=data.wheel_t[keep], v_left=data.v_left[keep], v_right=data.v_right[keep], change_t=np.array([7.0, 20.0])
    )
    assert_twins(data, parameters())
    assert_twins(data, parameters(), icrs=(-0.5, 0.5, 0.1))
    short, _ = drive(3, seconds=INVERTED_S)
    assert_twins(short, parameters(guard=PRINTED), icrs=(-0.7, 0.9, 1.0), icr_std=INVERTED_STD_M)
    assert_twins(data, parameters(least_icr=0.2), icrs=(-0.5, 0.5, 0.1))


def test_twins_agree_where_stamps_coincide() -> None:
    data, _ = drive(4, coincident=True)
    assert_twins(data, parameters())


def test_the_kernel_equals_its_python_function(monkeypatch: pytest.MonkeyPatch) -> None:
    from icrtool.kernels import ekf

    data, _ = drive(5, seconds=3.0)
    t0, x0, P0 = start(data)
    out = run_ekf(data, t0, x0, P0, parameters())
    monkeypatch.setattr(ekf, "filter_events", ekf.filter_events.py_func)  # type: ignore[attr-defined]
    again = run_ekf(data, t0, x0, P0, parameters())
    for name in out._fields:
        np.testing.assert_allclose(getattr(out, name), getattr(again, name), rtol=1e-12, atol=1e-12, err_msg=name)


def test_the_size_of_compiled_blocks_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    data, _ = drive(6, seconds=5.0)
    t0, x0, P0 = start(data)
    settings = parameters(gnss_gate=9.0, heading_gate=6.0)
    whole = run_ekf(data, t0, x0, P0, settings)
    monkeypatch.setattr("icrtool.kernels.ekf.BLOCK_EVENTS", 50)
    for name, one, other in zip(whole._fields, whole, run_ekf(data, t0, x0, P0, settings), strict=True):
        np.testing.assert_array_equal(one, other, err_msg=name)


@pytest.mark.parametrize("icrs", [(0.5, -0.75, -0.25), (-0.4, 0.3, 0.1), (0.0005, -0.0005, 0.1)])
def test_a_drive_of_the_oracle_is_its_steps_one_after_the_other(icrs: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(4)
    v_left, v_right = rng.normal(0.5, 0.3, (2, 200))
    dt = rng.uniform(0.01, 0.1, 199)
    states = drive_states(np.array([3.0, -2.0, 2.5, *icrs]), v_left, v_right, dt, 0.5)
    for before, after, left, right, step in zip(states[:-1], states[1:], v_left, v_right, dt, strict=False):
        np.testing.assert_allclose(after, step_state(before, left, right, step, 0.5), rtol=0, atol=1e-12)


@pytest.mark.parametrize("step_heading", [0.0, 0.5])
@pytest.mark.parametrize("icrs", [(0.5, -0.75, -0.25), (-0.3, 0.4, 0.1), (1.0, -1.0, 1.0)])
def test_the_jacobian_equals_complex_step_differences(icrs: tuple[float, float, float], step_heading: float) -> None:
    x = np.array([3.0, -2.0, 0.7, *icrs])
    F = state_jacobian(x, 0.31, 0.52, 0.1, step_heading)
    for column in range(6):
        stepped = x.astype(complex)
        stepped[column] += 1j * COMPLEX_STEP
        derivative = np.imag(step_state(stepped, 0.31, 0.52, 0.1, step_heading)) / COMPLEX_STEP
        np.testing.assert_allclose(F[:, column], derivative, atol=DERIVATIVE_TOLERANCE)


def printed_jacobian(x: np.ndarray, v_left: float, v_right: float, dt: float) -> np.ndarray:
    """Eqs. 17 and 27-29 as they are printed, with D, the difference of Eqs. 32-34, in place of y_l - y_r."""
    _, _, psi, y_r, y_l, x_v = x
    D = -abs(y_l - y_r)
    along, turning = v_right * y_l - v_left * y_r, (v_left - v_right) * x_v
    c, s = math.cos(psi), math.sin(psi)
    F = np.eye(6)
    F[0, 2] = dt * (-along / D * s - turning / D * c)
    F[1, 2] = dt * (along / D * c - turning / D * s)
    F[0, 3] = dt * (along * c / D**2 - v_left * c / D - turning * s / D**2)
    F[0, 4] = dt * (-along * c / D**2 + v_right * c / D + turning * s / D**2)
    F[0, 5] = -dt * (v_left - v_right) * s / D
    F[1, 3] = dt * (along * s / D**2 - v_left * s / D + turning * c / D**2)
    F[1, 4] = dt * (-along * s / D**2 + v_right * s / D - turning * c / D**2)
    F[1, 5] = dt * (v_left - v_right) * c / D
    F[2, 3] = -dt * (v_left - v_right) / D**2
    F[2, 4] = dt * (v_left - v_right) / D**2
    return F


def transcription(data: FilterInputs, x: np.ndarray, P: np.ndarray) -> np.ndarray:
    """Eqs. 14-25 as they stand in the paper, for a log with all three streams at the same stamps."""
    Q = np.diag(PAPER_Q)
    R = np.diag([0.01**2, 0.01**2, math.radians(1) ** 2])
    H = np.hstack([np.eye(3), np.zeros((3, 3))])
    states = [x]
    for k in range(1, len(data.wheel_t)):
        dt = data.wheel_t[k] - data.wheel_t[k - 1]
        u = data.v_left[k - 1], data.v_right[k - 1]
        F = printed_jacobian(x, *u, dt)
        x, P = step_state(x, *u, dt), F @ P @ F.T + dt**2 * Q
        y = np.array([*data.gnss_z[k], data.heading_z[k]])
        nu = y - H @ x
        nu[2] = (nu[2] + math.pi) % (2 * math.pi) - math.pi
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        x, P = x + K @ nu, (np.eye(6) - K @ H) @ P
        states.append(x)
    return np.array(states)


def test_derivatives_as_printed_are_the_true_ones_of_a_proper_state_only() -> None:
    for icrs, proper in (((0.5, -0.75, -0.25), True), ((-0.3, 0.4, 0.1), False)):
        x = np.array([3.0, -2.0, 0.7, *icrs])
        difference = np.abs(printed_jacobian(x, 0.31, 0.52, 0.01) - state_jacobian(x, 0.31, 0.52, 0.01)).max()
        assert (difference < DERIVATIVE_TOLERANCE) == proper


@pytest.mark.parametrize(
    ("icrs", "std", "seconds"), [((1.0, -1.0, 1.0), 1.0, 60.0), ((-0.7, 0.9, 1.0), INVERTED_STD_M, INVERTED_S)]
)
def test_the_papers_filter_equals_a_transcription(icrs: tuple[float, ...], std: float, seconds: float) -> None:
    """Its own start, and an inverted one."""
    data, _ = drive(6, seconds=seconds, rate=100.0, coincident=True)
    t0, x0, P0 = start(data, icrs=icrs, icr_std=std)
    settings = parameters(rate_invariant=False, step_heading=0.0, wheel_gap_s=math.inf, guard=PRINTED)
    out = run_ekf(data, t0, x0, P0, settings)
    np.testing.assert_allclose(out.x, transcription(data, x0, P0), atol=TRANSCRIPTION_TOLERANCE)


def test_one_state_is_recorded_per_wheel_sample_from_the_first_stamp_all_streams_have_been_seen() -> None:
    data, _ = drive(7)
    late = data.heading_t > 5.0
    data = data._replace(heading_t=data.heading_t[late], heading_z=data.heading_z[late], heading_r=data.heading_r[late])
    t0, x0, P0 = start(data)
    out = run_ekf(data, t0, x0, P0, parameters())
    assert len(out.x) == np.count_nonzero(data.wheel_t >= t0)
    assert (out.gnss_code[data.gnss_t <= t0] == UNSEEN).all()
    assert (out.gnss_code[(data.gnss_t > t0) & (data.gnss_t <= data.wheel_t[-1])] == USED).all()


def test_outliers_are_gated_and_a_jump_that_stays_is_believed_within_two_seconds() -> None:
    data, truth = drive(8, seconds=40.0)
    data.gnss_z[100::50] += [3.0, -4.0]
    data.gnss_z[data.gnss_t > 25.0] += [2.0, 1.0]
    settings = parameters(gnss_gate=18.4, heading_gate=15.1)
    t0, x0, P0 = start(data)
    out = run_ekf(data, t0, x0, P0, settings)
    before = data.gnss_t < 25.0
    outlier = np.zeros(len(data.gnss_t), bool)
    outlier[100::50] = True
    assert (out.gnss_code[outlier & before] == GATED).all()
    assert (out.gnss_code == RECOVERED).sum() == 1
    late = data.wheel_t[-len(out.x) :] > 28.0
    jumped = truth[-len(out.x) :, :2][late] + [2.0, 1.0]
    assert np.hypot(*(out.x[late, :2] - jumped).T).max() < 0.1


def test_a_gap_in_the_wheel_data_makes_the_pose_uncertain_and_drives_nowhere() -> None:
    data, _ = drive(9)
    keep = (data.wheel_t < 10) | (data.wheel_t > 13)
    blind = (data.gnss_t < 10) | (data.gnss_t > 13)
    data = data._replace(
        wheel_t=data.wheel_t[keep], v_left=data.v_left[keep], v_right=data.v_right[keep],
        gnss_t=data.gnss_t[blind], gnss_z=data.gnss_z[blind], gnss_r=data.gnss_r[blind],
    )  # fmt: skip
    t0, x0, P0 = start(data)
    out = run_ekf(data, t0, x0, P0, parameters())
    stamps = data.wheel_t[-len(out.x) :]
    after = int(np.searchsorted(stamps, 13.0))
    assert out.distance[after] == out.distance[after - 1]
    assert out.variance[after, 0] > 9.0


@pytest.mark.parametrize(
    ("angle", "wrapped"), [(0.0, 0.0), (math.pi, math.pi), (-math.pi, math.pi), (7.0, 7.0 - 2 * math.pi)]
)
def test_angles_wrap_to_the_half_open_turn(angle: float, wrapped: float) -> None:
    assert wrap(angle) == pytest.approx(wrapped, abs=1e-15)


def test_nees_and_nis_stay_in_their_bands_where_the_model_holds() -> None:
    """Consistency over many seeds: process noise as simulated (none but the ICRs' prior), the paper's sensors."""
    runs, nees, nis = 60, [], []
    settings = parameters(process_variance=(1e-9,) * 6)
    rng = np.random.default_rng(0)
    for seed in range(runs):
        icrs = (0.6 + 0.1 * rng.normal(), -0.6 + 0.1 * rng.normal(), 0.1 * rng.normal())
        data, truth = drive(1000 + seed, seconds=20.0, icrs=icrs, coincident=True)
        t0, x0, P0 = start(data, icrs=(0.6, -0.6, 0.0), icr_std=0.1)
        out = run_ekf(data, t0, x0, P0, settings)
        error = out.x[-1] - truth[-1]
        error[2] = math.remainder(error[2], 2 * math.pi)
        nees.append(error @ np.linalg.solve(out.P, error))
        nis.append(np.nanmean(out.gnss_nis))
    # chi-squared with 6 * 60 degrees of freedom, 95 %: 310.4 to 414.5 (divided by the runs)
    assert 309.0 / runs < np.mean(nees) < 416.0 / runs
    assert np.mean(nis) == pytest.approx(2.0, abs=0.05)
