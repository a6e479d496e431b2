"""Findings that a user needs before trusting a run."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from icrtool.alignment.wheel_alignment import LARGEST_SCALE_CORRECTION, LARGEST_SCALE_STD
from icrtool.config import Config
from icrtool.estimation.filter_setup import configured_noise
from icrtool.estimation.run_filter import LARGEST_POSITION_MPS, NOISE_FACTOR
from icrtool.kernels.arrays import Bytes, Floats
from icrtool.kernels.filter_records import GATED, UNSEEN
from icrtool.records.measurements import AlignmentEstimate, WheelFacts
from icrtool.records.notes import Note, note, notes_about
from icrtool.records.presets import ProcessNoise
from icrtool.records.run import ICR_WORDS
from icrtool.records.run_document import ExcitationDocument
from icrtool.records.tables import States

MULTIPLIERS = (0.9, 6.0)
"""Smallest and largest usual distance between the ICRs of a robot that slips, in track widths."""

ROLLS = 0.02
"""Largest difference of the multiplier from 1, if two standard deviations are smaller, at which a robot does not slip
in turns. Track widths are measured no more accurately."""

ROLLS_STD = 0.05
"""Largest standard deviation of the multiplier with which a robot can be found not to slip."""

LOPSIDED_M, LOPSIDED_SIGMAS = 0.05, 3.0
"""Distance of the ICRs' middle from the sensor above which the ICRs are not symmetric [m], and in standard deviations.
The larger one counts."""

USUAL_X_M = 0.15
"""Largest usual distance of x_icr from the body origin of skid-steer robots [m] (Pentzer 2014: 0.06 and 0.14 m)."""

TWIST_SIGMAS = 2.0
"""Excess of the ICRs' separation over the track width, in standard deviations, below which a body twist turns as the
robot does, because its controller corrects the slip."""

WORTH_WARNING_SHARE = 0.1
"""Share of rejected measurements from which on there is a warning."""

DELAY_SIGMAS = 3.0
"""Delay above which the clock of a stream is the cause of rejected measurements, in standard deviations."""

LARGEST_TURN_UNEXPLAINED, UNEXPLAINED_SIGMAS = 0.5, 2.0
"""Unexplained share of the variance of turns above which the wheels explain almost none of the turns, and number of
standard deviations by which the share must exceed it."""

USELESS_HEADING_DEGPS = 50.0
"""Noise of the heading above which the wheels do not show turns [deg/s]. The heading by wheels is then wrong by 5 deg
after 1 s."""

CONTRADICTION_SIGMAS, CONTRADICTION_SHARE = 3.0, 0.1
"""Difference of two estimates of a y ICR above which they contradict each other, in standard deviations and as a share
of the separation. Both must be exceeded."""

UNUSABLE_SHARE = 0.3
"""Share of rejected fixes or headings above which the filter did not follow them."""

REJECTED = {"fixes": "fixes_rejected", "headings": "headings_rejected"}
MOSTLY_REJECTED = {"fixes": "fixes_mostly_rejected", "headings": "headings_mostly_rejected"}
"""Codes of findings about rejected fixes and headings. `MOSTLY_REJECTED` is for a run that is not usable."""


def unusable_reasons(
    excitation: ExcitationDocument,
    rejected: Mapping[str, float],
    noise: ProcessNoise,
    wheel_scale: AlignmentEstimate | None = None,
    twist_separation: tuple[float, float] | None = None,
    contradiction: str = "",
    filtered: str = "",
    wheels: WheelFacts | None = None,
    *,
    inverted: bool = False,
) -> list[Note]:
    """Return why the ICRs of a run must not be used, as grave findings; empty if they can be used.

    Parameters
    ----------
    excitation : ICRs that the drive shows
    rejected : `rejected_share` of the fixes, and of the headings
    noise : process noise of the pose
    wheel_scale : estimate of the scale of the wheels
    twist_separation : (y_r - y_l) / b by a body twist that was converted with b, and its standard deviation; None for
        other wheels
    contradiction : result of `contradicts_windows`
    filtered : evidence that a filter made the wheel speeds, which is then the only reason
    wheels : facts about the wheels; without compared turns, the filter's noise of the heading decides
    inverted : the right ICR ended left of the left ICR
    """
    if (cause := _cause_of_all(filtered, wheels)) is not None:
        return [cause]
    hidden = [ICR_WORDS[name] for name in excitation.verdict.not_shown]
    why = "it turns too little, or its sensors disagree"
    reasons = list[Note]()
    if hidden:
        reasons.append(note("icrs_not_shown", f"this drive does not show {', '.join(hidden)}: {why}"))
    elif inverted:
        reasons.append(note("icrs_inverted", "the ICRs ended inverted: check sides and signs of the wheels"))
    for word, share in rejected.items():
        if share > UNUSABLE_SHARE:
            reasons.append(note(MOSTLY_REJECTED[word], f"{100 * share:.0f} % of the {word} rejected"))
    if noise.position_mps * NOISE_FACTOR > LARGEST_POSITION_MPS:
        reasons.append(note("motion_unexplained", "the wheels explain almost none of the motion"))
    elif noise.heading_degps > USELESS_HEADING_DEGPS and (why := _why_turns_unexplained(wheels)):
        reasons.append(note("turns_unexplained", why))
    elif contradiction and not hidden:
        reasons.append(note("windows_contradict", contradiction))
    if wheel_scale is not None and wheel_scale.value is not None and wheel_scale.std is not None:
        remaining_scale = wheel_scale.value / wheel_scale.applied
        if wheel_scale.std < LARGEST_SCALE_STD and abs(remaining_scale - 1.0) > LARGEST_SCALE_CORRECTION:
            scale_text = f"the robot goes {100 * remaining_scale:.0f} % of the distance that the wheels report"
            # This reason comes first, because a wrong radius causes the other reasons.
            reasons.insert(0, note("wheel_scale_wrong", scale_text))
    if twist_separation is not None and not hidden:
        reasons += _twist_reasons(*twist_separation)
    return reasons


def _cause_of_all(filtered: str, wheels: WheelFacts | None) -> Note | None:
    """Return the finding that is the only reason, because it causes all others; None without it."""
    if filtered:
        needed = "wheel speeds are needed: topics.wheels names their topic"
        return note("wheels_filtered", f"filtered or fused odometry ({filtered}); {needed}")
    if wheels is None or wheels.exchanged_s is None:
        return None
    time_text = f"{wheels.exchanged_s:.0f}"
    advice = f"fit each part by itself: --to {time_text}, --from {time_text}"
    return note("sides_exchanged", f"left and right wheels are exchanged before or after about {time_text} s; {advice}")


def _why_turns_unexplained(wheels: WheelFacts | None) -> str:
    """Return why the turns are not explained; empty if the wheels may explain most of their variance."""
    slip = "do they slip, as on ice?"
    if wheels is None or wheels.turn_unexplained is None or wheels.turn_unexplained_std is None:
        return f"the wheels explain almost none of the turns: {slip}"
    unexplained, std = wheels.turn_unexplained, wheels.turn_unexplained_std
    if unexplained - UNEXPLAINED_SIGMAS * std < LARGEST_TURN_UNEXPLAINED:
        return ""
    return (
        f"the wheels explain {100 * max(1.0 - unexplained, 0.0):.0f} ± {100 * std:.0f} % of the turns' variance: {slip}"
    )


def _twist_reasons(separation: float, std: float) -> list[Note]:
    """Return why a body twist shows no ICRs, from their separation in track widths; empty if it may show them.

    Notes
    -----
    If a twist turns as the robot does, the separation of its ICRs equals the width that it was converted with. A
    skid-steer robot turns less than its wheels, so that the separation is larger by more than its standard deviation.
    """
    if separation >= 1.0 + TWIST_SIGMAS * std:
        return []
    why = (
        f"the turns of the body twist are {separation:.2f} ± {std:.2f} of the robot's: they hold no slip, so that "
        "these ICRs are not the ICRs of the tracks; set wheels.twist_width_m to the width that its controller uses"
    )
    return [note("twist_holds_multiplier", why)]


def contradicts_windows(table: States, covariance: Floats, estimates: Mapping[str, AlignmentEstimate]) -> str:
    """Return how the final y ICRs contradict the ICRs from windows of the drive; empty if they agree.

    Parameters
    ----------
    table : the recorded states
    covariance : (3, 3) covariance of the final ICRs [m^2]
    estimates : estimates of the alignment; without ICRs among them nothing is compared

    Notes
    -----
    The filter uses single samples. The windows (`icrtool.alignment.estimator`) compare motion over metres and include
    delays. On recorded and simulated drives whose streams agree, both differ by up to 0.04 of the separation.
    """
    right, left = estimates.get("y_icr_right_m"), estimates.get("y_icr_left_m")
    apart = []
    for row, (word, estimate) in enumerate((("right", right), ("left", left))):
        if estimate is None or estimate.value is None or estimate.std is None:
            return ""
        final = float(table.icrs_at(-1)[row])
        sigma = math.hypot(estimate.std, math.sqrt(max(float(covariance[row, row]), 0.0)))
        separation = abs(table.y_icr_right_m[-1] - table.y_icr_left_m[-1])
        if abs(final - estimate.value) > max(CONTRADICTION_SIGMAS * sigma, CONTRADICTION_SHARE * separation):
            apart.append(
                f"y {word} is {final:+z.2f} m by the filter and "
                f"{estimate.value:+z.2f} ± {estimate.std:.2f} m by windows"
            )
    return f"wheels and reference contradict each other ({'; '.join(apart)}): clocks or slip" if apart else ""


def rejected_share(code: Bytes) -> float:
    """Return the share of the measurements in the run that the gate rejected, from their codes (m,); 0 for none."""
    seen = code[code > UNSEEN]
    return float((seen == GATED).mean()) if len(seen) else 0.0


def noise_warnings(name: str, config: Config, noise: ProcessNoise) -> list[Note]:
    """Return the findings about process noise that was raised, because the wheels contradict the reference."""
    configured, notes = configured_noise(config), list[Note]()
    if noise.position_mps != configured.position_mps:
        causes = "slip, clock offsets, repeated samples, fixes worse than they state"
        raised = f"position noise raised to {noise.position_mps:.1f} m/s; filter.process_position_mps sets it"
        why = f"the wheels contradict the position reference ({causes}): {raised}"
        notes.append(note("position_noise_raised", why, name))
    if noise.heading_degps != configured.heading_degps:
        causes = "repeated samples, clock offsets, slip"
        raised = f"heading noise raised to {noise.heading_degps:.0f} deg/s; filter.process_heading_degps sets it"
        notes.append(note("heading_noise_raised", f"the wheels contradict the heading ({causes}): {raised}", name))
    return notes


def run_warnings(
    name: str,
    rejected: Mapping[str, float],
    multiplier: tuple[float, float] | None,
    excitation: ExcitationDocument,
    estimates: Mapping[str, AlignmentEstimate],
    *,
    inverted: bool,
) -> tuple[Note, ...]:
    """Return the findings that a user needs before trusting the numbers.

    Parameters
    ----------
    name : name of the log
    rejected : `rejected_share` of the fixes, and of the headings
    multiplier : (y_r - y_l) / b and its standard deviation; None if b is not known, or the run is not usable
    excitation : ICRs that the drive shows
    estimates : estimates of the alignment
    inverted : the right ICR ended left of the left ICR
    """
    notes = list[Note]()
    if multiplier is not None and excitation.verdict.shows_sides:
        value, std = multiplier
        if abs(value - 1.0) <= max(ROLLS, 2.0 * std) and std <= ROLLS_STD:
            rolls = f"this robot turns as a differential drive (multiplier {value:.3f} ± {std:.3f})"
            notes.append(note("robot_does_not_slip", f"{rolls}: ICRs improve nothing"))
        elif not MULTIPLIERS[0] <= value <= MULTIPLIERS[1]:
            cause = f"slip makes it 1 to {MULTIPLIERS[1]:g}: check robot.track_width_m, wheel radius and sides"
            notes.append(note("multiplier_unusual", f"the ICRs are {value:.2f} of the track width apart; {cause}"))
    if inverted:
        why = "the ICRs ended inverted (right not right of left): do not use them; check sides and signs of the wheels"
        notes.append(note("icrs_ended_inverted", why))
    delays = {"fixes": "position_delay_s", "headings": "heading_delay_s"}
    for word, share in rejected.items():
        if share > WORTH_WARNING_SHARE:
            cause = _cause_of_rejection(estimates.get(delays[word]))
            notes.append(note(REJECTED[word], f"{100 * share:.0f} % of the {word} were rejected: {cause}"))
    return notes_about(name, notes)


def _cause_of_rejection(delay: AlignmentEstimate | None) -> str:
    """Return the possible cause of rejected measurements, from their delay against the wheels."""
    scatter = "they jump or scatter by more than they state"
    if delay is None or delay.value is None or delay.std is None:
        return f"their clock, or {scatter}; this drive does not show their delay"
    remaining_s = delay.value - delay.applied
    if abs(remaining_s) > DELAY_SIGMAS * delay.std:
        does = "lag" if remaining_s > 0 else "lead"
        return f"they {does} the wheels by {abs(remaining_s):.2f} ± {delay.std:.2f} s, or {scatter}"
    return f"{scatter} (their clock agrees with the wheels to {max(delay.std, abs(remaining_s)):.2f} s)"


def antenna_warning(name: str, table: States, covariance: Floats) -> list[Note]:
    """Return a finding if both ICRs lie to one side of a position sensor whose place on the robot is not known.

    Parameters
    ----------
    name : name of the log
    table : the recorded states
    covariance : (3, 3) covariance of the final ICRs [m^2]

    Notes
    -----
    An antenna off the centre line has the same effect as unequal slip of the sides, and an antenna ahead of the body
    origin the same effect as an x_icr behind it: only differences are shown (`icrtool.calibration.sensor_findings`).
    Nothing is corrected.
    """
    settled = slice(len(table) // 2, None)
    middle = float(np.median(table.y_icr_right_m[settled] + table.y_icr_left_m[settled])) / 2
    sigma = math.sqrt(max(float(covariance[:2, :2].sum()), 0.0)) / 2
    if abs(middle) <= max(LOPSIDED_M, LOPSIDED_SIGMAS * sigma):
        x = float(table.x_icr_m[-1])
        if abs(x) <= max(USUAL_X_M, LOPSIDED_SIGMAS * math.sqrt(max(float(covariance[2, 2]), 0.0))):
            return []
        unknown = "as the log does not hold its place on the robot"
        advice = "frames.antenna_forward_m sets how far ahead of the body origin it is, and is added to x"
        why = f"x {x:+z.2f} m is counted from the position sensor (antenna), {unknown}: {advice}"
        return [note("antenna_forward_unknown", why, name)]
    side, opposite = ("right", "left") if middle > 0 else ("left", "right")
    where = f"{abs(middle):.2f} m"
    why = (
        f"both ICRs lie {where} to the {side} of the position sensor (antenna): the sensor is {opposite} of "
        f"the centre line, or the sides slip unequally. If it is {where} {opposite} of it, set "
        f"frames.antenna_right_m={-middle:z.2f}, and frames.antenna_forward_m, from which x_icr is counted"
    )
    return [note("antenna_aside_unknown", why, name)]
