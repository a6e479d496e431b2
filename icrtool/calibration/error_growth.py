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


class Spread(NamedTuple):
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

    def combined_moments(self, variances: Floats) -> Spread:
        """Return the moments (w, 1) of all sources together, for variances (c,) of the sources."""
        return Spread(*((moments @ variances)[:, None] for moments in self))

    def plus(self, other: Spread) -> Spread:
        """Return the moments of the sum of two independent errors."""
        return Spread(*(a + b for a, b in zip(self, other, strict=True)))


class PathErrors(NamedTuple):
    """Motion in windows by a model, and moments of its errors.

    Attributes
    ----------
    moved : complex (w,) displacement, forward + j right [m]; turned : (w,) [rad]
    of_parameters : moments by errors of the parameters, one column
    of_sources : moments by a unit variance of each source, a column for each source
    """

    moved: Complexes
    turned: Floats
    of_parameters: Spread
    of_sources: Spread


def path_errors(
    windows: Windows, fitted_model: FittedModel, width_m: float, constants: LogConstants = NO_CONSTANTS
) -> PathErrors:
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
    of_start, of_end = (steps.place_t[rows] + constants.wheels_later_s for rows in (windows.begin, windows.end))
    at = np.unique(np.concatenate([of_start, of_end, steps.t]))
    path = path_at(steps, lambda rows: (fixed[:, rows], axes, columns[:, rows]), fitted_model.parameters, at)
    s, e = np.searchsorted(at, of_start), np.searchsorted(at, of_end)
    moved, by = displacements(path, s, e)
    moved_by, turned_by = by[:-1], path.heading_by[:, e] - path.heading_by[:, s]
    of_parameters = Spread(
        *(np.einsum("kw,kl,lw->w", a, fitted_model.covariance, b)[:, None]
          for a, b in ((turned_by, turned_by), (moved_by.real, moved_by.real), (moved_by.real, moved_by.imag),
                       (moved_by.imag, moved_by.imag)))
    )  # fmt: skip
    turned = path.heading[e] - path.heading[s]
    return PathErrors(moved, turned, of_parameters, _source_moments(path.heading, path.place, s, e))


def _source_moments(theta: Floats, place: Complexes, s: Ints, e: Ints) -> Spread:
    """Return the moments (w, `SOURCES`) of a unit variance of each source, by sums between knots."""
    step = np.diff(place)
    length = np.concatenate([[0.0], np.cumsum(np.abs(step))])
    middle_m, middle_rad = (length[1:] + length[:-1]) / 2, (theta[1:] + theta[:-1]) / 2
    middle = (place[1:] + place[:-1]) / 2

    def sum_between_knots(values: Values) -> Values:
        """Return the sum of values between the knots of each window."""
        sums = np.concatenate([np.zeros(1, values.dtype), np.cumsum(values)])
        difference: Values = sums[e] - sums[s]
        return difference

    back, went, driven = np.exp(-1j * theta[s]), place[e] - place[s], length[e] - length[s]
    by_rate = 1j * back * (sum_between_knots(step * middle_m) - length[s] * went)
    by_turn = 1j * back * (sum_between_knots(step * middle_rad) - theta[s] * went)
    constant = [
        (0.0 * driven, 1j * back * went),
        (driven, by_rate),
        (theta[e] - theta[s], by_turn),
        (0.0 * driven, back * went),
    ]
    driven_m, first = np.abs(step), sum_between_knots(np.abs(step) * middle)
    zero = sum_between_knots(driven_m)
    # The sum of q (S_e - S_u)(S_e - S_u)^T along the path is computed as squared length and as square of a complex
    # number.
    size = (
        zero * np.abs(place[e]) ** 2
        - 2.0 * (np.conj(place[e]) * first).real
        + sum_between_knots(driven_m * np.abs(middle) ** 2)
    )
    square = (zero * place[e] ** 2 - 2.0 * place[e] * first + sum_between_knots(driven_m * middle**2)) * (
        1j * back
    ) ** 2
    wander = _from_squares(driven, size, square)
    along = np.divide(step**2, driven_m, out=np.zeros(len(step), np.complex128), where=driven_m > 0.0)
    speed = _from_squares(0.0 * driven, zero, sum_between_knots(along) * back**2)
    moments = [Spread(h**2, p.real**2, p.real * p.imag, p.imag**2) for h, p in constant]
    ones, none = np.ones(len(s)), np.zeros(len(s))
    reference = [Spread(ones, none, none, none), Spread(none, ones, none, ones)]
    ordered = (*moments[:3], wander, moments[3], speed, *reference)
    return Spread(*(np.column_stack(column) for column in zip(*ordered, strict=True)))


def _from_squares(heading: Floats, size: Floats, square: Floats) -> Spread:
    """Return the moments of errors z whose sums of |z|^2 and of z^2 are `size` and `square`."""
    return Spread(heading, (size + square.real) / 2, square.imag / 2, (size - square.real) / 2)


def radius_of_share(spread: Spread, share: float) -> Floats:
    """Return the radius (w,) [m] that holds a share of normal errors with the moments (w, 1), by bisection."""
    across = _directions(spread)
    low, high = np.zeros(len(across)), 6.0 * np.sqrt(across.max(axis=1))
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        with np.errstate(divide="ignore", invalid="ignore"):
            inside = 1.0 - np.nan_to_num(np.exp(-(middle[:, None] ** 2) / (2.0 * across))).mean(axis=1)
        low, high = np.where(inside < share, middle, low), np.where(inside < share, high, middle)
    return np.asarray((low + high) / 2)


def mean_error(spread: Spread) -> Floats:
    """Return the mean length (w,) [m] of errors that are normal with the moments (w, 1)."""
    return np.asarray(np.sqrt(np.pi / 2.0) * np.sqrt(_directions(spread)).mean(axis=1))


def _directions(spread: Spread) -> Floats:
    """Return the squared lengths (w, `ANGLES`) of unit vectors of a quarter circle times the root of the covariance."""
    xx, xy, yy = spread.xx[:, 0], spread.xy[:, 0], spread.yy[:, 0]
    middle, apart = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    large, small = middle + apart, np.maximum(middle - apart, 0.0)
    angle = np.pi / 2 * (np.arange(ANGLES) + 0.5) / ANGLES
    return np.asarray(large[:, None] * np.cos(angle) ** 2 + small[:, None] * np.sin(angle) ** 2)


def fit_variances(length: Floats, sources: Spread, known: Spread, turned: Floats, missed: Complexes) -> Floats:
    """Return the variances (`SOURCES`,) that best explain the squared errors of windows.

    Parameters
    ----------
    length : (w,) length of each window [m]; each length has the same weight
    sources, known : moments by unit variances of the sources, and by errors of the parameters
    turned, missed : (w,) errors of the turn [rad], and of the displacement, forward + j right [m]
    """
    matrix, y = np.zeros((SOURCES, SOURCES)), np.zeros(SOURCES)
    kinds = (
        (sources.heading, known.heading, turned**2),
        (sources.xx, known.xx, missed.real**2),
        (sources.yy, known.yy, missed.imag**2),
    )
    for metres in np.unique(length):
        rows = length == metres
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
        The path is shorter than a metre or holds values that are not numbers, or the calibration has no sources of
        error.
    """
    if not (np.abs([north_m, east_m]) <= FURTHEST_M).all():
        raise DataError("plan", f"a point is not a number, or beyond {FURTHEST_M:g} m", "give metres")
    points = np.asarray(north_m, np.float64) + 1j * np.asarray(east_m, np.float64)
    length = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(points)))])
    if not 1.0 <= length[-1] <= LONGEST_PATH_M:
        raise DataError("plan", f"the path is {length[-1]:.3g} m long", f"give 1 m to {LONGEST_PATH_M:g} m")
    at = np.linspace(0.0, length[-1], max(round(length[-1] / STEP_M), 10) + 1)
    line = np.clip(np.searchsorted(length, at, side="right") - 1, 0, len(points) - 2)
    path = np.interp(at, length, points.real) + 1j * np.interp(at, length, points.imag)
    step = np.diff(path)
    speed = np.full(len(step), SPEED_MPS) if speed_mps is None else np.asarray(speed_mps, np.float64)[line[:-1]]
    if not ((np.abs(speed) > 0.0) & (np.abs(speed) <= FASTEST_MPS)).all():
        why = f"a speed is zero, not a number, or beyond {FASTEST_MPS:g} m/s"
        raise DataError("plan", why, "give speed_mps in m/s, negative in reverse")
    speed = np.sign(speed) * np.maximum(np.abs(speed), SLOWEST_PLAN_MPS)
    # A corner is driven as a curve over one track width: the directions are averaged over this distance.
    width = max(round(calibration.width_m / STEP_M), 1)
    padded = np.pad(unwrapped(np.angle(step * np.sign(speed))), (width // 2, width - 1 - width // 2), mode="edge")
    direction = np.convolve(padded, np.full(width, 1.0 / width), mode="valid")
    held = np.abs(step / speed)
    turn = np.append(np.diff(direction), 0.0) / held
    left, right = wheel_speeds(calibration.fitted, calibration.width_m, speed, turn)
    t, distance = (np.concatenate([[0.0], np.cumsum(steps)]) for steps in (held, np.abs(step)))
    left, right, turn, direction = (np.append(column, column[-1:]) for column in (left, right, turn, direction))
    planned = Track.of_states(
        t, np.append(held, 0.0), left, right, path.real, path.imag, direction, distance
    )._replace(gyro=turn, into=0.5)  # fmt: skip
    return _along(calibration, planned, planned, with_gyro=with_gyro)


def forecast_drive(calibration: Calibration, recording: Recording, *, with_gyro: bool = False) -> Forecast:
    """Return the errors along the path of a recording, with its wheel speeds and, if `with_gyro`, its gyro."""
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
        made = ahead_and_turn(v, w)
        by_v = (ahead_and_turn(v + 1e-4, w) - made) / 1e-4
        by_w = (ahead_and_turn(v, w + 1e-4) - made) / 1e-4
        off = np.array([speed, turn]) - made
        size = by_v[0] * by_w[1] - by_v[1] * by_w[0]
        size = np.where(np.abs(size) > 1e-3, size, 1e-3)
        v = v + (off[0] * by_w[1] - off[1] * by_w[0]) / size
        w = w + (off[1] * by_v[0] - off[0] * by_v[1]) / size
    return v + w * width_m / 2.0, v - w * width_m / 2.0


def _along(calibration: Calibration, track: Track, steps: Track, *, with_gyro: bool) -> Forecast:
    """Return the forecast after each metre of a track; `steps` is the track with joined wheel samples."""
    metres = np.arange(1.0, np.floor(track.distance[-1]) + 1.0)
    if not len(metres):
        raise DataError("path", f"is {track.distance[-1]:.2f} m long", "a forecast needs at least a metre")
    rows = np.searchsorted(track.distance, metres)
    windows = Windows(steps, np.zeros_like(rows), rows, metres)
    spread, expected, p95 = forecast_errors(calibration, windows, with_gyro=with_gyro)
    c, s = np.cos(track.heading[0]), np.sin(track.heading[0])
    xx, xy, yy = spread.xx[:, 0], spread.xy[:, 0], spread.yy[:, 0]
    north = np.sqrt(np.maximum(c * c * xx - 2 * c * s * xy + s * s * yy, 0.0))
    east = np.sqrt(np.maximum(s * s * xx + 2 * c * s * xy + c * c * yy, 0.0))
    return Forecast(
        metres, track.east[rows], track.north[rows], expected, p95, east, north,
        np.degrees(np.sqrt(spread.heading[:, 0])),
    )  # fmt: skip


def forecast_errors(calibration: Calibration, windows: Windows, *, with_gyro: bool) -> tuple[Spread, Floats, Floats]:
    """Return the moments, the expected error and the 95 % error (w,) [m] in windows of a drive.

    Raises
    ------
    DataError
        The calibration has no sources of error.
    """
    fitted_model, sources = calibration.fitted, calibration.error_sources
    if with_gyro and calibration.gyro is not None and (turned := calibration.fitted_with_gyro) is not None:
        fitted_model, sources = turned, calibration.gyro.error_sources
    if sources is None:
        why = "its error growth was not measured"
        raise DataError(calibration.name or "calibration", why, "calibrate again, with a longer drive or more logs")
    growth = path_errors(windows, fitted_model, calibration.width_m)
    spread = growth.of_sources.combined_moments(np.array(astuple(sources)[:SOURCES])).plus(growth.of_parameters)
    return spread, sources.expected_factor * mean_error(spread), sources.p95_factor * radius_of_share(spread, 0.95)
