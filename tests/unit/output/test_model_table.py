"""The rows of the model comparison in report.json: those of summary.csv."""

from __future__ import annotations

import json

import pytest

import icrtool
from icrtool.dropout_analysis.report import DropoutReport
from icrtool.output.files.formats import json_bytes
from icrtool.records.rows import REPORT_ROWS


@pytest.fixture(scope="module")
def report(make_run) -> DropoutReport:
    return icrtool.dropout_report(make_run(duration_s=90.0))


def test_each_row_states_what_it_learned_from_and_what_turns_it(report: DropoutReport) -> None:
    models = report.document.ladder.models
    assert models is not None
    assert [one.name for one in models] == list(dict.fromkeys(report.summary["model"]))
    assert {one.heading for one in models} == {"wheels", "heading"}
    learned = {one.name: one.fitted for one in models}
    assert learned["icr"] == REPORT_ROWS["icr"].knows
    assert learned["no_slip"] == "the track width"
    assert learned["recommended"] == learned["controller"] == "the rest of the drive"
    assert "whole drive" in learned["icr_final"]


def test_the_document_is_json(report: DropoutReport) -> None:
    document = json.loads(json_bytes(report.document.ladder))
    assert [model["name"] for model in document["models"]] == [one.name for one in report.results]
    assert set(document["fits"]) >= {"no_slip", "five", "recommended", "recommended_gyro"}
