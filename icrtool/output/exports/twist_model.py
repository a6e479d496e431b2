"""A calibration's twist model as JSON in REP-103 (y left, counter-clockwise), for a robot's own node.

Changing hands turns v_y, the turn rate and w over: a coefficient keeps its sign where an even number of these meet.
"""

from __future__ import annotations

import numpy as np

from icrtool import __version__
from icrtool.calibration.controller_numbers import POSE_AFTER_M
from icrtool.calibration.record import Calibration
from icrtool.kernels.window_residuals import OMEGA, VX, VY
from icrtool.motion.models import TERMS, Term, wheel_motion
from icrtool.output.files.formats import json_bytes
from icrtool.records.plain_data import plain

TWIST_SCHEMA = "icrtool/twist/1"

AXES = {VX: "v_x", VY: "v_y", OMEGA: "yaw_rate"}
SYMBOLS = {
    "v": "(v_left + v_right) / 2",
    "w": "(v_right - v_left) / b",
    "spin": "abs(v_left - v_right) / (abs(v_left) + abs(v_right)), 0 where both are 0",
    "b": "track_width_m",
}


def format_twist(calibration: Calibration) -> str:
    """Return the JSON text, no line end; `v_x`, `v_y` and `yaw_rate` are each the sum of value times formula."""
    fitted = calibration.fitted
    free = [TERMS[name] for name in fitted.model.terms]
    signs = np.array([sign_in_rep103(term) for term in free])
    fixed = [term for term in TERMS.values() if term.nominal and term not in free]
    geometry, covariance = calibration.geometry()
    stds = np.sqrt(np.diag(covariance)).tolist()
    p95, expected = calibration.held_out_m("recommended", POSE_AFTER_M)
    document = {
        "schema": TWIST_SCHEMA,
        "tool_version": __version__,
        "created": calibration.created,
        "robot": plain(calibration.robot),
        "frame": "REP-103: x forward, y left, yaw counter-clockwise",
        "inputs": "v_left, v_right [m/s]: wheel speeds at the configured radius, forward positive",
        "outputs": "v_x, v_y [m/s], yaw_rate [rad/s]",
        "model": fitted.model.name,
        "symbols": SYMBOLS,
        "track_width_m": calibration.width_m,
        "terms": [
            {"name": term.name, "output": AXES[term.axis], "formula": term.formula, "value": value, "std": std}
            for term, value, std in [
                *((term, sign_in_rep103(term) * term.nominal, 0.0) for term in fixed),
                *zip(free, (signs * fitted.parameters).tolist(), fitted.std.tolist(), strict=True),
            ]
        ],
        "covariance": {
            "of": list(fitted.model.terms),
            "matrix": (np.outer(signs, signs) * fitted.covariance).tolist(),
        },
        "icrs": {
            "y_icr_right_m": -geometry.y_icr_right_m, "y_icr_left_m": -geometry.y_icr_left_m,
            "x_icr_m": geometry.x_icr_m,
            "std": dict(zip(("y_icr_right_m", "y_icr_left_m", "x_icr_m"), stds[:3], strict=True)),
        },
        "held_out": {"horizon_m": POSE_AFTER_M, "p95_m": p95, "expected_m": expected},
        "logs": plain(calibration.logs),
        "warnings": list(calibration.warnings),
    }  # fmt: skip
    return json_bytes(document).decode().rstrip("\n")


def sign_in_rep103(term: Term) -> float:
    """Return the factor of a parameter when y points left, turns count counter-clockwise and w = -w."""
    left, right = np.array([0.3]), np.array([0.1])
    here, swapped = (term.column(wheel_motion(*sides, 1.0))[0] for sides in ((left, right), (right, left)))
    axis = 1.0 if term.axis == VX else -1.0
    return axis if here == swapped else -axis
