"""What a user should know before trusting a run, in words."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from icrtool.analysis.adaptive_run import AdaptedRun
from icrtool.analysis.filter_setup import configured_process_position_mps
from icrtool.config import Config
from icrtool.core.ekf import GATED, UNSEEN
from icrtool.core.kinematics import MIN_ICR_SEPARATION_M
from icrtool.tables import States

if TYPE_CHECKING:
    from icrtool.analysis.fit import MeasurementOutcome

LITTLE_WAY_M, LITTLE_TURN_RAD = 1.0, math.radians(20.0)
"""What drives and turns less has shown nothing of the ICRs."""


def adaptation_notes(name: str, config: Config, adapted: AdaptedRun) -> list[str]:
    """Say what was done about clocks and wheels that contradict the position reference."""
    notes = []
    if config.frames.reference_delay_s == "auto" and adapted.reference_delay_s:
        side = "late" if adapted.reference_delay_s > 0 else "early"
        notes.append(
            f"{name}: the position reference is {abs(adapted.reference_delay_s):.2f} s {side} against the wheels: "
            "taken out; frames.reference_delay_s sets it"
        )
    if adapted.process_position_mps != configured_process_position_mps(config):
        notes.append(
            f"{name}: the wheels contradict the position reference (held samples, clock offsets, slip): "
            f"position noise raised to {adapted.process_position_mps:.1f} m/s; filter.process_position_mps sets it"
        )
    return notes


def doubts(name: str, table: States, gnss: MeasurementOutcome) -> list[str]:
    """Return what a user should know before trusting the numbers."""
    found = []
    distance, turns = float(table.distance_m[-1]), _turns(table)
    if distance < LITTLE_WAY_M and not turns:
        found.append(f"the robot drove {distance:.2f} m: the ICRs are the start's, nothing was learned")
    elif not turns:
        found.append("the robot hardly turned: the ICRs are not observable on a straight drive")
    if table.y_icr_right_m[-1] <= table.y_icr_left_m[-1]:
        found.append(
            "the ICRs ended inverted (right not right of left): do not use them; check sides and signs of the wheels"
        )
    seen = int(np.count_nonzero(gnss.code > UNSEEN))
    gated = int(np.count_nonzero(gnss.code == GATED))
    if seen and gated > 0.1 * seen:
        found.append(
            f"{100 * gated / seen:.0f} % of the fixes were rejected: "
            "clocks, antenna place or fix quality do not fit the wheels"
        )
    return [f"{name}: {doubt}" for doubt in found]


def _turns(table: States) -> bool:
    """Say whether the robot turned enough to show its ICRs: by the heading and, if it went nowhere, by the wheels too.

    A parked robot whose heading drifts has learned nothing, and one that spun on the spot has.
    """
    turned = float(np.ptp(table.heading_rad))
    if float(table.distance_m[-1]) < LITTLE_WAY_M:
        width = float(table.y_icr_right_m[-1] - table.y_icr_left_m[-1])
        ahead = np.cumsum(np.diff(table.t_s) * (table.v_left_mps - table.v_right_mps)[:-1])
        turned = min(turned, float(np.ptp(ahead)) / max(abs(width), MIN_ICR_SEPARATION_M))
    return turned >= LITTLE_TURN_RAD
