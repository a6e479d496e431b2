"""Open-loop trials: inputs and outputs of the kernels.

No kernel is here: a process that only reads or draws these records need not load numba.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icrtool.kernels.arrays import Floats, Ints


class FrozenIcrs(NamedTuple):
    """The ICRs a trial from state k drives with. Each of shape (n,), or (1,) for one triple from every start.

    Attributes
    ----------
    y_icr_right, y_icr_left, x_icr : float64 [m], body frame
    """

    y_icr_right: Floats
    y_icr_left: Floats
    x_icr: Floats

    @classmethod
    def constant(cls, y_icr_right: float, y_icr_left: float, x_icr: float) -> FrozenIcrs:
        """Return one triple [m] for every start: no-slip is ``(b/2, -b/2, 0)``."""
        return cls(np.array([y_icr_right]), np.array([y_icr_left]), np.array([x_icr]))


class OpenLoopPath(NamedTuple):
    """An open-loop path from a start state to an end state, both included; float64 (m,) [m, m, rad]."""

    north: Floats
    east: Floats
    heading: Floats


class TrialCounts(NamedTuple):
    """How many starts were a trial, and why the others were none; int64 (n_horizons,) each."""

    trials: Ints
    short: Ints
    gap: Ints
    outage: Ints
    standing: Ints
    crosses_jump: Ints


class Summary(NamedTuple):
    """Errors of one model, per horizon; (n_horizons,) each, NaN where there was no trial.

    Attributes
    ----------
    trials : int64
    expected, p50, p95, largest : float64 [m]; the expected error is the mean
    """

    trials: Ints
    expected: Floats
    p50: Floats
    p95: Floats
    largest: Floats


class Intervals(NamedTuple):
    """Confidence intervals of the expected error and of p95, per horizon; float64 (n_horizons,) [m] each.

    NaN where the path with trials is shorter than `icrtool.kernels.open_loop.error_statistics.MIN_BLOCKS` horizons.
    """

    expected_low: Floats
    expected_high: Floats
    p95_low: Floats
    p95_high: Floats


class Histogram(NamedTuple):
    """Share of trials by error: float64 (n_bins,) each, bins ``[left, right)`` [m] from zero on, percent of all."""

    left: Floats
    right: Floats
    percent: Floats
