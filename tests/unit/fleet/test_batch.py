from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import msgspec
import pytest

from icrtool.config import ConfigSources
from icrtool.errors import ConfigError, LogError, OutputError
from icrtool.fleet import processes
from icrtool.fleet.batch import find_finished_row, plan_requests, run_batch
from icrtool.fleet.fleet_files import write_fleet
from icrtool.fleet.one_log import process_log
from icrtool.fleet.processes import default_jobs
from icrtool.records.fleet_document import FleetLog
from icrtool.records.requests import BatchRequest, LogRequest, ReportRequest, ResultFiles

# A worker whose logs behave as they are named; the row is kept as `icrtool.fleet.one_log.process` keeps it.
SCRIPT = """
import os, signal, sys, time
from pathlib import Path
from msgspec.structs import replace
from icrtool.errors import DataError
from icrtool.fleet import one_log, processes

def results(request, stage):
    stage("reading")
    path = one_log.path_from_bytes(request.path)
    with open(path.parent / "order.txt", "a", errors="surrogateescape") as order:
        order.write(path.stem + chr(10))
    if "hang" in path.stem:
        time.sleep(60)
    if "kill" in path.stem:
        os.kill(os.getpid(), signal.SIGKILL)
    if "bug" in path.stem:
        print("a library prints this")
        raise KeyError("missing")
    if "once" in path.stem and not (path.parent / "tried").exists():
        (path.parent / "tried").touch()
        os.abort()
    if "bad" in path.stem:
        raise DataError(path.name, "no wheels")
    time.sleep(0.3 if "slow" in path.stem else 0)
    directory = one_log.path_from_bytes(request.folder) / request.known.run
    (directory / "dropout").mkdir(parents=True, exist_ok=True)
    (directory / "run.json").write_text("{}")
    (directory / "B2SUMS").touch()
    if request.files.page:
        (directory / "report.html").touch()
    return replace(request.known, status="done", distance_m=7.0, errors={"icr_p95_10m_m": 0.25},
                   inputs=one_log.hashed_files(path))

one_log._fit_and_report = results
processes.main()
"""


@pytest.fixture
def season(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "script.py").write_text(SCRIPT)
    monkeypatch.setattr(processes, "PROCESS_COMMAND", (sys.executable, str(tmp_path / "script.py")))
    (tmp_path / "season").mkdir()
    yield tmp_path / "season"
    processes.close_all()


def add(season: Path, *names: str) -> None:
    for name in names:
        (season / f"{name}.mcap").write_bytes(b"\x89MCAP0\r\n" + name.encode())


def run(
    season: Path, jobs: int = 2, robot: str | None = None, sets: tuple[str, ...] = (), **options: object
) -> dict[str, FleetLog]:
    files = ResultFiles(page=bool(options.pop("page", True)))
    asked = BatchRequest(ConfigSources(None, robot, sets), files=files, timeout_s=60.0, **options)  # type: ignore[arg-type]
    requests = plan_requests([season], season.parent / "out", asked)
    with ThreadPoolExecutor(jobs) as executor:
        rows = list(run_batch(requests, executor, asked))
    assert sorted(row.log for row in rows) == sorted(request.known.log for request in requests), "one row a log"
    return {Path(row.log).stem: row for row in rows}


def test_a_log_that_fails_hangs_or_dies_costs_only_itself(season: Path) -> None:
    add(season, "a", "bad", "bug", "kill", "once", "z")
    rows = run(season, robot="husky-a200")
    assert {name: row.robot for name, row in rows.items() if row.status == "failed"} == dict.fromkeys(
        ("bad", "bug", "kill"), "husky-a200"
    )
    assert {name: row.status for name, row in rows.items()} == {
        "a": "done", "bad": "failed", "bug": "failed", "kill": "failed", "once": "done", "z": "done",
    }  # fmt: skip
    assert rows["bad"].reason == "bad.mcap: no wheels"
    assert "KeyError" in rows["bug"].reason
    assert "Traceback" in rows["bug"].details
    assert "a library prints this" in rows["bug"].details
    assert "SIGKILL" in rows["kill"].reason
    tried = (season / "order.txt").read_text().split()
    assert {name: tried.count(name) for name in rows} == {"a": 1, "bad": 1, "bug": 2, "kill": 2, "once": 2, "z": 1}


def test_a_log_that_hangs_is_ended(season: Path) -> None:
    add(season, "hang", "a")
    requests = plan_requests([season], season.parent / "out", BatchRequest())
    begun = time.monotonic()
    with ThreadPoolExecutor(2) as executor:
        rows = list(run_batch(requests, executor, BatchRequest(timeout_s=10.0)))
    assert time.monotonic() - begun < 40
    assert {row.log: row.status for row in rows} == {"hang.mcap": "failed", "a.mcap": "done"}
    assert {row.log: row.usable for row in rows} == {"hang.mcap": False, "a.mcap": True}
    assert all(row.took_s >= 10.0 for row in rows if "longer than 10 s" in row.reason)
    assert any("longer than 10 s" in row.reason for row in rows)


def test_what_is_done_is_skipped_until_input_configuration_or_request_change(season: Path) -> None:
    add(season, "a", "b", "bad")
    first = {name: row.status for name, row in run(season).items()}
    assert first == {"a": "done", "b": "done", "bad": "failed"}
    again = run(season)
    assert {name: row.status for name, row in again.items()} == first, "the status is about the result"
    assert {row.this_time for row in again.values()} == {"skipped"}
    assert again["a"].distance_m == 7.0
    assert len((season / "order.txt").read_text().split()) == 3, "the log's own error is kept, nothing ran again"
    (season / "a.mcap").touch()  # another time, the same content
    assert run(season)["a"].this_time == "skipped"
    (season / "a.mcap").write_bytes(b"\x89MCAP0\r\nA")  # the same size and another content
    assert run(season)["a"].this_time == "processed"
    assert run(season, sets=("filter.preset=paper",))["b"].this_time == "processed"
    assert run(season, sets=("filter.preset=paper",), redo=True)["b"].this_time == "processed"
    (season.parent / "out" / "runs" / "b" / "run.json").unlink()
    assert run(season, sets=("filter.preset=paper",))["b"].this_time == "processed"


def test_the_content_and_name_of_a_calibration_and_the_refit_belong_to_what_is_done(season: Path) -> None:
    add(season, "a")
    first, second = season.parent / "first.json", season.parent / "second.json"
    first.write_text("1")
    assert run(season)["a"].this_time == "processed"
    assert run(season, calibrations=(first,))["a"].this_time == "processed"
    assert run(season, calibrations=(first,))["a"].this_time == "skipped"
    refit = ReportRequest(refit_sensors=True)
    assert run(season, calibrations=(first,), report=refit)["a"].this_time == "processed"
    assert run(season, calibrations=(first,))["a"].this_time == "processed"
    first.write_text("2")
    assert run(season, calibrations=(first,))["a"].this_time == "processed"
    # A row of the report has the name of the file.
    first.rename(second)
    assert run(season, calibrations=(second,))["a"].this_time == "processed"
    (season.parent / "elsewhere").mkdir()
    moved = second.rename(season.parent / "elsewhere" / second.name)
    assert run(season, calibrations=(moved,))["a"].this_time == "skipped"
    assert run(season, calibrations=(moved, moved))["a"].this_time == "processed"


def test_a_calibration_that_changes_while_a_batch_runs_fails_the_log_until_the_next_batch(season: Path) -> None:
    add(season, "a")
    file = season.parent / "cal.json"
    file.write_text("1")
    (request,) = plan_requests([season], season.parent / "out", BatchRequest(calibrations=(file,)))
    reasons = {}
    for content in ("2", None):
        if content is None:
            file.unlink()
        else:
            file.write_text(content)
        row = process_log(request, lambda _: None)
        assert (row.status, row.repeatable) == ("failed", False)
        reasons[content] = row.reason
    assert "cal.json: changed since the batch began" in reasons["2"]
    assert "cal.json: No such file" in reasons[None]


def test_another_version_processes_all_again(season: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    add(season, "a")
    run(season)
    monkeypatch.setattr("icrtool.fleet.batch.__version__", "99")
    assert run(season)["a"].this_time == "processed"


def test_a_row_file_that_is_damaged_is_not_trusted(season: Path) -> None:
    add(season, "a")
    run(season)
    (file,) = (season.parent / "out" / ".rows").iterdir()
    for content in (b"", b"{}", b"[", file.read_bytes()[:-20]):
        file.write_bytes(content)
        assert run(season)["a"].this_time == "processed"


def test_a_finished_log_without_a_page_is_processed_again_where_one_is_asked_for(season: Path) -> None:
    add(season, "a")
    assert run(season, page=False)["a"].this_time == "processed"
    assert run(season, page=False)["a"].this_time == "skipped"
    assert run(season)["a"].this_time == "processed"
    assert run(season)["a"].this_time == "skipped"


def test_an_interrupted_batch_ends_its_processes_and_is_continued(season: Path) -> None:
    add(season, "a", "hang1", "hang2", "hang3")
    asked = BatchRequest(timeout_s=50)
    requests = plan_requests([season], season.parent / "out", asked)
    begun, threads = time.monotonic(), threading.active_count()
    with ThreadPoolExecutor(2) as executor:
        rows = run_batch(requests, executor, asked)
        assert next(rows).log == "a.mcap"
        rows.close()
    assert time.monotonic() - begun < 30, "nobody waits for what hangs"
    assert threading.active_count() < threads + 10
    for name in ("hang1", "hang2", "hang3"):
        (season / f"{name}.mcap").unlink()
    add(season, "b")
    assert {name: row.this_time for name, row in run(season).items()} == {"a": "skipped", "b": "processed"}


def test_a_worker_ends_with_whoever_started_it(season: Path) -> None:
    add(season, "hang")
    request = plan_requests([season], season.parent / "out", BatchRequest())[0]
    process = subprocess.Popen(
        processes.PROCESS_COMMAND, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=Path(__file__).parents[3],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])},
    )  # fmt: skip
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write(request.encode() + b"\n")
    process.stdin.flush()
    assert b"reading" in process.stdout.readline()
    process.stdin.close()
    assert process.wait(20) == 1
    process.stdout.close()


def test_a_request_survives_its_journey_whatever_its_path(season: Path) -> None:
    name = os.fsdecode(b"\xff\n.mcap")
    (season / name).write_bytes(b"\x89MCAP0\r\n")
    request = plan_requests(
        [season], season.parent / "out", BatchRequest(ConfigSources(sets=("robot.track_width_m=0.5",)))
    )[0]
    from icrtool.records.requests import decode_request

    again = decode_request(request.encode())
    assert again == request
    assert again.config.effective() == request.config.effective()
    assert os.fsdecode(again.path) == str(season / name)
    assert b"\n" not in request.encode()
    assert run(season).popitem()[1].status == "done"


def test_the_manifest_gives_robot_group_and_tags(season: Path) -> None:
    add(season, "a", "b")
    (season / "own.toml").write_text('[robot]\nname = "mule"\ntrack_width_m = 0.9\n')
    (season / "m.csv").write_text(
        "log,robot,config,group,tags\na.mcap,husky-a200,,grass,wet\nb.mcap,mule,own.toml,ice,\n"
    )
    requests = plan_requests([season / "m.csv"], season.parent / "out", BatchRequest())
    first, second = requests
    assert (first.known.robot, first.known.group, first.known.tags) == ("husky-a200", "grass", ("wet",))
    assert first.config.robot.name == "husky-a200"
    assert (second.known.robot, second.config.robot.track_width_m) == ("mule", 0.9)
    (season / "m.csv").write_text("log,robot\na.mcap,husky-a20\n")
    with pytest.raises(ConfigError, match="husky-a20"):
        plan_requests([season / "m.csv"], season.parent / "out", BatchRequest())


def test_what_cannot_be_planned_is_refused_at_once(season: Path, tmp_path: Path) -> None:
    with pytest.raises(LogError, match="no recording"):
        plan_requests([season], tmp_path / "out", BatchRequest())
    add(season, "a")
    with pytest.raises(ConfigError, match="gate"):
        plan_requests([season], tmp_path / "out", BatchRequest(report=ReportRequest(gates=("nonsense",))))
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="is a file"):
        plan_requests([season], tmp_path / "file", BatchRequest())
    (tmp_path / "run.json").touch()
    with pytest.raises(OutputError, match="is the directory of a run"):
        plan_requests([season], tmp_path, BatchRequest())


def test_memory_bounds_how_many_logs_run_at_once(season: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    add(season, *"abcdefgh")
    logs = sorted(season.iterdir())
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(8)), raising=False)
    for free, jobs in ((None, 8), (100 << 30, 8), (2 << 30, 5), (1, 1)):
        monkeypatch.setattr("icrtool.fleet.processes._free_bytes", lambda free=free: free)
        assert default_jobs(logs) == jobs
    assert default_jobs(logs[:3]) <= 3


def test_tables_hold_a_row_per_log_and_null_where_nothing_is_known(season: Path, tmp_path: Path) -> None:
    done = FleetLog("a.mcap", "runs/a", "done", distance_m=7.0, errors={"icr_p95_10m_m": 0.25}, icr={"x_icr_m": 0.1})
    bad = FleetLog(
        "b\udcff.mcap".encode("utf-8", "backslashreplace").decode(), "runs/b", "failed", reason='a "why", here'
    )
    write_fleet([done, bad], tmp_path)
    with (tmp_path / "fleet.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows] == ["done", "failed"]
    assert rows[0]["icr_p95_10m_m"] == "0.25"
    assert rows[1]["icr_p95_10m_m"] == rows[1]["distance_m"] == ""
    with (tmp_path / "failures.csv").open(encoding="utf-8") as file:
        assert [row["reason"] for row in csv.DictReader(file)] == ['a "why", here']
    import pandas as pd

    frame = pd.read_parquet(tmp_path / "fleet.parquet")
    assert list(frame.columns) == list(rows[0])
    assert frame["distance_m"].isna().tolist() == [False, True]
    document = json.loads((tmp_path / "fleet.json").read_text())
    assert document["counts"] == {"done": 1, "failed": 1, "skipped": 0}
    contract = ("log", "status", "this_time", "reason",
                "robot", "group", "start_utc", "duration_s", "distance_m", "y_icr_right_m",
                "y_icr_left_m", "x_icr_m", "std_y_icr_right_m", "std_y_icr_left_m", "std_x_icr_m", "multiplier",
                "multiplier_std", "events", "outages", "warnings", "tool_version")  # fmt: skip
    assert set(contract) <= set(rows[0])


def test_a_finished_log_of_a_moved_folder_is_found_by_content(season: Path, tmp_path: Path) -> None:
    add(season, "a")
    run(season)
    moved = tmp_path / "moved"
    season.rename(moved)
    request = plan_requests([moved], tmp_path / "out", BatchRequest())[0]
    assert isinstance(request, LogRequest)
    found = find_finished_row(request, tmp_path / "out")
    assert found is not None
    other = msgspec.structs.replace(request.known, key="other")
    assert find_finished_row(msgspec.structs.replace(request, known=other), tmp_path / "out") is None
