"""Check of the rows of a report: each needs enough trials, and two rows must not contradict each other."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from icrtool.dropout_analysis.report import OpenLoopErrors
from icrtool.motion.recording import LONGEST_RECORDING_STEP_S, MOST_TRIALS
from icrtool.records.acceptance import CHOICE_HORIZON_M
from icrtool.records.notes import Note, note
from icrtool.records.rows import FALLBACK_ROW, MAIN_ROW
from icrtool.records.run import ICR_COLUMNS, ICR_WORDS
from icrtool.records.run_document import RunDocument

FEWEST_TRIALS = 30
"""Smallest number of trials of a row. The 95th percentile of fewer trials is their largest or second largest error."""

SMALLEST_SHARE_TRIED = 0.1
"""Smallest share of the starts for which a row has an error. With less, only a part of the drive was tested."""

LARGEST_ROW_RATIO = 3.0
"""Ratio of the errors of `recommended` and `icr` above which the two rows contradict each other."""


def why_unusable(document: RunDocument, errors: OpenLoopErrors, held_out: Iterable[str]) -> Note | None:
    """Return why the rows of a report must not be used; None if they can be used.

    Parameters
    ----------
    document : document of the run
    errors : errors of the rows
    held_out : names of the rows that are tested on distance that they were not fitted to

    Notes
    -----
    Rows are compared at the horizon nearest to `CHOICE_HORIZON_M` at which each has `FEWEST_TRIALS`. Starts of trials
    of held-out rows are up to `LONGEST_RECORDING_STEP_S` apart, at most `MOST_TRIALS` of a drive.
    """
    rows = {result.name: result.document.by_horizon for result in errors.results}
    names = [name for name in held_out if name in rows]
    if not names:
        return None
    trials = np.array([[row.trials for row in rows[name]] for name in names])
    enough = np.flatnonzero(trials.min(axis=0) >= FEWEST_TRIALS)
    compared = enough if len(enough) else np.arange(len(errors.horizons_m))
    h = int(compared[np.abs(errors.horizons_m[compared] - CHOICE_HORIZON_M).argmin()])
    horizon, least = f"{errors.horizons_m[h]:g} m", int(trials[:, h].argmin())
    seconds = int(errors.counts.trials[h]) * document.drive.duration_s / max(errors.states, 1)
    expected = min(int(errors.counts.trials[h]), seconds / LONGEST_RECORDING_STEP_S, MOST_TRIALS)
    if trials[least, h] < max(FEWEST_TRIALS, SMALLEST_SHARE_TRIED * expected):
        few = f"{names[least]} has only {trials[least, h]:,} trials of {horizon}"
        if errors.counts.trials[h] < FEWEST_TRIALS:
            return note("few_trials", f"{few}: the drive is too short; drive further")
        icr_text = f"and icr has {errors.counts.trials[h]:,}"
        return note("few_trials", f"{few}, {icr_text}; check the stamps of the wheels (icrtool info -v)")
    hidden = [ICR_WORDS[column] for column in ICR_COLUMNS[:2] if document.icr_of_drive(column) is None]
    icr, recommended = (rows[name][h].p95_m if name in rows else None for name in (FALLBACK_ROW, MAIN_ROW))
    if not hidden or icr is None or recommended is None:
        return None
    if max(icr, recommended) <= LARGEST_ROW_RATIO * min(icr, recommended):
        return None
    apart = f"{FALLBACK_ROW} errs by {icr:.3g} m and {MAIN_ROW} by {recommended:.3g} m after {horizon} (95 %)"
    text = f"the drive does not show {' and '.join(hidden)}, and {apart}: wheels and fixes contradict each other"
    return note("rows_contradict", text)
