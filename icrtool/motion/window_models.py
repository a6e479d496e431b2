"""The models that windows of way are fitted with: what is free, what it does, what is known of it beforehand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icrtool.kernels.window_errors import NEUTRAL
from icrtool.records.tables import Floats

USUAL_MULTIPLIER = 1.4
"""W / b of the prior: skid factors in the published settings of Clearpath and Husarion robots are 1.1 to 1.9."""

TERMS = ("separation", "asymmetry", "x_icr", "scale", "scale_difference", "bend", "speed", "late")
"""What can be fitted: W [m], (y_r + y_l) / 2 [m], x_icr [m], scale of both sides, left minus right, and ``bend``,
``speed`` of `icrtool.kernels.window_errors`; ``late`` [s]: the wheels are read this much later than the pose."""

_BASIS = np.array(
    [
        [0.5, -0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 0.0, 0.5, -0.5, 0.0, 0.0, 0.0],
        [0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0],
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0],
    ]
)
"""Rows: what one unit of each term adds to (y_r, y_l, x, k_l, k_r, bend, speed, late)."""

_PRIOR_STD = {"scale": 0.05, "scale_difference": 0.05, "bend": 0.3, "speed": 0.3, "late": 0.2}
"""How far the terms stray on real robots: a drive that says nothing of a term leaves it where it belongs."""


@dataclass(frozen=True, slots=True)
class WindowModel:
    """A model to fit: what is free, of `TERMS`; the rest is neutral."""

    name: str
    label: str
    terms: tuple[str, ...]


MULTIPLIER = WindowModel("multiplier", "best single multiplier", ("separation",))
CONSTANT = WindowModel("window", "window fit", ("separation", "asymmetry", "x_icr"))
EXTENDED = (
    WindowModel("window_scale", "with scales", (*CONSTANT.terms, "scale", "scale_difference")),
    WindowModel("window_late", "with delay", (*CONSTANT.terms, "late")),
    WindowModel("window_scale_late", "with scales and delay", (*CONSTANT.terms, "scale", "scale_difference", "late")),
    WindowModel("window_bend", "with scales and curvature", (*CONSTANT.terms, "scale", "scale_difference", "bend")),
    WindowModel("window_speed", "with scales and speed", (*CONSTANT.terms, "scale", "scale_difference", "speed")),
)
"""Models that pay on some robots and not on others: cross-validation chooses."""


def basis_of(model: WindowModel) -> Floats:
    """Return what one unit of each of a model's terms adds to the parameters (k, 8)."""
    return _BASIS[[TERMS.index(term) for term in model.terms]]


def base_parameters() -> Floats:
    """Return the parameters (8,) to which the terms add."""
    return np.array([*NEUTRAL, 0.0])


def usual_terms(width_m: float, model: WindowModel) -> tuple[Floats, Floats]:
    """Return mean and standard deviation of the model's terms before any window is seen."""
    means = {"separation": USUAL_MULTIPLIER * width_m}
    stds = {"separation": width_m, "asymmetry": width_m / 2, "x_icr": width_m / 2, **_PRIOR_STD}
    return np.array([means.get(term, 0.0) for term in model.terms]), np.array([stds[term] for term in model.terms])
