"""Dropout analysis without slip events: trials that cross one are left out, and their cost is measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from icrtool.dropout_analysis.report import DropoutReport
from icrtool.dropout_analysis.starts import Starts
from icrtool.dropout_analysis.trials import dropout
from icrtool.records.dropout import EventCost
from icrtool.records.run import Run


def leave_out_events(run: Run) -> Run:
    """Return the run with a gap in place of each slip event: no trial, window or forced outage crosses a gap."""
    return replace(run, in_gap=run.in_gap | run.slipping)


def with_event_cost(report: DropoutReport, run: Run, *, starts: Starts, seed: int) -> DropoutReport:
    """Return the report of `leave_out_events` with what the slip events cost.

    Parameters
    ----------
    run : with its slip events
    """
    horizons: Sequence[float] = report.horizons_m.tolist()
    whole = dropout(run, horizons, starts=starts, seed=seed)
    cost = EventCost(
        events=len(run.sensors.events),
        trials=whole.counts.trials - report.counts.trials,
        with_events={result.name: result.summary for result in whole.results},
    )
    # starts at a gap, at an outage or at a standstill are counted as without the option
    counts = whole.counts._replace(trials=report.counts.trials)
    return replace(report, counts=counts, event_cost=cost)
