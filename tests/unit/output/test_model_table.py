"""The ladder as text and data."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from icrtool.calibration.model_comparison import Ladder, judge_ladder
from icrtool.estimation.measured_heading import measured_headings
from icrtool.output.run_directory import json_bytes
from icrtool.output.tables.model_comparison import (
    LADDER_COLUMNS,
    extended_line,
    format_ladder,
    ladder_document,
    ladder_rows,
)


@pytest.fixture(scope="module")
def ladder(make_run) -> Ladder:
    run = make_run(duration_s=90.0)
    return judge_ladder(run, measured_headings(run))


def test_every_model_has_its_line(ladder: Ladder) -> None:
    text = format_ladder(ladder)
    for rung in ladder.rungs:
        assert any(line.startswith(rung.label) for line in text.splitlines())
    assert "held out" in text


def test_every_row_of_the_csv_has_a_cell_for_each_column(ladder: Ladder) -> None:
    rows = list(ladder_rows(ladder))
    assert len(rows) == len(ladder.rungs) * len(ladder.horizons_m)
    assert {len(row) for row in rows} == {len(LADDER_COLUMNS)}
    assert {row[2] for row in rows} == {"wheels", "heading"}


def test_the_document_is_json(ladder: Ladder) -> None:
    document = json.loads(json_bytes(ladder_document(ladder)))
    assert [model["name"] for model in document["models"]] == [rung.name for rung in ladder.rungs]
    assert set(document["fits"]["window"]["value"]) >= {"y_icr_right_m", "y_icr_left_m", "x_icr_m"}


def test_the_line_names_what_was_chosen_or_why_nothing_was(ladder: Ladder) -> None:
    line = extended_line(replace(ladder, blocks=3, chosen=("icr", "five", "five"), best="eight"))
    assert [ladder.fits[name].model.label in line for name in ("icr", "five", "eight")] == [True] * 3
    assert "too few" in extended_line(replace(ladder, blocks=2, chosen=("multiplier",) * 2, best="icr"))
