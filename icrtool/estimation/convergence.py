"""Convergence times of the ICRs of a run, from their estimates (Pentzer 2014, Section 5.2) or standard deviations."""

from __future__ import annotations

import numpy as np

from icrtool.kernels.arrays import Floats, runs_of
from icrtool.records.run import ICR_COLUMNS, Run
from icrtool.records.run_document import IcrColumn
from icrtool.records.tables import States

ARRIVED_S = 2.0
"""Time for which a converged estimate must stay within 10 % of its final change [s]. An overshoot crosses this range
faster."""

SMALLEST_CHANGE_M = 0.03
"""Smallest change of an estimate that shows its convergence [m]. A smaller change is replaced by the standard
deviation."""

LEARNED_SHARE = 0.9
"""Share of the decrease of its standard deviation after which an ICR is learned."""

LEAST_FALL = 0.5
"""Smallest relative decrease of a standard deviation. An ICR whose
standard deviation decreases less is not learned."""


def converge(table: States, until_s: float | None = None) -> dict[IcrColumn, tuple[float, float] | None]:
    """Return when each ICR estimate converged.

    Parameters
    ----------
    table : the recorded states
    until_s : end of the used states, since the first state; None: all are used

    Returns
    -------
    dict
        By column: time [s] at which the estimate has made 10 % of the change from its start to its settled value
        (median over the second half of the run), and time from which it stays within 10 % of this change for
        `ARRIVED_S`; None if it never settles. For an estimate that starts near its settled value (10 % of the change is
        less than its settled standard deviation): the times at which its standard deviation has made 10 % and 90 % of
        its decrease; None if it decreases by less than half.

    Notes
    -----
    Pentzer 2014, Section 5.2: the time from 10 % of the change until within 90 % of the final value. An estimate that
    happens to start at its final value has no such time, although the filter did not know that it was right.
    """
    rows = max(int(np.searchsorted(table.t_s, until_s)), 1) if until_s is not None else len(table)
    t_s = table.t_s[:rows]
    return {
        column: _span(t_s, getattr(table, column)[:rows], getattr(table, f"std_{column}")[:rows])
        for column in ICR_COLUMNS
    }


def _span(t_s: Floats, estimate: Floats, std: Floats) -> tuple[float, float] | None:
    """Return start and end [s] of the convergence of an estimate (n,) with a standard deviation (n,)."""
    settled, noise = (float(np.median(column[len(column) // 2 :])) for column in (estimate, std))
    change = settled - float(estimate[0])
    if abs(change) < max(SMALLEST_CHANGE_M, noise / (1.0 - LEARNED_SHARE)):
        begin, end = (fallen_at(std, share) for share in (1.0 - LEARNED_SHARE, LEARNED_SHARE))
        return None if begin is None or end is None else (float(t_s[begin]), float(t_s[end]))
    gone = (estimate - estimate[0]) / change
    first = int(np.argmax(np.abs(gone) >= 0.1))
    begins, behind = runs_of(np.abs(gone - 1.0) <= 0.1)
    settled_by = np.searchsorted(t_s, t_s[begins] + ARRIVED_S)
    stays = begins[(settled_by <= behind) & (settled_by < len(t_s))]
    return (float(t_s[first]), float(t_s[stays[0]])) if len(stays) else None


def fallen_at(std: Floats, share: float = LEARNED_SHARE) -> int | None:
    """Return the first state at which a standard deviation (n,) has made a share of its decrease.

    None if it decreases by less than `LEAST_FALL`.

    Notes
    -----
    The standard deviation decreases from s_0 at the first state to s_f, its median over the second half of the states.
    It has made the share at the first state with s <= s_f + (1 - share) (s_0 - s_f).
    """
    first, final = float(std[0]), float(np.median(std[len(std) // 2 :]))
    if final > (1.0 - LEAST_FALL) * first:
        return None
    return int(np.argmax(std <= final + (1.0 - share) * (first - final)))


def icr_std_m(run: Run, column: IcrColumn) -> Floats:
    """Return the standard deviation (n,) of an ICR [m] at each recorded state; the last is ``final_std`` of run.json.

    If the drive does not show the ICR, the filter's standard deviation (states.csv) is returned.

    Notes
    -----
    The filter's variance follows from its process noise; ``final_std`` follows from the differences between stretches
    of the drive (`icrtool.estimation.observability.final_covariance`). With the filter's variance P(t), the information
    that it has gained since the start is 1/P(t) - 1/P(0). This information is multiplied by one factor, so that the
    last value is ``final_std``. The start stays as configured, and the part of the clocks in x is added. Where the
    filter knows no more at the end than at the start (a warm start), the difference or the ratio of the variances is
    applied instead.
    """
    filter_std: Floats = np.asarray(getattr(run.table, f"std_{column}"), np.float64)
    final = run.document.icr.final_std[column]
    if final is None or not filter_std[-1] > 0.0:
        return filter_std
    clock = min(run.document.icr.x_clock_std_m, final) if column == "x_icr_m" else 0.0
    variance, first, end = filter_std**2, float(filter_std[0]) ** 2, final**2 - clock**2
    if 0.0 < end < first and variance[-1] < first:
        gained = 1.0 / variance - 1.0 / first
        factor = (1.0 / end - 1.0 / first) / gained[-1]
        # After a change of ground the filter may know less than at the start. Its own variance is then used.
        counted = 1.0 / (1.0 / first + np.where(gained > 0.0, factor * gained, min(factor, 1.0) * gained))
    elif end >= variance[-1]:
        counted = variance + (end - variance[-1])
    else:
        counted = variance * (end / variance[-1])
    return np.asarray(np.sqrt(counted + clock**2))
