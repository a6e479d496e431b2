"""Trials that cross a slip event are left out on request, and what they cost is reported."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icrtool.config import load_config
from icrtool.dropout_analysis.dropout_report import dropout_report
from icrtool.dropout_analysis.trials import errors_from_states
from icrtool.kernels.track import trial_ends
from icrtool.output.tables.dropout import format_dropout
from icrtool.pipeline import fit
from icrtool.records.dropout_document import column_of
from icrtool.records.measurements import SlipEvent
from icrtool.records.run import Run, track_of
from support.drives import make_log

HORIZONS_M = (1.0, 5.0, 10.0)
EVENT_S = (40.0, 43.0)


@pytest.fixture(scope="module")
def run() -> Run:
    found = fit(make_log(seconds=120.0), load_config(sets=["robot.track_width_m=0.8"]))
    begin, end = (int(found.table.stamp_ns[0] + second * 1e9) for second in EVENT_S)
    event = SlipEvent("slip", begin, end, 0.0, 0.0, 1.0, 0.5, 0.99)
    # the pose of the reference jumps at the event, so that trials across it have large errors
    north = found.table.north_m + 0.5 * (found.table.t_s > sum(EVENT_S) / 2)
    return replace(found, sensors=replace(found.sensors, events=(event,)), table=replace(found.table, north_m=north))


def test_only_trials_across_an_event_are_left_out(run: Run) -> None:
    whole = dropout_report(run, horizons_m=HORIZONS_M, ladder=False)
    report = dropout_report(run, horizons_m=HORIZONS_M, ladder=False, without_events=True)
    cost = report.document.without_events
    assert cost is not None
    assert cost.events == 1
    t = run.table.t_s
    ends = trial_ends(track_of(run), np.array(HORIZONS_M))
    for h, horizon in enumerate(HORIZONS_M):
        last = t[np.maximum(ends[:, h], 0)]
        crossing = (ends[:, h] >= 0) & (t < EVENT_S[1]) & (last > EVENT_S[0])
        left_out = report.document.trials[h].no_trial["across_slip_event"]
        assert left_out == np.count_nonzero(crossing)
        assert report.counts.trials[h] == whole.counts.trials[h] - left_out
        errors = errors_from_states(run, horizon)["icr"]
        icr = report.result("icr")
        assert icr is not None
        kept = errors[np.isfinite(errors) & ~crossing]
        assert icr.column("p95_m")[h] == pytest.approx(np.percentile(kept, 95.0))
        assert cost.with_events["icr"][h].p95_m == pytest.approx(np.nanpercentile(errors, 95.0))
        assert icr.column("expected_error_m")[h] < cost.with_events["icr"][h].expected_error_m
    (row, *_) = report.document.trials
    assert row.trials + sum(row.no_trial.values()) == report.document.starts


def test_the_distance_within_a_budget_is_given_with_and_without_events_from_the_same_trials(run: Run) -> None:
    whole = dropout_report(run, horizons_m=HORIZONS_M, ladder=False, budgets_m=(0.4,))
    without = dropout_report(run, horizons_m=HORIZONS_M, ladder=False, budgets_m=(0.4,), without_events=True)
    quiet = dropout_report(
        replace(run, sensors=replace(run.sensors, events=())), horizons_m=HORIZONS_M, ladder=False, budgets_m=(0.4,)
    )
    for one, free, unknown in zip(
        whole.document.budgets, without.document.budgets, quiet.document.budgets, strict=True
    ):
        # blocks of other starts sum their steps in another order
        assert one.without_events_m == pytest.approx(free.distance_m, abs=1e-9)
        assert one.beyond_without_events == free.beyond
        assert one.distance_m == unknown.distance_m <= one.without_events_m
        assert unknown.without_events_m is None
    icr = next(one for one in whole.document.budgets if one.model == "icr")
    assert icr.distance_m < icr.without_events_m
    rows = {row.model: row for row in whole.document.budgets}
    assert rows["icr"].without_events_m == icr.without_events_m
    for result, free in zip(whole.results, without.results, strict=True):
        np.testing.assert_allclose(column_of(result.without_events, "p95_m"), free.column("p95_m"), rtol=1e-9)
        np.testing.assert_array_equal(column_of(result.without_events, "trials"), free.column("trials"))


def test_the_cost_is_printed_and_a_log_without_events_says_so(run: Run) -> None:
    text = format_dropout(dropout_report(run, horizons_m=HORIZONS_M, ladder=False, without_events=True))
    assert "1 slip event left out: icr after" in text
    assert "across a slip event" in text
    quiet = replace(run, sensors=replace(run.sensors, events=()))
    report = dropout_report(quiet, horizons_m=HORIZONS_M, ladder=False, without_events=True)
    assert report.document.without_events is not None
    assert not any(row.no_trial["across_slip_event"] for row in report.document.trials)
    assert "none in this log" in format_dropout(report)
