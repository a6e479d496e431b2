"""Excitation: which ICRs a drive could show, from the information it holds, and what to drive next."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from icrtool.estimation.icr_uncertainty import StateWindows, prior_std
from icrtool.kernels.arrays import Floats
from icrtool.kernels.kinematics import MIN_ICR_SEPARATION_M
from icrtool.kernels.track import Track
from icrtool.records.plain_data import known
from icrtool.records.run import ICR_COLUMNS, ICR_WORDS, width_or_usual_m
from icrtool.records.run_document import ExcitationDocument, Excited, IcrColumn, NumberByIcr, VerdictByIcr
from icrtool.records.tables import States

SPIN_BOTH = "drive two full turns on the spot to the right and two to the left"

SLIP_SHARE = 0.03
"""Part of distance and of turn that slips differently from one window to the next."""

SHOWN_SHARE, WEAK_SHARE = 0.03, 0.1
"""Standard deviations in parts of y right - y left up to which an ICR is shown, and weakly."""

AT_LIMIT = 1.1
"""A y ICR within this many times the filter's limit is the limit, not an estimate."""

UNLEARNED = 0.7
"""An ICR whose standard deviation is still more than this share of the start's was not learned."""

TURNS_NEEDED_RAD = math.pi
STEERS, SURELY_TURNED_RAD = 0.1, 0.1
"""Sides that turn by less than this part of what the robot turns do not turn it; and more than headings err."""
ONE_DIRECTION = 0.15
"""Turns are in one direction where those to the other side are less than this share of them."""
SPIN_RATIO = 3.0
"""A turn counts as a spin where the sides differ by this many times their mean."""


@dataclass(frozen=True, slots=True)
class Excitation:
    """What a drive could show.

    Attributes
    ----------
    std_m : by ICR, the standard deviation that the drive's information allows (Cramer-Rao, constants, `SLIP_SHARE`)
    verdicts : by ICR
    turned_right_rad, turned_left_rad : heading changes summed to either side; spun_*: of these, on the spot
    sentences : the verdict in words, and what to drive next; empty where all is shown
    """

    std_m: dict[str, float]
    verdicts: dict[str, Excited]
    turned_right_rad: float
    turned_left_rad: float
    spun_right_rad: float
    spun_left_rad: float
    sentences: tuple[str, ...]

    @property
    def shows_sides(self) -> bool:
        """Whether both y ICRs are shown, at least weakly."""
        return all(self.verdicts[name] != "not shown" for name in ICR_COLUMNS[:2])

    @property
    def not_shown(self) -> frozenset[IcrColumn]:
        """The ICRs that are not shown."""
        return frozenset(name for name in ICR_COLUMNS if self.verdicts[name] == "not shown")

    def summary(self) -> ExcitationDocument:
        """Return what run.json holds."""
        return ExcitationDocument(
            NumberByIcr(*(known(self.std_m[name]) for name in ICR_COLUMNS)),
            VerdictByIcr(*(self.verdicts[name] for name in ICR_COLUMNS)),
            math.degrees(self.turned_right_rad),
            math.degrees(self.turned_left_rad),
            math.degrees(self.spun_right_rad),
            math.degrees(self.spun_left_rad),
            self.sentences,
        )


def find_excitation(table: States, track: Track, track_width_m: float | None, windows: StateWindows) -> Excitation:
    """Return which ICRs a drive could show.

    Parameters
    ----------
    table : the recorded states
    track : the same as a track
    track_width_m : b, None where not known
    windows : of the drive, with `nominal_icrs`

    Returns
    -------
    Excitation

    Notes
    -----
    The Fisher information of constant ICRs in displacements and heading changes over windows of distance, with the
    filter's own uncertainties and some slip as noise, after the heading's offset and the wheels' scales are
    marginalised. It is what a drive could show at best, not what the filter learned.
    """
    p = nominal_icrs(table, track_width_m)
    width = float(p[0] - p[1])
    std = _posterior(windows, width)
    omega = (track.v_left - track.v_right) / width
    spins = np.abs(track.v_left - track.v_right) > SPIN_RATIO * np.abs(track.v_left + track.v_right) / 2
    # noise of standing encoders is no turn
    moving = np.abs(track.v_left) + np.abs(track.v_right) > 0.02
    turns = np.where(moving, track.held * omega, 0.0)
    right, left, spun_right, spun_left = (
        float(turns[turns > 0].sum()), abs(float(turns[turns < 0].sum())),
        float(turns[spins & (turns > 0)].sum()), abs(float(turns[spins & (turns < 0)].sum())),
    )  # fmt: skip
    stds: dict[str, float] = dict(zip(ICR_COLUMNS, (float(value) for value in std), strict=True))
    verdicts: dict[str, Excited] = {name: _verdict(value / width) for name, value in stds.items()}
    return Excitation(
        std_m=stds,
        verdicts=verdicts,
        turned_right_rad=right,
        turned_left_rad=left,
        spun_right_rad=spun_right,
        spun_left_rad=spun_left,
        sentences=_sentences(stds, verdicts, right, left, windows.distance_m, _turned_otherwise(table, windows)),
    )


def withhold_unlearned(
    found: Excitation, table: States, *, std_m: Floats, start_std_m: Floats, least_icr_m: float
) -> Excitation:
    """Return the excitation with each final ICR "not shown" that the filter did not learn from the drive.

    Parameters
    ----------
    table : the recorded states
    std_m : (3,) of the final ICRs, `icrtool.estimation.icr_uncertainty.final_covariance`
    start_std_m : (3,) of the filter's start
    least_icr_m : the filter keeps both y ICRs at least this far from the centre line; -inf: anywhere
    """
    final = dict(zip(ICR_COLUMNS, table.icrs_at(-1), strict=True))
    filter_std = {name: float(getattr(table, f"std_{name}")[-1]) for name in ICR_COLUMNS}
    width = max(final["y_icr_right_m"] - final["y_icr_left_m"], MIN_ICR_SEPARATION_M)
    verdicts, sentences = dict(found.verdicts), list(found.sentences)
    for name, std, start in zip(ICR_COLUMNS, std_m, start_std_m, strict=True):
        side = -1.0 if name == "y_icr_left_m" else 1.0
        if name != "x_icr_m" and side * final[name] <= AT_LIMIT * least_icr_m:
            why = f"stopped at the limit of {side * least_icr_m:+.2f} m that the filter keeps"
        elif filter_std[name] > UNLEARNED * start:
            why = f"± {filter_std[name]:.2f} m, about as uncertain as at the start (± {start:.2f} m)"
        elif std > WEAK_SHARE * width:
            why = f"± {std:.2f} m, by how much stretches of the drive differ"
        else:
            continue
        if verdicts[name] != "not shown":
            sentences.append(f"{ICR_WORDS[name]} is not shown: {why}")
        verdicts[name] = "not shown"
    return replace(found, verdicts=verdicts, sentences=tuple(sentences))


def nominal_icrs(table: States, track_width_m: float | None) -> Floats:
    """Return ICRs (3,) [m] near which to ask: the run's final ones where they can be, else those of the width."""
    right, left, x = table.icrs_at(-1)
    half = width_or_usual_m(track_width_m) / 2
    if right - left < half or right <= 0.0 or left >= 0.0:
        right, left, x = 1.4 * half, -1.4 * half, 0.0
    return np.array([right, left, x])


def _posterior(windows: StateWindows, width: float) -> Floats:
    """Return standard deviations (3,) of the ICRs, heading offset and scales marginalised."""
    slip = SLIP_SHARE * np.abs([windows.length_m, windows.length_m, windows.turned_rad])
    rows = windows.jacobian / np.hypot(slip, np.maximum(windows.noise, 1e-6)[:, None]).ravel()[:, None]
    information = rows.T @ rows + np.diag(prior_std(width) ** -2.0)
    deviations: Floats = np.sqrt(np.diag(np.linalg.solve(information, np.eye(6)))[:3])
    return deviations


def _verdict(share: float) -> Excited:
    if share <= SHOWN_SHARE:
        return "shown"
    return "weak" if share <= WEAK_SHARE else "not shown"


def _sentences(
    stds: dict[str, float], verdicts: dict[str, Excited], right: float, left: float, distance_m: float, steered: float
) -> tuple[str, ...]:
    """Return sentences: what is not shown, why, and what to drive; `steered` of `_turned_otherwise`."""
    lacking = [name for name, verdict in verdicts.items() if verdict != "shown"]
    if not lacking:
        return ()
    unshown = ", ".join(f"{ICR_WORDS[name]} ({verdicts[name]}, about ± {stds[name]:.2f} m)" for name in lacking)
    first = f"this drive could not show the ICRs well: {unshown}"
    if steered > TURNS_NEEDED_RAD and right + left < STEERS * steered:
        angles = f"the robot turned by {math.degrees(steered):.0f}° and its sides by {math.degrees(right + left):.0f}°"
        return (first, f"{angles}: it steers as a car does, and has no track ICRs, or one side is a copy of the other")
    if lacks := lacking_turns(right, left):
        return (first, lacks)
    return (first, f"too few turns in {distance_m:.0f} m by the wheels for this measurement noise: {SPIN_BOTH}")


def _turned_otherwise(table: States, windows: StateWindows) -> float:
    """Return how far the robot turned in the windows, by its headings, to whichever side [rad]."""
    turned = np.abs(np.diff(np.interp(windows.end_s, table.t_s, table.heading_rad)))
    return float(turned[turned > SURELY_TURNED_RAD].sum())


def lacking_turns(right_rad: float, left_rad: float) -> str:
    """Return which turns a drive lacks and what to drive, from its turns to either side; empty where it has enough."""
    total = right_rad + left_rad
    if total < TURNS_NEEDED_RAD:
        return f"hardly any turns ({math.degrees(total):.0f}° in all): {SPIN_BOTH}"
    if min(right_rad, left_rad) < ONE_DIRECTION * max(right_rad, left_rad):
        side = "left" if right_rad > left_rad else "right"
        return f"turned in one direction only: drive two full turns on the spot, or circles, to the {side}"
    return ""
