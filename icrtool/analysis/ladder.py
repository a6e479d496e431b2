"""The ladder of models, each judged on way it was not fitted to, all on the same trials.

A run is cut by path length into contiguous blocks. What is fitted is fitted on windows that keep clear of the block
held out, and judged on the trials that lie entirely within it; extended models are also *chosen* without it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from icrtool.analysis.dropout import DrivenRun, drive_of
from icrtool.analysis.window_fit import (
    CONSTANT,
    EXTENDED,
    MULTIPLIER,
    WindowFit,
    WindowModel,
    Windows,
    cut_windows,
    fit_windows,
)
from icrtool.core.open_loop import Drive, FrozenIcrs, trial_ends
from icrtool.core.open_loop_fast import open_loop_errors
from icrtool.core.statistics import Summary, summarise
from icrtool.errors import DataError
from icrtool.tables import Bools, Floats, HeadingSamples, Ints

HORIZONS_M = (5.0, 10.0, 20.0)
SHORTEST_BLOCK_M = 25.0
MOST_BLOCKS = 5
CHOICE_HORIZON_M = 10.0
WORTHWHILE = 0.95
"""An extended model is chosen only where it brings the expected error below this part of the plain window fit's."""


@dataclass(frozen=True, slots=True)
class Rung:
    """One model's held-out errors.

    Attributes
    ----------
    name : ``no_slip``, ``multiplier``, ``icr``, ``icr_final``, ``window``, ``extended``, and each with ``_heading``
    fitted : ``never``, ``before`` (from the states up to the start), ``all`` (in sample), ``others`` (held out)
    """

    name: str
    label: str
    fitted: str
    measured_heading: bool
    summary: Summary


@dataclass(frozen=True, slots=True)
class Ladder:
    """The table.

    Attributes
    ----------
    blocks : held out one after the other
    chosen : name of the extended model chosen for each block
    fits : of all windows, by model name: what to paste, not what was judged
    best : the model cross-validation prefers for the whole log
    held_out : by model name, the fits of each block's complement
    heading_is_reference : the heading comes from the same topic as the position
    """

    horizons_m: tuple[float, ...]
    blocks: int
    rungs: tuple[Rung, ...]
    chosen: tuple[str, ...]
    fits: dict[str, WindowFit]
    best: str
    held_out: dict[str, tuple[WindowFit, ...]]
    heading_is_reference: bool

    def rung(self, name: str) -> Rung:
        """Return a rung by name."""
        return next(rung for rung in self.rungs if rung.name == name)


class _Trials(NamedTuple):
    """Trials within blocks: `ends` (n, h), negative where there is none; block of each state (n,)."""

    drive: Drive
    t: Floats
    ends: Ints
    block: Ints


def count_blocks(distance_m: float) -> int:
    """Return into how many blocks a drive of this length is cut."""
    return int(np.clip(distance_m // SHORTEST_BLOCK_M, 2, MOST_BLOCKS))


def judge_ladder(
    run: DrivenRun,
    heading: HeadingSamples | None = None,
    *,
    heading_offset_rad: float = 0.0,
    heading_is_reference: bool = False,
    horizons_m: Sequence[float] = HORIZONS_M,
) -> Ladder:
    """Judge every model on way it was not fitted to.

    Parameters
    ----------
    run : a finished run, or one read back
    heading : measured headings, for the models that need not turn by wheels alone; None: these are left out
    heading_offset_rad : subtracted from them
    heading_is_reference : they come from the position reference, and are as good as it is
    horizons_m : ascending, with 10 m among them

    Raises
    ------
    DataError
        The drive is too short to hold anything out.
    """
    table, distance = run.table, run.table.distance_m
    total = float(distance[-1])
    if total < 2.0 * CHOICE_HORIZON_M:
        raise DataError(run.name, f"{total:.1f} m of way", "too short to fit on one part and judge on another")
    windows, blocks = cut_windows(run), count_blocks(total)
    edges = np.linspace(0.0, total, blocks + 1)[1:-1]
    drive, block = drive_of(run), np.searchsorted(edges, distance, side="right")
    ends = trial_ends(drive, np.array(horizons_m, np.float64))
    trials = _Trials(drive, table.t_s, np.where((ends >= 0) & (block[ends] == block[:, None]), ends, -1), block)
    clear = [_clear_of(windows, edges, held) for held in range(blocks)]
    plain = (MULTIPLIER, CONSTANT)
    held_out = {
        model.name: tuple(fit_windows(windows.keep(clear[held]), model) for held in range(blocks))
        for model in (*plain, *EXTENDED)
    }
    errors = {
        name: np.stack([_predict(trials, fit.parameters) for fit in fits]) for name, fits in held_out.items() if fits
    }
    judged = {name: _by_block(stack, block) for name, stack in errors.items()}
    chosen = _choose(trials, windows, clear, list(horizons_m).index(CHOICE_HORIZON_M))
    judged["extended"] = np.select([(block == k)[:, None] for k in range(blocks)], [errors[c][k] for k, c in enumerate(chosen)], np.nan)
    return judged  # type: ignore[return-value]
