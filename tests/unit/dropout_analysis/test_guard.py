"""Reports that must not be used: too few trials in a row, or rows that contradict each other."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import pytest

from icrtool.config import parse_config
from icrtool.dropout_analysis.dropout_report import dropout_report
from icrtool.dropout_analysis.guard import why_unusable
from icrtool.dropout_analysis.report import DropoutReport
from icrtool.output.tables.dropout import format_dropout
from icrtool.pipeline import fit
from icrtool.records.dropout_document import ModelResult
from icrtool.records.notes import note
from icrtool.records.run import Run
from icrtool.records.run_document import GeometryDocument, RunDocument
from support.barn import TRACK_WIDTH_M, simulate
from support.drives import make_log

HELD_OUT = ["controller", "recommended"]


@pytest.fixture(scope="module")
def run() -> Run:
    return fit(simulate(), parse_config({"robot": {"track_width_m": TRACK_WIDTH_M}}))


@pytest.fixture(scope="module")
def report(run: Run) -> DropoutReport:
    return dropout_report(run)


def changed(report: DropoutReport, name: str, **numbers: float) -> DropoutReport:
    """Return a report whose row `name` has these numbers at every horizon."""

    def of(one: ModelResult) -> ModelResult:
        rows = [msgspec.structs.replace(row, **numbers) for row in one.document.by_horizon]
        return one._replace(document=msgspec.structs.replace(one.document, by_horizon=rows))

    return replace(report, results=tuple(of(one) if one.name == name else one for one in report.results))


def not_shown(document: RunDocument) -> RunDocument:
    """Return the document of a run that does not show its y ICRs."""
    return msgspec.structs.replace(document, geometry=GeometryDocument(covariance_m2=[[1.0] * 3] * 3))


def test_a_report_of_a_sound_run_is_usable(report: DropoutReport) -> None:
    assert report.document.usable
    assert why_unusable(report.run_document, report, HELD_OUT) is None


@pytest.mark.parametrize("trials", [29, 4])
def test_a_row_of_few_trials_makes_the_run_unusable(report: DropoutReport, trials: int) -> None:
    why = why_unusable(report.run_document, changed(report, "recommended", trials=trials), HELD_OUT)
    assert why is not None
    assert why.code == "few_trials"
    assert f"recommended has only {trials} trials of 10 m, and icr has " in why.text


def test_rows_that_contradict_each_other_do_so_only_where_the_icrs_are_not_shown(report: DropoutReport) -> None:
    apart = changed(changed(report, "icr", p95_m=0.4), "recommended", p95_m=1.3)
    assert why_unusable(report.run_document, apart, HELD_OUT) is None
    why = why_unusable(not_shown(report.run_document), apart, HELD_OUT)
    assert why is not None
    assert why.code == "rows_contradict"
    assert "does not show y right and y left, and icr errs by 0.4 m and recommended by 1.3 m after 10 m" in why.text
    near = changed(apart, "recommended", p95_m=1.1)
    assert why_unusable(not_shown(report.run_document), near, HELD_OUT) is None


def test_the_report_of_such_a_run_states_no_distance_and_fails_its_limits(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    why = "recommended has only 4 trials of 10 m"
    monkeypatch.setattr("icrtool.dropout_analysis.dropout_report.why_unusable", lambda *_: note("few_trials", why))
    found = dropout_report(run, horizons_m=[5.0, 10.0], gates=["recommended.p95@10m <= 100"])
    assert (found.document.usable, found.document.unusable_because) == (False, why)
    assert found.document.budgets == ()
    assert found.document.recommended is None
    assert not found.passed
    printed = format_dropout(found)
    assert printed.startswith(f"Do not use: {why}")
    assert "How far within" not in printed
    allowed = dropout_report(run, horizons_m=[5.0, 10.0], gates=["recommended.p95@10m <= 100"], allow_unusable=True)
    assert allowed.passed
    assert not allowed.document.usable


def test_the_trials_that_are_printed_are_those_of_the_first_row() -> None:
    # at 50 Hz a trial of a held-out row starts at every fifth sample
    found = dropout_report(fit(make_log(), parse_config({"robot": {"track_width_m": 0.7}})))
    first, icr = found.result("controller"), found.result("icr")
    assert first is not None
    assert icr is not None
    h = found.horizons_m.tolist().index(10.0)
    trials = first.document.by_horizon[h].trials
    assert trials < icr.document.by_horizon[h].trials
    assert f"{trials:,} trials of 10 m" in format_dropout(found)
