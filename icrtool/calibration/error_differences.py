"""Differences of open-loop errors with intervals that respect that neighbouring trials share their distance."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.open_loop.block_sums import LEVEL
from icrtool.kernels.open_loop.error_statistics import error_summary
from icrtool.kernels.track import Track
from icrtool.records.dropout import DEFAULT_SEED

RESAMPLES = 300

SHORTEST_BLOCK_M = 10.0

FEWEST_BLOCKS = 3
"""With fewer blocks there is no interval."""

SAME_ROUTE_M = 1.0
"""Two drives took the same route where they are nowhere further apart at the same distance."""


class ErrorEstimate(NamedTuple):
    """Errors, or differences of errors, with 95 % intervals [m]; NaN where there is none."""

    p95_m: float
    p95_low_m: float
    p95_high_m: float
    expected_m: float
    expected_low_m: float
    expected_high_m: float


def compare_errors(
    first: Floats, first_block: Ints, second: Floats, second_block: Ints, *, paired: bool, seed: int = DEFAULT_SEED
) -> ErrorEstimate:
    """Return p95 and mean of errors, second minus first.

    Parameters
    ----------
    first, second : (k,), (m,) [m], NaN for no trial
    first_block, second_block : (k,), (m,) stretch of distance in which each trial starts
    paired : equal numbers of blocks are the same stretch: they are drawn together
    seed : of the bootstrap

    Notes
    -----
    Bootstrap over blocks (Kuensch 1989); paired blocks keep what is hard in a stretch for both out of the difference.
    """
    sides = [_by_block(first, first_block), _by_block(second, second_block)]
    if paired:
        shared = sorted(sides[0].keys() & sides[1].keys())
        sides = [{block: side[block] for block in shared} for side in sides]
    if not all(sides):
        return ErrorEstimate(*([float("nan")] * 6))
    p95, mean = _difference([np.concatenate(list(side.values())) for side in sides])
    if min(len(side) for side in sides) < FEWEST_BLOCKS:
        return ErrorEstimate(p95, np.nan, np.nan, mean, np.nan, np.nan)
    rng = np.random.default_rng(seed)
    lists = [list(side.values()) for side in sides]
    found = np.empty((RESAMPLES, 2))
    for resample in found:
        drawn = [rng.integers(len(side), size=len(side)) for side in lists]
        drawn[1] = drawn[0] if paired else drawn[1]
        resample[:] = _difference(
            [np.concatenate([side[i] for i in rows]) for side, rows in zip(lists, drawn, strict=True)]
        )
    low, high = np.percentile(found, [50.0 * (1.0 - LEVEL), 50.0 * (1.0 + LEVEL)], axis=0)
    return ErrorEstimate(p95, float(low[0]), float(high[0]), mean, float(low[1]), float(high[1]))


def blocks_of(path_m: Floats, horizon_m: float) -> Ints:
    """Return the block (k,) of each trial by the path length at its start (k,): as long as the horizon at least."""
    return np.floor(path_m / max(horizon_m, SHORTEST_BLOCK_M)).astype(np.int64)


def same_route(first: Track, second: Track) -> bool:
    """Return whether two drives took the same route at the same distance."""
    ends = [float(one.distance[-1]) for one in (first, second)]
    if abs(ends[1] - ends[0]) > 0.05 * min(ends):
        return False
    at = np.arange(0.0, min(ends), 1.0)
    places = [np.interp(at, one.distance, one.north) + 1j * np.interp(at, one.distance, one.east)
              for one in (first, second)]  # fmt: skip
    return bool(np.abs(places[1] - places[0]).max() < SAME_ROUTE_M)


def _by_block(errors: Floats, block: Ints) -> dict[int, Floats]:
    some = np.isfinite(errors)
    errors, block = errors[some], block[some]
    order = np.argsort(block, kind="stable")
    numbers, first = np.unique(block[order], return_index=True)
    return dict(zip(numbers.tolist(), np.split(errors[order], first[1:]), strict=True)) if len(numbers) else {}


def _difference(sides: list[Floats]) -> tuple[float, float]:
    before, after = (error_summary(side[:, None]) for side in sides)
    return float(after.p95[0] - before.p95[0]), float(after.expected[0] - before.expected[0])
