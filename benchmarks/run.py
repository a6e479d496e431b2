"""Speed and memory of icrtool, each row with its ratio to a peer on the same machine: `make bench`, options below.

Nothing fails because of a time: timings vary, so medians and ratios within one run are printed, and written as JSON.
`benchmarks/compare.py` prints the ratio of two such tables. A section that fails ends the run with its traceback.
Peers: AnyReader of rosbags, which deserializes every message of the same log in plain Python; one thread that
decompresses the log's chunks; the filter in matrices of the tests; evo; direct integration; the command without images.
"""

from __future__ import annotations

import argparse
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import batch
import numpy as np
from bench_open_loop import open_loop_rows
from make_log import add_images, make_logs
from table import HEAD, Table, cpu_seconds_of, seconds_of

ROBOT = ("--robot", "segway-rmp400")
BY_ANYREADER = "to read it with AnyReader"


class Extent(NamedTuple):
    """How much is measured.

    Attributes
    ----------
    log_s, long_s, evo_s : length of the log; of the long one, 0 for none; of the part that evo gets
    images_gb : of images in a log; batch_logs, batch_s : number and length of the logs of a batch
    repeats : of each measurement that takes less than a minute
    """

    log_s: float
    long_s: float
    evo_s: float
    images_gb: float
    batch_logs: int
    batch_s: float
    repeats: int


FULL = Extent(3600.0, 36_000.0, 120.0, 5.0, 20, 300.0, 5)
QUICK = Extent(200.0, 0.0, 20.0, 0.05, 2, 45.0, 1)


class Bench:
    """The logs, the folder and the table of one run of the benchmarks."""

    def __init__(self, folder: Path, extent: Extent) -> None:
        self.folder, self.extent = folder, extent
        self.table = Table(extent.log_s)

    @cached_property
    def logs(self) -> dict[str, Path]:
        """The log in each container."""
        return make_logs(self.folder, self.extent.log_s)

    @cached_property
    def any_reader(self) -> dict[str, tuple[float, float]]:
        """Wall and CPU seconds in which AnyReader deserializes the log, by container; it uses one thread."""
        costs = {}
        for name, log in self.logs.items():
            begin = time.perf_counter()
            cpu = cpu_of(lambda log=log: read_all(log))
            costs[name] = time.perf_counter() - begin, cpu
        return costs


def read_all(log: Path) -> None:
    """Deserialize every message of a log with rosbags."""
    from rosbags.highlevel import AnyReader

    with AnyReader([log]) as reader:
        for connection, _, raw in reader.messages():
            reader.deserialize(raw, connection.msgtype)


def ingest(bench: Bench) -> None:
    """Read the log into columns, against AnyReader, and against the decompression of its chunks."""
    import icrtool

    config = icrtool.load_config(robot="segway-rmp400")
    for name, goal in {"hour.mcap": "40 times", "hour.bag": "56 times", "hour_db3": "12 times"}.items():
        log = bench.logs[name]
        ours = seconds_of(lambda log=log: icrtool.read_log(log, config), bench.extent.repeats)
        bench.table.add(f"ingest {name}", ours, bench.any_reader[name][0], BY_ANYREADER, goal=goal)
    log = bench.logs["hour.mcap"]
    chunks = chunks_of(log)
    ours, peer = [], []
    for _ in range(bench.extent.repeats):
        ours.append(cpu_of(lambda: icrtool.read_log(log, config)))
        peer.append(cpu_of(lambda: decompress(chunks)))
    bench.table.add(
        "ingest hour.mcap, CPU", ours, float(np.median(peer)), "to decompress its chunks in one thread", goal="1/3"
    )


def chunks_of(log: Path) -> list[tuple[bytes, int]]:
    """Return the compressed chunks of an MCAP file, and the length of each when decompressed."""
    from mcap.reader import make_reader

    with log.open("rb") as stream:
        summary = make_reader(stream).get_summary()
        chunks = []
        for index in summary.chunk_indexes if summary else ():
            stream.seek(index.chunk_start_offset + index.chunk_length - index.compressed_size)
            chunks.append((stream.read(index.compressed_size), index.uncompressed_size))
    return chunks


def decompress(chunks: list[tuple[bytes, int]]) -> None:
    """Decompress chunks one after the other."""
    import zstandard

    for packed, size in chunks:
        zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)


def cpu_of(call: Callable[[], object]) -> float:
    """Return the CPU seconds of a call, of all threads."""
    begin = time.process_time()
    call()
    return time.process_time() - begin


def filter_speed(bench: Bench) -> None:
    """Run the filter alone on one core, against the same in matrices on the first minute."""
    import icrtool
    from icrtool.alignment.align import align
    from icrtool.estimation.filter_setup import FilterSetup, set_up_filter
    from icrtool.kernels.ekf import run_ekf

    sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))
    from support.matrix_filter import run_ekf_plain

    config = icrtool.load_config(robot="segway-rmp400")

    def prepare(end_s: float) -> tuple[FilterSetup, float]:
        log = icrtool.read_log(bench.logs["hour.mcap"], config, end=end_s)
        setup = set_up_filter(align(log, config).sensors, config)
        return setup, (len(setup.data.wheel_t) + len(setup.data.gnss_t) + len(setup.data.heading_t)) / 1e6

    (whole, events), (minute, few) = prepare(bench.extent.log_s), prepare(60.0)
    ours = [seconds / events for seconds in cpu_seconds_of(lambda: run_ekf(*whole), bench.extent.repeats)]
    [plain] = cpu_seconds_of(lambda: run_ekf_plain(*minute), 1, warm_up=False)
    bench.table.add("filter, an event", ours, plain / few, "in matrices", unit="us", goal="0.2 us")


class Cost(NamedTuple):
    """What a command needed, its processes together; the memory is that of the largest of them."""

    wall_s: float
    cpu_s: float
    megabytes: float


LAUNCH = """
import os, subprocess, sys, time
begin = time.perf_counter()
process = subprocess.Popen([sys.executable, "-P", "-m", "icrtool", *sys.argv[1:]], stdout=subprocess.DEVNULL)
_, status, usage = os.wait4(process.pid, 0)
print(time.perf_counter() - begin, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024 / 1e6)
sys.exit(os.waitstatus_to_exitcode(status))
"""
"""Started through a small process: a new process inherits the peak memory of the process that starts it."""


def command(folder: Path, *arguments: str | Path, **environment: str) -> Cost:
    """Run icrtool in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", LAUNCH, *arguments],
        cwd=folder, env={**os.environ, **environment}, capture_output=True, check=False, text=True,
    )  # fmt: skip
    if done.returncode:
        raise RuntimeError(f"icrtool {' '.join(map(str, arguments))}: {done.stderr}")
    return Cost(*map(float, done.stdout.split()))


def first_run(bench: Bench) -> None:
    """Fit and report with an empty cache of compiled kernels, as on a fresh machine."""
    log = bench.logs["hour.mcap"]
    _, peer = bench.any_reader["hour.mcap"]
    with tempfile.TemporaryDirectory() as cache:
        fit = command(bench.folder, "fit", log, *ROBOT, "-q", "-o", "first", *NO_PICTURES, NUMBA_CACHE_DIR=cache)
        bench.table.add("the very first fit, CPU", [fit.cpu_s], peer, BY_ANYREADER, goal="10 s")
        report = command(bench.folder, "dropout-report", "first", "-q", *NO_PAGE, NUMBA_CACHE_DIR=cache)
        bench.table.add("the very first dropout-report, CPU", [report.cpu_s], peer, BY_ANYREADER, goal="5 s more")


NO_PICTURES = ("--plots", "none")
NO_PAGE = (*NO_PICTURES, "--no-page")


def commands(bench: Bench) -> None:
    """Fit and report the log in fresh processes, with and without pictures."""
    log, (peer_wall, peer) = bench.logs["hour.mcap"], bench.any_reader["hour.mcap"]
    fit, report = ("fit", log, *ROBOT, "-q", "-o", "run"), ("dropout-report", "run", "-q")
    wanted: dict[str, tuple[tuple[str | Path, ...], str, str]] = {
        "fit without pictures": ((*fit, *NO_PICTURES), "2.5 s", "700 MB"),
        "fit with pictures": (fit, "", ""),
        "dropout-report without pictures and page": ((*report, *NO_PAGE), "3 s", ""),
        "dropout-report with pictures and page": (report, "5 s", ""),
    }
    for name, (arguments, cpu_goal, memory_goal) in wanted.items():
        costs = [command(bench.folder, *arguments) for _ in range(bench.extent.repeats)]
        bench.table.add(f"{name}, CPU", [one.cpu_s for one in costs], peer, BY_ANYREADER, goal=cpu_goal)
        bench.table.add(f"{name}, wall", [one.wall_s for one in costs], peer_wall, BY_ANYREADER)
        of_log = log.stat().st_size / 1e6
        memory = [one.megabytes for one in costs]
        bench.table.add(f"{name}, memory", memory, of_log, "the file", unit="MB", goal=memory_goal)
    starts = [command(bench.folder, "--help").cpu_s for _ in range(bench.extent.repeats)]
    bench.table.add("--help, CPU", starts, peer, BY_ANYREADER, goal="0.5 s")


def long_log(bench: Bench) -> None:
    """Fit and report a season in one log: memory."""
    if not bench.extent.long_s:
        return
    log = make_logs(bench.folder / "long", bench.extent.long_s, ("hour.mcap",))["hour.mcap"]
    fit = command(bench.folder, "fit", log, *ROBOT, "-q", "-o", "season")
    report = command(bench.folder, "dropout-report", "season", "-q")
    of_log, hours = log.stat().st_size / 1e6, bench.extent.long_s / 3600
    for name, cost in {"fit": fit, "dropout-report": report}.items():
        what = f"{name} of {hours:g} h with pictures, memory"
        bench.table.add(what, [cost.megabytes], of_log, "the file", unit="MB", goal="1000 MB")
    log.unlink()


def images(bench: Bench) -> None:
    """Fit the log with images added: time and memory stay nearly the same."""
    log, gigabytes = bench.logs["hour.mcap"], bench.extent.images_gb
    big = add_images(log, bench.folder / "images.mcap", gigabytes)
    fit = ("-q", *ROBOT, *NO_PICTURES, "-o")
    plain, seen = (
        [command(bench.folder, "fit", one, *fit, name) for _ in range(bench.extent.repeats)]
        for one, name in ((log, "without"), (big, "with"))
    )
    big.unlink()
    for what, unit in {"cpu_s": "s", "megabytes": "MB"}.items():
        values, peers = ([getattr(one, what) for one in costs] for costs in (seen, plain))
        name = f"fit with {gigabytes:g} GB of images, {'CPU' if unit == 's' else 'memory'}"
        bench.table.add(name, values, float(np.median(peers)), "without images", unit=unit)


def batches(bench: Bench) -> None:
    """Fit and report many logs in one process and in two."""
    logs = batch.make_logs(bench.folder / "batch", bench.extent.batch_logs, bench.extent.batch_s)
    alone, two = (batch.run(logs, bench.folder / "batch" / "out", "-j", jobs) for jobs in ("1", "2"))
    name = f"batch of {bench.extent.batch_logs} logs of {bench.extent.batch_s:g} s, -j 2"
    bench.table.add(f"{name}, wall", [two["wall_s"]], alone["wall_s"], "with -j 1", goal="1.8 times")
    bench.table.add(f"{name}, memory", [two["most_mb"]], alone["most_mb"], "with -j 1", unit="MB", goal="1/2")


SERVER = "import sys; from moto.server import main; main(['-H', '127.0.0.1', '-p', sys.argv[1]])"


def object_store(bench: Bench) -> None:
    """Read the log from S3 on this machine's loopback, in a process of its own, against the file on disk."""
    import s3fs

    import icrtool

    with socket.create_server(("127.0.0.1", 0)) as free:
        port = str(free.getsockname()[1])
    os.environ |= {"AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}", "AWS_ACCESS_KEY_ID": "bench",
                   "AWS_SECRET_ACCESS_KEY": "bench", "AWS_DEFAULT_REGION": "us-east-1"}  # fmt: skip
    quiet = subprocess.DEVNULL
    server = subprocess.Popen([sys.executable, "-c", SERVER, port], stdout=quiet, stderr=quiet)
    try:
        while not _answers(int(port)):
            time.sleep(0.1)
        store = s3fs.S3FileSystem()
        store.mkdir("field")
        config = icrtool.load_config(robot="segway-rmp400")
        for name, goal in {"hour.mcap": "1/1.5", "hour.bag": "1/1.5", "hour_db3": ""}.items():
            log, address = bench.logs[name], f"s3://field/{name}"
            store.put(str(log), address, recursive=log.is_dir())
            disk, remote = [], []
            for _ in range(bench.extent.repeats):
                disk += seconds_of(lambda log=log: icrtool.read_log(log, config), 1)
                remote += seconds_of(lambda address=address: icrtool.read_log(address, config), 1)
            bench.table.add(f"ingest {name} from S3", remote, float(np.median(disk)), "from disk", goal=goal)
    finally:
        server.terminate()
        server.wait()


def _answers(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port)).close()
    except OSError:
        return False
    return True


def open_loop(bench: Bench) -> None:
    """Compare the analysis without GNSS with direct integration."""
    open_loop_rows(bench.table, bench.extent.log_s / 3600, bench.extent.repeats)


def against_evo(bench: Bench) -> None:
    """Compare with evo_rpe --all_pairs, the most similar tool: one horizon, by the state, on a part of the log."""
    import icrtool

    config = icrtool.load_config(robot="segway-rmp400")
    run = icrtool.fit(icrtool.read_log(bench.logs["hour.mcap"], config), config)
    count = round(bench.extent.evo_s * 100)
    t_s, north, east, heading = (
        column[:count] for column in (run.table.t_s, run.table.north_m, run.table.east_m, run.table.heading_rad)
    )
    none = np.zeros(count)
    for name, shift in (("reference", 0.0), ("estimate", 0.01)):
        pose = (t_s, north + shift * t_s, east, none, none, none, np.sin(heading / 2), np.cos(heading / 2))
        np.savetxt(bench.folder / f"{name}.tum", np.column_stack(pose))
    evo = [Path(sys.executable).with_name("evo_rpe"), "tum", "reference.tum", "estimate.tum", "--all_pairs",
           "--delta", "10", "--delta_unit", "m"]  # fmt: skip
    # it writes its settings to the home directory
    begin = time.perf_counter()
    subprocess.run(
        evo, cwd=bench.folder, env={**os.environ, "HOME": str(bench.folder)}, capture_output=True, check=True
    )
    peer = (time.perf_counter() - begin) / count
    ours = [
        seconds / len(run.table) for seconds in seconds_of(lambda: icrtool.dropout(run, [10.0]), bench.extent.repeats)
    ]
    microseconds = [1e6 * one for one in ours]
    bench.table.add("errors after 10 m, a state", microseconds, 1e6 * peer, "evo_rpe", unit="us", goal="100 times")


SECTIONS: dict[str, Callable[[Bench], None]] = {
    "ingest": ingest,
    "s3": object_store,
    "filter": filter_speed,
    "open-loop": open_loop,
    "first": first_run,
    "commands": commands,
    "images": images,
    "evo": against_evo,
    "batch": batches,
    "long": long_log,
}


def main() -> None:
    """Run the benchmarks chosen on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="200 s of log instead of an hour, each measured once")
    parser.add_argument("--only", choices=SECTIONS, action="append", help="a section; repeatable")
    parser.add_argument("--json", type=Path, help="file for the table")
    asked = parser.parse_args()
    extent = QUICK if asked.quick else FULL
    print(f"log of {extent.log_s:.0f} s: JointState and Imu 100 Hz, NavSatFix 20 Hz\n\n{HEAD}", flush=True)
    with tempfile.TemporaryDirectory(prefix="icrtool-bench-") as name:
        bench = Bench(Path(name), extent)
        for section in asked.only or SECTIONS:
            SECTIONS[section](bench)
    if asked.json:
        bench.table.write(asked.json)
        print(f"\nTable: {asked.json}")


if __name__ == "__main__":
    main()
