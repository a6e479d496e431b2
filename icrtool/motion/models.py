"""Motion models that are linear in their parameters: body twist (v_x, v_y, omega) = sum theta_k phi_k(V_l, V_r).

A `Term` is one phi with its prior, and a `MotionModel` is a list of terms. A new term or model is one entry in this
module. Body frame: x forward, y right, omega clockwise. Track width b, v = (V_l + V_r) / 2, w = (V_l - V_r) / b. Speeds
refer to the configured wheel radius.

The model of track ICRs (Pentzer 2014, Eqs. 8-12) is one of them: with W = y_r - y_l the twist is
v_x = v + (y_r + y_l) / W w b / 2, v_y = -2 x / W w b / 2, omega = b / W w. The no-slip model has no free terms.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.window_residuals import OMEGA, VX, VY
from icrtool.records.rows import REPORT_ROWS


class WheelMotion(NamedTuple):
    """Inputs of the terms, (n,) each.

    Attributes
    ----------
    v, w : mean speed [m/s], (V_l - V_r) / b [rad/s]
    spin : |V_l - V_r| / (|V_l| + |V_r|): 0 straight ahead, 1 on the spot
    b : track width [m]
    gyro : turn rate of a gyro [rad/s], clockwise; turn : turn rate of a wheels-only model [rad/s]; zeros if not used
    """

    v: Floats
    w: Floats
    spin: Floats
    b: float
    gyro: Floats
    turn: Floats


def wheel_motion(v_left: Floats, v_right: Floats, width_m: float, gyro: Floats | None = None) -> WheelMotion:
    """Return the inputs of the terms, from speeds at the configured wheel radius (n,) [m/s]."""
    both = np.abs(v_left) + np.abs(v_right)
    spin = np.divide(np.abs(v_left - v_right), both, out=np.zeros_like(both), where=both > 0.0)
    none = np.zeros_like(both)
    measured = none if gyro is None else gyro
    return WheelMotion((v_left + v_right) / 2.0, (v_left - v_right) / width_m, spin, width_m, measured, none)


@dataclass(frozen=True, slots=True)
class Term:
    """One term of a motion model.

    Attributes
    ----------
    name : name of the parameter
    axis : velocity that the term adds to: `VX`, `VY` or `OMEGA`
    column : returns the velocity (n,) for a parameter of 1
    formula : the same in the symbols of `WheelMotion`, for other programs
    mean, std : prior of the parameter: mean and standard deviation over real robots
    wide : standard deviation of a wider prior, for a term that few drives show; 0: no wider prior
    meaning : words for the term, with its source
    nominal : the parameter without slip
    """

    name: str
    axis: int
    column: Callable[[WheelMotion], Floats]
    formula: str
    std: float
    meaning: str
    mean: float = 0.0
    nominal: float = 0.0
    wide: float = 0.0


TERMS: dict[str, Term] = {
    term.name: term
    for term in (
        Term("vx_v", VX, lambda m: m.v, "v", 0.04, "common wheel scale, longitudinal slip", mean=1.0, nominal=1.0),
        Term("vx_w", VX, lambda m: m.w * m.b / 2, "w * b / 2", 0.3, "ICRs off centre (Martinez 2005)"),
        Term("omega_w", OMEGA, lambda m: m.w, "w", 0.4, "b / W, 1 / multiplier (Mandow 2007)", mean=0.6, nominal=1.0),
        Term("omega_v", OMEGA, lambda m: m.v / m.b, "v / b", 0.02, "left/right asymmetry: turns while driving ahead"),
        Term("vy_w", VY, lambda m: m.w * m.b / 2, "w * b / 2", 0.3, "-2 x_icr / W (Martinez 2005)"),
        Term("vy_vw", VY, lambda m: m.v * m.w, "v * w", 0.03, "side slip by centripetal acceleration (Seegmiller 2014)",
             wide=1.0),
        Term("omega_sw", OMEGA, lambda m: m.spin * m.w, "spin * w", 0.01, "change of the turn gain with curvature",
             wide=0.3),
        Term("omega_vw", OMEGA, lambda m: np.abs(m.v) * m.w, "abs(v) * w", 0.006, "change of the turn gain with speed",
             wide=0.2),
        Term("vy_v", VY, lambda m: m.v, "v", 0.02, "sideways while driving ahead (Anousaki 2004)"),
        Term("gyro_scale", OMEGA, lambda m: m.gyro, "gyro", 0.02, "scale error of the gyro"),
        Term("wheels_weight", OMEGA, lambda m: m.turn - m.gyro, "turn - gyro", 0.15, "weight of the wheels' turn rate"),
    )
}  # fmt: skip
"""Every term by name."""

GYRO_TERMS = ("gyro_scale", "wheels_weight")
"""Terms that a gyro adds to a model. At their prior means the turn rate is the gyro's."""


@dataclass(frozen=True, slots=True)
class MotionModel:
    """A list of free terms; every other term keeps its nominal value.

    Attributes
    ----------
    label : words for the model in tables
    source : publication that proposed the model
    stds : prior standard deviations of a fit, where they differ from the terms' own
    """

    name: str
    label: str
    terms: tuple[str, ...]
    source: str
    stds: tuple[float, ...] = ()

    @property
    def prior_mean(self) -> Floats:
        """Prior mean of each term (k,)."""
        return np.array([TERMS[name].mean for name in self.terms])

    @property
    def prior_std(self) -> Floats:
        """Prior standard deviation of each term (k,)."""
        return np.array(self.stds or [TERMS[name].std for name in self.terms])

    def with_wide_priors(self) -> MotionModel | None:
        """Return the model with wide priors of the terms that have a wide prior; None without such terms."""
        if self.stds or not any(TERMS[name].wide for name in self.terms):
            return None
        return replace(self, stds=tuple(TERMS[name].wide or TERMS[name].std for name in self.terms))

    def with_shown_priors(self, widened: FittedModel) -> MotionModel:
        """Return the model with the priors that follow from a fit of the model of `with_wide_priors`.

        Notes
        -----
        Few drives show how slip changes with curvature and speed, so these priors are narrow. If the fit with wide
        priors gives a parameter theta of more than `SHOWN_SIGMAS` standard deviations s, the variance of its prior
        grows by theta^2 - (`SHOWN_SIGMAS` s)^2 (empirical Bayes, positive part: Efron and Morris 1973).
        """
        beyond = widened.parameters**2 - (SHOWN_SIGMAS * widened.std) ** 2
        wide = np.array([TERMS[name].wide > 0.0 for name in self.terms])
        stds = np.sqrt(self.prior_std**2 + np.where(wide, np.maximum(beyond, 0.0), 0.0))
        return replace(self, stds=tuple(stds.tolist()))

    @property
    def uses_gyro(self) -> bool:
        """Whether the turn rate is the weighted mean of the gyro's turn rate and a wheels-only model's turn rate."""
        return GYRO_TERMS[0] in self.terms

    def with_gyro(self) -> MotionModel:
        """Return the same model, with a turn rate that is the weighted mean of its own turn rate and a gyro's."""
        moves = tuple(name for name in self.terms if TERMS[name].axis != OMEGA)
        return MotionModel(f"{self.name}_gyro", f"{self.label} + gyro", (*moves, *GYRO_TERMS), self.source)


NO_SLIP, FIVE, RECOMMENDED = "no_slip", "five", "recommended"
"""Names of the fitted models: the model without free terms, the model for ICRs and controller, the model that
predicts."""

CONTROLLER = "controller"
"""Name of the row of a differential-drive controller with the multiplier and radius factors of `FIVE`."""

_FIVE = ("vx_v", "vx_w", "omega_w", "omega_v", "vy_w")
_EIGHT = (*_FIVE, "vy_vw", "omega_sw", "omega_vw")
"""Names of the terms of `FIVE` and of `RECOMMENDED`."""

MODELS: dict[str, MotionModel] = {
    model.name: model
    for model in (
        MotionModel(NO_SLIP, REPORT_ROWS[NO_SLIP].words, (), "Pentzer 2014, Eqs. 38-39"),
        MotionModel(FIVE, "ICRs, wheel scales", _FIVE, "Mandow 2007, five parameters"),
        MotionModel(
            RECOMMENDED,
            REPORT_ROWS[RECOMMENDED].words,
            _EIGHT,
            "with Seegmiller 2014, and gains of curvature and speed",
        ),
    )
}
"""The models that are fitted, by name."""

FULL_LINEAR = MotionModel("full_linear", "full linear", (*_FIVE, "vy_v"), "Anousaki 2004")
"""Model that is linear in both wheel speeds. It is not fitted; the filter's ICRs are converted to its terms."""


def model_columns(model: MotionModel, motion: WheelMotion) -> tuple[Floats, Ints, Floats]:
    """Return the twist without the free terms (3, n), the axis of each free term (k,), and its column (k, n)."""
    fixed = np.zeros((3, len(motion.v)))
    if model.uses_gyro:
        fixed[OMEGA] = motion.gyro
    for term in TERMS.values():
        if model.uses_gyro and term.axis == OMEGA:
            continue
        if term.name not in model.terms and term.nominal:
            fixed[term.axis] += term.nominal * term.column(motion)
    axes = np.array([TERMS[name].axis for name in model.terms], np.int64)
    columns = np.empty((len(model.terms), len(motion.v)))
    for row, name in zip(columns, model.terms, strict=True):
        row[:] = TERMS[name].column(motion)
    return fixed, axes, columns


class TrackGeometry(NamedTuple):
    """Track ICRs and controller numbers of a twist that is linear in V_l and V_r.

    Attributes
    ----------
    y_icr_right_m, y_icr_left_m, x_icr_m : track ICRs, body frame
    multiplier : (y_r - y_l) / b, for use together with the radius factors
    radius_left, radius_right : ratio of the wheel radius to the configured radius
    """

    y_icr_right_m: float
    y_icr_left_m: float
    x_icr_m: float
    multiplier: float
    radius_left: float
    radius_right: float


ICR_VALUES = 3
"""Number of values at the start of a `TrackGeometry` that are ICRs."""


def track_geometry(model: MotionModel, parameters: NDArray[Any], width_m: float) -> TrackGeometry:
    """Return ICRs, multiplier and radius factors of a model, without the terms that are not linear in the speeds.

    Notes
    -----
    y_r = (d v_x / d V_l) / (d omega / d V_l), y_l = (d v_x / d V_r) / (d omega / d V_r), x from v_y = -x omega of a
    turn. The radius factors multiply the speeds of the sides, so that one W gives the turn of both:
    a_l = W d omega / d V_l, a_r = -W d omega / d V_r.
    """
    by_term = dict(zip(model.terms, parameters.tolist(), strict=True))
    term = {name: by_term.get(name, TERMS[name].nominal) for name in _FIVE}
    # With v = (V_l + V_r) / 2 and w = (V_l - V_r) / b, these are half sums and half differences of the columns.
    x_left, x_right = (term["vx_v"] + term["vx_w"]) / 2.0, (term["vx_v"] - term["vx_w"]) / 2.0
    turn_left = (term["omega_v"] / 2.0 + term["omega_w"]) / width_m
    turn_right = (term["omega_v"] / 2.0 - term["omega_w"]) / width_m
    with np.errstate(divide="ignore", invalid="ignore"):
        y_right, y_left, x = np.divide(
            [x_left, x_right, -term["vy_w"] * width_m / 2.0], [turn_left, turn_right, term["omega_w"]]
        ).tolist()
    separation = y_right - y_left
    return TrackGeometry(y_right, y_left, x, separation / width_m, separation * turn_left, -separation * turn_right)


def parameters_of_icrs(icrs_m: Floats, width_m: float) -> tuple[Floats, Floats]:
    """Return the parameters of model ``full_linear`` with given track ICRs, and their derivatives.

    Parameters
    ----------
    icrs_m : (3,) y_icr_right, y_icr_left, x_icr
    width_m : track width b of the terms

    Returns
    -------
    parameters : (6,) of the terms, for wheels of the configured radius
    derivatives : (6, 5) by the three ICRs [1/m], by a scale of both wheel speeds, and by the difference of the left
        and the right scale

    Notes
    -----
    With scales s_l, s_r and W = y_r - y_l: v_x = (s_l V_l y_r - s_r V_r y_l) / W, omega = (s_l V_l - s_r V_r) / W,
    v_y = -x omega (Pentzer 2014, Eqs. 8-12).
    """
    right, left, x = icrs_m.tolist()
    W = right - left
    middle, gain, aside = (right + left) / W, width_m / W, -2.0 * x / W
    derivatives = {
        "vx_v": (0.0, 0.0, 0.0, 1.0, middle / 2),
        "vx_w": (-2.0 * left / W**2, 2.0 * right / W**2, 0.0, middle, 0.5),
        "omega_w": (-gain / W, gain / W, 0.0, gain, 0.0),
        "omega_v": (0.0, 0.0, 0.0, 0.0, gain),
        "vy_w": (-aside / W, aside / W, -2.0 / W, aside, 0.0),
        "vy_v": (0.0, 0.0, 0.0, 0.0, aside / 2),
    }
    value = {"vx_v": 1.0, "vx_w": middle, "omega_w": gain, "omega_v": 0.0, "vy_w": aside, "vy_v": 0.0}
    terms = FULL_LINEAR.terms
    return np.array([value[term] for term in terms]), np.array([derivatives[term] for term in terms])


NOT_SHOWN = 0.7
"""Ratio of the standard deviation of a parameter to the standard deviation of its prior above which the drive does not
show the parameter. A parameter that is two standard deviations or more from the prior's mean counts as shown in any
case."""

SHOWN_SIGMAS = 3.0
"""Size of a parameter, in its standard deviations, above which its prior is widened."""

TINY = 1e-20
"""Size of a complex step."""


@dataclass(frozen=True, slots=True)
class FittedModel:
    """A motion model with fitted parameters.

    Attributes
    ----------
    parameters : (k,), in the order of the model's terms; covariance : (k, k)
    wheels : of a model with a gyro, the wheels-only model whose turn rate it combines with the gyro's
    """

    model: MotionModel
    parameters: Floats
    covariance: Floats
    wheels: FittedModel | None = None

    @property
    def std(self) -> Floats:
        """One standard deviation of each parameter (k,)."""
        deviations: Floats = np.sqrt(np.diag(self.covariance))
        return deviations

    @property
    def not_shown(self) -> tuple[str, ...]:
        """Names of the terms that the data did not show; their parameters come from the prior."""
        hardly_narrowed = self.std / self.model.prior_std > NOT_SHOWN
        is_near_prior = np.abs(self.parameters - self.model.prior_mean) < 2.0 * self.std
        return tuple(
            name for name, unseen in zip(self.model.terms, hardly_narrowed & is_near_prior, strict=True) if unseen
        )

    def complete(self, motion: WheelMotion) -> WheelMotion:
        """Return a motion with the turn rate of the wheels-only model, where the model has one."""
        return motion if self.wheels is None else motion._replace(turn=self.wheels.twist(motion)[OMEGA])

    def twist(self, motion: WheelMotion) -> Floats:
        """Return the body twist v_x, v_y [m/s], omega [rad/s], (3, n)."""
        result, axes, columns = model_columns(self.model, self.complete(motion))
        for axis, parameter, column in zip(axes, self.parameters, columns, strict=True):
            result[axis] += parameter * column
        return result

    def geometry(self, width_m: float) -> tuple[TrackGeometry, Floats]:
        """Return ICRs, multiplier and radius factors, and their covariance (6, 6)."""
        geometry = track_geometry(self.model, self.parameters, width_m)
        # The derivatives come from complex steps (Squire and Trapp 1998).
        moved = self.parameters + TINY * 1j * np.eye(len(self.parameters))
        columns = [np.imag(track_geometry(self.model, parameters, width_m)) / TINY for parameters in moved]
        by_parameter = np.reshape(columns, (len(moved), len(geometry)))
        covariance: Floats = by_parameter.T @ self.covariance @ by_parameter
        return geometry, covariance


class Lever(NamedTuple):
    """The known parts of the lever from the body's origin to the measured position: ahead, and to the right.

    An unknown part has the same effect as ICRs off centre. It is a constant of the log, not an error of a controller.
    """

    ahead: bool = False
    aside: bool = False


NO_LEVER = Lever()
"""No part of the lever is known."""


def controller_model(five: FittedModel, lever: Lever, width_m: float) -> FittedModel:
    """Return the model of a differential-drive controller with the multiplier and radius factors of a fit of `FIVE`.

    Parameters
    ----------
    five : the fit, with the turn rate of the wheels, or of wheels and gyro
    lever : known parts of the lever; for an unknown part, the velocity of the measured point in a turn is kept
    width_m : track width b

    Notes
    -----
    v_x = (a_l V_l + a_r V_r) / 2, omega = (a_l V_l - a_r V_r) / (m b). With V_l = v + w b / 2 and V_r = v - w b / 2 the
    turn rate equals the fit's. v_x differs from the fit's by (y_r + y_l) / 2 omega, v_y by -x omega; a lever has the
    same effect.
    """
    values = dict(zip(five.model.terms, five.parameters.tolist(), strict=True))
    if lever.aside:
        wheels = five if five.wheels is None else five.wheels
        _, _, _, _, left, right = track_geometry(wheels.model, wheels.parameters, width_m)
        values |= {"vx_v": (left + right) / 2.0, "vx_w": (left - right) / 2.0}
    if lever.ahead:
        values["vy_w"] = 0.0
    parameters = np.array([values[name] for name in five.model.terms])
    return FittedModel(five.model, parameters, five.covariance, five.wheels)


def find_model(name: str) -> MotionModel:
    """Return a model by name; a name with ``_gyro`` at the end gives the model with a gyro.

    Raises
    ------
    KeyError
        No model has this name.
    """
    base = name.removesuffix("_gyro")
    return MODELS[base].with_gyro() if base != name else MODELS[base]
