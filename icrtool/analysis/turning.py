"""Straight and turning trials apart: on a straight way there is no turn for a model to be wrong about."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from icrtool.analysis.driven_run import DrivenRun, drive_of
from icrtool.analysis.dropout import models_of
from icrtool.core.open_loop import trial_ends
from icrtool.core.open_loop_fast import open_loop_errors

SPLIT_HORIZON_M = 5.0
STRAIGHT_RAD = math.radians(10.0)
SPLIT_MODELS = ("icr", "no_slip")


class TurningSplit(NamedTuple):
    """Expected error [m] by model over the trials that turned less than `STRAIGHT_RAD` in all, or more."""

    straight: bool
    horizon_m: float
    trials: int
    expected_m: dict[str, float]


def split_by_turning(run: DrivenRun, horizon_m: float = SPLIT_HORIZON_M) -> tuple[TurningSplit, ...]:
    """Judge straight and turning trials of one horizon apart (Pentzer 2014, Section 6.4, Figs. 33-34).

    Turning is the heading change summed over the way, so that an S counts as turning. A part without trials is left
    out.
    """
    drive = drive_of(run)
    ends = trial_ends(drive, np.array([horizon_m]))
    starts = np.flatnonzero(ends[:, 0] >= 0)
    turned = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(drive.heading)))])
    net = np.abs(drive.heading[ends[starts, 0]] - drive.heading[starts])
    # The filter's heading jitters by measurement noise: summed over the way that is no turn.
    noise = float(np.median(np.abs(np.diff(drive.heading)))) if len(turned) > 1 else 0.0
    summed = turned[ends[starts, 0]] - turned[starts] - noise * (ends[starts, 0] - starts)
    straight = np.maximum(net, np.maximum(summed, 0.0) / 2.0) < STRAIGHT_RAD
    errors = {
        model.name: open_loop_errors(drive, model.icrs, ends)[starts, 0]
        for model in models_of(run)
        if model.name in SPLIT_MODELS
    }
    return tuple(
        TurningSplit(
            kind, horizon_m, int(np.count_nonzero(part)), {name: float(e[part].mean()) for name, e in errors.items()}
        )
        for kind, part in ((True, straight), (False, ~straight))
        if part.any()
    )
