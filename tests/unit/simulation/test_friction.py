"""A robot on sliding contacts: closed forms of Coulomb friction, conservation laws, and what the paper saw."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icrtool.errors import ConfigError
from icrtool.kernels.friction import ROLLING_MPS, SlidingBody, slide
from icrtool.simulation.drives import DrivePlan, PathPlan, Sensors, drive_plan, simulate
from icrtool.simulation.friction import TRACKED_ROBOT, FrictionRobot, draw_grip, fitted_icrs, scaled_robot, slide_path
from icrtool.simulation.truths import FrictionTruth

EVEN = FrictionRobot(friction_std=0.0, lateral_friction=1.0, creep=0.0, mass_height_m=0.0)


def driven(
    robot: FrictionRobot, kind: str = "circle", speed: float = 0.3, radius: float = 2.0, seconds: float = 40.0
) -> FrictionTruth:
    plan = DrivePlan(
        icrs_m=(0.45, -0.45, 0.0), path=PathPlan(kind, speed, radius), duration_s=seconds, step_s=0.005, robot=robot
    )
    truth = drive_plan(plan, 0.01, np.random.default_rng(1))
    assert isinstance(truth, FrictionTruth)
    return truth


def test_a_straight_drive_rolls_without_slip() -> None:
    truth = driven(EVEN, "straight")
    assert truth.pose[-1, 2] == pytest.approx(0.5, abs=1e-9)
    moved = np.hypot(*(truth.pose[-1, :2] - truth.pose[0, :2]))
    assert moved == pytest.approx(truth.travel_left_m[-1], abs=1e-6)


def test_a_spin_of_four_wheels_has_the_icrs_of_coulomb_friction() -> None:
    """Closed form: each wheel slides by e along and a across; torques balance at e = a^2 / h, h the half track."""
    half, ahead = EVEN.half_track_m, EVEN.contact_forward_m[0]
    late = driven(EVEN, "circle", speed=0.6, radius=0.0).icrs_m[2000:6000]
    expected = half + ahead**2 / half
    assert late[:, 0].mean() == pytest.approx(expected, abs=0.002)
    assert late[:, 1].mean() == pytest.approx(-expected, abs=0.002)
    assert late[:, 2].mean() == pytest.approx(0.0, abs=0.001)


def test_on_a_slow_spin_the_icrs_do_not_depend_on_mass_or_friction() -> None:
    other = replace(EVEN, mass_kg=40.0, friction=0.3)
    one, two = (driven(robot, "spins", speed=0.5).icrs_m[4000] for robot in (EVEN, other))
    np.testing.assert_allclose(one, two, atol=0.003)


def test_a_steady_circle_has_the_centripetal_force_of_its_speed() -> None:
    """Newton: the rightward velocity and turn rate are steady, so that forces across equal m v omega."""
    v_x, v_y, omega = driven(EVEN, speed=1.0).velocity[6000:].T
    for column in (v_x, v_y, omega):
        assert np.ptp(column) < 1e-3 * max(1.0, abs(column.mean()))
    assert v_y.mean() < 0.0  # the body slides to the outside: away from a right turn


def test_the_motion_mirrors_with_the_turns() -> None:
    plan = DrivePlan(
        icrs_m=(0.45, -0.45, 0.0), path=PathPlan("circle", 0.5, 2.0), duration_s=20.0, start_heading_rad=0.0,
        step_s=0.005, robot=EVEN,
    )  # fmt: skip
    right = drive_plan(plan, 0.01)
    t, n = right.t_s, len(right.t_s)
    assert isinstance(right, FrictionTruth)
    left = slide_path(
        EVEN, t, np.full(n, 0.5), np.full(n, -0.25), np.full(n, True), (0.45, -0.45, 0.0), start_heading_rad=0.0,
        lag_s=0.0, rng=np.random.default_rng(0),
    )  # fmt: skip
    np.testing.assert_allclose(left.pose[:, 0], right.pose[:, 0], atol=1e-9)
    np.testing.assert_allclose(left.pose[:, 1:], -right.pose[:, 1:], atol=1e-9)


def test_the_step_of_the_grid_changes_nothing() -> None:
    coarse, fine = (
        drive_plan(DrivePlan(path=PathPlan("circle", 0.5, 2.0), duration_s=10.0, step_s=step, robot=EVEN), 0.01)
        for step in (0.01, 0.001)
    )
    np.testing.assert_allclose(coarse.poses(np.array([9.0])), fine.poses(np.array([9.0])), atol=1e-3)


@pytest.mark.parametrize("slope", [(0.02, 0.0), (0.0, 0.02)])
def test_on_a_slope_a_standing_robot_creeps_as_fast_as_its_friction_lets_it(slope: tuple[float, float]) -> None:
    """Closed form: mu v / sqrt(v^2 + s0^2) is the slope, with s0 the sliding speed of 0.7 of the friction."""
    t, n = np.arange(600) * 0.01, 600
    velocity = slide_path(
        EVEN, t, np.zeros(n), np.zeros(n), np.full(n, True), (0.5, -0.5, 0.0), start_heading_rad=0.0, lag_s=0.0,
        rng=np.random.default_rng(0), slope=np.tile(slope, (n, 1)), steers=False,
    ).velocity[-1, :2]  # fmt: skip
    share = 0.02 / EVEN.friction
    expected = EVEN.slip_mps * share / np.sqrt(1.0 - share**2)
    np.testing.assert_allclose(velocity, expected * np.array(slope) / 0.02, rtol=1e-3, atol=1e-9)


def test_rolling_resistance_slows_the_robot_below_its_wheels() -> None:
    """Closed form: at a steady speed friction along the wheels equals the rolling resistance."""
    t, n, robot = np.arange(600) * 0.01, 600, replace(EVEN, resistance=0.05)
    speed = slide_path(
        robot, t, np.full(n, 0.5), np.zeros(n), np.full(n, True), (0.5, -0.5, 0.0), start_heading_rad=0.0, lag_s=0.0,
        rng=np.random.default_rng(0), steers=False,
    ).velocity[-1, 0]  # fmt: skip
    share = robot.resistance / robot.friction * speed / np.hypot(speed, ROLLING_MPS)
    assert 0.5 - speed == pytest.approx(robot.slip_mps * share / np.sqrt(1.0 - share**2), rel=1e-3)


def test_a_mass_right_of_the_middle_mirrors_a_mass_left_of_it() -> None:
    t, n, height = np.arange(2000) * 0.01, 2000, replace(EVEN, mass_height_m=0.2, resistance=0.05)

    def pose(mass_right_m: float, turn: float) -> np.ndarray:
        return slide_path(
            replace(height, mass_right_m=mass_right_m), t, np.full(n, 0.5), np.full(n, turn), np.full(n, True),
            (0.5, -0.5, 0.0), start_heading_rad=0.0, lag_s=0.0, rng=np.random.default_rng(0), steers=False,
        ).pose  # fmt: skip

    right, mirrored, other = pose(0.05, 0.3), pose(-0.05, -0.3), pose(-0.05, 0.3)
    np.testing.assert_allclose(right[:, 0], mirrored[:, 0], atol=1e-9)
    np.testing.assert_allclose(right[:, 1:], -mirrored[:, 1:], atol=1e-9)
    assert np.hypot(*(right - other)[-1, :2]) > 0.01  # the place of the mass matters


def test_the_compiled_motion_is_that_of_python() -> None:
    truth = driven(FrictionRobot(), "curved", speed=0.8, seconds=0.5)
    robot, n = FrictionRobot(), 40
    t = truth.t_s[:n]
    body = SlidingBody(118.0, 10.0, 0.05, 0.02, 0.3, 0.02, 0.03, 2.0, 0.03, 0.1, 0.5, 2.0, 0.5, -0.5, 0.1)
    x, y = np.array(robot.contact_forward_m * 2), np.repeat([0.305, -0.305], 2)
    grip = draw_grip(robot, np.random.default_rng(3))[:100]
    results = []
    for function in (slide, slide.py_func):
        commands, tracks, pose, velocity = (np.zeros((n, columns)) for columns in (2, 2, 3, 3))
        function(
            t, np.full(n, 0.8), np.full(n, 0.5), 0.5 * t, np.ones(n, np.int64), x, y, grip, np.full((n, 2), 0.01), body,
            commands, tracks, pose, velocity,
        )  # fmt: skip
        results.append(np.column_stack([commands, tracks, pose, velocity]))
    np.testing.assert_allclose(results[0], results[1], rtol=1e-9, atol=1e-12)


def test_fitted_icrs_are_those_of_a_known_motion() -> None:
    t = np.arange(2000) * 0.01
    omega = 0.4 * np.sin(t)
    v_x = np.full(2000, 0.8)
    right, left, x = 0.6, -0.7, 0.1
    velocity = np.column_stack([v_x, -omega * x, omega])
    found = fitted_icrs(t, velocity, left=v_x - omega * left, right=v_x - omega * right)
    np.testing.assert_allclose(found, np.broadcast_to([right, left, x], (2000, 3)), atol=1e-9)


def test_the_grip_has_the_mean_and_spread_that_it_is_drawn_with() -> None:
    robot = FrictionRobot(friction=0.6, friction_std=0.1)
    grip = draw_grip(robot, np.random.default_rng(7))
    assert grip.mean() == pytest.approx(0.6, abs=0.01)
    assert grip.std() == pytest.approx(0.06, abs=0.005)
    cells = 20  # 2 m, the length of its correlation
    assert np.corrcoef(grip[:-cells, 0], grip[cells:, 0])[0, 1] == pytest.approx(np.exp(-1), abs=0.06)
    assert abs(np.corrcoef(grip.T)[0, 1]) < 0.1


@pytest.mark.parametrize(("robot", "expected"), [(FrictionRobot(), (0.63, -0.76)), (TRACKED_ROBOT, (0.41, -0.41))])
def test_the_robots_have_about_the_icrs_of_the_papers_long_runs(
    robot: FrictionRobot, expected: tuple[float, float]
) -> None:
    """Tables I and II; x is not compared: the paper's antenna is not at the middle."""
    truth = driven(replace(robot, friction_std=0.0), "lawnmower", speed=0.45, radius=2.5, seconds=120.0)
    turning = np.abs(truth.velocity[:, 2]) > 0.1
    right, left, _ = truth.icrs_m[turning].mean(axis=0)
    assert right - left == pytest.approx(expected[0] - expected[1], rel=0.2)


def test_x_moves_forward_with_speed_as_in_table_iii() -> None:
    slow, fast = (driven(FrictionRobot(), "curved", speed=speed, radius=5.0) for speed in (0.4, 4.0))
    x_slow, x_fast = (one.icrs_m[np.abs(one.velocity[:, 2]) > 0.05, 2] for one in (slow, fast))
    assert x_fast.mean() > x_slow.mean() + 0.03
    assert x_fast.std() > 2.0 * x_slow.std()


def test_a_scaled_robot_has_the_icrs_in_proportion() -> None:
    double = scaled_robot(EVEN, 4.0 * EVEN.half_track_m)
    assert double.half_track_m == pytest.approx(2.0 * EVEN.half_track_m)
    assert double.mass_kg == pytest.approx(4.0 * EVEN.mass_kg)


def test_the_log_of_a_robot_on_contacts_is_the_same_for_a_seed() -> None:
    plan = DrivePlan(duration_s=5.0, robot=FrictionRobot())
    one, same, other = (simulate(plan, Sensors(), seed)[1]["north_m"] for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one, other)


def test_known_changes_of_the_icrs_are_refused() -> None:
    plan = DrivePlan(duration_s=5.0, robot=FrictionRobot(), changes=((2.0, (0.6, -0.6, 0.0)),))
    with pytest.raises(ConfigError, match="change: the ICRs of a robot on sliding contacts follow from forces"):
        simulate(plan, Sensors(), 0)
