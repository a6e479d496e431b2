"""Choice of the sides of the wheels and of the senses of heading and positions: hypotheses compared by likelihood.

Displacements of windows are linear in two integrals along the measured heading, p = Z_v ∫v e^{j psi} + Z_u ∫u e^{j psi}
where v is the mean of the sides' speeds and u half their difference. Heading changes are linear in ∫u and ∫v. Sides
that are swapped or reversed exchange v and u or change their signs. A heading or a position of the other handedness
changes the sign of psi. One robust fit for each handedness gives Z and the turn's coefficients with covariance. Every
hypothesis states their expected values: |Z_v| = 1 up to a common factor, Z_u small, a positive turn for a faster left
side. The cost of a hypothesis is the squared Mahalanobis distance from them.

Two pairs of hypotheses give the same motion: position and heading mirrored, and sides swapped; a heading turned by 180
deg, and sides swapped and both reversed. Of each pair the hypothesis with fewer faults is chosen. A gyro of the other
sense and a robot that hardly ever drives forward count as one fault each.

`icrtool.alignment.estimator` is not used here, because it needs named sides and one solve for each hypothesis. This fit
is linear: two solves give all 32 hypotheses.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from icrtool.alignment.log_track import (
    FEWEST_ALIGNMENT_WINDOWS,
    FEWEST_OVERLAPPING,
    LEAST_CHORD_M,
    STARTS_A_WINDOW,
    DriveWindows,
    cut_chords,
)
from icrtool.kernels.arrays import Complexes, Floats, trapezoids
from icrtool.kernels.robust import mad_std, robust_regression, sandwich_covariance, soft_l1_loss
from icrtool.kernels.track import Track
from icrtool.motion.recording import fit_gyro_line
from icrtool.records.notes import Note, note
from icrtool.records.tables import RobotLog

EXPECTED_STD = np.array([0.3, 0.3, 0.5, 0.5, 0.3, 0.2])
"""Standard deviations, between robots, of the six fitted values: Z_v about 1 and Z_u about 0 (two real numbers each),
the turn about 1 (largest coefficient), the asymmetry about 0."""

DECISIVE = 25.0
"""Twice the gain in log-likelihood above which a hypothesis is preferred to the names in the log, 5 sigma."""

VAGUE_PRIOR_STD = 10.0
"""Prior standard deviation of the fit's parameters, which are near 1. It has hardly any effect."""

FAULTS = {"swapped": 1.0, "one side reversed": 1.0, "both reversed": 1.0, "heading mirrored": 1.0,
          "position mirrored": 1.5, "pose mirrored": 0.75, "turned about": 0.5, "gyro upside down": 1.0,
          "drives backwards": 1.0}  # fmt: skip
"""Number of faults that each deviation from the names counts as. A pose with mirrored position and heading is one
common fault; two joints or topics with exchanged names are rarer."""

ABOUT_RAD = math.radians(135.0)
"""Smallest offset of a heading that counts as turned about [rad]."""

BACKWARDS_SHARE = 0.8
"""Share of the distance driven backwards above which a hypothesis has a fault. Robots are mostly driven forward."""

CHORD_IN_POSITION_STD = 4.0
"""Smallest chord that is compared without a heading, in standard deviations of the position."""


class StreamSigns(NamedTuple):
    """A hypothesis about sides and senses.

    Attributes
    ----------
    swapped : whether the sides are exchanged
    sign_left, sign_right : signs of the named sides, before they are exchanged
    heading, position : +1, or -1 if mirrored
    """

    swapped: bool
    sign_left: int
    sign_right: int
    heading: int
    position: int

    def faults(self, offset: float, track: Track, gyro_sense: int) -> float:
        """Return the number of faults of the hypothesis, weighted by `FAULTS`.

        Parameters
        ----------
        offset : offset of the heading by this hypothesis [rad]
        gyro_sense : as in `decide_conventions`
        """
        count = FAULTS["swapped"] * self.swapped
        signs = self.sign_left + self.sign_right
        count += FAULTS["one side reversed"] * (signs == 0) + FAULTS["both reversed"] * (signs == -2)
        if self.heading < 0 and self.position < 0 and track.same_clock:
            count += FAULTS["pose mirrored"]
        else:
            count += FAULTS["heading mirrored"] * (self.heading < 0) + FAULTS["position mirrored"] * (self.position < 0)
            # An ENU yaw that is read as a NED yaw, or the reverse, is also turned by 90 deg.
            if self.heading < 0 and not track.same_clock:
                offset = math.remainder(offset - math.pi / 2, 2 * math.pi)
        count += FAULTS["turned about"] * (abs(offset) > ABOUT_RAD)
        distance = (self.sign_left * track.v_left + self.sign_right * track.v_right) * track.held
        backwards = float(-np.minimum(distance, 0.0).sum()) > BACKWARDS_SHARE * float(np.abs(distance).sum()) > 0.0
        count += FAULTS["drives backwards"] * backwards
        return count + FAULTS["gyro upside down"] * (gyro_sense * self.heading < 0)


class Decision(NamedTuple):
    """The chosen convention.

    Attributes
    ----------
    convention : the chosen convention
    as_likely : another convention with the same likelihood and at most half a fault more; None without one
    """

    convention: StreamSigns
    as_likely: StreamSigns | None


AS_NAMED = StreamSigns(swapped=False, sign_left=1, sign_right=1, heading=1, position=1)
"""The convention in which sides, signs and senses are as their names state."""


class _Shown(NamedTuple):
    """Fit of displacements and turns for one handedness.

    Attributes
    ----------
    z, z_covariance : (4,) real and imaginary part of Z_v, then of Z_u, and their covariance (4, 4)
    turn, turn_covariance : (2,) turn by u and by v, and their covariance (2, 2)
    residuals : (2 w,) residuals of the displacements, as shares of their length
    """

    z: Floats
    z_covariance: Floats
    turn: Floats
    turn_covariance: Floats
    residuals: Floats


def decide_conventions(
    windows: DriveWindows, *, metric: bool, gyro_sense: int = 0, mirror_allowed: bool = True
) -> Decision:
    """Return the most likely of all hypotheses; the names in the log if there are too few windows.

    Parameters
    ----------
    windows : windows of the drive
    metric : whether positions may be mirrored, as poses in a local frame may; geodetic positions may not
    gyro_sense : result of `gyro_sense`
    mirror_allowed : whether the heading may be mirrored
    """
    if min(len(windows.begin), len(windows.turn_begin)) < FEWEST_OVERLAPPING:
        return Decision(AS_NAMED, None)
    track = windows.track
    laid = windows.laid, windows.over(track.at_places(track.half_difference * track.nose))
    fits = {1: _show(windows, laid, 1), -1: _show(windows, (np.conj(laid[0]), np.conj(laid[1])), -1)}
    # Twice the negative log-likelihood of each handedness is computed with the noise of the better one.
    scale = min(mad_std(convention.residuals, 0.0) for convention in fits.values())
    scale = max(scale, 0.5 * track.place_std_m / windows.length_m[0])
    losses = {hand: soft_l1_loss(convention.residuals / scale) / STARTS_A_WINDOW for hand, convention in fits.items()}
    costs, offsets = dict[StreamSigns, float](), dict[StreamSigns, float]()
    headings, positions = (1, -1) if mirror_allowed else (1,), (1, -1) if metric else (1,)
    for convention in map(StreamSigns._make, product((False, True), (1, -1), (1, -1), headings, positions)):
        hand = convention.heading * convention.position
        cost, offsets[convention] = _cost(convention, fits[hand])
        costs[convention] = cost + losses[hand]
    best = min(costs.values())
    if costs[AS_NAMED] - best < DECISIVE:
        return Decision(AS_NAMED, None)
    likely = {
        convention: convention.faults(offsets[convention], track, gyro_sense)
        for convention in costs
        if costs[convention] < best + TIE
    }
    ranked = sorted(likely, key=lambda convention: (likely[convention], costs[convention]))
    chosen = ranked[0]
    close = len(ranked) > 1 and likely[ranked[1]] <= likely[chosen] + 0.5
    return Decision(chosen, ranked[1] if close else None)


class NamedFit(NamedTuple):
    """Agreement of the positions with wheels and heading, with the names in the log.

    Attributes
    ----------
    residuals : (k,) residuals of the displacements, as shares of their length
    scatter : robust scatter of the residuals
    offset_rad : offset of the heading [rad]
    turn_sigmas : ratio of the heading's turn to the wheels' turn, in standard deviations; positive if the heading turns
        clockwise with a faster left side
    """

    residuals: Floats
    scatter: float
    offset_rad: float
    turn_sigmas: float

    def cost(self, scatter: float) -> float:
        """Return twice the negative log-likelihood for a given scatter; overlapping windows count once."""
        return soft_l1_loss(self.residuals / scatter) / STARTS_A_WINDOW

    @classmethod
    def of(cls, windows: DriveWindows) -> NamedFit:
        """Return the agreement in the windows of a log."""
        track = windows.track
        laid = windows.laid, windows.over(track.at_places(track.half_difference * track.nose))
        fit = _show(windows, laid, 1)
        std = math.sqrt(max(float(fit.turn_covariance[0, 0]), 1e-24))
        offset = math.atan2(float(fit.z[1]), float(fit.z[0]))
        return cls(fit.residuals, float(mad_std(fit.residuals, 0.0)), offset, float(fit.turn[0]) / std)


def senses_by_distance(track: Track) -> StreamSigns:
    """Return the convention of a drive without a heading, by distances alone: whether one side counts backwards.

    Distances do not show which side it is; the side with which the robot then drives forward is chosen.
    """
    _, step, left, right = cut_chords(track)
    chord = np.abs(step)
    moved = chord > max(LEAST_CHORD_M, CHORD_IN_POSITION_STD * track.place_std_m)
    if np.count_nonzero(moved) < FEWEST_ALIGNMENT_WINDOWS:
        return AS_NAMED
    as_named, reversed_ = (
        float(np.median(np.abs(chord - np.abs(both) / 2)[moved])) for both in (left + right, left - right)
    )
    if reversed_ > as_named / 2:
        return AS_NAMED
    forward = float((left - right).sum()) > 0.0
    return AS_NAMED._replace(sign_right=-1) if forward else AS_NAMED._replace(sign_left=-1)


TIE = 9.0
"""Difference of the cost from the cost of the best hypothesis below which a hypothesis counts as equally likely."""


def _show(windows: DriveWindows, laid: tuple[Complexes, Complexes], hand: int) -> _Shown:
    """Return the fit of displacements and turns for one handedness, under a prior with hardly any effect.

    Parameters
    ----------
    laid : (w,) mean of the sides' distances, and half their difference, along the heading of that handedness [m]
    """
    track, seen = windows.track, windows.seen / windows.length_m
    v, u = (distances / windows.length_m for distances in laid)
    columns = np.column_stack([v, 1j * v, u, 1j * u])
    first, last = windows.turn_begin, windows.turn_end
    turns = [track.cumulate(speed) for speed in (track.half_difference, track.mean_speed)]
    by = [np.interp(last, track.t, total) - np.interp(first, track.t, total) for total in turns]
    displacement_fit, turn_fit = (
        robust_regression(design, target, np.full(design.shape[1], VAGUE_PRIOR_STD), float(STARTS_A_WINDOW))
        for design, target in (
            (np.concatenate([columns.real, columns.imag]), np.concatenate([seen.real, seen.imag])),
            (np.column_stack(by), hand * windows.heading_changes),
        )
    )
    covariance = sandwich_covariance(displacement_fit, np.tile(windows.group, 2))
    turn_covariance = sandwich_covariance(turn_fit, windows.turn_group)
    return _Shown(displacement_fit.x, covariance, turn_fit.x, turn_covariance, displacement_fit.residuals)


def _cost(convention: StreamSigns, fit: _Shown) -> tuple[float, float]:
    """Return the squared Mahalanobis distance of the fit from a convention's expected values, and its offset."""
    sides = np.diag([float(convention.sign_left), float(convention.sign_right)])
    if convention.swapped:
        sides = sides[::-1]
    # `back` maps (v, u) of the true sides to (v, u) of the named sides: p = Z (v, u)_named = Z back (v, u)_true
    halves = np.array([[0.5, 0.5], [0.5, -0.5]])
    back = 2.0 * halves @ sides.T @ halves
    lift = np.kron(back.T, np.eye(2))
    z = lift @ fit.z
    offset = math.atan2(z[1], z[0])
    c, s = math.cos(offset), math.sin(offset)
    place = np.kron(np.eye(2), [[c, s], [-s, c]]) @ lift / max(math.hypot(z[0], z[1]), math.hypot(z[2], z[3]), 1e-9)
    turn = convention.position * back.T[::-1, ::-1]
    turn /= max(float(np.abs(turn @ fit.turn).max()), 1e-9)
    cost = 0.0
    for scaled, value, covariance, expected, std in (
        (place, fit.z, fit.z_covariance, [1.0, 0.0, 0.0, 0.0], EXPECTED_STD[:4]),
        (turn, fit.turn, fit.turn_covariance, [1.0, 0.0], EXPECTED_STD[4:]),
    ):
        away = scaled @ value - expected
        cost += float(away @ np.linalg.solve(scaled @ covariance @ scaled.T + np.diag(std**2), away))
    return cost, math.remainder(offset * convention.position, 2 * math.pi)


def convention_notes(decision: Decision, *, corrects: bool, mirrored: bool = False) -> list[Note]:
    """Return findings about sides and senses that differ from their names, except the sense of the heading.

    Parameters
    ----------
    decision : the decision
    corrects : whether the preset corrects them
    mirrored : whether the log has neither gyro nor heading, so that swapped sides and mirrored positions look alike
    """
    convention, alternative, done = decision.convention, decision.as_likely, ": corrected" if corrects else ""
    notes = []
    if convention.swapped:
        other_cause = (
            "; or a latitude or longitude has the wrong sign, or both are exchanged: "
            "without gyro and heading, the log cannot distinguish these causes"
        )
        text = f"left and right wheels are swapped{done}{other_cause if mirrored else ''}"
        notes.append(note("sides_swapped", text))
    signs = (convention.sign_left, convention.sign_right)
    reversed_ = {(-1, 1): "the left wheels", (1, -1): "the right wheels", (-1, -1): "both wheels"}
    if signs in reversed_:
        notes.append(note("side_reversed", f"{reversed_[signs]} count backwards{done}"))
    if convention.position < 0:
        notes.append(note("positions_mirrored", f"positions are mirrored (east for west){done}"))
    if alternative is not None:
        parts = {
            "swapped sides": alternative.swapped,
            "a reversed left side": alternative.sign_left < 0,
            "a reversed right side": alternative.sign_right < 0,
            "a mirrored heading": alternative.heading < 0,
            "mirrored positions": alternative.position < 0,
        }
        words = " with ".join(part for part, is_so in parts.items() if is_so)
        words = words or "sides as named and a heading turned by 180°"
        why = f"{words} would explain the log as well: check the names of the wheels"
        notes.append(note("sides_ambiguous", why))
    return notes


def gyro_sense(log: RobotLog, track: Track) -> int:
    """Return +1 if the gyro turns in the sense of the heading as named, -1 in the opposite sense, 0 if not shown."""
    if log.gyro is None or len(track.heading_t) < 2:
        return 0
    t, rate = (log.gyro.stamp_ns - log.wheels.stamp_ns[0]) / 1e9, log.gyro.rate_radps
    line = fit_gyro_line(t, rate, trapezoids(t, rate), track.heading_t, track.heading)
    return int(np.sign(line.scale)) if line.is_yaw else 0


def apply_convention(log: RobotLog, convention: StreamSigns) -> RobotLog:
    """Return the log with sides, headings and positions corrected by a convention; the same log for `AS_NAMED`."""
    if convention == AS_NAMED:
        return log
    wheels, heading, gnss = log.wheels, log.heading, log.gnss
    left, right = convention.sign_left * wheels.v_left_mps, convention.sign_right * wheels.v_right_mps
    if convention.swapped:
        left, right = right, left
    if convention.heading < 0:
        heading = replace(heading, heading_rad=-heading.heading_rad)
    if convention.position < 0:
        gnss = replace(gnss, east_m=-gnss.east_m, cov_north_east_m2=-gnss.cov_north_east_m2)
    return replace(log, wheels=replace(wheels, left=left, right=right), heading=heading, gnss=gnss)
