"""A calibration that predicts: constant parameters fitted to what they are for, the place after some way driven blind.

The filter's momentary ICRs explain the last seconds; a constant fitted to open-loop displacements over 5-10 m predicts
the next ones. Windows of way start every half metre of a run; their open-loop end points, in the body frame of their
start, are held against the filter's estimates there. The loss is robust, the covariance that of stretches of way.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icrtool.errors import DataError
from icrtool.kernels.open_loop import trial_ends
from icrtool.kernels.window_errors import move, window_misses
from icrtool.motion.window_models import CONSTANT, WindowModel, base_parameters, basis_of, usual_terms
from icrtool.records.run import Run, drive_of, half_width_m
from icrtool.records.tables import Bools, Complexes, Floats, Ints

WINDOWS_M = (5.0, 10.0)
"""Lengths of the windows. One length alone lets a circle of just that circumference say nothing."""

EVERY_M = 0.5
"""A window of each length starts every so much way."""

MOST_STARTS = 1000
"""Where many fits are made, windows of a long way start further apart: about so many of a length."""

HUBER_SIGMAS = 2.0
"""Where the loss turns from square to straight, in robust standard deviations of the residuals."""

REWEIGHTINGS = 6
"""The loss takes its scale from the residuals this often, at most."""

SETTLED = 1e-4
"""In standard deviations of the prior: a smaller change of a term is none."""

COARSE_STEP_S = 0.1
"""Wheel samples are joined to steps of this length to get near the solution."""

MOST_STEPS, LONGEST_STEP_S, COARSE_STEP_M = 10_000, 0.4, 0.25
"""Steps are longer where there would be more of them, but not longer than this in time and way."""

STRETCH_M = 20.0
"""Way that errs alike, for the covariance: twice the longest window."""


class Windows(NamedTuple):
    """Windows of a run, ready to be fitted.

    Attributes
    ----------
    t, dt, v_left, v_right : (n,) wheel samples, `dt` 0 over gaps
    knot_t : (m,) ascending [s]: times at which windows start or end
    start, end : (w,) rows of `knot_t`
    start_m, end_m : (w,) path length [m] at start and end
    length_m : (w,)
    reference : complex (w,), displacement in the body frame of the start [m]
    width_m : b, or what stands for it
    lag : (n,) [s] how long into a step its heading is taken: 0 where it is one wheel sample
    """

    t: Floats
    dt: Floats
    v_left: Floats
    v_right: Floats
    knot_t: Floats
    start: Ints
    end: Ints
    start_m: Floats
    end_m: Floats
    length_m: Floats
    reference: Complexes
    width_m: float
    lag: Floats

    def keep(self, kept: Bools) -> Windows:
        """Return the windows marked in `kept` (w,)."""
        return self._replace(
            start=self.start[kept], end=self.end[kept], start_m=self.start_m[kept], end_m=self.end_m[kept],
            length_m=self.length_m[kept], reference=self.reference[kept],
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class WindowFit:
    """Parameters that were fitted.

    Attributes
    ----------
    terms : values of the model's terms, in its order
    covariance : (k, k) of them, from stretches of way (sandwich)
    parameters : (8,) y_icr_right, y_icr_left, x_icr [m], scale_left, scale_right, bend, speed [s/m], late [s]
    parameter_covariance : (8, 8)
    residual_m : robust standard deviation of a window's miss, per square root of metre
    windows : how many were used
    """

    model: WindowModel
    terms: Floats
    covariance: Floats
    parameters: Floats
    parameter_covariance: Floats
    residual_m: float
    windows: int

    @property
    def icrs_m(self) -> tuple[float, float, float]:
        """y_icr_right, y_icr_left, x_icr [m]."""
        right, left, x = (float(value) for value in self.parameters[:3])
        return right, left, x

    @property
    def icr_std_m(self) -> tuple[float, float, float]:
        """One standard deviation of `icrs_m`."""
        right, left, x = (float(value) for value in np.sqrt(np.diag(self.parameter_covariance)[:3]))
        return right, left, x


def window_spacing_m(run: Run) -> float:
    """Return how far apart windows start where a run is fitted many times [m]."""
    return max(EVERY_M, float(run.table.distance_m[-1]) / MOST_STARTS)


def cut_windows(run: Run, lengths_m: Iterable[float] = WINDOWS_M, every_m: float = EVERY_M) -> Windows:
    """Cut a run into overlapping windows of way; those across a gap or ending in an outage are left out.

    Raises
    ------
    DataError
        The run holds fewer than ten windows.
    """
    drive, table = drive_of(run), run.table
    place = drive.north + 1j * drive.east
    begins = np.unique(np.searchsorted(table.distance_m, np.arange(0.0, float(table.distance_m[-1]), every_m)))
    begins = begins[~drive.in_outage[begins]]
    starts, ends, lengths = [], [], []
    for length, column in zip(lengths_m, trial_ends(drive, np.array(list(lengths_m), np.float64)).T, strict=True):
        end = column[begins]
        whole = end >= 0
        starts.append(begins[whole])
        ends.append(end[whole])
        lengths.append(np.full(np.count_nonzero(whole), length))
    start, end, length_m = np.concatenate(starts), np.concatenate(ends), np.concatenate(lengths)
    if len(start) < 10:
        raise DataError(
            run.name, f"only {len(start)} windows of {min(lengths_m):g} m of way", "a window fit needs a longer drive"
        )
    knots, rows = np.unique(np.concatenate([start, end]), return_inverse=True)
    return Windows(
        t=table.t_s,
        dt=np.where(drive.gap, 0.0, drive.dt_s),
        v_left=table.v_left_mps,
        v_right=table.v_right_mps,
        knot_t=table.t_s[knots],
        start=rows[: len(start)],
        end=rows[len(start) :],
        start_m=table.distance_m[start],
        end_m=table.distance_m[end],
        length_m=length_m,
        reference=np.exp(-1j * drive.heading[start]) * (place[end] - place[start]),
        width_m=2.0 * half_width_m(run.track_width_m),
        lag=np.zeros(len(table)),
    )


def fit_windows(windows: Windows, model: WindowModel = CONSTANT) -> WindowFit:
    """Fit a model's constants to windows of way.

    Parameters
    ----------
    windows : of `cut_windows`, or some of them
    model : what is free

    Returns
    -------
    WindowFit

    Notes
    -----
    Levenberg-Marquardt (More 1978, MINPACK) with analytic Jacobian, reweighted for the soft-L1 loss, whose scale is
    the residuals' own (Huber 1964), under a wide prior: W about 1.4 b, no asymmetry, no x_icr, ± the robot's half
    width, terms beyond the ICRs as far as they stray on real robots. A miss grows about as the root of the way, hence
    the weights. Windows overlap: a stretch of way counts once in the covariance (sandwich, White 1982), and the prior
    as much as one.
    """
    basis, base = basis_of(model), base_parameters()
    mean, held, std = prior_of(windows, model)
    terms = mean
    # far from the solution a tenth of the samples tells the way there
    for problem in (_Problem(thin_windows(windows), basis, base), _Problem(windows, basis, base)):
        for _ in range(REWEIGHTINGS):
            before, terms = terms, _step(problem, terms, mean, held, std)
            if np.all(np.abs(terms - before) < SETTLED * std):
                break
    misses, slopes = problem(terms)
    scale = robust_scale(misses)
    covariance = clustered_covariance(misses / scale, slopes / scale, held, np.tile(windows.start_m, 2))
    return WindowFit(
        model=model,
        terms=terms,
        covariance=covariance,
        parameters=base + terms @ basis,
        parameter_covariance=basis.T @ covariance @ basis,
        residual_m=scale,
        windows=len(windows.start),
    )


def _step(problem: _Problem, terms: Floats, mean: Floats, held: Floats, std: Floats) -> Floats:
    """Return the terms that minimise the loss whose scale is that of the residuals at `terms`."""
    from scipy.optimize import least_squares

    misses, _ = problem(terms)
    scale = robust_scale(misses)
    # soft L1 by reweighting: rho'(z) = (1 + z)^(-1/2)
    weight = (1.0 + (misses / (HUBER_SIGMAS * scale)) ** 2) ** -0.25 / scale
    found: Floats = least_squares(
        lambda q: np.concatenate([problem(q)[0] * weight, (q - mean) * held]),
        terms,
        jac=lambda q: np.concatenate([problem(q)[1] * weight[:, None], np.diag(held)]),
        method="lm",
        x_scale=std,
        xtol=SETTLED / 10.0,
        ftol=1e-6,
    ).x
    return found


def robust_scale(misses: Floats) -> float:
    """Return the robust standard deviation of misses about zero."""
    return max(1.4826 * float(np.median(np.abs(misses))), 1e-6)


def coarse_rows(dt: Floats, v_left: Floats, v_right: Floats) -> int:
    """Return how many wheel samples make a step of the fits.

    A tenth of a second; on a long drive longer, up to four, as long as a step is no more than a quarter of a metre of
    way. `dt` (n,) is 0 over gaps [s], speeds are (n,) [m/s].
    """
    lasting = dt > 0.0
    if not lasting.any():
        return 1
    total_s = float(dt.sum())
    speed_mps = float((dt * (np.abs(v_left) + np.abs(v_right))).sum()) / 2.0 / total_s
    step_s = min(total_s / MOST_STEPS, COARSE_STEP_M / max(speed_mps, 1e-3), LONGEST_STEP_S)
    return max(int(max(step_s, COARSE_STEP_S) / float(np.median(dt[lasting]))), 1)


def thin_windows(windows: Windows) -> Windows:
    """Return the windows with wheel samples joined to steps as `coarse_rows` has them, mean speeds over their time.

    Notes
    -----
    Euler steps of m samples at a constant turn rate move along the heading (m - 1) / 2 samples into them: that is the
    `lag` of the joined step, without which it would cut the corner.
    """
    joined = coarse_rows(windows.dt, windows.v_left, windows.v_right)
    first = np.arange(0, len(windows.t), joined)
    dt = np.add.reduceat(windows.dt, first)
    left, right = (np.add.reduceat(windows.dt * v, first) for v in (windows.v_left, windows.v_right))
    moving = dt > 0.0
    return windows._replace(
        t=windows.t[first],
        dt=dt,
        v_left=np.divide(left, dt, out=np.zeros(len(dt)), where=moving),
        v_right=np.divide(right, dt, out=np.zeros(len(dt)), where=moving),
        lag=dt * (joined - 1) / (2.0 * joined),
    )


def evaluate_windows(windows: Windows, p: Floats) -> tuple[Floats, Floats]:
    """Return weighted misses of all windows (2 w,) [m per root metre] and their derivatives (2 w, 8) by p (8,)."""
    w = windows
    motion = move(w.t, w.dt, w.v_left, w.v_right, p[:7], w.knot_t + p[7], w.lag)
    return window_misses(motion, w.start, w.end, w.reference, 1.0 / np.sqrt(w.length_m))


class _Problem:
    """Weighted misses of all windows (2 w,) [m per root metre] and their derivatives (2 w, k), once per place."""

    def __init__(self, windows: Windows, basis: Floats, base: Floats) -> None:
        self._windows, self._basis, self._base = windows, basis, base
        self._last: tuple[bytes, tuple[Floats, Floats]] | None = None

    def __call__(self, terms: Floats) -> tuple[Floats, Floats]:
        key = terms.tobytes()
        if self._last is None or self._last[0] != key:
            misses, slopes = evaluate_windows(self._windows, self._base + terms @ self._basis)
            self._last = key, (misses, slopes @ self._basis.T)
        return self._last[1]


def prior_of(windows: Windows, model: WindowModel, kept: Bools | None = None) -> tuple[Floats, Floats, Floats]:
    """Return mean (k,) of a model's terms, square roots of their information, and their standard deviations.

    Parameters
    ----------
    kept : (w,) the windows that will be fitted; default all. The prior weighs as much as one stretch of way, and
        windows that overlap say the same several times.
    """
    start_m, length_m = (
        (windows.start_m, windows.length_m) if kept is None else (windows.start_m[kept], windows.length_m[kept])
    )
    mean, std = usual_terms(windows.width_m, model)
    way_m = max(float(np.ptp(start_m)), EVERY_M) if len(start_m) else EVERY_M
    alike = max(float(length_m.sum()) / way_m, 1.0)
    return mean, np.sqrt(alike) / std, std


def clustered_covariance(misses: Floats, slopes: Floats, prior: Floats, way_m: Floats) -> Floats:
    """Return the covariance of a robust fit whose misses, over each stretch of way, are one another's kin.

    Parameters
    ----------
    misses : (m,), slopes : (m, k), in units of the residuals' scale
    prior : (k,) square roots of the prior's information
    way_m : (m,) [m] where each miss belongs

    Notes
    -----
    H^-1 (sum g g^T) H^-1 with g the gradient of a stretch and H the Gauss-Newton matrix (White 1982; Liang and Zeger
    1986 for clusters), with their B / (B - 1).
    """
    influence = 1.0 / np.sqrt(1.0 + (misses / HUBER_SIGMAS) ** 2)
    H = (slopes * influence[:, None]).T @ slopes + np.diag(prior**2)
    stretch = np.unique((way_m / STRETCH_M).astype(np.int64), return_inverse=True)[1]
    gradients = np.zeros((int(stretch.max()) + 1, slopes.shape[1]))
    np.add.at(gradients, stretch, slopes * (influence * misses)[:, None])
    count = len(gradients)
    meat = gradients.T @ gradients * (count / max(count - 1, 1)) + np.diag(prior**2)
    solved = np.linalg.solve(H, meat)
    covariance: Floats = np.linalg.solve(H, solved.T)
    return (covariance + covariance.T) / 2.0
