"""Text with tables: plain where it is piped, by rich on a terminal."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator

import pytest

from icrtool.cli.printing import print_document
from icrtool.output.tables.calibration import calibration_blocks
from icrtool.output.tables.run import run_blocks
from icrtool.output.text_blocks import (
    TEXT_WIDTH,
    Block,
    Checks,
    Facts,
    Items,
    Line,
    Section,
    Table,
    filled_blocks,
    fit_table,
    format_blocks,
    format_markdown,
)
from icrtool.records.calibration_document import CALIBRATION_SCHEMA, SensorDocument, SensorDrive
from icrtool.records.run import Run

TABLE = Table("lr", [("wheels", "50.0 Hz"), ("a [bold]b", "1.25 Hz")], ("stream", "rate"))


def test_columns_are_as_wide_as_their_cells_and_numbers_stand_at_the_right() -> None:
    assert format_blocks([TABLE]).splitlines() == ["stream        rate", "wheels     50.0 Hz", "a [bold]b  1.25 Hz"]


def tables_of(blocks: list[Block]) -> Iterator[Table]:
    """Every table of a document, those of its sections too."""
    for block in blocks:
        if isinstance(block, Table):
            yield block
        elif isinstance(block, Section):
            yield from tables_of(block.blocks)


@pytest.mark.parametrize("width", [40, 60, 80])
def test_a_table_that_is_too_wide_cuts_no_number_of_a_run(run: Run, width: int) -> None:
    tables = list(tables_of(run_blocks(run.document)))
    assert len(tables) > 1
    for table in tables:
        narrow, left_out = fit_table(table, width, 3)
        shown = {cell for row in narrow.rows for cell in row if "…" in cell}
        assert [cell for cell in shown if "±" in cell or cell.startswith(("+", "-"))] == []
        assert len(narrow.head) + len(left_out) == len(table.head)
        assert {*left_out} <= {*table.head}


def test_a_table_without_rows_is_nothing() -> None:
    assert format_blocks([Table("lr", [])]) == ""
    assert fit_table(Table("lr", []), 60, 3) == (Table("", []), [])


def test_what_is_empty_in_a_document_is_left_out() -> None:
    empty: list[Block] = [
        Line("", "bad"),
        Facts([("next", "")]),
        Table("lr", [], ("a", "b"), "caption"),
        Items([]),
        Checks([]),
    ]
    blocks: list[Block] = [
        "before",
        *empty,
        Section("Part", [Section("Inner", empty)], name="part"),
        Facts([("a", "1"), ("b", "")]),
    ]
    assert list(filled_blocks(blocks)) == ["before", Facts([("a", "1")])]
    assert format_blocks(blocks).splitlines() == ["before", "a           1"]
    assert "Part" not in format_markdown(blocks)
    lead = Section("Answer", [], lead="yes", label="Trust?")
    assert list(filled_blocks([lead])) == [lead]


def test_markdown_has_a_heading_a_section_an_item_a_sentence_and_escapes_names() -> None:
    section = Section("Part <1>", ["a_b is 1", TABLE], depth=1)
    lines = [line for line in format_markdown([section]).splitlines() if line]
    assert lines[:2] == ["### Part \\<1\\>", "- a\\_b is 1"]
    assert lines[2:4] == ["| stream | rate |", "| --- | ---: |"]
    assert lines[-1] == "| a \\[bold\\]b | 1.25 Hz |"


def test_sentences_are_wrapped_and_what_is_copied_is_not() -> None:
    words = " ".join(["word"] * 60)
    (first, *later) = format_blocks([words]).splitlines()
    assert len(first) <= TEXT_WIDTH
    assert all(line.startswith("  word") for line in later)
    assert format_blocks([Line(words, "as is")]) == words
    (first, *later) = format_blocks([Facts([("drive", words), ("", "next")])]).splitlines()
    assert first.startswith("drive       word")
    assert [line[:13] for line in later] == [f"{'':12}w"] * (len(later) - 1) + [f"{'':12}n"]


def test_settings_to_copy_are_words_that_a_shell_joins_and_a_terminal_holds() -> None:
    settings = {f"frames.heading_delay_{number}_s": 0.1234567 for number in range(5)}
    log = SensorDocument(
        schema=CALIBRATION_SCHEMA, log="log", inputs=(), windows=1, independent_stretches=1, window_miss_m=0.1,
        drive=SensorDrive(*[0.0] * len(SensorDrive.__struct_fields__)), settings=settings, alignment={}, parameters={},
    )  # fmt: skip
    text = format_blocks(calibration_blocks(None, log), verbose=False)
    assert max(map(len, text.splitlines())) <= 80
    script = f"printf '%s\\n' {text.partition(':')[2].strip()}"
    options = subprocess.run(["sh", "-c", script], capture_output=True, text=True, check=True).stdout.splitlines()
    assert options == [word for key in settings for word in ("--set", f"{key}=0.123457")]


PAGE = [Line("NOT USABLE: x", "bad"), TABLE, Facts([("drive", " ".join(["word"] * 30))])]


def test_a_terminal_gets_its_width_and_colours_and_no_markup_of_a_log(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, value in (("TERM", "xterm-256color"), ("COLUMNS", "60")):
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    print_document(PAGE, verbose=True)
    shown = capsys.readouterr().out
    assert "\x1b[1;31mNOT USABLE: x" in shown
    assert "a [bold]b" in shown
    monkeypatch.setenv("NO_COLOR", "1")
    print_document(PAGE, verbose=True)
    plain = capsys.readouterr().out
    assert "\x1b[1;31m" not in plain
    assert max(map(len, plain.splitlines())) <= 60 + 8
    monkeypatch.setenv("TERM", "dumb")
    print_document(PAGE, verbose=True)
    assert capsys.readouterr().out == f"{format_blocks(PAGE)}\n"


def test_a_pipe_gets_plain_text(capsys: pytest.CaptureFixture[str]) -> None:
    print_document(PAGE, verbose=True)
    assert capsys.readouterr().out == f"{format_blocks(PAGE)}\n"
