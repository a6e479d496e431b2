"""A batch on a Dask cluster: a real scheduler and two workers, processes of their own on the loopback address."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path

import pytest
from click.testing import CliRunner

from icrtool.cli.simulate import simulate_command
from icrtool.output.run_directory import open_run
from support.servers import object_store

pytestmark = pytest.mark.skipif(find_spec("distributed") is None, reason="needs the extra icrtool[cluster]")
ROOT = Path(__file__).parents[3]
LOGS = 5


def start(*arguments: str, TMPDIR: str = tempfile.gettempdir(), **options: object) -> subprocess.Popen[bytes]:
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": paths, "TMPDIR": TMPDIR}
    return subprocess.Popen([sys.executable, "-P", *arguments], env=environment, **options)  # type: ignore[call-overload]


@pytest.fixture
def store():
    """An object store, whose address and credentials the processes that are started next have in their environment."""
    pytest.importorskip("s3fs", reason="needs the extra icrtool[cloud]")
    pytest.importorskip("moto.server", reason="needs moto, of the extra icrtool[dev]")
    with object_store() as found:
        yield found


@pytest.fixture
def cluster(tmp_path: Path):
    """A scheduler and two workers, each with a working directory and a folder for temporary files of its own."""
    file = tmp_path / "scheduler.json"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    begin = ("-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
    processes = [start(*begin, "--scheduler-file", str(file), **quiet)]
    worker = ("-m", "distributed.cli.dask_worker", "--scheduler-file", str(file), "--nthreads", "1", "--no-nanny")
    for number in range(2):
        own = tmp_path / f"worker {number}"
        (own / "temporary").mkdir(parents=True)
        processes.append(start(*worker, "--no-dashboard", cwd=own, TMPDIR=str(own / "temporary"), **quiet))
    for _ in range(600):
        if file.exists():
            break
        time.sleep(0.1)
    yield json.loads(file.read_text())["address"], processes
    for process in processes:
        process.kill()
        process.wait()


@pytest.mark.parametrize("logs", [4, pytest.param(20, marks=pytest.mark.stress)])
def test_workers_that_share_no_folder_give_all_of_a_bucket_to_a_bucket(
    tmp_path: Path, store, cluster, logs: int
) -> None:  # fmt: skip
    address, processes = cluster
    drive = ("--duration", "30", "-o", str(tmp_path / "drive.mcap"), "-q")
    assert CliRunner().invoke(simulate_command, drive).exit_code == 0
    for number in range(logs):
        store.client.upload_file(str(tmp_path / "drive.mcap"), "field", f"season/{number:02}.mcap")
    (tmp_path / "drive.mcap").unlink()
    (tmp_path / "client").mkdir()
    arguments = ("-m", "icrtool", "batch", "s3://field/season", "-o", "s3://field/out", "--plots", "none",
                 "--robot", "pentzer-tracked", "--no-ladder", "--no-page")  # fmt: skip
    batch = start(*arguments, "--json", "--scheduler", address, stdout=subprocess.PIPE, cwd=tmp_path / "client")

    def there(prefix: str) -> list[str]:
        found = store.client.list_objects_v2(Bucket="field", Prefix=f"out/{prefix}").get("Contents", [])
        return [one["Key"].removeprefix("out/") for one in found]

    # In the middle of a log of this worker: of two, one is at work while the other one writes a row.
    while len(there(".rows/")) < logs // 4 and batch.poll() is None:
        time.sleep(0.25)  # each question costs the server 10 ms of CPU
    assert len(there(".rows/")) < logs
    processes[1].send_signal(signal.SIGKILL)
    document = json.loads(batch.communicate(timeout=500)[0])
    assert batch.returncode == 0
    names = [f"{number:02}" for number in range(logs)]
    assert [row["log"] for row in document["logs"]] == [f"{name}.mcap" for name in names]
    assert document["counts"] == {"done": logs, "failed": 0, "skipped": 0}
    table = store.client.get_object(Bucket="field", Key="out/fleet.csv")["Body"].read().decode().splitlines()
    rows = list(csv.DictReader(table))
    assert [row["log"] for row in rows] == [f"{name}.mcap" for name in names]
    assert len({row["y_icr_right_m"] for row in rows}) == 1, "all are copies"
    for name in names:
        assert len(open_run(f"s3://field/out/runs/{name}").states) > 2900
    assert not list((tmp_path / "client").iterdir())


@pytest.mark.stress
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


@pytest.mark.stress
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
