"""The fits of the ladder: every model to every complement of a block, and which extended model each may use."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from icrtool.motion.window_fit import WindowFit, Windows, thin_windows
from icrtool.motion.window_models import CONSTANT, EXTENDED, MULTIPLIER, WindowModel
from icrtool.motion.window_solve import Solution, drop_windows, fit_of, solve_windows
from icrtool.records.dropout import CHOICE_HORIZON_M
from icrtool.records.tables import Bools, Floats

FITS_AT_ONCE = 2

WORTHWHILE = 0.95
"""An extended model is chosen only where it brings the expected error below this part of the plain window fit's."""

FEWEST_TO_CHOOSE = 3
"""With fewer blocks, what is left beside the one judged cannot be cut once more to choose a model."""

CHOICES: tuple[WindowModel, ...] = (CONSTANT, *EXTENDED)


class BlockFits(NamedTuple):
    """Parameters to judge, and to paste.

    Attributes
    ----------
    held_out : by model name, ``extended`` among them, the parameters (blocks, 8) fitted without each block
    chosen : name of the extended model chosen for each block
    whole : of all windows, by model name
    best : the model cross-validation prefers for the whole log
    """

    held_out: dict[str, Floats]
    chosen: tuple[str, ...]
    whole: dict[str, WindowFit]
    best: str


def fit_blocks(windows: Windows, edges_m: Floats) -> BlockFits:
    """Fit all models without each block in turn, and to all of the way.

    Parameters
    ----------
    windows : of `cut_windows`
    edges_m : inner borders of the blocks [m]

    Notes
    -----
    The extended model of a block is chosen by a second cross-validation among the other blocks, from its fit without
    the block alone: windows of another one are taken out to first order (`drop_windows`).
    """
    thin, blocks = thin_windows(windows), len(edges_m) + 1
    everything = np.ones(len(windows.start), np.bool_)
    clear = [clear_of(windows, edges_m, block) for block in range(blocks)]
    inside = [_inside(windows, edges_m, block) for block in range(blocks)]
    with ThreadPoolExecutor(FITS_AT_ONCE) as pool:
        jobs = [pool.submit(_fit_all, thin, kept) for kept in (everything, *clear)]
        whole, *solved = (job.result() for job in jobs)
        chosen = tuple(pool.map(lambda block: _choose(solved[block], clear, inside, block), range(blocks)))
    held_out = {name: np.array([fits[name].parameters for fits in solved]) for name in whole}
    held_out["extended"] = np.array([fits[name].parameters for fits, name in zip(solved, chosen, strict=True)])
    scores = {
        model.name: _score([_errors(fits[model.name].misses, here) for fits, here in zip(solved, inside, strict=True)])
        for model in CHOICES
    }
    return BlockFits(held_out, chosen, {name: fit_of(one, windows) for name, one in whole.items()}, _prefer(scores))


def clear_of(windows: Windows, edges_m: Floats, block: int) -> Bools:
    """Say which windows share no way with a block; `edges_m` are the inner borders of the blocks [m]."""
    begin, end = _borders(edges_m, block)
    clear: Bools = (windows.end_m <= begin) | (windows.start_m >= end)
    return clear


def _borders(edges_m: Floats, block: int) -> tuple[float, float]:
    borders = np.concatenate([[-math.inf], edges_m, [math.inf]])
    return float(borders[block]), float(borders[block + 1])


def _inside(windows: Windows, edges_m: Floats, block: int) -> Bools:
    """Say which windows of the length that choices are made at lie within a block."""
    begin, end = _borders(edges_m, block)
    inside: Bools = (windows.start_m >= begin) & (windows.end_m <= end) & (windows.length_m == CHOICE_HORIZON_M)
    return inside


def _fit_all(windows: Windows, kept: Bools) -> dict[str, Solution]:
    """Fit every model to some windows, each from a simpler one's fit to the same."""
    fits = {MULTIPLIER.name: solve_windows(windows, MULTIPLIER, kept)}
    fits[CONSTANT.name] = solve_windows(windows, CONSTANT, kept, fits[MULTIPLIER.name])
    for model in EXTENDED:
        fits[model.name] = solve_windows(windows, model, kept, fits[CONSTANT.name])
    return fits


def _choose(fits: dict[str, Solution], clear: Sequence[Bools], inside: Sequence[Bools], block: int) -> str:
    """Choose the model of a block by its fits without it; the plain one where there are too few blocks."""
    if len(clear) < FEWEST_TO_CHOOSE:
        return CONSTANT.name
    others = [other for other in range(len(clear)) if other != block]
    scores = {}
    for model in CHOICES:
        fit, errors = fits[model.name], []
        for other in others:
            misses = drop_windows(fit, clear[block] & ~clear[other])
            errors.append(_errors(misses, inside[other]))
        scores[model.name] = _score(errors)
    return _prefer(scores)


def _errors(misses: Floats, here: Bools) -> Floats:
    """Return the lengths (m,) of the misses (2 w,) marked in `here` (w,), all of windows of one length."""
    count = len(here)
    lengths: Floats = np.hypot(misses[:count][here], misses[count:][here])
    return lengths


def _score(errors: Sequence[Floats]) -> float:
    """Return the expected error over blocks; infinite where there is nothing to go by."""
    together = np.concatenate(errors)
    return float(together.mean()) if len(together) else math.inf


def _prefer(scores: dict[str, float]) -> str:
    """Return the model of the least expected error, the plain one unless another is clearly better."""
    best = min(scores, key=lambda name: scores[name] if math.isfinite(scores[name]) else math.inf)
    return best if scores[best] < WORTHWHILE * scores[CONSTANT.name] else CONSTANT.name
