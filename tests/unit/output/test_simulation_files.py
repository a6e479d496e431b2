"""What a study leaves behind: a directory that appears whole, a CSV and JSON that read back, a table that fits."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from icrtool.cli.printing import print_document
from icrtool.errors import DataError, OutputError
from icrtool.output.figures.study import study_figure, study_subtitle, study_title
from icrtool.output.figures.style import new_figure
from icrtool.output.simulation_files import (
    check_study_target,
    log_and_truth,
    read_speeds,
    truth_path,
    write_study,
    write_truth,
)
from icrtool.output.tables.study import finding_text, runs_text, study_blocks
from icrtool.output.text_blocks import Table, format_blocks
from icrtool.simulation.drives import DrivePlan, PathPlan, Sensors, simulate
from icrtool.simulation.studies import STUDIES, run_study
from icrtool.simulation.study_records import StudyNumber
from support.studies import small_request, small_study

PNG = b"\x89PNG"


@pytest.mark.parametrize("name", STUDIES)
def test_a_study_directory_holds_json_csv_and_picture(name, tmp_path: Path) -> None:
    result = small_study(name)
    write_study(result, tmp_path / "study")
    assert sorted(path.name for path in (tmp_path / "study").glob("[!.]*")) == sorted(
        ["study.json", f"{name}.csv", f"{name}.png"]
    )
    document = json.loads((tmp_path / "study" / "study.json").read_text(encoding="utf-8"))
    assert document["schema"] == "icrtool/study/1"
    assert document["settings"]["drive"]["path"]["kind"]
    assert len(document["levels"]) == len(result.levels)
    table = pd.read_csv(tmp_path / "study" / f"{name}.csv")
    assert list(table) == list(result.columns)
    for column, values in result.columns.items():
        if not isinstance(values, list):
            np.testing.assert_array_equal(table[column].to_numpy(), np.asarray(values))
    assert (tmp_path / "study" / f"{name}.png").read_bytes().startswith(PNG)


@pytest.mark.parametrize("name", STUDIES)
def test_every_number_of_the_table_is_whole_on_a_terminal_of_80_columns(
    name, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    blocks = study_blocks(small_study(name))
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("NO_COLOR", "1")
    print_document(blocks, verbose=False)
    shown = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
    assert shown.startswith(name)
    assert max(map(len, shown.splitlines())) <= 80
    cells = [cell for block in blocks if isinstance(block, Table) for row in block.rows for cell in row[:-1]]
    inverted = [row[-1] for block in blocks if isinstance(block, Table) if "r" in block.align for row in block.rows]
    assert [cell for cell in (*cells, *inverted) if cell not in shown] == []


@pytest.mark.parametrize("name", STUDIES)
def test_the_title_of_a_picture_states_the_answer_with_its_number(name) -> None:
    result = small_study(name)
    figure = new_figure(study_title(result), study_subtitle(result), height_in=2.0)
    title, subtitle = (text.get_text() for text in figure.texts[:2])
    assert [finding_text(one) for one in result.answer if finding_text(one) not in title] == []
    assert subtitle.startswith(f"{name}: ICRs")
    assert "…" not in title + subtitle


@pytest.mark.parametrize(("name", "changes"), [("initial", {"values": (0.0,)}), ("consistency", {})])
def test_a_study_of_one_value_or_one_time_is_drawn_too(name, changes: dict[str, object]) -> None:
    assert study_figure(run_study(small_request(name, 1, 4.0, **changes))).axes


def test_an_old_study_is_replaced_and_anything_else_is_left_alone(tmp_path: Path) -> None:
    result = small_study("rate")
    write_study(result, tmp_path / "study", plots=())
    before = (tmp_path / "study").stat().st_ino
    write_study(result, tmp_path / "study", plots=())
    assert (tmp_path / "study").stat().st_ino != before
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes").touch()
    with pytest.raises(OutputError, match="not a study directory"):
        check_study_target(tmp_path / "mine")
    with pytest.raises(OutputError, match="not a study directory"):
        write_study(result, tmp_path / "mine")
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["notes"]


def test_a_study_that_cannot_be_drawn_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from icrtool.output.figures import study as figure_study

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(figure_study, "study_figure", fail)
    with pytest.raises(OutputError, match="No space left"):
        write_study(small_study("rate"), tmp_path / "deep" / "study")
    assert list(tmp_path.rglob("*")) == [tmp_path / "deep"]


def test_the_table_names_the_robot_settings_and_the_paper(tmp_path: Path) -> None:
    text = format_blocks(study_blocks(small_study("turn-radius")))
    assert "turn-radius (Fig. 10): convergence after a change" in text
    assert "2 runs of 25 s each, seed 0; circle at 0.4 m/s, ICRs +0.500, -0.750, -0.250 m" in text
    assert "0.1 s (Fig. 10)" in text


def test_one_run_is_singular() -> None:
    request = small_study("rate").request
    assert runs_text(replace(request, runs=1)).startswith("1 run of")


@pytest.mark.parametrize(
    ("ours", "unit", "text"),
    [
        ((1.234,), "s", "1.23 s"),
        ((0.0004,), "m", "0.000 m"),
        ((12.345, 99.9), "%", "12.3 to 99.9 %"),
        ((0.1, 0.25, 3.0), "m", "0.250 m [0.100, 3.00]"),
        ((float("nan"),), "s", "never"),
        ((6.1,), "", "6.10"),
    ],
)
def test_numbers_are_told_with_three_digits(ours: tuple[float, ...], unit: str, text: str) -> None:
    assert finding_text(StudyNumber("", ours, unit)) == text


def test_the_truth_reads_back_to_the_last_bit(tmp_path: Path) -> None:
    _, truth = simulate(DrivePlan(duration_s=3.0), Sensors(), 0)
    write_truth(truth, tmp_path / "truth.csv")
    table = pd.read_csv(tmp_path / "truth.csv")
    for name, values in truth.items():
        np.testing.assert_array_equal(table[name].to_numpy(), values)


def test_track_speeds_read_from_a_table_with_other_columns(tmp_path: Path) -> None:
    file = tmp_path / "speeds.csv"
    file.write_text("\ufeffv_right_mps, t_s, note, v_left_mps\n0.1,10,a,0.2\n0.3,11.5,b,0.4\n", encoding="utf-8")
    speeds = read_speeds(file)
    np.testing.assert_array_equal(speeds.t_s, [0.0, 1.5])
    np.testing.assert_array_equal(speeds.v_left_mps, [0.2, 0.4])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t_s,v_left_mps\n0,1\n", "no column v_right_mps; it holds t_s, v_left_mps"),
        ("", "no column t_s; it holds nothing"),
        ("t_s,v_left_mps,v_right_mps\n0,1,1\n", "1 rows; at least two are needed"),
        ("t_s,v_left_mps,v_right_mps\n0,1,1\n1,,1\n", "row 2 holds a value that is not a finite number"),
        ("t_s,v_left_mps,v_right_mps\n0,1,1\n0,1,1\n", "the times do not increase at row 2; t_s = 0 after 0"),
        ("t_s,v_left_mps,v_right_mps\n0,fast,1\n", "not a table of numbers; could not convert"),
        ("t_s,v_left_mps,v_right_mps\n0,1\n1,1,1\n", "row 1 holds a value that is not a finite number"),
    ],
)
def test_speeds_that_cannot_be_driven_are_refused_in_words(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "speeds.csv"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(DataError) as refused:
        read_speeds(file)
    assert words in str(refused.value)


def write_pair(log: Path, *, force: bool, text: str = "new") -> None:
    with log_and_truth(log, force=force) as (fresh, truth):
        fresh.write_text(text, encoding="utf-8")
        truth.write_text(text, encoding="utf-8")


def test_a_log_and_its_truth_appear_together_or_not_at_all(tmp_path: Path) -> None:
    log = tmp_path / "drive.mcap"

    def fail() -> None:
        with log_and_truth(log, force=False) as (fresh, _):
            fresh.touch()
            raise OSError(28, "No space left on device")

    with pytest.raises(OutputError, match="No space left"):
        fail()
    assert list(tmp_path.iterdir()) == []
    write_pair(log, force=False)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drive.mcap", "drive.mcap.truth.csv"]
    assert truth_path(log).read_text(encoding="utf-8") == "new"


def test_a_log_that_cannot_be_written_is_named_as_it_was_asked_for(tmp_path: Path) -> None:
    with pytest.raises(OutputError) as caught, log_and_truth(tmp_path / "drive.mcap", force=False) as (fresh, _):
        raise OutputError(fresh, "cannot be written", "No space left on device")
    assert str(caught.value) == f"{tmp_path / 'drive.mcap'}: cannot be written; No space left on device"


@pytest.mark.parametrize("place", [".", "/"])
def test_a_folder_is_no_name_of_a_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(OutputError, match="has no name for a log"):
        write_pair(Path(place), force=True)
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_overwritten_unless_forced(tmp_path: Path) -> None:
    log = tmp_path / "drive.bag"
    write_pair(log, force=False, text="old")
    with pytest.raises(OutputError, match="exists already; --force replaces it"):
        write_pair(log, force=False)
    assert log.read_text(encoding="utf-8") == "old"
    write_pair(log, force=True)
    assert log.read_text(encoding="utf-8") == "new"


def test_a_directory_that_is_no_bag_is_never_replaced(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "one.jpg").touch()
    with pytest.raises(OutputError, match="holds something that is not a bag directory"):
        write_pair(tmp_path / "photos", force=True)
    (tmp_path / "photos" / "metadata.yaml").touch()
    with pytest.raises(OutputError, match=r"holds one\.jpg, which is no part of a bag directory"):
        write_pair(tmp_path / "photos", force=True)
    assert (tmp_path / "photos" / "one.jpg").exists()


def test_a_place_that_does_not_exist_is_said_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot be written; No such file"):
        write_pair(tmp_path / "nowhere" / "drive.mcap", force=False)


def test_a_path_may_be_named_in_any_study(tmp_path: Path) -> None:
    request = small_request("rate", 1, 6.0, values=(50.0,))
    result = run_study(replace(request, plan=replace(request.plan, path=PathPlan("spins"))))
    assert "spins at 0.4 m/s" in format_blocks(study_blocks(result))
