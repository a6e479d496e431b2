"""What a script relies on: JSON, exit status, names in error lines, and where runs go."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import pytest

from icrtool.cli import main

ROBOT = ("--robot", "pentzer-tracked")
FAST = (*ROBOT, "--plots", "none")
GATE = "icr.p95@2m <= 0.00001"
RATES = ("--duration", 40, "--wheel-rate", 20, "--gnss-rate", 5, "--heading-rate", 20, "--gnss", "0.002")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two folders with a log of the same name and other content, beside each a table of the truth."""
    folder = tmp_path_factory.mktemp("logs")
    with pytest.MonkeyPatch.context() as patch:
        for seed, day in enumerate(("monday", "tuesday")):
            (folder / day).mkdir()
            log = folder / day / "drive.mcap"
            patch.setattr(
                sys, "argv", ["icrtool", "simulate", "-q", "-o", str(log), "--seed", str(seed), *map(str, RATES)]
            )
            with pytest.raises(SystemExit) as left:
                main()
            assert not left.value.code
    return folder


@pytest.fixture
def logs(made: Path, run_place: Path) -> Path:
    """A copy of those folders, below the folder that commands run in."""
    shutil.copytree(made, run_place, dirs_exist_ok=True)
    (run_place / "bad.mcap").write_bytes(b"\x89MCAP0\r\n")
    return run_place


def names(folder: Path) -> set[str]:
    return {str(file.parent.relative_to(folder)) for file in folder.rglob("run.json")}


def test_json_is_one_document_and_all_there_is_on_stdout(icrtool, logs: Path) -> None:
    status, out, err = icrtool("fit", "monday/drive.mcap", "bad.mcap", "--json", *FAST)
    document = json.loads(out)
    assert status == 1
    assert document["schema"] == "icrtool/fit/1"
    good, bad = document["logs"]
    assert good["run"] == json.loads(Path(good["directory"], "run.json").read_text(encoding="utf-8"))
    assert (bad["status"], bad["log"]) == ("failed", "bad.mcap")
    assert bad["reason"] in err

    status, out, _ = icrtool("info", "monday/drive.mcap", "bad.mcap", "--json", *ROBOT)
    document = json.loads(out)
    assert (status, document["schema"]) == (1, "icrtool/info/1")
    good, bad = document["logs"]
    assert {one["role"] for one in good["streams"]} == {"wheels", "gnss", "heading"}
    assert {one["topic"] for one in good["streams"]} <= {one["topic"] for one in good["topics"]}
    assert good["run"]["schema"].startswith("icrtool/run/")
    assert (bad["run"], bad["status"]) == (None, "failed")

    status, out, _ = icrtool("batch", "monday", "-o", "fleet", "-j", 1, "--json", *FAST)
    document = json.loads(out)
    assert (status, document["schema"], document["counts"]["done"]) == (0, "icrtool/batch/1", 1)


def test_a_missed_limit_decides_the_exit_status_whatever_became_of_other_logs(icrtool, logs: Path) -> None:
    status, _, err = icrtool("dropout-report", "bad.mcap", "monday/drive.mcap", "--gate", GATE, "-q", *FAST)
    assert status == 3
    for line in err.splitlines():
        assert "bad.mcap" in line or "drive" in line, "each line names its log"
    status, _, err = icrtool("dropout-report", "bad.mcap", "icrtool-runs/drive", *FAST[2:])
    assert status == 1
    status, _, err = icrtool("dropout-report", "icrtool-runs/drive", "--gate", "vendor.p95@2m <= 1", *FAST[2:])
    assert status == 1
    assert "icrtool-runs/drive" in err


def test_into_is_the_parent_however_many_logs_there_are(icrtool, logs: Path) -> None:
    assert icrtool("fit", "monday/drive.mcap", "--into", "runs", *FAST)[0] == 0
    assert names(logs) == {"runs/drive"}
    assert icrtool("fit", "monday/drive.mcap", "--into", "runs", "-o", "x", *FAST)[0] == 2


def test_two_logs_of_one_name_have_a_run_each_and_other_files_are_left_out(icrtool, logs: Path) -> None:
    files = [*sorted(logs.glob("*day/*")), logs / "monday" / ".." / "monday" / "drive.mcap"]
    status, _, err = icrtool("fit", *files, *FAST)
    assert status == 0, err
    assert names(logs / "icrtool-runs") == {"monday-drive", "tuesday-drive"}
    assert err.count("not a log") == 2
    assert icrtool("fit", "monday", "--into", "of_folder", *FAST)[0] == 0
    assert names(logs / "of_folder") == {"drive"}


def test_the_run_of_another_recording_is_not_replaced_unasked(icrtool, logs: Path) -> None:
    assert icrtool("fit", "monday/drive.mcap", *FAST)[0] == 0
    run = logs / "icrtool-runs" / "drive"
    before = (run / "run.json").read_bytes()
    for command in ("fit", "dropout-report"):
        status, _, err = icrtool(command, "tuesday/drive.mcap", *FAST)
        assert status == 1
        assert "monday/drive.mcap" in err
        assert (run / "run.json").read_bytes() == before
    status, _, err = icrtool("fit", "tuesday/drive.mcap", "--overwrite", *FAST)
    assert status == 0
    assert "monday/drive.mcap" in err, "what was replaced is reported"
    shutil.copy(logs / "tuesday" / "drive.mcap", logs / "drive.mcap")
    assert icrtool("fit", "drive.mcap", *FAST)[0] == 0, "a copy is the same recording"
    shutil.copy(logs / "monday" / "drive.mcap", logs / "drive.mcap")
    status, _, err = icrtool("fit", "drive.mcap", *FAST)
    assert status == 0, "so is a file in the same place"
    assert "replaced the run of another recording" in err


def test_a_relative_path_from_another_folder_is_another_recording(icrtool, logs: Path, monkeypatch) -> None:
    assert icrtool("fit", "monday/drive.mcap", "-o", "run", *FAST)[0] == 0
    (logs / "here" / "monday").mkdir(parents=True)
    shutil.copy(logs / "tuesday" / "drive.mcap", logs / "here" / "monday" / "drive.mcap")
    from icrtool.errors import OutputError
    from icrtool.output.run_directory import check_target

    monkeypatch.chdir(logs / "here")
    with pytest.raises(OutputError):
        check_target(logs / "run", Path("monday/drive.mcap"))


def test_a_run_fitted_again_reports_what_it_removes_and_removes_nothing_of_others(icrtool, logs: Path) -> None:
    assert icrtool("dropout-report", "monday/drive.mcap", *FAST)[0] == 0
    notes = logs / "icrtool-runs" / "drive" / "notes.txt"
    notes.write_text("mine")
    for command in ("fit", "dropout-report"):
        status, _, err = icrtool(command, "monday/drive.mcap", "--overwrite", *FAST)
        assert status == 1
        assert "holds notes.txt" in err
        assert notes.read_text() == "mine"
    notes.unlink()
    status, _, err = icrtool("fit", "monday/drive.mcap", *FAST)
    assert status == 0
    assert "removed dropout/, report.html" in err
