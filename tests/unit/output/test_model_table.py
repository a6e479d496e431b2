"""The comparison as text and data."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from icrtool.calibration.model_comparison import ModelComparison, compare_models
from icrtool.estimation.measured_heading import measured_headings
from icrtool.output.files.json_file import json_bytes
from icrtool.output.tables.model_comparison import (
    COMPARISON_COLUMNS,
    comparison_blocks,
    comparison_document,
    comparison_rows,
    extended_line,
)
from icrtool.output.text_blocks import Text


@pytest.fixture(scope="module")
def comparison(make_run) -> ModelComparison:
    run = make_run(duration_s=90.0)
    return compare_models(run, measured_headings(run)).table


def test_every_model_has_its_line(comparison: ModelComparison) -> None:
    text = Text(comparison_blocks(comparison))
    for score in comparison.scores:
        assert any(line.startswith(score.label) for line in text.splitlines())
    assert "held out" in text


def test_every_row_of_the_csv_has_a_cell_for_each_column(comparison: ModelComparison) -> None:
    rows = list(comparison_rows(comparison))
    assert len(rows) == len(comparison.scores) * len(comparison.horizons_m)
    assert {len(row) for row in rows} == {len(COMPARISON_COLUMNS)}
    assert {row[2] for row in rows} == {"wheels", "heading"}


def test_the_document_is_json(comparison: ModelComparison) -> None:
    document = json.loads(json_bytes(comparison_document(comparison)))
    assert [model["name"] for model in document["models"]] == [score.name for score in comparison.scores]
    assert set(document["fits"]["window"]["value"]) >= {"y_icr_right_m", "y_icr_left_m", "x_icr_m"}


def test_the_line_names_what_was_chosen(comparison: ModelComparison) -> None:
    line = extended_line(replace(comparison, blocks=3, chosen=("icr", "five", "five"), best="eight"))
    assert [comparison.fits[name].model.label in line for name in ("icr", "five", "eight")] == [True] * 3
