"""The rows of ladder.csv and of report.json: those of summary.csv."""

from __future__ import annotations

import json

import pytest

import icrtool
from icrtool.dropout_analysis.report import DropoutReport
from icrtool.output.dropout_directory import COMPARISON_COLUMNS, comparison_rows
from icrtool.output.files.formats import json_bytes
from icrtool.records.rows import REPORT_ROWS


@pytest.fixture(scope="module")
def report(make_run) -> DropoutReport:
    return icrtool.dropout_report(make_run(duration_s=90.0))


def test_rows_are_those_of_the_summary(report: DropoutReport) -> None:
    rows = [dict(zip(COMPARISON_COLUMNS, row, strict=True)) for row in comparison_rows(report.document)]
    summary = report.summary
    assert [row["model"] for row in rows] == list(summary["model"])
    for name in ("horizon_m", "trials", "p95_m", "expected_error_m", "expected_pct"):
        assert [row[name] for row in rows] == pytest.approx(list(summary[name]), nan_ok=True)
    assert {row["heading"] for row in rows} == {"wheels", "heading"}
    learned = {row["model"]: row["fitted"] for row in rows}
    assert learned["icr"] == REPORT_ROWS["icr"].knows
    assert learned["no_slip"] == "the track width"
    assert learned["recommended"] == learned["controller"] == "the rest of the drive"
    assert "whole drive" in learned["icr_final"]


def test_the_document_is_json(report: DropoutReport) -> None:
    document = json.loads(json_bytes(report.document.ladder))
    assert [model["name"] for model in document["models"]] == [one.name for one in report.results]
    assert set(document["fits"]) >= {"no_slip", "five", "recommended", "recommended_gyro"}
