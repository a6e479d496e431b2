"""The family of motion models: members are what their papers say, ICRs by the ratios."""

from __future__ import annotations

import numpy as np
import pytest

from icrtool.kernels.kinematics import body_velocity
from icrtool.motion.models import (
    GYRO_TERMS,
    TERMS,
    FittedModel,
    Lever,
    controller_model,
    find_model,
    parameters_of_icrs,
    track_geometry,
    wheel_motion,
)
from support.recordings import FAMILY, twist

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
    model, value = FAMILY["icr"], of_icrs()
    found = twist(model, np.array([value[term] for term in model.terms]), MOTION)
    expected = [body_velocity(left, right, *ICRS) for left, right in zip(V_LEFT, V_RIGHT, strict=True)]
    np.testing.assert_allclose(found.T, expected, atol=EXACT)


def test_no_slip_is_every_model_at_its_nominal_values() -> None:
    v, omega = (V_LEFT + V_RIGHT) / 2, (V_LEFT - V_RIGHT) / WIDTH_M
    for model in FAMILY.values():
        nominal = np.array([TERMS[term].nominal for term in model.terms])
        np.testing.assert_allclose(twist(model, nominal, MOTION), [v, 0 * v, omega], atol=EXACT)


@pytest.mark.parametrize("scale", [1.0, 0.95])
def test_icrs_come_back_by_the_ratios(scale: float) -> None:
    model, value = FAMILY["five"], of_icrs(scale)
    found = track_geometry(model, np.array([value.get(term, 0.0) for term in model.terms]), WIDTH_M)
    assert found[:3] == pytest.approx(ICRS)
    assert found.multiplier == pytest.approx((ICRS[0] - ICRS[1]) / WIDTH_M)
    assert (found.radius_left, found.radius_right) == pytest.approx((scale, scale))


def test_radius_factors_of_the_sides_give_the_same_motion_as_the_model() -> None:
    """A controller with these radii, this multiplier and these ICRs does what the five-parameter model does."""
    model = FAMILY["five"]
    parameters = np.array([0.96, -0.03, 0.6, -0.015, 0.02])
    found = track_geometry(model, parameters, WIDTH_M)
    for left, right, expected in zip(V_LEFT, V_RIGHT, twist(model, parameters, MOTION).T, strict=True):
        sides = found.radius_left * left, found.radius_right * right
        v_x, _, omega = body_velocity(*sides, found.y_icr_right_m, found.y_icr_left_m, found.x_icr_m)
        assert (v_x, omega) == pytest.approx((expected[0], expected[2]))


def test_terms_that_are_not_linear_in_the_speeds_do_not_enter_the_geometry() -> None:
    five, eight = np.array([0.98, 0.01, 0.5, 0.02, -0.1]), np.array([0.98, 0.01, 0.5, 0.02, -0.1, 0.1, 0.2, 0.1])
    assert track_geometry(FAMILY["recommended"], eight, WIDTH_M) == track_geometry(FAMILY["five"], five, WIDTH_M)


@pytest.mark.parametrize("lever", [Lever(ahead, aside) for ahead in (False, True) for aside in (False, True)])
def test_a_controller_drives_the_fit_less_what_a_known_lever_leaves_to_the_robot(lever: Lever) -> None:
    """Witness: the equations of diff_drive_controller, and a place off the body's origin that is carried along."""
    model, parameters = FAMILY["five"], np.array([0.96, -0.03, 0.6, -0.015, 0.02])
    geometry = track_geometry(model, parameters, WIDTH_M)
    found = controller_model(FittedModel(model, parameters, np.zeros((5, 5))), lever, WIDTH_M).twist(MOTION)
    left, right = geometry.radius_left * V_LEFT, geometry.radius_right * V_RIGHT
    omega = (left - right) / (geometry.multiplier * WIDTH_M)
    aside = 0.0 if lever.aside else (geometry.y_icr_right_m + geometry.y_icr_left_m) / 2.0
    of_turn = 0.02 * (V_LEFT - V_RIGHT) / 2.0
    np.testing.assert_allclose(found[2], omega, atol=EXACT)
    np.testing.assert_allclose(found[0], (left + right) / 2.0 + aside * omega, atol=EXACT)
    np.testing.assert_allclose(found[1], 0.0 if lever.ahead else of_turn, atol=EXACT)


@pytest.mark.parametrize(("ahead_m", "aside_m"), [(0.5, 0.0), (0.0, -0.3), (0.4, 0.2)])
def test_multiplier_and_radii_do_not_depend_on_where_the_position_is_measured(ahead_m: float, aside_m: float) -> None:
    model, parameters = FAMILY["five"], np.array([0.96, 0.02, 0.6, -0.015, 0.02])
    geometry = track_geometry(model, parameters, WIDTH_M)
    # v_x - aside omega, v_y + ahead omega with omega = omega_w w + omega_v v / b
    moved = parameters + np.array([
        -aside_m * parameters[3] / WIDTH_M, -aside_m * parameters[2] * 2.0 / WIDTH_M, 0.0, 0.0,
        ahead_m * parameters[2] * 2.0 / WIDTH_M,
    ])  # fmt: skip
    found = track_geometry(model, moved, WIDTH_M)
    assert found[3:] == pytest.approx(geometry[3:])
    assert found.y_icr_right_m == pytest.approx(geometry.y_icr_right_m - aside_m)
    assert found.x_icr_m == pytest.approx(geometry.x_icr_m - ahead_m)


def test_a_gyro_turns_the_robot_where_the_wheels_have_no_weight() -> None:
    model = find_model("five_gyro")
    assert model == FAMILY["five"].with_gyro()
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
    used = {term for model in FAMILY.values() for term in model.terms} | set(GYRO_TERMS)
    assert used == set(TERMS)
    assert all(term.std > 0.0 for term in TERMS.values())


def test_parameters_of_icrs_give_the_papers_twist_and_derivatives_equal_differences() -> None:
    def expected(y_right: float, y_left: float, x: float, scale: float, difference: float) -> np.ndarray:
        left, right = (scale + difference / 2) * V_LEFT, (scale - difference / 2) * V_RIGHT
        return np.array([body_velocity(v_l, v_r, y_right, y_left, x) for v_l, v_r in zip(left, right, strict=True)]).T

    at, step = np.array([*ICRS, 1.0, 0.0]), 1e-6
    parameters, by = parameters_of_icrs(np.array(ICRS), WIDTH_M)
    model = FAMILY["full_linear"]
    np.testing.assert_allclose(twist(model, parameters, MOTION), expected(*at), atol=EXACT)
    without = twist(model, np.zeros(len(model.terms)), MOTION)
    for column, change in enumerate(np.eye(5) * step):
        slope = (expected(*(at + change)) - expected(*(at - change))) / (2 * step)
        np.testing.assert_allclose(twist(model, by[:, column], MOTION) - without, slope, atol=1e-8)
