"""Time a batch: one process against several, overhead beside the logs' own work, Dask with two workers, resume.

Run it on an idle machine: ``python benchmarks/batch.py FOLDER [--logs N] [--dask]``; 60 logs with Dask take some 15
minutes. The logs (5 min, simulated, each with its own seed) are made in FOLDER once.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

ICRTOOL = (sys.executable, "-P", "-m", "icrtool")
ROBOT = ("--robot", "husky-a200")
RATES = ("--wheel-rate", "50", "--gnss-rate", "5", "--heading-rate", "50")


DASK_SETTINGS = {  # of docs/fleet.md
    "DASK_DISTRIBUTED__ADMIN__TICK__INTERVAL": "500ms",
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
    "DASK_DISTRIBUTED__WORKER__MEMORY__MONITOR_INTERVAL": "2s",
}


def make_logs(folder: Path, count: int, duration_s: float = 300.0) -> Path:
    """Simulate the logs that are not there yet."""
    logs = folder / f"logs{count}"
    logs.mkdir(parents=True, exist_ok=True)
    for seed in range(count):
        log = logs / f"drive{seed:03d}.mcap"
        if not log.exists():
            path = ("lawnmower", "curved", "figure-eight")[seed % 3]
            options = ("--seed", str(seed), "--duration", str(duration_s), "--path", path, *ROBOT, *RATES)
            subprocess.run([*ICRTOOL, "simulate", "-q", "-o", log, *options], check=True)
            log.with_suffix(".mcap.truth.csv").unlink(missing_ok=True)
    return logs


def run(logs: Path, output: Path, *options: str, fresh: bool = True) -> dict[str, float]:
    """Run a batch; return wall time, the logs' own time, CPU time [s] and the most memory of all its processes [MB]."""
    if fresh:
        shutil.rmtree(output, ignore_errors=True)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    begun = time.monotonic()
    process, most_mb = subprocess.Popen([*ICRTOOL, "batch", logs, "-o", output, "-q", *ROBOT, *options]), 0.0
    while process.returncode is None:
        most_mb = max(most_mb, memory_mb(process.pid))
        with suppress(subprocess.TimeoutExpired):
            process.wait(timeout=1.0)  # a look takes 10 ms of CPU
    wall = time.monotonic() - begun
    if process.returncode:
        raise SystemExit(f"batch ended with {process.returncode}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    rows = json.loads((output / "fleet.json").read_bytes())["logs"]
    if failed := [row["log"] for row in rows if row["status"] == "failed"]:
        raise SystemExit(f"{failed}: failed")
    return {
        "wall_s": wall,
        "logs_s": sum(row["took_s"] for row in rows),
        "cpu_s": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
        "most_mb": most_mb,
    }


def memory_mb(pid: int) -> float:
    """Return the memory of a process and its children [MB]; of what several processes share, each one's part."""
    try:
        pss = Path(f"/proc/{pid}/smaps_rollup").read_text().partition("\nPss:")[2]
        children = [one for file in Path(f"/proc/{pid}/task").glob("*/children") for one in file.read_text().split()]
        kilobytes = int(pss.split()[0])
    except (OSError, IndexError):  # it has ended
        return 0.0
    return kilobytes / 2**10 + sum(memory_mb(int(child)) for child in children)


def with_dask(logs: Path, output: Path) -> dict[str, float]:
    """Run a batch on a scheduler and two workers on this machine."""
    dask = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "8799",
            "--dashboard-address", "127.0.0.1:0"]  # fmt: skip
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", "tcp://127.0.0.1:8799", "--nthreads", "1"]
    settings = {**os.environ, **DASK_SETTINGS}
    processes = [subprocess.Popen(one, stderr=subprocess.DEVNULL, env=settings) for one in (dask, worker, worker)]
    try:
        time.sleep(5.0)
        return run(logs, output, "--scheduler", "tcp://127.0.0.1:8799")
    finally:
        for process in reversed(processes):
            process.terminate()
            process.wait()


def main() -> None:
    """Print a line per measurement."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--logs", type=int, default=200)
    parser.add_argument("--dask", action="store_true")
    asked = parser.parse_args()
    logs, output = make_logs(asked.folder, asked.logs), asked.folder / "out"
    jobs = str(os.cpu_count() or 1)
    print(f"{asked.logs} logs of 5 min, {jobs} cores, load {os.getloadavg()[0]:.1f}")
    found = {"-j 1": run(logs, output, "-j", "1"), f"-j {jobs}": run(logs, output, "-j", jobs)}
    found["resume"] = run(logs, output, "-j", jobs, fresh=False)
    if asked.dask:
        found["dask"] = with_dask(logs, output)
    alone, local = found["-j 1"], found[f"-j {jobs}"]
    for name, one in found.items():
        count = 1 if name == "-j 1" else int(jobs)
        print(f"{name:7} wall {one['wall_s']:7.1f} s  CPU {one['cpu_s']:7.1f} s  memory {one['most_mb']:.0f} MB")
        if name != "resume":
            print(
                f"        overhead beside the logs' own work {100 * (one['wall_s'] * count / one['logs_s'] - 1):.1f} %"
            )
    print(f"-j {jobs}: {alone['wall_s'] / local['wall_s']:.2f} times faster than -j 1 (goal 1.8)")
    print(f"-j {jobs}: {local['most_mb'] / alone['most_mb']:.2f} times the memory of -j 1 (goal {jobs})")
    if asked.dask:
        print(
            f"dask: {100 * (found['dask']['wall_s'] / local['wall_s'] - 1):+.1f} % of the time of -j {jobs} (goal 15 %)"
        )


if __name__ == "__main__":
    main()
