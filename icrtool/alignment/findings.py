"""What the alignment estimates of a log and its robot: the findings of run.json, and the start of the filter."""

from __future__ import annotations

import math

import numpy as np

from icrtool.alignment.corrections import AlignedStreams
from icrtool.alignment.estimator import Geometry
from icrtool.config import Config
from icrtool.records.measurements import Finding, IcrStart
from icrtool.records.run import width_or_usual_m

LEAST_START_STD, INFLATION = 0.15, 3.0
"""The filter starts from the alignment's ICRs with three times their standard deviation, at least this part of b."""

LARGEST_WIDTH_STD, WIDTHS = 0.2, (0.7, 6.0)
"""The ICRs are shown where W is known to this share, and lies between so many b."""

USUAL_WIDTH = 1.5
"""Most skid-steer robots turn as if they were this much wider than they are."""

START = "start of the filter"


def alignment_findings(found: AlignedStreams, antenna_m: tuple[float, float]) -> dict[str, Finding]:
    """Return all estimates of the alignment, by name with unit.

    Parameters
    ----------
    antenna_m : the antenna from the body origin, forward and right; the ICRs refer to the origin
    """
    wheels, heading, delays = found.wheels, found.heading, found.delays
    degrees = math.degrees
    return {
        "wheel_scale": _finding(wheels.scale, wheels.scale_std, wheels.applied_scale, nothing=1.0),
        "heading_offset_deg": _finding(
            -degrees(heading.offset_rad), degrees(heading.offset_std_rad), -degrees(heading.applied_offset_rad)
        ),
        "heading_delay_s": _finding(*delays.heading, delays.applied_heading_s),
        "position_delay_s": _finding(*delays.gnss, delays.applied_gnss_s),
        "position_delay_against_heading_s": _finding(
            *delays.apart, delays.applied_gnss_s - delays.applied_heading_s if not delays.together else 0.0
        ),
    } | _robot_findings(found, antenna_m)


def _robot_findings(found: AlignedStreams, antenna_m: tuple[float, float]) -> dict[str, Finding]:
    """Return side scales, ICRs and the antenna's place against them; none without an estimate."""
    geometry = found.geometry
    if geometry is None:
        return {}
    (right, left, x, left_scale, right_scale, width), covariance = geometry.values.tolist(), geometry.covariance
    forward_m, right_m = antenna_m
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist()
    half_sum = np.array([0.5, 0.5, 0.0, 0.0, 0.0, 0.0])
    middle_std = math.sqrt(max(float(half_sum @ covariance @ half_sum), 0.0))
    place = "only the position of the antenna relative to the ICRs is determined"
    scales = found.wheels.applied
    return {
        "left_scale": _finding(left_scale, std[3], scales[0], nothing=1.0),
        "right_scale": _finding(right_scale, std[4], scales[1], nothing=1.0),
        "icr_separation_m": Finding(width, std[5], 0.0, START),
        "antenna_forward_minus_x_icr_m": Finding(-x, std[2], forward_m, place),
        "antenna_right_minus_icr_middle_m": Finding(-(right + left) / 2, middle_std, right_m, place),
        "y_icr_right_m": Finding(right + right_m, std[0], 0.0, START),
        "y_icr_left_m": Finding(left + right_m, std[1], 0.0, START),
        "x_icr_m": Finding(x + forward_m, std[2], 0.0, START),
    }


def _finding(value: float, std: float, applied: float, nothing: float = 0.0) -> Finding:
    """Return one estimate; `nothing` is the correction that changes nothing."""
    known = math.isfinite(value) and math.isfinite(std)
    if applied != nothing:
        why = "corrected"
    elif known:
        why = "not corrected: too small, too uncertain, or not separable from wheel slip"
    else:
        why = "not corrected: this drive does not show it"
    return Finding(value if known else None, std if known else None, applied, why)


def start_icrs(found: Geometry | None, antenna_m: tuple[float, float], config: Config) -> IcrStart | None:
    """Return the ICRs to start the filter from; None in preset ``paper``.

    They are those of the alignment with an inflated standard deviation, where the drive shows them; else those of
    most skid-steer robots, as uncertain as those differ.
    """
    if config.filter.preset == "paper":
        return None
    b = width_or_usual_m(config.robot.track_width_m)
    least = LEAST_START_STD * b
    if found is not None:
        right, left, x = found.values[:3].tolist()
        std, width = np.sqrt(np.maximum(np.diag(found.covariance), 0.0)), float(found.values[5])
        shown = std[5] < LARGEST_WIDTH_STD * width and WIDTHS[0] * b < width < WIDTHS[1] * b
        icrs = (right + antenna_m[1], left + antenna_m[1], x + antenna_m[0])
        if shown and icrs[0] > least > -least > icrs[1] and float(std[:3].max()) < b:
            inflated = [max(INFLATION * float(one), least) for one in std[:3]]
            return IcrStart(icrs, (inflated[0], inflated[1], inflated[2]))
    return IcrStart((USUAL_WIDTH * b / 2, -USUAL_WIDTH * b / 2, 0.0), (b / 2, b / 2, b / 2))
