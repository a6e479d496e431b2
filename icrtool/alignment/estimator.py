"""One estimate of the relations between wheels, heading and positions: scales, ICRs, heading offset, delays.

With the heading measured along the path, the equations are linear except in the heading offset and the delays. They
compare windows of driven distance from fix to fix, and windows of time of the heading itself:

    p_2 - p_1 = e^{i d} ∫(a v + m u + n |u| + i (c + l v) psi') e^{i psi},                           u = (V_l - V_r)/2
    psi(t + T) - psi(t) = k ∫w + q ∫v/b + g T,                                                       w = (V_l - V_r)/b

The symbols are:

========= ============================================================================================
p_1, p_2  positions of the first and the last fix of a window, north + i east [m]; i is the imaginary unit
psi, psi' heading, clockwise [rad], and its rate [rad/s]; psi is taken tau_h later than stamped
V_l, V_r  speeds of the left and right wheels, v their mean [m/s]
b         track width [m]; W = a b/k is the separation of the ICRs [m]
T         duration of a window of the heading [s]
a, m, n   ``scale``, ``middle`` and ``drag``: speed ahead per v, per u and per magnitude of u [1]
c, l      ``sideways`` [m] and ``slip`` [s]: sideways speed per turn rate, at rest and per v
k, q, g   ``turn`` [1], ``asymmetry`` [1] and ``drift`` [rad/s] of the heading change
d         ``offset``: heading offset [rad]
tau_h     ``heading_delay`` [s]
tau_p     ``position_after_heading`` [s]: p is taken tau_p earlier, in addition to tau_h
========= ============================================================================================

In general y_r = (∂v_x/∂V_l)/(∂ω/∂V_l), y_l = (∂v_x/∂V_r)/(∂ω/∂V_r), x = -c - l v (Pentzer 2014, Eqs. 8-12). The
sideways motion is computed with the measured turn psi', not with the wheels' turn: the latter leads while the robot
begins to turn, which has the same effect as a delay.

A drive does not separate a sideways drift on straight paths from the offset. It does not separate the antenna's
position from the ICRs: its forward part from x_icr, its right part from the middle of the y ICRs. At constant speed it
does not separate sideways slip l from tau_p. In these cases the priors decide.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from icrtool.alignment.log_track import FEWEST_OVERLAPPING, DriveWindows
from icrtool.kernels.arrays import Complexes, Floats, trapezoids
from icrtool.kernels.robust import RobustFit, correlated_covariance, robust_least_squares
from icrtool.kernels.track import Track
from icrtool.motion.models import FIVE, MODELS, FittedModel, TrackGeometry
from icrtool.records.measurements import LONGEST_RESPONSE_S

ESTIMATE_NAMES = (
    "scale",
    "middle",
    "sideways",
    "slip",
    "turn",
    "asymmetry",
    "drift",
    "offset",
    "position_after_heading",
    "heading_delay",
    "drag",
)
"""Names of the parameters, in the order of their rows."""

(
    WHEEL_SCALE, ICR_MIDDLE, SIDEWAYS, SIDE_SLIP, TURN_GAIN, SIDE_ASYMMETRY, HEADING_DRIFT, HEADING_OFFSET,
    POSITION_LAG, HEADING_LAG, TURN_DRAG,
) = range(11)  # fmt: skip
"""Rows of the parameters: a, m, c, l, k, q, g, d, tau_p, tau_h and n of the equations above."""

ESTIMATE_PRIOR_MEAN = np.array([1.0, 0.0, 0.0, 0.0, 0.6, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
"""Prior means, in the order of `ESTIMATE_NAMES`."""

ESTIMATE_PRIOR_STD = np.array([0.5, 0.1, 0.5, 0.2, 0.6, 0.05, 3e-4, math.inf, 0.15, 0.5, 0.1])
"""Prior standard deviations, in the order of `ESTIMATE_NAMES`. They have an effect only where a drive does not separate
parameters.

Robots are symmetric: the middle of the ICRs is near 0 (`MIDDLE_STD_M`), and x_icr is within half of b (the third value
is in units of b). Delays of position and heading of one robot usually agree to 0.15 s. An absolute heading drifts by at
most a degree in a minute; without this prior, a drive at constant speed does not separate the drift from unequal
wheels."""

MIDDLE_STD_M = 0.1
"""Prior standard deviation of the sideways distance between the middle of the ICRs and the antenna [m]."""

SAME_CLOCK_STD_S = 1e-3
"""Prior standard deviation of the delay between position and heading in the same messages [s]."""

DELAY_STEP_S, HEADING_STEP_S = 0.02, 0.1
"""Steps of central differences [s]: for derivatives by delays, and for derivatives of noisy headings."""

SMOOTH_S = 0.2
"""Half the time over which the heading is averaged for the sideways motion [s]. Its noise would reduce this motion."""

OVERLAP = 1.0
"""Number of residuals that count as one independent residual. It is 1, because the windows end at different fixes; the
spread between groups of windows shows errors that windows have in common."""

RESPONSE_STD_S = LONGEST_RESPONSE_S / math.sqrt(12.0)
"""Standard deviation of a robot's response to its wheels [s], uniform between 0 and the longest. No drive separates the
response from a delay of the streams."""

CLOCK_S_PER_M = 0.1
"""Apparent lag of the position behind the heading, per metre of track width [s/m]. It arises because a body follows a
change of speed later than a turn.

On 19 rigid-body drives without any delay it is 0.1 s/m rms (0.03 s rms where b is 0.5 to 0.8 m, 0.11 s where b is 1.1
m), on five recorded drives with b = 1.1 m 0.04 s rms."""

SCALE_STD = 0.003
"""Standard deviation of the wheel scale, from slip that varies with speed and turns: rms on the drives of
`CLOCK_S_PER_M`."""

SLIPPING = 0.08
"""Relative difference between the distances of wheels and positions, from window to window, above which wheels slip.
They then show neither a scale nor a delay. On firm ground it is 1 to 3 %, on simulated ice 9 to 18 %."""

TURNS_SLIPPING = 0.14
"""Relative difference between the turns of wheels and heading within a second above which wheels slip. A body that
slides follows its wheels half a second later, which is no error of a clock. On firm ground the difference is 4 to 13 %,
on fast simulated ice 15 to 22 %."""

LEAST_TURN_RAD = 0.2
"""Smallest usual turn within a second to which the difference is related [rad]. Smaller turns are mostly noise."""

ATTITUDE_STD_RAD, ATTITUDE_TIME_S = math.radians(1.0), 30.0
"""Size [rad] and correlation time [s] of the slow error of an attitude sensor, from magnetic surroundings."""

MOUNTING_STD_RAD = math.radians(3.0)
"""Standard deviation of a sensor's direction from straight ahead, where no drive shows its offset [rad]."""

MOST_NEWTON_STEPS = 15
"""Largest number of Newton steps of a fit."""

EVIDENCE_SIGMAS = 4.0
"""Number of standard deviations needed against an assumption: sensors mounted straight, equal sides, measured wheels.
It is large, because standard deviations from few stretches of distance are uncertain themselves."""

FIVE_TERMS = MODELS[FIVE]
"""Motion model of the displacements and turns, without drag and drift."""


class ResidualsByEstimate(NamedTuple):
    """Residuals of the windows, prediction minus measurement, before and after the estimates.

    The residuals before use the turn gain alone; the residuals after use all estimates.

    Attributes
    ----------
    before, after : (2, w) residuals of displacements along and across the heading [m]
    turn_before, turn_after : (u,) residuals of the heading changes [rad]
    turn_rad : (u,) measured heading changes [rad]
    """

    before: Floats
    after: Floats
    turn_before: Floats
    turn_after: Floats
    turn_rad: Floats


class AlignmentFit(NamedTuple):
    """The estimate of the alignment, with k parameters in the order of `ESTIMATE_NAMES`.

    Attributes
    ----------
    solution : the robust fit
    covariance : (k, k) covariance of the parameters
    width_m : track width b of the equations [m]
    windows : data of the fit
    model : expected motion in the windows
    turning_speed_mps : mean speed, weighted by the square of the turn rate [m/s]; x_icr is stated at this speed
    """

    solution: RobustFit
    covariance: Floats
    width_m: float
    windows: DriveWindows
    model: MotionOfWindows
    turning_speed_mps: float

    def estimate(self, name: str) -> tuple[float, float]:
        """Return a parameter and its standard deviation, by its name in `ESTIMATE_NAMES`.

        ``position_delay`` is the delay of the positions with respect to the wheels [s].
        """
        if name == "position_delay":
            both = self.covariance[np.ix_([POSITION_LAG, HEADING_LAG], [POSITION_LAG, HEADING_LAG])]
            delay_s = float(self.solution.x[POSITION_LAG] + self.solution.x[HEADING_LAG])
            return delay_s, math.sqrt(max(float(both.sum()), 0.0))
        row = ESTIMATE_NAMES.index(name)
        variance = float(self.covariance[row, row])
        # Rounding may leave a variance below zero if the drive hardly shows the parameter.
        return float(self.solution.x[row]), math.sqrt(variance) if variance > 0.0 else math.inf

    @property
    def heading_scatter_rad(self) -> float:
        """Robust scatter of the heading without the fixes' noise [rad]: across windows or within a second."""
        return max(self.angle_scatter_rad, float(self.solution.scale[-1]) / math.sqrt(2.0))

    @property
    def distance_scatter(self) -> float:
        """Robust scatter of the displacements along the heading, without the fixes' noise, per usual window length."""
        return self._scatter(0)

    @property
    def angle_scatter_rad(self) -> float:
        """Robust scatter across the heading, without the fixes' noise, per usual window length: a small angle [rad]."""
        return self._scatter(len(self.windows.begin))

    def _scatter(self, row: int) -> float:
        """Return the scatter of the kind of the residual in a row, without the fixes' noise, per window length."""
        noise2 = 2.0 * self.windows.track.place_std_m**2
        return math.sqrt(max(float(self.solution.scale[row]) ** 2 - noise2, 0.0)) / self.windows.usual_length_m

    @property
    def turn_wander_rad(self) -> float:
        """Rms difference between the turns of heading and wheels in a second [rad], from short windows."""
        u = len(self.windows.turn_begin)
        length = self.windows.turn_end - self.windows.turn_begin
        return float(np.sqrt(np.mean(self.solution.residuals[-u:] ** 2 / length)))

    @property
    def turn_slip(self) -> float:
        """Robust scatter of the turns within a second about the wheels' turns, as a share of the usual turn."""
        usual = math.sqrt(float(np.mean(self.windows.heading_changes**2)))
        return float(self.solution.scale[-1]) / max(usual, LEAST_TURN_RAD)

    @property
    def slips(self) -> bool:
        """Whether the wheels slip too much to show a scale or a delay.

        Where headings are rare, the windows are few, and their scatter must be larger by two standard deviations.
        """
        few = 0.0
        if self.windows.track.measured_t is not None:
            few = 2.0 / math.sqrt(2.0 * len(np.unique(self.windows.group)))
        return self.distance_scatter * (1.0 - few) > SLIPPING or self.turn_slip * (1.0 - few) > TURNS_SLIPPING

    def geometry(self) -> tuple[TrackGeometry, Floats]:
        """Return ICRs about the antenna, multiplier and side scales, and their covariance (6, 6)."""
        x, b, speed = self.solution.x, self.width_m, self.turning_speed_mps
        # At one speed, the sideways slip l v has the same effect as c.
        aside = x[SIDEWAYS] + x[SIDE_SLIP] * speed
        derivatives = np.zeros((len(FIVE_TERMS.terms), len(x)))
        derivatives[[0, 1, 2, 3], [WHEEL_SCALE, ICR_MIDDLE, TURN_GAIN, SIDE_ASYMMETRY]] = 1.0
        gains = np.array([aside, x[TURN_GAIN], x[TURN_GAIN] * speed])
        derivatives[4, [TURN_GAIN, SIDEWAYS, SIDE_SLIP]] = gains * 2.0 / b
        sideways = x[TURN_GAIN] * aside * 2.0 / b
        parameters = np.append(x[[WHEEL_SCALE, ICR_MIDDLE, TURN_GAIN, SIDE_ASYMMETRY]], sideways)
        model = FittedModel(FIVE_TERMS, parameters, derivatives @ self.covariance @ derivatives.T)
        values, covariance = model.geometry(b)
        # At one speed, positions that lag have the same effect as an antenna that is further back.
        covariance[2, 2] += (speed * _clock_std_s(self.windows.track, b)) ** 2
        return values, covariance


def residuals_by_estimate(fit: AlignmentFit) -> ResidualsByEstimate:
    """Return the residuals of all windows before and after the estimate."""
    count = 2 * len(fit.windows.begin)
    neutral = ESTIMATE_PRIOR_MEAN.copy()
    neutral[TURN_GAIN] = fit.solution.x[TURN_GAIN]
    before, after = (fit.model.evaluate(x)[0] for x in (neutral, fit.solution.x))
    return ResidualsByEstimate(
        before[:count].reshape(2, -1), after[:count].reshape(2, -1), before[count:], after[count:],
        fit.windows.heading_changes,
    )  # fmt: skip


def _clock_std_s(track: Track, width_m: float) -> float:
    """Return the standard deviation of the time between position and heading that no drive shows [s].

    A heading that is carried by the wheels turns with the wheels. The body turns later, by a response time that is not
    known.
    """
    std = RESPONSE_STD_S if track.same_clock else max(CLOCK_S_PER_M * width_m, RESPONSE_STD_S)
    return std if track.measured_t is None else math.hypot(std, RESPONSE_STD_S)


def estimate_alignment(windows: DriveWindows, width_m: float) -> AlignmentFit | None:
    """Return the joint estimate of all parameters; None with too few windows.

    Parameters
    ----------
    windows : of a drive with a heading
    width_m : the track width b

    Notes
    -----
    The residuals have soft-L1 weights, and each kind of residual (along, across, turn) has its own robust scale. The
    covariance comes from groups of distance (`icrtool.kernels.robust`).
    """
    if min(len(windows.begin), len(windows.turn_begin)) < FEWEST_OVERLAPPING:
        return None
    track, model = windows.track, MotionOfWindows(windows, width_m)
    start = ESTIMATE_PRIOR_MEAN.copy()
    # The heading offset begins at the direction of the displacements relative to the wheels' motion along the heading.
    unit = (windows.seen * np.conj(windows.laid))[np.abs(windows.laid) > windows.length_m / 3]
    spins = len(unit) < FEWEST_OVERLAPPING
    if not spins:
        start[HEADING_OFFSET] = np.angle(np.sum(unit / np.maximum(np.abs(unit), 1e-12)))
    distances, turns = len(windows.begin), len(windows.turn_begin)
    kind = np.concatenate([np.zeros(distances, np.int64), np.ones(distances, np.int64), np.full(turns, 2)])
    group = np.concatenate([windows.group, windows.group, windows.turn_group])
    prior_std = ESTIMATE_PRIOR_STD.copy()
    # Spins on the spot show the distance of the middle of the ICRs from the antenna, but not its direction.
    prior_std[HEADING_OFFSET] = MOUNTING_STD_RAD if spins else prior_std[HEADING_OFFSET]
    prior_std[POSITION_LAG] = SAME_CLOCK_STD_S if track.same_clock else prior_std[POSITION_LAG]
    prior_std[ICR_MIDDLE] = MIDDLE_STD_M / (1.5 * width_m)
    prior_std[SIDEWAYS] *= width_m
    try:
        fit = robust_least_squares(
            model.evaluate,
            start,
            ESTIMATE_PRIOR_MEAN,
            prior_std,
            kind=kind,
            overlap=OVERLAP,
            most_steps=MOST_NEWTON_STEPS,
        )
        covariance = correlated_covariance(fit, group)
    except np.linalg.LinAlgError:
        return None
    if not np.isfinite(covariance).all():
        # Exact data on a single circle give no finite estimate.
        return None
    covariance[HEADING_LAG, HEADING_LAG] += RESPONSE_STD_S**2
    covariance[WHEEL_SCALE, WHEEL_SCALE] += SCALE_STD**2
    if not track.same_clock:
        covariance[POSITION_LAG, POSITION_LAG] += _clock_std_s(track, width_m) ** 2
        share = min(1.0, 2.0 * ATTITUDE_TIME_S / max(float(track.t[-1]), 1e-9))
        covariance[HEADING_OFFSET, HEADING_OFFSET] += ATTITUDE_STD_RAD**2 * share
    weight = track.held * model.u**2
    speed = float((weight * model.v).sum() / max(float(weight.sum()), 1e-12))
    return AlignmentFit(fit, covariance, width_m, windows, model, speed)


class MotionOfWindows:
    """Motion in windows for given parameters: residuals with their Jacobian, and motion and turn until each fix.

    Attributes
    ----------
    track : the drive (n samples of the wheels)
    windows : windows of the drive: w of distance, u of time
    width_m : track width b [m]
    v, u : (n,) mean of the sides' speeds, and half their difference [m/s]
    edge_t : (2, w) times of the first and the last fix of each window [s]
    to_window_axes : (w,) factors of magnitude 1 that turn a displacement to the axes along and across the heading
    travel_m, wheel_turn_rad : (n + 1,) sums of v dt [m], and of the turn by the wheels [rad], from the start
    smooth_heading : heading averaged over `SMOOTH_S` on both sides [rad], at the headings' times
    """

    def __init__(self, windows: DriveWindows, width_m: float) -> None:
        self.track, self.windows, self.width_m = windows.track, windows, width_m
        track = windows.track
        self.v, self.u = track.mean_speed, track.half_difference
        # Positions are needed only at the starts and ends of windows. On a long drive these are few of the fixes.
        self.edge_t = track.place_t[np.stack([windows.begin, windows.end])]
        self.to_window_axes = np.exp(-0.5j * track.heading_at(self.edge_t).sum(axis=0))
        self.travel_m, self.wheel_turn_rad = track.cumulate(self.v), track.cumulate(2 * self.u / width_m)
        # The heading is averaged over `SMOOTH_S` on both sides, so that its noise does not count as a turn.
        t, area = track.heading_t, trapezoids(track.heading_t, track.heading)
        reach = np.minimum(np.minimum(t - t[0], t[-1] - t), SMOOTH_S)
        mean = (np.interp(t + reach, t, area) - np.interp(t - reach, t, area)) / np.maximum(2.0 * reach, 1e-9)
        self.smooth_heading = np.where(reach > 0.0, mean, track.heading)

    def evaluate(self, x: Floats) -> tuple[Floats, Floats]:
        """Return residuals (2 w + u,) along, across and of turns, and their Jacobian (2 w + u, k)."""
        track, v, u, drag = self.track, self.v, self.u, np.abs(self.u)
        nose, rate, ahead, aside = self._motion(x)
        t = self.edge_t - x[POSITION_LAG] - x[HEADING_LAG]
        passed = np.interp(t, track.t, np.arange(len(track.t)))
        row = np.minimum(passed.astype(np.int64), len(track.t) - 2)
        part = passed - row

        def laid(speed: Floats) -> Complexes:
            """Return the integral of a speed (n,) along the heading over each window (w,)."""
            total = track.cumulate(np.asarray(speed * nose))
            begin, end = total[row] + part * (total[row + 1] - total[row])
            return np.asarray(end - begin)

        derivatives = np.zeros((len(x), len(self.windows.begin)), np.complex128)
        derivatives[WHEEL_SCALE], derivatives[ICR_MIDDLE], derivatives[TURN_DRAG] = laid(v), laid(u), laid(drag)
        derivatives[SIDEWAYS], derivatives[SIDE_SLIP] = 1j * laid(rate), 1j * laid(v * rate)
        predicted = x @ derivatives
        derivatives[HEADING_OFFSET] = 1j * predicted
        path = track.cumulate(np.asarray((ahead + 1j * aside * rate) * nose))
        before, after = (np.interp(t + shift_s, track.t, path) for shift_s in (-DELAY_STEP_S, DELAY_STEP_S))
        derivatives[POSITION_LAG] = np.diff(before - after, axis=0) / (2 * DELAY_STEP_S)
        # The derivative of the unit vector of the heading is taken over `HEADING_STEP_S`.
        after, before = (
            track.heading_at(t + shift_s + x[HEADING_LAG]) + x[HEADING_OFFSET]
            for shift_s in (HEADING_STEP_S, -HEADING_STEP_S)
        )
        turning = 0.5j * (after - before) / HEADING_STEP_S * np.exp(0.5j * (after + before))
        begin, end = np.interp(t, track.t + track.held / 2, aside) * turning
        derivatives[HEADING_LAG] = derivatives[POSITION_LAG] + 1j * laid(rate * ahead) + end - begin
        to_axes = self.to_window_axes * np.exp(-1j * x[HEADING_OFFSET])
        missed, derivatives = (predicted - self.windows.seen) * to_axes, derivatives * to_axes
        turn, turn_derivatives = self._turns(x)
        return (
            np.concatenate([missed.real, missed.imag, turn]),
            np.concatenate([derivatives.real, derivatives.imag, turn_derivatives], axis=1).T,
        )

    def until_fixes(self, x: Floats) -> tuple[Complexes, Floats]:
        """Return motion by the wheels, north + i east [m], and turn [rad], until each fix (m,)."""
        nose, rate, ahead, aside = self._motion(x)
        path = self.track.cumulate(np.asarray((ahead + 1j * aside * rate) * nose))
        t = self.track.place_t
        turn = (
            x[TURN_GAIN] * self.wheel_turn_rad
            + x[SIDE_ASYMMETRY] / self.width_m * self.travel_m
            + x[HEADING_DRIFT] * self.track.t
        )
        return (
            np.asarray(np.interp(t - x[POSITION_LAG] - x[HEADING_LAG], self.track.t, path), np.complex128),
            np.asarray(np.interp(t - x[HEADING_LAG], self.track.t, turn), np.float64),
        )

    def _motion(self, x: Floats) -> tuple[Complexes, Floats, Floats, Floats]:
        """Return the heading as a unit vector, its rate [rad/s], and the terms of the speeds ahead and aside (n,)."""
        track = self.track
        ends = np.append(track.t, track.t[-1] + track.held[-1])
        # A wheel speed acts along the heading of a later time, because the response delays motion and heading equally.
        heading = track.heading_at(ends + x[HEADING_LAG]) + x[HEADING_OFFSET]
        smooth = np.interp(ends + x[HEADING_LAG], track.heading_t, self.smooth_heading)
        rate = np.where(track.held > 0.0, np.diff(smooth) / np.maximum(track.held, 1e-9), 0.0)
        ahead = x[WHEEL_SCALE] * self.v + x[ICR_MIDDLE] * self.u + x[TURN_DRAG] * np.abs(self.u)
        return np.exp(0.5j * (heading[1:] + heading[:-1])), rate, ahead, x[SIDEWAYS] + x[SIDE_SLIP] * self.v

    def _turns(self, x: Floats) -> tuple[Floats, Floats]:
        """Return predicted minus seen heading changes (u,), and their derivatives (k, u)."""
        edges = np.stack([self.windows.turn_begin, self.windows.turn_end]) - x[HEADING_LAG]

        def over(values: Floats, shift_s: float = 0.0) -> Floats:
            begin, end = np.interp(edges + shift_s, self.track.t, values)
            return np.asarray(end - begin)

        derivatives = np.zeros((len(x), edges.shape[1]))
        derivatives[TURN_GAIN] = over(self.wheel_turn_rad)
        derivatives[SIDE_ASYMMETRY] = over(self.travel_m) / self.width_m
        derivatives[HEADING_DRIFT] = edges[1] - edges[0]
        predicted = x @ derivatives
        later, earlier = over(self.wheel_turn_rad, -DELAY_STEP_S), over(self.wheel_turn_rad, DELAY_STEP_S)
        derivatives[HEADING_LAG] = x[TURN_GAIN] * (later - earlier) / (2 * DELAY_STEP_S)
        return predicted - self.windows.heading_changes, derivatives
