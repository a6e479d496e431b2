"""`icrtool dropout-report` as a user runs it: files, words, exit status."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree as ET

import pandas as pd
import pyarrow.parquet as pq
import pytest

from icrtool.cli import main

ROOT = Path(__file__).resolve().parents[2]
LOG = "third"
RUN = Path("icrtool-runs") / LOG
ROBOT = ("--robot", "husky-a200")
PICTURES = {"summary", "histogram", "worst", "error_map"}
NO_PLOTS = ("--plots", "none")
LEAN = ("--no-page", "--no-ladder")
EASY, HARD = "icr.p95@10m <= 100", "icr.p95@10m <= 0.001"


def report(directory: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "error:::icrtool"}
    command = [sys.executable, "-m", "icrtool", "dropout-report", *(str(argument) for argument in arguments)]
    return subprocess.run(
        command, cwd=directory, env=environment, capture_output=True, text=True, stdin=subprocess.DEVNULL, check=False
    )


@pytest.fixture
def report_here(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]):
    """The same in this process, which has all it needs loaded: for the many ways to be refused."""

    def run(directory: Path, *arguments: object) -> tuple[int, str, str]:
        monkeypatch.chdir(directory)
        monkeypatch.setattr(sys, "argv", ["icrtool", "dropout-report", *map(str, arguments), *NO_PLOTS])
        with pytest.raises(SystemExit) as left:
            main()
        return int(left.value.code or 0), *capfd.readouterr()

    return run


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory, short_logs: Path) -> Path:
    """A folder in which a copy of the log was fitted and reported on in one go, with all that can be asked for."""
    folder = tmp_path_factory.mktemp("field")
    shutil.copytree(short_logs / LOG, folder / LOG)
    done = report(
        folder, LOG, *ROBOT, "--outage", 10, "--trials", "--gate", EASY, "--gate", "no_slip.max@7.5 < 0.01",
        "--budget", 0.5, "--budget", 2, "--junit", "gates.xml", "--markdown", "pr.md",
    )  # fmt: skip
    (folder / "done.json").write_text(json.dumps([done.returncode, done.stdout, done.stderr]), encoding="utf-8")
    return folder


@pytest.fixture
def folder(fitted: Path, tmp_path: Path) -> Path:
    """A copy of that folder, to change."""
    shutil.copytree(fitted, tmp_path / "field")
    return tmp_path / "field"


def files_in(directory: Path) -> set[str]:
    return {str(path.relative_to(directory)) for path in directory.rglob("*") if path.is_file()}


def test_a_log_is_fitted_and_reported_on_in_one_go(fitted: Path) -> None:
    status, out, err = json.loads((fitted / "done.json").read_text(encoding="utf-8"))
    assert status == 3, err
    assert "Traceback" not in err
    assert (fitted / RUN / "states.csv").is_file()
    assert (fitted / RUN / "plots" / "trajectory.png").is_file()
    files = {"summary.csv", "histogram.csv", "worst.csv", "report.json", "trials.parquet"}
    pictures = {f"plots/{name}.png" for name in PICTURES | {"outages"}}
    assert files_in(fitted / RUN / "dropout") == files | pictures
    assert "within 0.5 m (95 %)" in out
    assert "within 2 m (95 %)" in out
    assert f"pass  {EASY}" in out
    assert "FAIL  no_slip.max@7.5 < 0.01" in out
    assert re.search(r"Outages +\d+ forced, the worst", out)


def test_all_files_say_the_same(fitted: Path) -> None:
    directory = fitted / RUN / "dropout"
    summary = pd.read_csv(directory / "summary.csv").set_index(["model", "horizon_m"])
    assert summary.index.levels[1].tolist() == sorted([*map(float, range(1, 21)), 7.5])
    document = json.loads((directory / "report.json").read_bytes())
    for model in document["models"]:
        for row in model["by_horizon"]:
            assert row["p95_m"] == summary.loc[(model["name"], row["horizon_m"]), "p95_m"]
    trials = pq.read_table(directory / "trials.parquet").to_pandas()
    sizes = trials.groupby(["model", "horizon_m"], observed=True).size()
    assert sizes.to_dict() == summary.trials.to_dict()
    gate = document["gates"][1]
    assert gate["value_m"] == summary.loc[("no_slip", 7.5), "max_m"]
    cases = ET.parse(fitted / "gates.xml").getroot().findall("testsuite/testcase")
    assert [case.find("failure") is None for case in cases] == [True, False]
    assert "limit is not met" in (fitted / "pr.md").read_text(encoding="utf-8")


@pytest.mark.usefixtures("without_drawing")
def test_without_an_argument_the_newest_run_is_taken_and_not_filtered_again(folder: Path, report_here) -> None:
    shutil.rmtree(folder / LOG)
    before = {name: (folder / RUN / name).read_bytes() for name in ("states.csv", "run.json")}
    status, out, err = report_here(folder, "--horizons", "2,10", "--gate", EASY)
    assert (status, err) == (0, "")
    assert {name: (folder / RUN / name).read_bytes() for name in before} == before
    assert files_in(folder / RUN / "dropout") == {
        "summary.csv",
        "histogram.csv",
        "worst.csv",
        "report.json",
    }
    assert pd.read_csv(folder / RUN / "dropout" / "summary.csv").horizon_m.unique().tolist() == [2.0, 10.0]
    full = pd.read_csv(folder / RUN / "dropout" / "summary.csv").set_index(["model", "horizon_m"])
    assert str(RUN / "report.html") in out
    assert full.trials.gt(0).all()


def test_forced_outages_on_a_stored_run_need_no_log_and_give_the_same(folder: Path, report_here) -> None:
    stored = json.loads((folder / RUN / "dropout" / "report.json").read_bytes())["outages"]
    shutil.rmtree(folder / LOG)
    assert report_here(folder, RUN, "--outage", 10, *LEAN, "-q") == (0, "", "")
    assert json.loads((folder / RUN / "dropout" / "report.json").read_bytes())["outages"] == stored
    assert stored


@pytest.mark.parametrize(
    ("name", "edit", "why"),
    [
        ("states.csv", lambda text: text.replace("1", "2", 1), "states.csv was edited"),
        ("run.json", lambda text: text.replace('"icrtool/run/1"', '"icrtool/run/99"'), "its schema is icrtool/run/99"),
    ],
)
def test_an_edited_run_and_one_of_another_schema_are_refused(
    folder: Path, report_here, name: str, edit, why: str
) -> None:
    file = folder / RUN / name
    file.write_text(edit(file.read_text(encoding="utf-8")), encoding="utf-8")
    status, out, err = report_here(folder, RUN, "--junit", "again.xml")
    assert (status, out) == (1, "")
    assert err.startswith("Error: ")
    assert why in err
    error = ET.parse(folder / "again.xml").find("testsuite/testcase/error")
    assert error is not None
    assert why in error.get("message", "")


def test_several_are_reported_on_in_turn_and_one_that_fails_does_not_stop_the_others(folder: Path, report_here) -> None:
    (folder / RUN / "dropout" / "plots" / "summary.png").unlink()
    status, out, err = report_here(folder, "no.bag", RUN, "--gate", HARD, "--junit", "g.xml", "--horizons", 10, *LEAN)
    assert status == 3, "a gate failed, whatever became of other logs"
    assert "1 of 2" in err
    assert f"FAIL  {HARD}" in out
    assert len(ET.parse(folder / "g.xml").findall("testsuite")) == 2
    assert not (folder / RUN / "dropout" / "plots").exists()


def test_no_run_at_all_is_said_in_one_line(tmp_path: Path) -> None:
    done = report(tmp_path)
    assert done.returncode == 1
    assert done.stderr == (
        "Error: icrtool-runs: holds no run; name a run directory or a log, or make a run with icrtool fit\n"
    )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "status", "why"),
    [
        (("--gate", "icr <= 1"), 2, "not of the form"),
        (("--gate", "magic.p95@1m <= 1"), 2, "no model magic"),
        (("--gate", "icr_finale.p95@1m <= 1"), 2, "did you mean icr_final?"),
        (("--gate", "calibration.p95@1m <= 1"), 1, "no model calibration"),
        (("--budget", "50cm"), 2, "'50cm' has a unit; give the number of metres alone, here 0.5"),
        (("--horizons", "1,x"), 2, "--horizons"),
        (("--horizons", "0"), 2, "--horizons"),
        (("--outage-at", "5"), 2, "--outage"),
        (("--refit-sensors",), 2, "--calibration"),
        (("--outage", "1e6"), 1, "too long"),
        (("--budget", "-1"), 2, "--budget"),
        (("--budget", "nan"), 1, "budget"),
        (("--junit", "nowhere/g.xml"), 1, "does not exist"),
        (("--robot", "jackal"), 1, "a finished run keeps"),
        (("-o", "elsewhere"), 1, "leave -o out"),
        (("--outage", "0"), 2, "--outage"),
        (("--frobnicate",), 2, "frobnicate"),
    ],
)
def test_requests_that_cannot_be_met_leave_the_old_report(
    fitted: Path, report_here, arguments: tuple[str, ...], status: int, why: str
) -> None:
    before = {name: (fitted / RUN / name).stat().st_mtime_ns for name in files_in(fitted / RUN)}
    found, out, err = report_here(fitted, RUN, *LEAN, *arguments)
    assert (found, out) == (status, ""), err
    assert why in err
    assert {name: (fitted / RUN / name).stat().st_mtime_ns for name in files_in(fitted / RUN)} == before


def test_the_smoother_may_be_the_reference(folder: Path, report_here) -> None:
    status, _, err = report_here(folder, RUN, "--reference", "smoothed")
    assert status == 1
    assert "has no smoothed states; run icrtool fit --smooth" in err
    status, out, _ = report_here(folder, LOG, *ROBOT, "--reference", "smoothed", *LEAN, "-v")
    assert status == 0
    assert "compared with the smoothed trajectory" in " ".join(out.split())
    assert "held out in turn" not in out
    document = json.loads((folder / RUN / "dropout" / "report.json").read_text(encoding="utf-8"))
    assert document["request"]["reference"] == "smoothed"
    with (folder / RUN / "smoothed.csv").open("a", encoding="utf-8") as file:
        file.write("\n")
    status, _, err = report_here(folder, RUN, "--reference", "smoothed")
    assert status == 1
    assert "smoothed.csv was edited" in err


def test_the_ladder_holds_the_rows_of_the_summary(fitted: Path) -> None:
    document = json.loads((fitted / RUN / "dropout" / "report.json").read_text(encoding="utf-8"))["ladder"]
    summary = pd.read_csv(fitted / RUN / "dropout" / "summary.csv")
    names = [model["name"] for model in document["models"]]
    wheels = {"icr", "no_slip", "icr_final", "controller", "recommended", "adaptive"}
    assert set(names) == wheels | {f"{name}_gyro" for name in wheels} | {"vendor"}
    assert list(summary.model.unique()) == names
    fitted_to = {model["name"]: model["fitted"] for model in document["models"]}
    assert fitted_to["recommended"] == "the rest of the drive"


def test_a_finished_run_has_the_ladder_of_its_log(folder: Path, report_here) -> None:
    file = folder / RUN / "dropout" / "summary.csv"
    of_log = pd.read_csv(file)
    status, _, err = report_here(folder, RUN, "--no-page")
    assert (status, err) == (0, "")
    # a gate of the first report adds a distance
    pd.testing.assert_frame_equal(of_log[of_log.horizon_m != 7.5].reset_index(drop=True), pd.read_csv(file))
    (folder / RUN / "measurements.npz").write_bytes(b"something else")
    status, _, err = report_here(folder, RUN)
    assert status == 1
    assert "measurements.npz was edited" in err


def test_a_standstill_counts_once_unless_every_start_is_asked_for(folder: Path, report_here) -> None:
    documents = {}
    for starts in ("moving", "all"):
        status, _, err = report_here(folder, RUN, "--starts", starts, "--horizons", "1,5,1e6", *LEAN)
        assert (status, err) == (0, "")
        documents[starts] = json.loads((folder / RUN / "dropout" / "report.json").read_text(encoding="utf-8"))
    moving, every = (documents[starts]["trials"][0] for starts in ("moving", "all"))
    assert every["no_trial"]["from_standstill"] == 0
    assert every["trials"] - moving["trials"] == moving["no_trial"]["from_standstill"]
    assert documents["all"]["request"]["starts"] == "all"
    assert documents["all"]["trials"][2]["why_none"]
