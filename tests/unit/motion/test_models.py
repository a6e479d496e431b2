"""The family of motion models: members are what their papers say, ICRs by the ratios."""

from __future__ import annotations

import numpy as np
import pytest

from icrtool.kernels.kinematics import body_velocity
from icrtool.motion.models import (
    GYRO_TERMS,
    MODELS,
    TERMS,
    TypicalDrive,
    find_model,
    parameters_of_icrs,
    track_geometry,
    twist,
    typical_drive,
    wheel_motion,
)

WIDTH_M = 0.6
ICRS = (0.52, -0.44, 0.1)
V_LEFT, V_RIGHT = np.array([0.5, -0.2, 0.0, 1.3, 0.4]), np.array([0.3, 0.4, 0.0, 1.3, -0.4])
MOTION = wheel_motion(V_LEFT, V_RIGHT, WIDTH_M)
EXACT = 1e-12


def of_icrs(scale: float = 1.0) -> dict[str, float]:
    """Return the parameters that track ICRs and a common wheel scale amount to."""
    y_right, y_left, x = ICRS
    width = y_right - y_left
    return {
        "vx_v": scale,
        "vx_w": scale * (y_right + y_left) / width,
        "omega_w": scale * WIDTH_M / width,
        "vy_w": -2.0 * scale * x / width,
    }


def test_the_icr_member_is_the_papers_model() -> None:
    model, value = MODELS["icr"], of_icrs()
    found = twist(model, np.array([value[term] for term in model.terms]), MOTION)
    expected = [body_velocity(left, right, *ICRS) for left, right in zip(V_LEFT, V_RIGHT, strict=True)]
    np.testing.assert_allclose(found.T, expected, atol=EXACT)


def test_no_slip_is_every_model_at_its_nominal_values() -> None:
    v, omega = (V_LEFT + V_RIGHT) / 2, (V_LEFT - V_RIGHT) / WIDTH_M
    for model in MODELS.values():
        nominal = np.array([TERMS[term].nominal for term in model.terms])
        np.testing.assert_allclose(twist(model, nominal, MOTION), [v, 0 * v, omega], atol=EXACT)


@pytest.mark.parametrize("scale", [1.0, 0.95])
def test_icrs_come_back_by_the_ratios(scale: float) -> None:
    model, value = MODELS["five"], of_icrs(scale)
    found = track_geometry(model, np.array([value.get(term, 0.0) for term in model.terms]), WIDTH_M)
    assert found[:3] == pytest.approx(ICRS)
    assert found.multiplier == pytest.approx((ICRS[0] - ICRS[1]) / WIDTH_M)
    assert found.multiplier_nominal == pytest.approx((ICRS[0] - ICRS[1]) / (scale * WIDTH_M))
    assert (found.radius_left, found.radius_right) == pytest.approx((scale, scale))


def test_radius_factors_of_the_sides_give_the_same_motion_as_the_model() -> None:
    """A controller with these radii, this multiplier and these ICRs does what the five-parameter model does."""
    model = MODELS["five"]
    parameters = np.array([0.96, -0.03, 0.6, -0.015, 0.02])
    found = track_geometry(model, parameters, WIDTH_M)
    for left, right, expected in zip(V_LEFT, V_RIGHT, twist(model, parameters, MOTION).T, strict=True):
        sides = found.radius_left * left, found.radius_right * right
        v_x, _, omega = body_velocity(*sides, found.y_icr_right_m, found.y_icr_left_m, found.x_icr_m)
        assert (v_x, omega) == pytest.approx((expected[0], expected[2]))


def test_turn_gains_enter_the_geometry_where_the_robot_turned() -> None:
    model = MODELS["eight"]
    parameters = np.array([1.0, 0.0, 0.5, 0.0, 0.0, 0.1, 0.2, 0.1])
    found = track_geometry(model, parameters, WIDTH_M, TypicalDrive(0.5, 0.8, 1.0))
    assert found.multiplier_nominal == pytest.approx(1.0 / 0.7)
    assert found.x_icr_m == pytest.approx(-0.08 / 0.7)
    spin = wheel_motion(np.array([1.0, 0.5]), np.array([-1.0, 0.5]), WIDTH_M)
    assert typical_drive([(spin, np.ones(2))]) == pytest.approx((1.0, 0.0, 0.0))


def test_a_gyro_turns_the_robot_where_the_wheels_have_no_weight() -> None:
    model = find_model("five_gyro")
    assert model == MODELS["five"].with_gyro()
    gyro = np.linspace(-1.0, 1.0, len(V_LEFT))
    motion = MOTION._replace(gyro=gyro, turn=np.full(len(gyro), 5.0))
    value = {"vx_v": 1.0, "gyro_scale": 0.0, "wheels_weight": 0.0}
    np.testing.assert_allclose(twist(model, np.array([value.get(term, 0.0) for term in model.terms]), motion)[2], gyro)
    value["wheels_weight"] = 1.0
    np.testing.assert_allclose(twist(model, np.array([value.get(term, 0.0) for term in model.terms]), motion)[2], 5.0)


def test_the_formula_of_a_term_is_its_column() -> None:
    motion = MOTION._replace(gyro=np.linspace(-1.0, 1.0, len(V_LEFT)), turn=np.full(len(V_LEFT), 5.0))
    for term in TERMS.values():
        value = eval(term.formula, {"__builtins__": {}, "abs": abs}, motion._asdict())
        np.testing.assert_allclose(term.column(motion), value, atol=EXACT, err_msg=term.name)


def test_every_term_has_a_prior_and_is_used() -> None:
    used = {term for model in MODELS.values() for term in model.terms} | set(GYRO_TERMS)
    assert used == set(TERMS)
    assert all(term.std > 0.0 for term in TERMS.values())


def test_parameters_of_icrs_give_the_papers_twist_and_derivatives_equal_differences() -> None:
    def expected(y_right: float, y_left: float, x: float, scale: float, difference: float) -> np.ndarray:
        left, right = (scale + difference / 2) * V_LEFT, (scale - difference / 2) * V_RIGHT
        return np.array([body_velocity(v_l, v_r, y_right, y_left, x) for v_l, v_r in zip(left, right, strict=True)]).T

    at, step = np.array([*ICRS, 1.0, 0.0]), 1e-6
    parameters, by = parameters_of_icrs(np.array(ICRS), WIDTH_M)
    model = MODELS["full_linear"]
    np.testing.assert_allclose(twist(model, parameters, MOTION), expected(*at), atol=EXACT)
    without = twist(model, np.zeros(len(model.terms)), MOTION)
    for column, change in enumerate(np.eye(5) * step):
        slope = (expected(*(at + change)) - expected(*(at - change))) / (2 * step)
        np.testing.assert_allclose(twist(model, by[:, column], MOTION) - without, slope, atol=1e-8)
