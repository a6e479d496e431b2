"""Information of a drive about its ICRs, the turns that it lacks, and the differences between its stretches."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from icrtool.alignment.sensor_noise import SLIP_SHARE
from icrtool.kernels.arrays import ROWS_AT_ONCE, Bools, Floats, Ints, rows_at_steps
from icrtool.kernels.filter_records import REFERENCE_STEP_S
from icrtool.kernels.kinematics import MIN_ICR_SEPARATION_M
from icrtool.kernels.robust import Linearised, sandwich_covariance, scale_by_kind
from icrtool.kernels.track import Track, Windows
from icrtool.kernels.window_residuals import path_at, window_residuals
from icrtool.motion.models import FULL_LINEAR, model_columns, parameters_of_icrs, wheel_motion
from icrtool.records.notes import Note, note
from icrtool.records.plain_data import finite_or_none
from icrtool.records.run import ICR_COLUMNS, ICR_WORDS, width_or_usual_m
from icrtool.records.run_document import ExcitationDocument, Excited, NumberByIcr, VerdictByIcr
from icrtool.records.tables import States

STATE_WINDOW_M, WINDOW_IN_SEPARATIONS = 2.0, 3.0
"""Distance of the wheels, spins included, over which displacement and turn are compared: the smaller of this distance
[m] and this multiple of y right - y left. Slip is a share of the distance; over 2 m it exceeds the effect of the ICRs
of a robot of 0.2 m."""

STRETCH_IN_WINDOWS = 10.0
"""Length of a stretch, in windows. Errors within a stretch are correlated, because slip, ground and heading errors last
for some metres."""

WIDTH_M = 1.0
"""Track width of the motion model in this module [m]. The ICRs do not depend on its value."""

HEADING_BIAS_RAD = math.radians(1.0)
"""Standard deviation of the heading's offset before a drive [rad]."""

SCALE_ERROR = 0.02
"""Standard deviation of the wheels' scale, and of the difference between the scales of the sides, before a drive. A
circle alone does not separate the ICRs from these scales and the heading's offset."""

Y_OF_STRETCH, X_OF_STRETCH = 0.04, 0.1
"""Standard deviation of the y ICRs, and of x_icr, of a stretch about those of the drive before it is driven, as a share
of y right - y left. Ground and slip differ between stretches.

x_icr also changes with the speed of a turn: a side slip of 0.1 s over a turn gain of 0.6 changes it by 0.1 of 0.9 to
1.8 m at 0.5 to 1.1 m/s."""

USUAL_EXCESS = 0.4
"""Excess of y right - y left over the track width, as a share of b, above which slip varies as usual. With a smaller
excess, the variation is smaller in proportion."""

LEAST_SLIP = 0.25
"""Variation of slip of a robot whose wheels roll, as a share of the usual variation."""


@dataclass(frozen=True)
class StateWindows(Windows):
    """Displacement and turn over windows of the wheels' distance, linear in the unknown parameters.

    Attributes
    ----------
    residuals : (3 w,) forward, right [m] and turn [rad] of the wheels' motion minus the states' motion
    jacobian : (3 w, 6) by y_icr_right, y_icr_left, x_icr [m], heading offset [rad], scale of both wheels, difference
    turned_rad : (w,) turn by the wheels; end_m : (w,) distance of the wheels at the end of each window
    stretch : (w,) number of the stretch of each window
    distance_m : distance of the wheels in the whole drive
    separation_m : y right - y left of the ICRs that convert the wheels' motion
    noise : (3,) standard deviation of each kind of residual by the noise of the states
    heading_std_rad : standard deviation of the error that all headings share
    """

    residuals: Floats
    jacobian: Floats
    turned_rad: Floats
    end_m: Floats
    stretch: Ints
    distance_m: float
    separation_m: float
    noise: Floats
    heading_std_rad: float


def cut_states(
    table: States, track: Track, track_width_m: float | None, heading_std_rad: float = 0.0
) -> StateWindows:  # fmt: skip
    """Return consecutive windows of states, with the motion of the wheels by constant ICRs.

    The ICRs are the final ICRs of the run if they are possible, else ICRs from the track width.

    Parameters
    ----------
    table : the recorded states
    track : track of the same states
    track_width_m : track width b; None if it is not known
    heading_std_rad : standard deviation of the error that all headings share
    """
    right, left, x = table.icrs_at(-1)
    half = width_or_usual_m(track_width_m) / 2
    if right - left < half or right <= 0.0 or left >= 0.0:
        right, left, x = 1.4 * half, -1.4 * half, 0.0
    distance, separation_m = track.travel, float(right - left)
    window_m = min(STATE_WINDOW_M, WINDOW_IN_SEPARATIONS * separation_m)
    rows = rows_at_steps(distance, window_m)
    start, end = np.arange(len(rows) - 1), np.arange(1, len(rows))
    parameters, by_icrs = parameters_of_icrs(np.array([right, left, x]), WIDTH_M)
    terms, whole_m, distance = len(parameters), float(distance[-1]), distance[rows]

    def twists(rows: slice) -> tuple[Floats, Ints, Floats]:
        return model_columns(FULL_LINEAR, wheel_motion(track.v_left[rows], track.v_right[rows], WIDTH_M))

    path = path_at(track, twists, parameters, track.t[rows])
    windows = Windows(track, rows[:-1], rows[1:], np.diff(distance))
    moved_residuals, jacobian = window_residuals(path, start, end, windows.moved, 0.0, np.ones(len(start)))
    turn_rad = np.diff(path.heading)
    by_offset = np.concatenate([jacobian[:, terms], np.zeros(len(turn_rad))])
    by_terms = np.concatenate([jacobian[:, :terms], np.diff(path.heading_by).T]) @ by_icrs
    place_std_m = float(np.median(np.hypot(table.std_north_m, table.std_east_m), overwrite_input=True))
    return StateWindows(
        track,
        windows.begin,
        windows.end,
        windows.length_m,
        residuals=np.concatenate([moved_residuals, turn_rad - windows.turned]),
        jacobian=np.column_stack([by_terms[:, :3], by_offset, by_terms[:, 3:]]),
        turned_rad=turn_rad,
        end_m=distance[1:],
        stretch=(distance[:-1] // (STRETCH_IN_WINDOWS * window_m)).astype(np.int64),
        distance_m=whole_m,
        separation_m=separation_m,
        noise=math.sqrt(2.0) * np.array([place_std_m, place_std_m, float(np.median(table.std_heading_rad))]),
        heading_std_rad=heading_std_rad,
    )


def prior_std(width_m: float, heading_std_rad: float = 0.0) -> Floats:
    """Return the deviations (6,) of the parameters in `StateWindows.jacobian` before a drive [m, m, m, rad, 1, 1].

    Parameters
    ----------
    width_m : standard deviation of each ICR [m]
    heading_std_rad : standard deviation of the error that all headings share [rad]; 0 where it is not known
    """
    return np.array([width_m, width_m, width_m, max(HEADING_BIAS_RAD, heading_std_rad), SCALE_ERROR, SCALE_ERROR])


def final_covariance(
    windows: StateWindows,
    filter_covariance: Floats,
    *,
    process_icr_mps: float,
    track_width_m: float | None = None,
    since_s: float = 0.0,
) -> Floats:
    """Return the covariance (3, 3) of the final ICRs [m^2], from the differences between stretches of the drive.

    Parameters
    ----------
    windows : windows with the motion by the final ICRs; y right - y left is also the prior standard deviation
    filter_covariance : (3, 3) covariance of the ICRs at the end; with the process noise it gives the filter's memory
    process_icr_mps : process noise of the ICRs in the filter
    track_width_m : track width b; None if it is not known
    since_s : time of the last terrain change; the drive before it shows other ICRs

    Notes
    -----
    The filter's own covariance assumes that the ICRs vary with the process noise. On even ground its variance is four
    times too large, and it does not include slip that varies along the drive. This function returns the sandwich
    covariance (Liang and Zeger 1986) of a fit over the windows, clustered by stretches of `STRETCH_IN_WINDOWS`, with
    heading offset and wheel scales marginalised. The expected difference between stretches (`Y_OF_STRETCH`) counts as
    one further stretch. The residuals are computed with the final ICRs, so that a difference between filter and fit
    increases the covariance. Their scale is at least the noise of the states, because states follow poor fixes slowly.
    The weight of a window is exp(-d / D), with the distance d from its end to the end of the drive, and the memory
    D = P / q of a Kalman filter with variance P and process noise q by distance.

    Share of differences within 2 standard deviations (of both numbers of a pair together):

    - Parts of one log, five recorded Warthog drives on grass and asphalt and one of a Husky: halves y 11 of 12, x 5 of
      6; thirds y 27 of 28, x all of 14; quarters y 50 of 52, x all of 26.
    - Four logs on grass: y 11 of 12, x all of 6; halves of different logs 78 %.
    - Halves of 49 drives of simulated contact physics on even ground, with three kinds of heading: y 98 to 99 %, rms
      difference 0.5 to 0.56 of the standard deviation, x all.
    - 117 simulated drives with random sensors and faults, compared with the same filter on true poses of the same
      drive: y all, x 98 %. This reference contains the drive's own slip, so it is closer than another drive.

    The coverage is smallest for halves of recorded drives, in particular of x_icr, because the halves have different
    turns and speeds.
    """
    width_m, is_recent = windows.separation_m, windows.track.t[windows.begin] >= since_s
    if np.count_nonzero(is_recent) < 2:
        return filter_covariance + np.eye(3) * width_m**2
    icr_noise_m2_per_m = process_icr_mps**2 * REFERENCE_STEP_S
    memory_m = float(np.trace(filter_covariance)) / 3.0 / icr_noise_m2_per_m if icr_noise_m2_per_m > 0.0 else math.inf
    weight = np.tile(np.exp((windows.end_m - windows.end_m[-1]) / memory_m)[is_recent], 3)
    direction, rows = np.repeat(np.arange(3), np.count_nonzero(is_recent)), np.tile(is_recent, 3)
    residuals, prior = windows.residuals[rows], np.diag(prior_std(width_m, windows.heading_std_rad) ** -2.0)
    scale = np.hypot(scale_by_kind(residuals, direction), windows.noise[direction]) / np.sqrt(weight)
    at_final_icrs = Linearised(residuals=residuals, jacobian=windows.jacobian[rows], scale=scale, prior=prior)
    slip = (
        1.0 if track_width_m is None else min(max(abs(width_m / track_width_m - 1.0) / USUAL_EXCESS, LEAST_SLIP), 1.0)
    )
    stretch_std_m = slip * width_m * np.array([Y_OF_STRETCH, Y_OF_STRETCH, X_OF_STRETCH, 0.0, 0.0, 0.0])
    return sandwich_covariance(at_final_icrs, np.tile(windows.stretch[is_recent], 3), stretch_std_m)[:3, :3]


def multiplier_std(covariance: Floats, track_width_m: float) -> float:
    """Return the standard deviation of (y right - y left) / b from the covariance (3, 3) of the ICRs."""
    gradient: np.ndarray[Any, np.dtype[np.float64]] = np.array([1.0, -1.0, 0.0])
    return math.sqrt(max(float(gradient @ covariance @ gradient), 0.0)) / track_width_m


SPIN_BOTH = "drive two full turns on the spot to the right and two to the left"
"""Advice for a drive with too few turns."""

SHOWN_SHARE, WEAK_SHARE = 0.03, 0.1
"""Largest standard deviations of an ICR that is shown, and of an ICR that is weakly shown, as a share of y right - y
left."""

AT_LIMIT = 1.1
"""Ratio of a y ICR to the filter's limit below which the ICR counts as the limit and not as an estimate."""

TURNS_NEEDED_RAD = math.pi
"""Sum of the turns to both sides below which a drive lacks turns [rad]."""

STEERING_RATIO = 0.1
"""Ratio of the turn by the difference of the sides to the robot's turn below which the sides do not turn the robot."""

SURELY_TURNED_RAD = 0.1
"""Smallest turn that counts in this ratio [rad]. It is larger than the errors of headings."""

ONE_DIRECTION = 0.15
"""Ratio of the turns to one side to the turns to the other side below which a drive turns in one direction only."""

SPIN_RATIO = 3.0
"""Ratio of the difference of the sides to their mean above which a turn is a spin."""


def find_excitation(windows: StateWindows, unlearned: Mapping[str, str]) -> ExcitationDocument:
    """Return which ICRs a drive could show.

    Parameters
    ----------
    windows : windows of the recorded states
    unlearned : result of `unlearned_icrs`; these ICRs count as not shown, even if the drive could show them

    Notes
    -----
    Fisher information of constant ICRs in displacements and heading changes over windows of distance. The noise is the
    filter's own uncertainty and some slip; heading offset and wheel scales are marginalised. This is the largest
    information that the drive could give; the filter may have learned less.
    """
    track, width = windows.track, windows.separation_m
    slip = SLIP_SHARE * np.abs([windows.length_m, windows.length_m, windows.turned_rad])
    rows = windows.jacobian / np.hypot(slip, np.maximum(windows.noise, 1e-6)[:, None]).ravel()[:, None]
    information = rows.T @ rows + np.diag(prior_std(width, windows.heading_std_rad) ** -2.0)
    std: Floats = np.sqrt(np.diag(np.linalg.solve(information, np.eye(6)))[:3])
    turns, spins = _turns(track, width)
    turned_right, spun_to_right = (float(angles.clip(min=0.0).sum()) for angles in (turns, turns[spins]))
    turned_left, spun_to_left = (0.0 - float(angles.clip(max=0.0).sum()) for angles in (turns, turns[spins]))
    stds: dict[str, float] = dict(zip(ICR_COLUMNS, std.tolist(), strict=True))
    verdicts: dict[str, Excited] = {
        name: "shown" if value / width <= SHOWN_SHARE else "weak" if value / width <= WEAK_SHARE else "not shown"
        for name, value in stds.items()
    }
    notes = _lacking(stds, verdicts, turned_right, turned_left, windows)
    for name, why in unlearned.items():
        if verdicts[name] != "not shown":
            notes.append(note("icr_not_learned", f"{ICR_WORDS[name]} is not shown: {why}"))
        verdicts[name] = "not shown"
    return ExcitationDocument(
        NumberByIcr(*map(finite_or_none, stds.values())), VerdictByIcr(*verdicts.values()), math.degrees(turned_right),
        math.degrees(turned_left), math.degrees(spun_to_right), math.degrees(spun_to_left), tuple(notes),
    )  # fmt: skip


def _turns(track: Track, width_m: float) -> tuple[Floats, Bools]:
    """Return the turn of a robot with each wheel sample (n,) [rad], and which of these turns are spins."""
    turns, spins = np.empty(len(track.t)), np.empty(len(track.t), np.bool_)
    for lo in range(0, len(track.t), ROWS_AT_ONCE):
        chunk = slice(lo, lo + ROWS_AT_ONCE)
        left, right = track.v_left[chunk], track.v_right[chunk]
        # The noise of encoders at rest is not a turn.
        moving = np.abs(left) + np.abs(right) > 0.02
        turns[chunk] = np.where(moving, track.held[chunk] * (left - right) / width_m, 0.0)
        spins[chunk] = np.abs(left - right) > SPIN_RATIO * np.abs(left + right) / 2
    return turns, spins


def unlearned_icrs(table: States, *, std_m: Floats, least_icr_m: float) -> dict[str, str]:
    """Return the final ICRs that the filter did not learn from the drive, with the reasons.

    Parameters
    ----------
    table : the recorded states
    std_m : (3,) standard deviations of the final ICRs, from `final_covariance`
    least_icr_m : smallest distance of the y ICRs from the centre line in the filter; -inf: no limit
    """
    final, reasons = dict(zip(ICR_COLUMNS, table.icrs_at(-1), strict=True)), dict[str, str]()
    width = max(final["y_icr_right_m"] - final["y_icr_left_m"], MIN_ICR_SEPARATION_M)
    for name, std in zip(ICR_COLUMNS, std_m, strict=True):
        side = -1.0 if name == "y_icr_left_m" else 1.0
        if name != "x_icr_m" and side * final[name] <= AT_LIMIT * least_icr_m:
            reasons[name] = f"stopped at the limit of {side * least_icr_m:+z.2f} m that the filter keeps"
        elif std > WEAK_SHARE * width:
            reasons[name] = f"± {std:.2f} m, from the differences between stretches of the drive"
    return reasons


def _lacking(
    stds: dict[str, float], verdicts: dict[str, Excited], turned_right: float, turned_left: float, windows: StateWindows
) -> list[Note]:
    """Return the findings about ICRs that are not shown, with the reason and what to drive."""
    lacking = [name for name, verdict in verdicts.items() if verdict != "shown"]
    if not lacking:
        return []
    unshown = ", ".join(f"{ICR_WORDS[name]} ({verdicts[name]}, about ± {stds[name]:.2f} m)" for name in lacking)
    first = note("icrs_poorly_shown", f"this drive could not show the ICRs well: {unshown}")
    turns_rad = np.abs(windows.turned[1:])
    steered = float(turns_rad[turns_rad > SURELY_TURNED_RAD].sum())
    turned_rad = turned_right + turned_left
    if steered > TURNS_NEEDED_RAD and turned_rad < STEERING_RATIO * steered:
        angles = f"the robot turned by {math.degrees(steered):.0f}° and its sides by {math.degrees(turned_rad):.0f}°"
        why = f"{angles}: it steers as a car does, and has no track ICRs, or one side is a copy of the other"
        return [first, note("steers_as_car", why)]
    if lacks := lacking_turns(turned_right, turned_left):
        return [first, note("turns_lacking", lacks)]
    why = f"too few turns in {windows.distance_m:.0f} m by the wheels for this measurement noise: {SPIN_BOTH}"
    return [first, note("turns_lacking", why)]


def lacking_turns(right_rad: float, left_rad: float) -> str:
    """Return which turns a drive lacks and what to drive, from its turns to both sides; empty if it has enough."""
    total = right_rad + left_rad
    if total < TURNS_NEEDED_RAD:
        return f"hardly any turns ({math.degrees(total):.0f}° in all): {SPIN_BOTH}"
    if min(right_rad, left_rad) < ONE_DIRECTION * max(right_rad, left_rad):
        side = "left" if right_rad > left_rad else "right"
        return f"turned in one direction only: drive two full turns on the spot, or circles, to the {side}"
    return ""
