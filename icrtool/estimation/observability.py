"""Excitation: which ICRs a drive could show, from the information it holds, and what to drive next."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from icrtool.kernels.equal_steps import rows_at_steps
from icrtool.kernels.trials import Drive
from icrtool.kernels.window_errors import NEUTRAL, displace, integrate
from icrtool.records.run import ICR_COLUMNS, half_width_m
from icrtool.records.tables import Floats, States

Excited = Literal["shown", "weak", "not shown"]

WORDS = {"y_icr_right_m": "y right", "y_icr_left_m": "y left", "x_icr_m": "x"}

WINDOW_M = 2.0
"""Way of the wheels, spins included, over which displacement and turn are compared."""

SLIP_SHARE = 0.03
"""Part of way and of turn that slips differently from one window to the next."""

HEADING_BIAS_RAD = math.radians(1.0)
SCALE_ERROR = 0.02
"""What is never known better before a drive: the heading's offset, and the wheels' scales, both and their difference.
A circle alone cannot tell the ICRs from these."""

SHOWN_SHARE, WEAK_SHARE = 0.03, 0.1
"""Standard deviations in parts of y right - y left up to which an ICR is shown, and weakly."""

TURNS_NEEDED_RAD = math.pi
ONE_WAY = 0.15
SPIN_RATIO = 3.0
"""A turn counts as a spin where the sides differ by this many times their mean."""


@dataclass(frozen=True, slots=True)
class Excitation:
    """What a drive could show.

    Attributes
    ----------
    std_m : by ICR, the standard deviation that the drive's information allows (Cramer-Rao, constants, `SLIP_SHARE`)
    verdicts : by ICR
    turned_right_rad, turned_left_rad : heading changes summed either way; spun_*: of these, on the spot
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
    def sufficient(self) -> bool:
        """Whether all three ICRs are shown."""
        return all(verdict == "shown" for verdict in self.verdicts.values())

    def summary(self) -> dict[str, Any]:
        """Return plain data for run.json."""
        return {
            "std_m": {name: std if math.isfinite(std) else None for name, std in self.std_m.items()},
            "verdict": dict(self.verdicts),
            "turned_right_deg": math.degrees(self.turned_right_rad),
            "turned_left_deg": math.degrees(self.turned_left_rad),
            "spun_right_deg": math.degrees(self.spun_right_rad),
            "spun_left_deg": math.degrees(self.spun_left_rad),
            "sentences": list(self.sentences),
        }


def find_excitation(table: States, drive: Drive, track_width_m: float | None) -> Excitation:
    """Return which ICRs a drive could show.

    Parameters
    ----------
    table : the recorded states
    drive : the same for the kernels
    track_width_m : b, None where not known

    Returns
    -------
    Excitation

    Notes
    -----
    The Fisher information of constant ICRs in displacements and heading changes over windows of way, with the filter's
    own uncertainties and some slip as noise, after the heading's offset and the wheels' scales are marginalised. It
    says what a drive could tell at best, not what the filter made of it.
    """
    dt = np.where(drive.gap, 0.0, drive.dt_s)
    p = _nominal(table, track_width_m)
    width = float(p[0] - p[1])
    way = np.concatenate([[0.0], np.cumsum(dt * (np.abs(drive.v_left) + np.abs(drive.v_right)) / 2)[:-1]])
    rows = rows_at_steps(way, WINDOW_M)
    start, end = np.arange(len(rows) - 1), np.arange(1, len(rows))
    motion = integrate(table.t_s, dt, drive.v_left, drive.v_right, p, table.t_s[rows])
    d, d_by, _ = displace(motion, start, end)
    turn_by = motion.theta_by[end] - motion.theta_by[start]
    turned = motion.theta[end] - motion.theta[start]
    std = _posterior(
        d, d_by, turn_by, turned, np.diff(way[rows]),
        position_std=float(np.median(np.hypot(table.std_north_m, table.std_east_m))),
        heading_std=float(np.median(table.std_heading_rad)), width=width,
    )  # fmt: skip
    omega = (drive.v_left - drive.v_right) / width
    spins = np.abs(drive.v_left - drive.v_right) > SPIN_RATIO * np.abs(drive.v_left + drive.v_right) / 2
    # noise of standing encoders is no turn
    moving = np.abs(drive.v_left) + np.abs(drive.v_right) > 0.02
    turns = np.where(moving, dt * omega, 0.0)
    right, left, spun_right, spun_left = (
        float(turns[turns > 0].sum()), abs(float(turns[turns < 0].sum())),
        float(turns[spins & (turns > 0)].sum()), abs(float(turns[spins & (turns < 0)].sum())),
    )  # fmt: skip
    stds = dict(zip(ICR_COLUMNS, (float(value) for value in std), strict=True))
    verdicts: dict[str, Excited] = {name: _verdict(value / width) for name, value in stds.items()}
    return Excitation(
        std_m=stds,
        verdicts=verdicts,
        turned_right_rad=right,
        turned_left_rad=left,
        spun_right_rad=spun_right,
        spun_left_rad=spun_left,
        sentences=_sentences(stds, verdicts, right, left, float(way[-1])),
    )


def _nominal(table: States, track_width_m: float | None) -> Floats:
    """Return parameters (7,) near which to ask: the run's final ICRs where they can be, else those of the width."""
    right, left, x = (float(column[-1]) for column in (table.y_icr_right_m, table.y_icr_left_m, table.x_icr_m))
    half = half_width_m(track_width_m)
    if right - left < half or right <= 0.0 or left >= 0.0:
        right, left, x = 1.4 * half, -1.4 * half, 0.0
    return np.array([right, left, x, *NEUTRAL[3:]])


def _posterior(
    d: np.ndarray[Any, np.dtype[np.complex128]], d_by: np.ndarray[Any, np.dtype[np.complex128]], turn_by: Floats,
    turned: Floats, way: Floats, *, position_std: float, heading_std: float, width: float,
) -> Floats:  # fmt: skip
    """Return standard deviations (3,) of the ICRs, heading offset and scales marginalised."""
    # y_r, y_l, x | heading offset, both scales, their difference
    both, difference = d_by[:, 3] + d_by[:, 4], (d_by[:, 3] - d_by[:, 4]) / 2
    place = np.column_stack([d_by[:, :3], 1j * d, both, difference])
    turn_both, turn_difference = turn_by[:, 3] + turn_by[:, 4], (turn_by[:, 3] - turn_by[:, 4]) / 2
    turn = np.column_stack([turn_by[:, :3], np.zeros(len(turned)), turn_both, turn_difference])
    place_noise = np.sqrt(2.0 * position_std**2 + (SLIP_SHARE * way) ** 2)
    turn_noise = np.sqrt(2.0 * heading_std**2 + (SLIP_SHARE * turned) ** 2 + 1e-12)
    rows = np.concatenate(
        [place.real / place_noise[:, None], place.imag / place_noise[:, None], turn / turn_noise[:, None]]
    )
    prior = np.array([width, width, width, HEADING_BIAS_RAD, SCALE_ERROR, SCALE_ERROR])
    information = rows.T @ rows + np.diag(1.0 / prior**2)
    deviations: Floats = np.sqrt(np.diag(np.linalg.solve(information, np.eye(6)))[:3])
    return deviations


def _verdict(share: float) -> Excited:
    if share <= SHOWN_SHARE:
        return "shown"
    return "weak" if share <= WEAK_SHARE else "not shown"


def _sentences(
    stds: dict[str, float], verdicts: dict[str, Excited], right: float, left: float, way_m: float
) -> tuple[str, ...]:
    """Say what is not shown, why, and what to drive."""
    lacking = [name for name, verdict in verdicts.items() if verdict != "shown"]
    if not lacking:
        return ()
    said = ", ".join(f"{WORDS[name]} ({verdicts[name]}, about ± {stds[name]:.2f} m)" for name in lacking)
    first = f"this drive could not show the ICRs well: {said}"
    total = right + left
    if total < TURNS_NEEDED_RAD:
        return (first, f"hardly any turns ({math.degrees(total):.0f}° in all): add two spins each way")
    if min(right, left) < ONE_WAY * max(right, left):
        side = "left" if right > left else "right"
        return (first, f"turns one way only: add two spins, or circles, to the {side}")
    return (first, f"too few turns in {way_m:.0f} m of way for this noise: add two spins each way")
