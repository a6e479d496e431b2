"""A batch on a Dask cluster: a real scheduler and two workers, processes of their own on the loopback address."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("distributed", reason="needs the extra icrtool[cluster]")
pytestmark = pytest.mark.stress

ROOT = Path(__file__).parents[3]
LOGS = 5


def start(*arguments: str, **options: object) -> subprocess.Popen[bytes]:
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": paths}
    return subprocess.Popen([sys.executable, "-P", *arguments], env=environment, **options)  # type: ignore[call-overload]


@pytest.fixture
def cluster(tmp_path: Path):
    file = tmp_path / "scheduler.json"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    begin = ("-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
    processes = [start(*begin, "--scheduler-file", str(file), **quiet)]
    worker = ("-m", "distributed.cli.dask_worker", "--scheduler-file", str(file), "--nthreads", "1", "--no-nanny")
    processes += [start(*worker, "--no-dashboard", **quiet) for _ in range(2)]
    for _ in range(600):
        if file.exists():
            break
        time.sleep(0.1)
    yield json.loads(file.read_text())["address"], processes
    for process in processes:
        process.kill()
        process.wait()


def test_a_worker_killed_in_the_middle_loses_no_row_and_doubles_none(tmp_path: Path, cluster) -> None:
    address, processes = cluster
    for number in range(LOGS):
        drive = ("--duration", "40", "--seed", str(number), "-o", str(tmp_path / "logs" / f"{number}.mcap"), "-q")
        (tmp_path / "logs").mkdir(exist_ok=True)
        assert start("-m", "icrtool", "simulate", *drive).wait(300) == 0
    arguments = ("-m", "icrtool", "batch", str(tmp_path / "logs"), "-o", str(tmp_path / "out"), "--plots", "none",
                 "--robot", "pentzer-tracked", "--no-ladder")  # fmt: skip
    batch = start(*arguments, "--json", "--scheduler", address, stdout=subprocess.PIPE)
    rows = tmp_path / "out" / ".rows"
    for _ in range(3000):
        if rows.is_dir() and len(list(rows.glob("[!.]*"))) >= 2:
            break
        time.sleep(0.1)
    processes[1].send_signal(signal.SIGKILL)
    document = json.loads(batch.communicate(timeout=500)[0])
    assert batch.returncode == 0
    assert [row["log"] for row in document["logs"]] == [f"{number}.mcap" for number in range(LOGS)]
    assert document["counts"] == {"done": LOGS, "failed": 0, "skipped": 0}


@pytest.mark.parametrize("lost", ["scheduler", "workers"])
def test_a_cluster_that_is_lost_gives_a_row_for_each_log_and_all_tables(tmp_path: Path, cluster, lost: str) -> None:
    address, processes = cluster
    (tmp_path / "logs").mkdir()
    for number in range(3):
        drive = ("--duration", "40", "--seed", str(number), "-o", str(tmp_path / "logs" / f"{number}.mcap"), "-q")
        assert start("-m", "icrtool", "simulate", *drive).wait(300) == 0
    if lost == "workers":
        for process in processes[1:]:
            process.kill()
    arguments = ("-m", "icrtool", "batch", str(tmp_path / "logs"), "-o", str(tmp_path / "out"), "--plots", "none",
                 "--robot", "pentzer-tracked", "--no-ladder", "--worker-timeout", "3")  # fmt: skip
    batch = start(*arguments, "--json", "--scheduler", address, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    if lost == "scheduler":
        for _ in range(3000):
            if list((tmp_path / "out").rglob("*.partial")):  # a worker writes: the batch is connected
                break
            time.sleep(0.02)
        processes[0].kill()
    output, errors = batch.communicate(timeout=300)
    assert b"Traceback" not in errors
    assert batch.returncode == 1
    document = json.loads(output)
    assert [row["log"] for row in document["logs"]] == [f"{number}.mcap" for number in range(3)]
    failures = [row for row in document["logs"] if row["status"] == "failed"]
    assert failures
    assert all("cluster" in row["reason"] for row in failures)
    assert (tmp_path / "out" / "fleet.csv").is_file()
