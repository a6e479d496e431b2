"""The report as text: on the terminal, as JUnit XML and as Markdown."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree as ET

import msgspec
import pytest

from icrtool.config import Config
from icrtool.dropout_analysis.dropout_report import dropout, dropout_report
from icrtool.dropout_analysis.report import DropoutReport
from icrtool.errors import OutputError, RunError
from icrtool.output.exports.acceptance import format_outcomes, suite_of, write_junit
from icrtool.output.files.atomic import check_place
from icrtool.output.tables.dropout import format_dropout, p95_at, reach_rows, reach_section
from icrtool.output.tables.errors import shown_horizons
from icrtool.output.text_format import error_text
from icrtool.records.acceptance import BudgetDistance
from icrtool.records.run import Run
from support.reports import with_content, with_run

HORIZONS_M = [0.5, 1.0, 5.0, 9.0, 30.0]
GATES = ("icr.p95@5m <= 100", "icr.p95@5m <= 0.001")


def content_of(run: Run, horizons_m: list[float], gates: tuple[str, ...] = ()) -> DropoutReport:
    return dropout_report(run, horizons_m=horizons_m, gates=gates, budgets_m=(0.05, 50.0), outage_s=(), ladder=False)


@pytest.fixture(scope="module")
def content(run: Run) -> DropoutReport:
    return content_of(run, HORIZONS_M, GATES)


def row_of(text: str, begin: str) -> list[str]:
    words = begin.split()
    return next(line.split()[len(words) :] for line in text.splitlines() if line.split()[: len(words)] == words)


def test_the_table_shows_the_horizons_nearest_to_1_5_10_and_20_m(content: DropoutReport) -> None:
    assert shown_horizons(content.horizons_m) == [1, 2, 3, 4]
    assert row_of(format_dropout(content), "distance without GNSS") == ["1", "m", "5", "m", "9", "m", "30", "m"]


def test_the_table_has_every_model_in_metres_and_percent_and_the_ratio(content: DropoutReport) -> None:
    text = format_dropout(content)
    icr, no_slip = content.result("icr"), content.result("no_slip")
    assert icr is not None
    assert no_slip is not None
    p95 = float(icr.column("p95_m")[1])
    assert row_of(text, "icr             95 %")[:4] == [f"{p95:.3f}", "m", f"{100 * p95:.1f}", "%"]
    ratio = float(no_slip.column("p95_m")[1]) / p95
    assert row_of(text, "no_slip / icr   95 %")[:2] == [f"{ratio:.1f}", "x"]
    assert "icr_final" in text
    assert max(len(line) for line in text.splitlines()) <= 100
    assert not any(line != line.rstrip() for line in text.splitlines())


def test_the_table_counts_trials_and_the_kinds_of_none(content: DropoutReport) -> None:
    text, counts = format_dropout(content), content.counts
    assert row_of(text, "trials")[0] == f"{counts.trials[1]:,}"
    assert row_of(text, "not counted: log ends")[0] == f"{counts.short[1]:,}"
    assert row_of(text, "  across a wheel gap")[0] == f"{counts.gap[1]:,}"
    assert row_of(text, "  ends in GNSS outage")[0] == f"{counts.outage[1]:,}"


def test_horizons_beyond_the_log_are_printed_with_the_reason(run: Run) -> None:
    report = dropout(run, [1.0, 500.0, 700.0])
    text = " ".join(format_dropout(report).split())
    driven = f"{run.summary['drive']['distance_m']:.1f} m"
    assert f"no trial of 500, 700 m: less than that is left of the {driven} driven" in text
    assert report.document.trials[0].why_none is None
    assert "no trial of" not in format_dropout(dropout(run, [1.0]))


def test_the_reference_and_the_run_up_stand_in_the_table(content: DropoutReport) -> None:
    text, own, split = format_dropout(content), content.document.reference_error, content.document.by_learning
    assert own is not None
    assert split is not None
    assert row_of(text, "reference alone 95 %")[0] == f"{own[1].p95_m:.3f}"
    assert row_of(text, "  before")[:3] == [
        f"{split.before[1].p95_m:.3f}",
        "/",
        f"{split.before[1].expected_error_m:.3f}",
    ]
    assert row_of(text, "  after")[0] == f"{split.after[1].p95_m:.3f}"


def test_outages_stand_beside_the_usual_error_over_as_much_way(content: DropoutReport) -> None:
    (outage,), icr = content.document.outages, content.result("icr")
    assert icr is not None
    document = content.document
    usual = p95_at(document, "icr", outage.distance_m)
    assert usual == icr.column("p95_m")[2]
    assert p95_at(document, "icr", 31.0) is None
    line = next(line for line in format_dropout(content).splitlines() if line.startswith("1 real"))
    assert f"{outage.end_error_m:.3f} m" in line
    assert usual > 0
    assert line.endswith(error_text(usual))


def test_verdicts_are_lines_of_the_table(content: DropoutReport) -> None:
    lines = format_dropout(content).splitlines()
    assert [verdict.verdict for verdict in content.document.gates] == lines[-2:]
    assert not content.passed
    assert content.document.gates[0].passed


def test_a_budget_is_a_table_a_field_engineer_can_act_on(content: DropoutReport) -> None:
    budgets = (
        BudgetDistance("icr", 0.5, 7.34, beyond=False, between_m=(7.0, 8.0)),
        BudgetDistance("no_slip", 0.5, 2.1, beyond=False, between_m=(1.0, 20.0)),
        BudgetDistance("icr_final", 0.5, 20.0, beyond=True, between_m=(20.0, 20.0)),
    )
    report = msgspec.structs.replace(content.document, budgets=budgets)
    assert reach_rows(report, 0.5, 0) == (
        [("icr", "7.3 m", "", ""), ("no_slip", "about 2 m", "", "between 1 and 20 m")],
        [("icr_final", "more than 20 m", "more than 20 m", "")],
    )
    assert reach_rows(report, 9.0, 0) == ([], [])


def test_a_distance_below_a_metre_between_far_horizons_is_not_zero() -> None:
    short = BudgetDistance("no_slip", 0.5, 0.3, beyond=False, between_m=(0.0, 10.0))
    assert short.short_text == "less than 1 m"
    assert msgspec.structs.replace(short, distance_m=1.4).short_text == "about 1 m"
    assert msgspec.structs.replace(short, between_m=(0.0, 1.0)).short_text == "0.3 m"


def test_the_distance_to_plan_with_is_the_lower_end_of_the_next_drive() -> None:
    known = BudgetDistance("icr", 0.5, 18.2, beyond=False, between_m=(18.0, 19.0), next_low_m=2.7)
    assert known.to_plan_with_m == 2.7
    assert msgspec.structs.replace(known, next_low_m=None).to_plan_with_m is None
    assert msgspec.structs.replace(known, next_low_m=None, distance_m=20.0, beyond=True).to_plan_with_m == 20.0


def test_a_page_begins_with_the_distance_to_plan_with(content: DropoutReport) -> None:
    known = BudgetDistance("icr", 0.5, 18.2, beyond=False, between_m=(18.0, 19.0), next_low_m=2.7)
    for next_low_m, lead in ((2.7, "plan with 2.7 m"), (None, "18.2 m")):
        budgets = (msgspec.structs.replace(known, next_low_m=next_low_m),)
        report = msgspec.structs.replace(content.document, budgets=budgets, best=None)
        reach = reach_section(content.run_document, report)
        assert reach.lead == lead
        assert ("2.7 m or more on the next drive" in reach.text) is (next_low_m is not None)
        assert ("18.2 m on this drive" in reach.text) is (next_low_m is not None)


def test_a_run_without_trials_or_track_width_is_told_plainly(make_run: Callable[..., Run]) -> None:
    parked = make_run(duration_s=20.0, speed_mps=0.008, turn_mps=0.0, troubles=False, track_width_m=None)
    text = format_dropout(content_of(parked, [5.0]))
    assert "Not known: the run is not usable" in text
    assert "robot.track_width_m is not known" in text
    assert "the robot stood at 100 % of the states" in text


def test_junit_has_a_suite_a_run_and_a_case_a_gate(content: DropoutReport, tmp_path: Path) -> None:
    strange = msgspec.structs.replace(content.run_document, log='a <b> & "c" \x01', config=Config())
    odd = with_content(with_run(content, strange), gates=content.document.gates[1:])
    error = RunError("runs/x", "edited", "fit <again> & again")
    write_junit(tmp_path / "j.xml", [suite_of(*one) for one in [("barn", content), ("odd", odd), ("runs/x", error)]])
    root = ET.parse(tmp_path / "j.xml").getroot()
    assert root.tag == "testsuites"
    assert {key: root.get(key) for key in ("tests", "failures", "errors")} == {
        "tests": "4",
        "failures": "2",
        "errors": "1",
    }
    first, second, third = root.findall("testsuite")
    assert [case.get("name") for case in first.findall("testcase")] == list(GATES)
    passed, failed = first.findall("testcase")
    assert passed.find("failure") is None
    failure = failed.find("failure")
    assert failure is not None
    assert failure.get("message") == content.document.gates[1].verdict
    assert second.get("name") == 'a <b> & "c" ?'
    told = third.find("testcase/error")
    assert told is not None
    assert told.get("message") == str(error)
    assert [path.name for path in tmp_path.iterdir()] == ["j.xml"]


def test_markdown_says_verdicts_sentences_and_numbers(content: DropoutReport) -> None:
    text = format_outcomes([("barn", content), ("runs/x", RunError("runs/x", "was edited"))])
    assert text.startswith("## barn")
    assert "Acceptance limits not met: 1" in text
    assert "within 50 m (95 %)" in text
    assert "Could not be used: runs/x: was edited" in text
    tables = [part for part in text.split("\n\n") if part.startswith("|")]
    assert len(tables) > 1
    assert all(len({line.count("|") for line in part.splitlines()}) == 1 for part in tables)
    passed = with_content(content, gates=content.document.gates[:1], passed=True)
    assert "All acceptance limits are met" in format_outcomes([("barn", passed)])


def test_exports_replace_a_file_whole_or_refuse_in_one_line(content: DropoutReport, tmp_path: Path) -> None:
    (tmp_path / "j.xml").write_text("old", encoding="utf-8")
    write_junit(tmp_path / "j.xml", [suite_of(*one) for one in [("barn", content)]])
    ET.parse(tmp_path / "j.xml")
    with pytest.raises(OutputError, match="cannot be written"):
        write_junit(tmp_path / "missing" / "j.xml", [suite_of(*one) for one in [("barn", content)]])
    with pytest.raises(OutputError, match="does not exist"):
        check_place(tmp_path / "missing" / "j.xml")
    with pytest.raises(OutputError, match="is a directory"):
        check_place(tmp_path)
    check_place(tmp_path / "new.xml")
    assert [path.name for path in tmp_path.iterdir()] == ["j.xml"]
