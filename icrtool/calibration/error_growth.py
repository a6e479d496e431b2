"""Growth of the error of a motion model along a path, and forecast of the error on a path without GNSS.

The position error of a drive without GNSS has two parts. The first part follows from the covariance of the parameters
by the derivatives of the path. The second part comes from effects that the model leaves out. Six sources of error
describe it, each with a variance: the heading at the start, a constant error of the turn rate, a proportional error of
the turns, a random walk of the turn rate, a proportional error of the speed, a random walk of the speed.
`icrtool.calibration.held_out` measures the variances.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple, TypeVar

import numpy as np
from msgspec.structs import astuple

from icrtool.alignment.wheel_units import FASTEST_MPS
from icrtool.calibration.record import Calibration
from icrtool.errors import DataError
from icrtool.kernels.arrays import Complexes, Floats, Ints, unwrapped
from icrtool.kernels.track import Track, Windows
from icrtool.kernels.window_residuals import OMEGA, VX, displacements, path_at
from icrtool.motion.models import FittedModel, model_columns, wheel_motion
from icrtool.motion.recording import NO_CONSTANTS, LogConstants, Recording, steps_of
from icrtool.records.calibration_document import ErrorSources

ANGLES, BISECTIONS = 24, 26
"""Number of directions of an average over an ellipse, and of halvings of a radius."""

SOURCES = ErrorSources.__struct_fields__.index("p95_factor")
"""Number of sources of error."""

STEP_M = 0.1
"""Length of the steps in which a planned path is driven [m]."""

SPEED_MPS = 0.5
"""Speed of a plan that states no speed [m/s]."""

SLOWEST_PLAN_MPS = 0.02
"""Smallest speed of a plan [m/s]. A slower speed is replaced by it."""

INVERSIONS = 8
"""Number of Newton steps that find wheel speeds for a motion."""

FURTHEST_M = 1e8
"""Largest distance of a point of a plan from the origin [m]. The origin may be the origin of UTM coordinates."""

LONGEST_PATH_M = 100_000.0
"""Longest path of a forecast [m]."""

Values = TypeVar("Values", Floats, Complexes)


class ErrorMoments(NamedTuple):
    """Second moments of errors at the ends of windows, in the body frame of their start.

    Attributes
    ----------
    heading : (w, c) [rad^2]; xx, xy, yy : (w, c) [m^2], forward and right; c is the number of sources, or 1 for all
        sources together
    """

    heading: Floats
    xx: Floats
    xy: Floats
    yy: Floats

    def combined_moments(self, variances: Floats) -> ErrorMoments:
        """Return the moments (w, 1) of all sources together, for variances (c,) of the sources."""
        return ErrorMoments(*((moments @ variances)[:, None] for moments in self))

    def plus(self, other: ErrorMoments) -> ErrorMoments:
        """Return the moments of the sum of two independent errors."""
        return ErrorMoments(*(a + b for a, b in zip(self, other, strict=True)))


class PathMoments(NamedTuple):
    """Motion in windows by a model, and moments of its errors.

    Attributes
    ----------
    moved : complex (w,) displacement, forward + j right [m]; turned : (w,) [rad]
    of_parameters : moments by errors of the parameters, one column
    of_sources : moments by a unit variance of each source, a column for each source
    """

    moved: Complexes
    turned: Floats
    of_parameters: ErrorMoments
    of_sources: ErrorMoments


def path_errors(
    windows: Windows, fitted_model: FittedModel, width_m: float, constants: LogConstants = NO_CONSTANTS
) -> PathMoments:
    """Return displacement and turn of windows by a model, and the moments of their errors.

    Parameters
    ----------
    fitted_model, width_m : the model, and the track width b [m]
    constants : constants of the recording
    """
    steps = windows.track
    gyro = None if steps.gyro is None else steps.gyro + constants.gyro_later_s * steps.gyro_change()
    motion = wheel_motion(steps.v_left, steps.v_right, width_m, gyro)
    fixed, axes, columns = model_columns(fitted_model.model, fitted_model.complete(motion))
    fixed[OMEGA] += constants.gyro_bias_radps
    # The sources act along the whole path, not only at the ends of the windows.
    start_s, end_s = (steps.place_t[rows] + constants.wheels_later_s for rows in (windows.begin, windows.end))
    times_s = np.unique(np.concatenate([start_s, end_s, steps.t]))
    path = path_at(steps, lambda rows: (fixed[:, rows], axes, columns[:, rows]), fitted_model.parameters, times_s)
    s, e = np.searchsorted(times_s, start_s), np.searchsorted(times_s, end_s)
    moved, moved_derivatives = displacements(path, s, e)
    moved_by, turn_by = moved_derivatives[:-1], path.heading_by[:, e] - path.heading_by[:, s]
    of_parameters = ErrorMoments(
        *(np.einsum("kw,kl,lw->w", a, fitted_model.covariance, b)[:, None]
          for a, b in ((turn_by, turn_by), (moved_by.real, moved_by.real), (moved_by.real, moved_by.imag),
                       (moved_by.imag, moved_by.imag)))
    )  # fmt: skip
    turn_rad = path.heading[e] - path.heading[s]
    return PathMoments(moved, turn_rad, of_parameters, _source_moments(path.heading, path.place, s, e))


def _source_moments(theta: Floats, position: Complexes, s: Ints, e: Ints) -> ErrorMoments:
    """Return the moments (w, `SOURCES`) of a unit variance of each source, by sums between knots."""
    step = np.diff(position)
    length = np.concatenate([[0.0], np.cumsum(np.abs(step))])
    middle_m, middle_rad = (length[1:] + length[:-1]) / 2, (theta[1:] + theta[:-1]) / 2
    middle = (position[1:] + position[:-1]) / 2

    def sum_between_knots(values: Values) -> Values:
        """Return the sum of values between the knots of each window."""
        sums = np.concatenate([np.zeros(1, values.dtype), np.cumsum(values)])
        difference: Values = sums[e] - sums[s]
        return difference

    to_body, displacement, path_length = np.exp(-1j * theta[s]), position[e] - position[s], length[e] - length[s]
    by_rate = 1j * to_body * (sum_between_knots(step * middle_m) - length[s] * displacement)
    by_turn = 1j * to_body * (sum_between_knots(step * middle_rad) - theta[s] * displacement)
    constant = [
        (0.0 * path_length, 1j * to_body * displacement),
        (path_length, by_rate),
        (theta[e] - theta[s], by_turn),
        (0.0 * path_length, to_body * displacement),
    ]
    driven_m, first = np.abs(step), sum_between_knots(np.abs(step) * middle)
    zero = sum_between_knots(driven_m)
    # The heading error of the wander grows along the path: a step of length q at the point S_u moves the end S_e by
    # j (S_e - S_u). The sum of q (S_e - S_u)(S_e - S_u)^T is computed as squared length `size` and as square of a
    # complex number, `square`; `zero` and `first` are the sums of q and of q S_u.
    size = (
        zero * np.abs(position[e]) ** 2
        - 2.0 * (np.conj(position[e]) * first).real
        + sum_between_knots(driven_m * np.abs(middle) ** 2)
    )
    square = (zero * position[e] ** 2 - 2.0 * position[e] * first + sum_between_knots(driven_m * middle**2)) * (
        1j * to_body
    ) ** 2
    wander = _from_squares(path_length, size, square)
    along = np.divide(step**2, driven_m, out=np.zeros(len(step), np.complex128), where=driven_m > 0.0)
    speed = _from_squares(0.0 * path_length, zero, sum_between_knots(along) * to_body**2)
    moments = [ErrorMoments(h**2, p.real**2, p.real * p.imag, p.imag**2) for h, p in constant]
    ones, none = np.ones(len(s)), np.zeros(len(s))
    reference = [ErrorMoments(ones, none, none, none), ErrorMoments(none, ones, none, ones)]
    ordered = (*moments[:3], wander, moments[3], speed, *reference)
    return ErrorMoments(*(np.column_stack(column) for column in zip(*ordered, strict=True)))


def _from_squares(heading: Floats, size: Floats, square: Floats) -> ErrorMoments:
    """Return the moments of errors z whose sums of |z|^2 and of z^2 are `size` and `square`."""
    return ErrorMoments(heading, (size + square.real) / 2, square.imag / 2, (size - square.real) / 2)


def radius_of_share(spread: ErrorMoments, share: float) -> Floats:
    """Return the radius (w,) [m] that holds a share of normal errors with the moments (w, 1), by bisection."""
    across = _directions(spread)
    low, high = np.zeros(len(across)), 6.0 * np.sqrt(across.max(axis=1))
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        with np.errstate(divide="ignore", invalid="ignore"):
            inside = 1.0 - np.nan_to_num(np.exp(-(middle[:, None] ** 2) / (2.0 * across))).mean(axis=1)
        low, high = np.where(inside < share, middle, low), np.where(inside < share, high, middle)
    return np.asarray((low + high) / 2)


def mean_error(spread: ErrorMoments) -> Floats:
    """Return the mean length (w,) [m] of errors that are normal with the moments (w, 1)."""
    return np.asarray(np.sqrt(np.pi / 2.0) * np.sqrt(_directions(spread)).mean(axis=1))


def _directions(spread: ErrorMoments) -> Floats:
    """Return the squared lengths (w, `ANGLES`) of unit vectors of a quarter circle times the root of the covariance."""
    xx, xy, yy = spread.xx[:, 0], spread.xy[:, 0], spread.yy[:, 0]
    middle, apart = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    large, small = middle + apart, np.maximum(middle - apart, 0.0)
    angle = np.pi / 2 * (np.arange(ANGLES) + 0.5) / ANGLES
    return np.asarray(large[:, None] * np.cos(angle) ** 2 + small[:, None] * np.sin(angle) ** 2)


def fit_variances(
    length: Floats, sources: ErrorMoments, known: ErrorMoments, turn_error_rad: Floats, error_m: Complexes
) -> Floats:
    """Return the variances (`SOURCES`,) that best explain the squared errors of windows.

    Parameters
    ----------
    length : (w,) length of each window [m]; each length has the same weight
    sources, known : moments by unit variances of the sources, and by errors of the parameters
    turn_error_rad, error_m : (w,) errors of the turn [rad], and of the displacement, forward + j right [m]
    """
    matrix, y = np.zeros((SOURCES, SOURCES)), np.zeros(SOURCES)
    kinds = (
        (sources.heading, known.heading, turn_error_rad**2),
        (sources.xx, known.xx, error_m.real**2),
        (sources.yy, known.yy, error_m.imag**2),
    )
    for length_m in np.unique(length):
        rows = length == length_m
        for columns, of_parameters, squared in kinds:
            weight = 1.0 / max(float(squared[rows].mean()), 1e-12)
            scaled = weight * columns[rows]
            matrix += scaled.T @ scaled / np.count_nonzero(rows)
            y += scaled.T @ (weight * (squared[rows] - of_parameters[rows, 0])) / np.count_nonzero(rows)
    return solve_nonnegative(matrix, y)


def solve_nonnegative(matrix: Floats, y: Floats) -> Floats:
    """Return x >= 0 (n,) that minimises x M x / 2 - y x; M (n, n) is positive semidefinite, and n is small.

    Notes
    -----
    The equations are solved for each of the 2^n sets of values above zero. The best solution without a negative value
    is returned.
    """
    size = np.sqrt(np.maximum(np.diag(matrix), np.finfo(np.float64).tiny))
    scaled, target = matrix / np.outer(size, size), y / size
    above = np.array(list(product((0.0, 1.0), repeat=len(y))))
    parts = scaled * above[:, :, None] * above[:, None, :]
    x = above * (np.linalg.pinv(parts, hermitian=True) @ (above * target)[:, :, None])[:, :, 0]
    cost = np.einsum("si,ij,sj->s", x, scaled, x) / 2.0 - x @ target
    cost[(x < 0.0).any(axis=1)] = np.inf
    best: Floats = x[np.argmin(cost)] / size
    return best


class Forecast(NamedTuple):
    """Errors along a path that is driven without GNSS from its start; (m,) each, after each metre.

    Attributes
    ----------
    distance_m : driven distance; east_m, north_m : position on the path at this distance
    expected_m, p95_m : mean error, and the error that 95 % of the errors do not exceed
    std_east_m, std_north_m, heading_std_deg : standard deviations of position and heading
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
    with_gyro : use the calibration's model with a gyro

    Raises
    ------
    DataError
        The path is shorter than a metre or longer than 100 km, a point is not a number or further than 1e8 m from the
        origin, a speed is zero, not a number or too fast, or the calibration has no sources of error.
    """
    if not (np.abs([north_m, east_m]) <= FURTHEST_M).all():
        raise DataError("plan", f"a point is not a number, or beyond {FURTHEST_M:g} m", "give metres")
    points = np.asarray(north_m, np.float64) + 1j * np.asarray(east_m, np.float64)
    length = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(points)))])
    if not 1.0 <= length[-1] <= LONGEST_PATH_M:
        raise DataError("plan", f"the path is {length[-1]:.3g} m long", f"give 1 m to {LONGEST_PATH_M:g} m")
    path_m = np.linspace(0.0, length[-1], max(round(length[-1] / STEP_M), 10) + 1)
    segment = np.clip(np.searchsorted(length, path_m, side="right") - 1, 0, len(points) - 2)
    path = np.interp(path_m, length, points.real) + 1j * np.interp(path_m, length, points.imag)
    step = np.diff(path)
    speed = np.full(len(step), SPEED_MPS) if speed_mps is None else np.asarray(speed_mps, np.float64)[segment[:-1]]
    if not ((np.abs(speed) > 0.0) & (np.abs(speed) <= FASTEST_MPS)).all():
        why = f"a speed is zero, not a number, or beyond {FASTEST_MPS:g} m/s"
        raise DataError("plan", why, "give speed_mps in m/s, negative in reverse")
    speed = np.sign(speed) * np.maximum(np.abs(speed), SLOWEST_PLAN_MPS)
    # A corner is driven as a curve over one track width: the directions are averaged over this distance.
    corner_steps = max(round(calibration.width_m / STEP_M), 1)
    padding = corner_steps // 2, corner_steps - 1 - corner_steps // 2
    padded = np.pad(unwrapped(np.angle(step * np.sign(speed))), padding, mode="edge")
    direction = np.convolve(padded, np.full(corner_steps, 1.0 / corner_steps), mode="valid")
    duration_s = np.abs(step / speed)
    turn = np.append(np.diff(direction), 0.0) / duration_s
    left, right = wheel_speeds(calibration.fitted, calibration.width_m, speed, turn)
    t, distance = (np.concatenate([[0.0], np.cumsum(steps)]) for steps in (duration_s, np.abs(step)))
    left, right, turn, direction = (np.append(column, column[-1:]) for column in (left, right, turn, direction))
    planned = Track.of_states(
        t, np.append(duration_s, 0.0), left, right, path.real, path.imag, direction, distance
    )._replace(gyro=turn, into=0.5)  # fmt: skip
    return _along(calibration, planned, planned, with_gyro=with_gyro)


def forecast_drive(calibration: Calibration, recording: Recording, *, with_gyro: bool = False) -> Forecast:
    """Return the errors along the path of a recording, with its wheel speeds and, if `with_gyro`, its gyro.

    Raises
    ------
    DataError
        The path is shorter than a metre, or the calibration has no sources of error.
    """
    return _along(calibration, recording.track, steps_of(recording), with_gyro=with_gyro)


def wheel_speeds(fitted_model: FittedModel, width_m: float, speed: Floats, turn: Floats) -> tuple[Floats, Floats]:
    """Return left and right speeds (n,) [m/s] for which a model gives a forward speed [m/s] and a turn rate [rad/s].

    Notes
    -----
    Newton steps in v and w, with derivatives of v_x and omega by differences.
    """

    def ahead_and_turn(v: Floats, w: Floats) -> Floats:
        """Return v_x and omega (2, n) of the model."""
        return fitted_model.twist(wheel_motion(v + w * width_m / 2.0, v - w * width_m / 2.0, width_m))[[VX, OMEGA]]

    v, w = speed.copy(), turn.copy()
    for _ in range(INVERSIONS):
        reached = ahead_and_turn(v, w)
        by_v = (ahead_and_turn(v + 1e-4, w) - reached) / 1e-4
        by_w = (ahead_and_turn(v, w + 1e-4) - reached) / 1e-4
        residual = np.array([speed, turn]) - reached
        determinant = by_v[0] * by_w[1] - by_v[1] * by_w[0]
        determinant = np.where(np.abs(determinant) > 1e-3, determinant, 1e-3)
        v = v + (residual[0] * by_w[1] - residual[1] * by_w[0]) / determinant
        w = w + (residual[1] * by_v[0] - residual[0] * by_v[1]) / determinant
    return v + w * width_m / 2.0, v - w * width_m / 2.0


def _along(calibration: Calibration, track: Track, steps: Track, *, with_gyro: bool) -> Forecast:
    """Return the forecast after each metre of a track; `steps` is the track with joined wheel samples.

    Raises
    ------
    DataError
        The track is shorter than a metre, or the calibration has no sources of error.
    """
    horizons_m = np.arange(1.0, np.floor(track.distance[-1]) + 1.0)
    if not len(horizons_m):
        raise DataError("path", f"is {track.distance[-1]:.2f} m long", "a forecast needs at least a metre")
    rows = np.searchsorted(track.distance, horizons_m)
    windows = Windows(steps, np.zeros_like(rows), rows, horizons_m)
    spread, expected, p95 = forecast_errors(calibration, windows, with_gyro=with_gyro)
    c, s = np.cos(track.heading[0]), np.sin(track.heading[0])
    xx, xy, yy = spread.xx[:, 0], spread.xy[:, 0], spread.yy[:, 0]
    north = np.sqrt(np.maximum(c * c * xx - 2 * c * s * xy + s * s * yy, 0.0))
    east = np.sqrt(np.maximum(s * s * xx + 2 * c * s * xy + c * c * yy, 0.0))
    return Forecast(
        horizons_m, track.east[rows], track.north[rows], expected, p95, east, north,
        np.degrees(np.sqrt(spread.heading[:, 0])),
    )  # fmt: skip


def forecast_errors(
    calibration: Calibration, windows: Windows, *, with_gyro: bool
) -> tuple[ErrorMoments, Floats, Floats]:
    """Return the moments, the expected error and the 95 % error (w,) [m] in windows of a drive.

    Raises
    ------
    DataError
        The calibration has no sources of error.
    """
    fitted_model, sources = calibration.fitted, calibration.error_sources
    if with_gyro and calibration.gyro is not None and (gyro_model := calibration.fitted_with_gyro) is not None:
        fitted_model, sources = gyro_model, calibration.gyro.error_sources
    if sources is None:
        why = "its error growth was not measured"
        raise DataError(calibration.name or "calibration", why, "calibrate again, with a longer drive or more logs")
    growth = path_errors(windows, fitted_model, calibration.width_m)
    spread = growth.of_sources.combined_moments(np.array(astuple(sources)[:SOURCES])).plus(growth.of_parameters)
    return spread, sources.expected_factor * mean_error(spread), sources.p95_factor * radius_of_share(spread, 0.95)
