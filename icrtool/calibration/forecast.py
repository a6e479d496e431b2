"""Forecast the error of driving a path without GNSS, from a calibration's covariance and sources of error."""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np

from icrtool.calibration.error_growth import SOURCES, PathErrors, Spread, mean_error, path_errors, radius
from icrtool.calibration.record import Calibration
from icrtool.errors import DataError
from icrtool.kernels.arrays import Complexes, Floats, Ints
from icrtool.kernels.track import Track
from icrtool.kernels.window_residuals import OMEGA, VX
from icrtool.motion.models import FittedModel, wheel_motion
from icrtool.motion.recording import Recording, steps_of

STEP_M = 0.1
"""A planned path is driven in steps of this length."""

SPEED_MPS = 0.5
"""Speed of a plan that gives none."""

SLOWEST_MPS = 0.02

INVERSIONS = 8

FURTHEST_M, FASTEST_MPS = 1e8, 100.0
"""Of a point from the origin, which may be that of UTM; of any robot with tracks."""

LONGEST_PATH_M = 100_000.0


class Forecast(NamedTuple):
    """Errors along a path that is driven without GNSS from its start; (m,) each, after each metre.

    Attributes
    ----------
    distance_m : driven; east_m, north_m : where the path is then
    expected_m, p95_m : mean error, and the distance within which 95 % of the errors are
    std_east_m, std_north_m, heading_std_deg : one standard deviation
    """

    distance_m: Floats
    east_m: Floats
    north_m: Floats
    expected_m: Floats
    p95_m: Floats
    std_east_m: Floats
    std_north_m: Floats
    heading_std_deg: Floats


def forecast_plan(
    calibration: Calibration, east_m: Floats, north_m: Floats, speed_mps: Floats | None = None, *,
    with_gyro: bool = False,
) -> Forecast:  # fmt: skip
    """Return the errors along a planned path.

    Parameters
    ----------
    east_m, north_m : (p,) points of the path, driven in their order
    speed_mps : (p,) speed from each point on, negative in reverse; default `SPEED_MPS`
    with_gyro : by the calibration's model with a gyro

    Raises
    ------
    DataError
        A path shorter than a metre or with values that are not numbers, or a calibration without sources of error.
    """
    if not (np.abs([north_m, east_m]) <= FURTHEST_M).all():
        raise DataError("plan", f"a point that is no number, or beyond {FURTHEST_M:g} m", "give metres")
    path, line = _resampled(np.asarray(north_m, np.float64) + 1j * np.asarray(east_m, np.float64))
    step = np.diff(path)
    speed = np.full(len(step), SPEED_MPS) if speed_mps is None else np.asarray(speed_mps, np.float64)[line[:-1]]
    if not ((np.abs(speed) > 0.0) & (np.abs(speed) <= FASTEST_MPS)).all():
        why = f"a speed that is zero, no number, or beyond {FASTEST_MPS:g} m/s"
        raise DataError("plan", why, "give speed_mps in m/s, negative in reverse")
    speed = np.sign(speed) * np.maximum(np.abs(speed), SLOWEST_MPS)
    # a corner of the plan is turned over the steps around it, not on the spot
    width = max(round(calibration.width_m / STEP_M), 1)
    direction = _smoothed(np.unwrap(np.angle(step * np.sign(speed))), width)
    held = np.abs(step / speed)
    turn = np.append(np.diff(direction), 0.0) / held
    left, right = wheel_speeds(calibration.fitted, calibration.width_m, speed, turn)
    t, length = (np.concatenate([[0.0], np.cumsum(one)]) for one in (held, np.abs(step)))
    left, right, turn, direction = (np.append(one, one[-1:]) for one in (left, right, turn, direction))
    planned = Track.of_states(
        t, np.append(held, 0.0), left, right, path.real, path.imag, direction, length
    )._replace(gyro=turn, into=0.5)  # fmt: skip
    return _along(calibration, planned, planned, with_gyro=with_gyro)


def forecast_drive(calibration: Calibration, recording: Recording, *, with_gyro: bool = False) -> Forecast:
    """Return the errors of driving the path of a recording again, with its wheel speeds (and gyro)."""
    return _along(calibration, recording.track, steps_of(recording), with_gyro=with_gyro)


def wheel_speeds(fitted: FittedModel, width_m: float, speed: Floats, turn: Floats) -> tuple[Floats, Floats]:
    """Return the speeds of the sides (n,) [m/s] that make a speed ahead [m/s] and a turn rate [rad/s] by a model.

    Notes
    -----
    The model's matrix from (v, w) to (v_x, omega), its terms that are not linear taken at the last step.
    """
    v, w = speed.copy(), turn.copy()
    for _ in range(INVERSIONS):
        made = _ahead_and_turn(fitted, width_m, v, w)
        by_v = (_ahead_and_turn(fitted, width_m, v + 1e-4, w) - made) / 1e-4
        by_w = (_ahead_and_turn(fitted, width_m, v, w + 1e-4) - made) / 1e-4
        off = np.array([speed, turn]) - made
        size = by_v[0] * by_w[1] - by_v[1] * by_w[0]
        size = np.where(np.abs(size) > 1e-3, size, 1e-3)
        v = v + (off[0] * by_w[1] - off[1] * by_w[0]) / size
        w = w + (off[1] * by_v[0] - off[0] * by_v[1]) / size
    return v + w * width_m / 2.0, v - w * width_m / 2.0


def _ahead_and_turn(fitted: FittedModel, width_m: float, v: Floats, w: Floats) -> Floats:
    return fitted.twist(wheel_motion(v + w * width_m / 2.0, v - w * width_m / 2.0, width_m))[[VX, OMEGA]]


def _resampled(points: Complexes) -> tuple[Complexes, Ints]:
    """Return points (n,) a step apart along straight lines between points (p,), and the line (n,) that each lies on."""
    length = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(points)))])
    if not 1.0 <= length[-1] <= LONGEST_PATH_M:
        raise DataError("plan", f"a path of {length[-1]:.3g} m", f"give 1 m to {LONGEST_PATH_M:g} m")
    at = np.linspace(0.0, length[-1], max(round(length[-1] / STEP_M), 10) + 1)
    line = np.clip(np.searchsorted(length, at, side="right") - 1, 0, len(points) - 2)
    place: Complexes = np.interp(at, length, points.real) + 1j * np.interp(at, length, points.imag)
    return place, line


def _smoothed(values: Floats, width: int) -> Floats:
    """Return means over `width` values; the first and last are repeated beyond the ends."""
    padded = np.concatenate([np.full(width // 2, values[0]), values, np.full(width - 1 - width // 2, values[-1])])
    return np.asarray(np.convolve(padded, np.full(width, 1.0 / width), mode="valid"))


def _along(calibration: Calibration, track: Track, steps: Track, *, with_gyro: bool) -> Forecast:
    """Return the forecast after each metre of a track, and of its wheel samples as they are integrated."""
    t, metres = track.t, np.arange(1.0, np.floor(track.distance[-1]) + 1.0)
    if not len(metres):
        raise DataError("path", f"{track.distance[-1]:.2f} m long", "a forecast needs a metre at least")
    rows = np.searchsorted(track.distance, metres)
    spread, expected, p95 = forecast_errors(calibration, steps, np.full(len(rows), t[0]), t[rows], with_gyro=with_gyro)
    c, s = np.cos(track.heading[0]), np.sin(track.heading[0])
    xx, xy, yy = spread.xx[:, 0], spread.xy[:, 0], spread.yy[:, 0]
    north = np.sqrt(np.maximum(c * c * xx - 2 * c * s * xy + s * s * yy, 0.0))
    east = np.sqrt(np.maximum(s * s * xx + 2 * c * s * xy + c * c * yy, 0.0))
    return Forecast(
        metres, track.east[rows], track.north[rows], expected, p95, east, north,
        np.degrees(np.sqrt(spread.heading[:, 0])),
    )  # fmt: skip


def forecast_errors(
    calibration: Calibration, steps: Track, begin_s: Floats, end_s: Floats, *, with_gyro: bool
) -> tuple[Spread, Floats, Floats]:
    """Return moments, expected and 95 % error (w,) [m] of windows of a drive from and to times (w,)."""
    fitted, sources = calibration.fitted, calibration.error_sources
    if with_gyro and calibration.gyro is not None and (turned := calibration.fitted_with_gyro) is not None:
        fitted, sources = turned, calibration.gyro.error_sources
    if sources is None:
        why = "its error growth was not measured"
        raise DataError(calibration.name or "calibration", why, "calibrate again, with a longer drive or more logs")
    found: PathErrors = path_errors(steps, begin_s, end_s, fitted, calibration.width_m)
    spread = found.of_sources.combined(np.array(msgspec.structs.astuple(sources)[:SOURCES])).plus(found.of_parameters)
    return spread, sources.expected_factor * mean_error(spread), sources.p95_factor * radius(spread, 0.95)
