"""What is easily mistaken for another thing: taken where it can be, else named with what to call instead."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

import icrtool as library
from icrtool.calibration.pooled import calibrate_runs
from icrtool.output.files.formats import CHECKSUM_FILE, file_b2sum
from icrtool.output.run_directory import RUN_FILE

LOGS = Path(__file__).resolve().parents[2] / "sample_logs"
NAME = "third"
OPTIONS = ("--robot", "husky-a200")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, short_logs: Path) -> Path:
    """Give the folder of one run."""
    folder = tmp_path_factory.mktemp("runs")
    config = library.load_config(robot="husky-a200")
    library.fit(library.read_log(short_logs / NAME, config), config).write(folder / NAME, plots=())
    return folder


@pytest.fixture
def run(made: Path, tmp_path: Path) -> Path:
    """Give a run that may be changed, in a folder ``runs``."""
    return Path(shutil.copytree(made / NAME, tmp_path / "runs" / NAME))


def test_fit_names_the_log_of_a_run(icrtool, run: Path) -> None:
    status, out, err = icrtool("fit", run, *OPTIONS)
    assert (status, out) == (1, "")
    assert "is a run" in err
    assert json.loads((run / RUN_FILE).read_text())["inputs"][0]["path"] in err
    assert f"icrtool dropout-report {run}" in err
    assert "--overwrite" not in err


def test_calibrate_takes_a_folder_of_runs_or_logs(icrtool, run: Path, tmp_path: Path, short_logs: Path) -> None:
    assert icrtool("calibrate", run.parent, "-o", "of-runs.json")[0] == 0
    shutil.copytree(short_logs / NAME, tmp_path / "season" / NAME)
    assert icrtool("calibrate", "season", *OPTIONS, "-o", "of-logs.json")[0] == 0
    of_runs, of_logs = (json.loads((tmp_path / name).read_text()) for name in ("of-runs.json", "of-logs.json"))
    assert of_runs["parameters"] == of_logs["parameters"]


def test_a_report_on_the_folder_of_a_batch_names_the_command_for_it(icrtool, tmp_path: Path) -> None:
    (tmp_path / "fleet").mkdir()
    (tmp_path / "fleet" / "fleet.json").write_text('{"schema": "icrtool/fleet/1"}')
    status, out, err = icrtool("dropout-report", "fleet")
    assert (status, out) == (1, "")
    assert "is the folder of a batch" in err
    assert "icrtool dropout-report fleet/runs/" in err


def test_forecast_calibrates_a_run_as_export_does(icrtool, run: Path, tmp_path: Path) -> None:
    assert icrtool("calibrate", run, "-o", "cal.json")[0] == 0
    found = [
        json.loads(icrtool("forecast", "--calibration", one, "--path", run, "--json")[1])["along"]["p95_error_m"]
        for one in ("cal.json", run)
    ]
    assert found[0] == pytest.approx(found[1])


@pytest.mark.parametrize("call", [library.dropout, library.dropout_report, library.calibrate])
@pytest.mark.parametrize("argument", ["run", Path("run")])
def test_python_says_how_to_read_a_run(call, argument: object) -> None:
    with pytest.raises(TypeError, match=r"a Run is needed, .*icrtool\.open_run"):
        call(argument)


@pytest.mark.parametrize("argument", ["log.mcap", Path("log.mcap")])
def test_python_says_how_to_read_a_log(argument: object) -> None:
    with pytest.raises(TypeError, match=r"a RobotLog is needed, .*icrtool\.read_log"):
        library.fit(argument)  # type: ignore[arg-type]


def test_a_run_from_before_jumps_were_listed_is_read_without_any(run: Path) -> None:
    document = json.loads((run / RUN_FILE).read_text())
    del document["reference_jumps"]
    (run / RUN_FILE).write_text(json.dumps(document))
    lines = (run / CHECKSUM_FILE).read_text().splitlines()
    sums = [f"{file_b2sum(run / RUN_FILE)}  {RUN_FILE}" if line.endswith(f"  {RUN_FILE}") else line for line in lines]
    (run / CHECKSUM_FILE).write_text("\n".join([*sums, ""]))
    opened = library.open_run(run)
    assert opened.summary["reference_jumps"] == []
    assert library.dropout(opened).counts.crosses_jump.sum() == 0


def test_a_log_that_was_cut_off_is_left_out_beside_the_whole_one(tmp_path: Path) -> None:
    content = (LOGS / "wheeled_lawnmower.mcap").read_bytes()
    config = library.load_config(robot="segway-rmp400")
    runs = []
    for name, size in (("whole", len(content)), ("short", 6 * len(content) // 10)):
        (tmp_path / f"{name}.mcap").write_bytes(content[:size])
        runs.append(library.fit(library.read_log(tmp_path / f"{name}.mcap", config), config))
    alone = library.calibrate(runs[0])
    for order in (runs, reversed(runs)):
        result = calibrate_runs(order)
        assert [str(one) for one in result.left_out] == ["short: left out: a part of whole"]
        assert [log.name for log in result.calibration.logs] == ["whole"]
        assert result.calibration.geometry == alone.geometry


def test_drives_of_the_same_wheels_with_other_fixes_are_both_calibrated(tmp_path: Path, icrtool) -> None:
    for seed in (1, 2):
        rates = ("--wheel-rate", "20", "--heading-rate", "20", "--gnss-rate", "5")
        options = ("--path", "figure-eight", "--duration", str(60 + 10 * seed), "--seed", str(seed), "-q", *rates)
        assert icrtool("simulate", "-o", f"{seed}.mcap", "--robot", "husky-a200", *options)[0] == 0
    assert icrtool("calibrate", "1.mcap", "2.mcap", "--robot", "husky-a200", "-o", "both.json")[0] == 0
    assert [log["name"] for log in json.loads((tmp_path / "both.json").read_text())["logs"]] == ["1", "2"]
