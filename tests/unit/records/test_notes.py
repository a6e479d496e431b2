"""Findings: grade by code, sentences for people, and the reasons against a run."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import pytest

import icrtool
from icrtool.cli.batch import line_of
from icrtool.fleet.fleet_files import fleet_rows
from icrtool.output.tables.run import to_drive, warnings_line
from icrtool.pipeline import fit
from icrtool.records.fleet_document import FleetLog
from icrtool.records.note_catalogue import CATALOGUE
from icrtool.records.notes import Note, first_to_read, note, notes_about, unusable_because, warnings_of
from icrtool.records.run import Run
from icrtool.records.text import LogText
from support.barn import configured, simulate

CUT = note("log_cut_off", "a text that says nothing", "drive.bag")
MOVED = note("delay_corrected", "the position lags the wheels by 0.20 s: corrected")
REJECTED = note("fixes_mostly_rejected", "40 % of the fixes rejected")
REASONS = [note("icrs_inverted", "the ICRs ended inverted"), REJECTED]


@pytest.fixture(scope="module")
def run() -> Run:
    return fit(simulate(), configured())


def test_a_finding_has_the_grade_of_its_code() -> None:
    assert [(one.code, one.grade) for one in (CUT, MOVED, REASONS[0])] == [
        ("log_cut_off", "warning"), ("delay_corrected", "info"), ("icrs_inverted", "grave"),
    ]  # fmt: skip


def test_a_code_without_explanation_is_refused() -> None:
    with pytest.raises(KeyError, match="unheard_of"):
        note("unheard_of", "something")


def test_a_finding_about_a_log_of_any_name_is_encoded() -> None:
    name = LogText("drive\n\u202e.bag")
    for one in (note("log_cut_off", "cut off", name), *notes_about(name, [MOVED])):
        assert msgspec.json.decode(msgspec.json.encode(one), type=Note) == one
        assert one.subject == "drive\\n\\u202e.bag"


def test_warnings_are_the_sentences_and_grave_findings_the_reasons() -> None:
    found = (*notes_about("drive", [MOVED]), CUT, *REASONS)
    assert warnings_of(found) == (
        "drive: the position lags the wheels by 0.20 s: corrected", "drive.bag: a text that says nothing",
    )  # fmt: skip
    assert unusable_because(found) == "the ICRs ended inverted; 40 % of the fixes rejected"
    assert unusable_because(found[:2]) is None


def test_the_finding_to_read_first_is_the_gravest_that_is_no_reason() -> None:
    assert first_to_read((MOVED, *REASONS, CUT)) is CUT
    assert first_to_read((MOVED, *REASONS)) is MOVED
    assert first_to_read(REASONS) is None
    assert warnings_line((MOVED, CUT)) == "2 warnings (-v): a text that says nothing"
    assert warnings_line((MOVED,)) == "1 warning (-v): the position lags the wheels by 0.20 s"
    assert warnings_line(REASONS) == ""


def test_a_run_has_its_findings_in_python_and_in_its_file(run: Run, tmp_path: Path) -> None:
    assert run.notes
    assert run.warnings == warnings_of(run.notes)
    assert {one.code for one in run.notes} <= CATALOGUE.keys()
    run.write(tmp_path / "run", plots=())
    stored = json.loads((tmp_path / "run" / "run.json").read_bytes())
    assert stored["notes"] == [msgspec.structs.asdict(one) for one in run.notes]
    assert stored["warnings"] == list(run.warnings)
    assert icrtool.open_run(tmp_path / "run").notes == run.notes


def test_a_report_has_the_findings_of_its_run(run: Run) -> None:
    document = icrtool.dropout(run).document
    assert document.notes[: len(run.notes)] == run.notes
    assert document.warnings == warnings_of(document.notes)


def reworded(one: Note) -> Note:
    return msgspec.structs.replace(one, text="other words")


def test_other_words_change_nothing_that_a_program_decides(run: Run) -> None:
    excitation = msgspec.structs.replace(
        run.document.excitation,
        verdict=msgspec.structs.replace(run.document.excitation.verdict, x_icr_m="not shown"),
        notes=(reworded(note("icrs_poorly_shown", "")), reworded(note("turns_lacking", ""))),
    )
    assert to_drive(msgspec.structs.replace(run.document, excitation=excitation)) == "other words"
    row = FleetLog("a.bag", "runs/a", "done", reason="other words", notes=(reworded(CUT), reworded(CUT)))
    assert line_of(row).startswith("cut off")
    unusable = msgspec.structs.replace(row, usable=False, notes=(REJECTED,))
    assert line_of(unusable).endswith("do not use: 40 % of the fixes rejected")
    assert fleet_rows([row])[0]["notes"] == "log_cut_off"


def test_a_finding_about_a_name_of_a_log_can_be_encoded() -> None:
    named = LogText("drive")
    for one in (note(MOVED.code, "moved", named), *notes_about(named, [MOVED])):
        assert msgspec.json.decode(msgspec.json.encode(one), type=Note).subject == "drive"
