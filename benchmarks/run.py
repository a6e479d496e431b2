"""Speed and memory of icrtool, and ratios to other tools where there are any. `make bench`, or with options below.

There is no pass or fail: timings vary, so medians over repeats and ratios within one run are printed.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))
from make_log import add_images, make_logs

ROBOT = ("--robot", "segway-rmp400")


def timed(call: Callable[[], object], repeats: int) -> list[float]:
    """Return the wall seconds of some calls, after one to warm up."""
    call()
    seconds = []
    for _ in range(repeats):
        begin = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - begin)
    return seconds


def row(what: str, seconds: list[float], peer: list[float] | None = None, goal: str = "", unit: str = "s") -> None:
    """Print one line of the table."""
    middle = statistics.median(seconds)
    ours = f"{middle:.3g} {unit} ({min(seconds):.3g}-{max(seconds):.3g}, n={len(seconds)})"
    other = f"{statistics.median(peer):.3g} {unit}" if peer else ""
    ratio = f"{statistics.median(peer) / middle:.1f}" if peer else ""
    print(f"| {what} | {ours} | {other} | {ratio} | {goal} |", flush=True)


def ingest(logs: dict[str, Path], repeats: int) -> None:
    """Read the log into columns, against rosbags' AnyReader with deserialize."""
    from rosbags.highlevel import AnyReader

    import icrtool

    config = icrtool.load_config(robot="segway-rmp400")
    goals = {"hour.mcap": ">= 15", "hour.bag": ">= 8", "hour_db3": ">= 5"}

    def peer(path: Path) -> None:
        with AnyReader([path]) as reader:
            for connection, _, raw in reader.messages():
                reader.deserialize(raw, connection.msgtype)

    for name, path in logs.items():
        ours = timed(lambda path=path: icrtool.read_log(path, config), repeats)  # type: ignore[misc]
        begin = time.perf_counter()
        peer(path)
        row(f"ingest {name} against AnyReader", ours, [time.perf_counter() - begin], goals[name])


def against_decompression(log: Path, repeats: int) -> None:
    """Read an MCAP log, and decompress its chunks in one thread, in turn."""
    import zstandard
    from mcap.reader import make_reader

    import icrtool

    config = icrtool.load_config(robot="segway-rmp400")
    with log.open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        chunks = []
        for index in summary.chunk_indexes if summary else ():
            stream.seek(index.chunk_start_offset + index.chunk_length - index.compressed_size)
            chunks.append((stream.read(index.compressed_size), index.uncompressed_size))

    def decompress() -> None:
        for packed, size in chunks:
            zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)

    wall, cpu = [], []
    icrtool.read_log(log, config)
    for _ in range(max(repeats, 5)):
        both = [cost(call) for call in (lambda: icrtool.read_log(log, config), decompress)]
        wall.append(both[0][0] / both[1][0])
        cpu.append(both[0][1] / both[1][1])
    row("read hour.mcap, in decompressions of its chunks by one thread", wall, goal="<= 3", unit="times")
    row("the same in CPU time", cpu, unit="times")


def cost(call: Callable[[], object]) -> tuple[float, float]:
    """Return the wall and CPU seconds of a call."""
    wall, cpu = time.perf_counter(), time.process_time()
    call()
    return time.perf_counter() - wall, time.process_time() - cpu


def filter_speed(logs: dict[str, Path], repeats: int) -> None:
    """Run the filter alone on one core."""
    import icrtool
    from icrtool.alignment.align import sensors_as_sent
    from icrtool.estimation.filter_setup import set_up_filter
    from icrtool.kernels.filter.ekf import run_ekf

    config = icrtool.load_config(robot="segway-rmp400")
    setup = set_up_filter(sensors_as_sent(icrtool.read_log(logs["hour.mcap"], config), config), config)
    seconds = timed(lambda: run_ekf(*setup), max(repeats, 5))
    events = len(setup.data.wheel_t) + len(setup.data.gnss_t) + len(setup.data.heading_t)
    row("filter, events a second", [events / s / 1e6 for s in seconds], goal=">= 5", unit="million")


LAUNCH = """
import os, subprocess, sys, time
begin = time.perf_counter()
process = subprocess.Popen([sys.executable, "-m", "icrtool", *sys.argv[1:]], stdout=subprocess.DEVNULL)
_, status, usage = os.wait4(process.pid, 0)
print(time.perf_counter() - begin, usage.ru_maxrss / 1e3)
sys.exit(os.waitstatus_to_exitcode(status))
"""
"""Started through a small process: a new process inherits the peak memory of the process that starts it."""


def command(arguments: list[str], folder: Path, **environment: str) -> tuple[float, float]:
    """Run icrtool in a process of its own; return wall seconds and peak resident megabytes."""
    done = subprocess.run(
        [sys.executable, "-c", LAUNCH, *arguments],
        cwd=folder,
        capture_output=True,
        check=False,
        text=True,
        env={**os.environ, **environment},
    )
    if done.returncode:
        raise RuntimeError(f"icrtool {' '.join(arguments)}: {done.stderr}")
    seconds, megabytes = map(float, done.stdout.split())
    return seconds, megabytes


def whole_commands(logs: dict[str, Path], folder: Path, repeats: int) -> None:
    """Time whole commands, cold processes."""
    log = str(logs["hour.mcap"])
    fit = ["fit", log, *ROBOT, "-q", "-o", "run"]
    row("--help", [command(["--help"], folder)[0] for _ in range(repeats)], goal="<= 0.5 s")
    with tempfile.TemporaryDirectory() as cache:
        row(
            "fit, the very first run (nothing compiled)",
            [command(fit, folder, NUMBA_CACHE_DIR=cache)[0]],
            goal="<= 15 s",
        )
    runs = [command([*fit, "--plots", "none"], folder) for _ in range(repeats)]
    row("fit without plots", [seconds for seconds, _ in runs], goal="<= 3 s")
    row("fit without plots, peak memory", [memory for _, memory in runs], goal="<= 700 MB", unit="MB")
    row("fit with plots", [command(fit, folder)[0] for _ in range(repeats)], goal="<= 6 s")
    reports = [command(["dropout-report", "run", "-q"], folder) for _ in range(repeats)]
    row("dropout-report on a finished run", [seconds for seconds, _ in reports], goal="<= 4 s")
    row("dropout-report, peak memory", [memory for _, memory in reports], unit="MB")
    nowhere = {"NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator", "NUMBA_CACHE_DIR": "/dev/null/x"}
    row("fit where no cache can be written", [command([*fit, "--plots", "none"], folder, **nowhere)[0]])


def images(logs: dict[str, Path], folder: Path, gigabytes: float, repeats: int) -> None:
    """Measure a log with images added: time and memory must stay the same."""
    big = add_images(logs["hour.mcap"], folder / "images.mcap", gigabytes)
    fit = ["fit", str(big), *ROBOT, "-q", "-o", "run-images", "--plots", "none"]
    runs = [command(fit, folder) for _ in range(repeats)]
    row(f"fit without plots, with {gigabytes:g} GB of images", [seconds for seconds, _ in runs])
    row(f"peak memory with {gigabytes:g} GB of images", [memory for _, memory in runs], goal="within 20 %", unit="MB")
    big.unlink()


def dropout_kernels() -> None:
    """Run the comparison of the analysis with compiled brute force (a separate script)."""
    print("\nDropout analysis against compiled brute force:\n", flush=True)
    subprocess.run([sys.executable, str(Path(__file__).with_name("bench_open_loop.py"))], check=True)


def against_evo(logs: dict[str, Path], folder: Path) -> None:
    """Compare with evo_rpe --all_pairs, the most similar tool: one horizon, on two minutes of the log."""
    import icrtool

    if shutil.which("evo_rpe") is None:
        print("| evo_rpe --all_pairs | not installed: pip install evo | | | |")
        return
    config = icrtool.load_config(robot="segway-rmp400")
    run = icrtool.fit(icrtool.read_log(logs["hour.mcap"], config), config)
    rows = slice(0, 12_000)
    table = run.table
    for name, shift in (("reference", 0.0), ("estimate", 0.01)):
        heading = table.heading_rad[rows]
        np.savetxt(
            folder / f"{name}.tum",
            np.column_stack([
                table.t_s[rows], table.north_m[rows] + shift * table.t_s[rows], table.east_m[rows], 0 * heading,
                0 * heading, 0 * heading, np.sin(heading / 2), np.cos(heading / 2),
            ]),
        )  # fmt: skip
    arguments = ["evo_rpe", "tum", "reference.tum", "estimate.tum", "--delta", "10", "--delta_unit", "m", "--all_pairs"]
    begin = time.perf_counter()
    done = subprocess.run(arguments, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False)
    peer = time.perf_counter() - begin
    if done.returncode:
        print("| evo_rpe --all_pairs | could not be run | | | |")
        return
    ours = timed(lambda: icrtool.dropout(run, [10.0]), 3)
    share = len(table) / 12_000
    row("10 m from every state, against evo_rpe (its time per state, scaled)", ours, [peer * share], ">= 100")


def main() -> None:
    """Run the benchmarks chosen on the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="ten minutes of log instead of an hour")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument(
        "--images-gb", type=float, default=0.5, help="gigabytes of images put into the log; 0: leave out"
    )
    parser.add_argument("--only", choices=["ingest", "filter", "commands", "images", "dropout", "evo"])
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="icrtool-bench-") as name:
        folder = Path(name)
        seconds = 600.0 if options.quick else 3600.0
        logs = make_logs(folder, seconds)
        print(f"log of {seconds:.0f} s: JointState and Imu 100 Hz, NavSatFix 20 Hz\n")
        print("| what | ours: median (min-max) | peer | ratio | goal (1 h log) |\n|---|---|---|---|---|", flush=True)
        chosen = options.only
        if chosen in (None, "ingest"):
            ingest(logs, options.repeats)
            against_decompression(logs["hour.mcap"], options.repeats)
        if chosen in (None, "filter"):
            filter_speed(logs, options.repeats)
        if chosen in (None, "commands"):
            whole_commands(logs, folder, options.repeats)
        if chosen in (None, "images") and options.images_gb > 0:
            images(logs, folder, options.images_gb, options.repeats)
        if chosen in (None, "evo"):
            against_evo(logs, folder)
        if chosen in (None, "dropout"):
            dropout_kernels()


if __name__ == "__main__":
    main()
