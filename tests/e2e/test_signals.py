"""Ctrl-C and SIGTERM at any moment: a command ends within a second, and leaves no process and no partial file.

Killed, it leaves the old or the new result.
"""

from __future__ import annotations

import json
import os
import secrets
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

import icrtool

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")

ICRTOOL = (sys.executable, "-P", "-m", "icrtool")
LOG = Path(__file__).parents[2] / "sample_logs" / "wheeled_lawnmower.mcap"
ROBOT = ("--robot", "segway-rmp400")
COMMANDS = {
    "fit": ("fit", "{log}", *ROBOT, "-o", "run"),
    "fit again": ("fit", "{log}", *ROBOT, "-o", "{run}"),
    "dropout-report": ("dropout-report", "{log}", *ROBOT, "-o", "run"),
    "calibrate": ("calibrate", "{run}", "-o", "calibration.json"),
    "batch": ("batch", "{folder}", *ROBOT, "-o", "season", "-j", "2"),
    "study": ("study", "consistency", "--runs", "400", "-o", "study"),
    "simulate": ("simulate", "-o", "log.mcap", "--duration", "3000"),
}
LONGEST_S = 1.0
BUSY = 3.0
"""A machine that tests run on does other things too."""


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A log, a folder with two, and a run."""
    folder = tmp_path_factory.mktemp("logs")
    for name in ("one.mcap", "two.mcap"):
        shutil.copy(LOG, folder / name)
    run = tmp_path_factory.mktemp("run") / "run"
    icrtool.fit(icrtool.read_log(LOG, config := icrtool.load_config(robot=ROBOT[1])), config).write(run, plots=())
    return {"log": LOG, "folder": folder, "run": run}


def processes_with(mark: str) -> list[int]:
    """Return the processes whose environment holds a mark."""
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        try:
            ended = (place / "stat").read_text().rsplit(")", 1)[1].split()[0] in "ZX"
            if not ended and mark.encode() in (place / "environ").read_bytes():
                found.append(int(place.name))
        except OSError:
            continue
    return found


def wait_until_it_handles_signals(process: subprocess.Popen[str]) -> None:
    """Wait until a command has set its handlers: a signal before ends the interpreter in its own manner."""
    bit = 1 << (signal.SIGTERM - 1)
    while process.poll() is None:
        with suppress(OSError):
            caught = Path(f"/proc/{process.pid}/status").read_text().partition("SigCgt:")[2].split()
            if caught and int(caught[0], 16) & bit:
                return
        time.sleep(0.01)


def interrupt(
    arguments: Sequence[str], places: dict[str, Path], folder: Path, number: int, after_s: float
) -> tuple[float | None, list[str]]:
    """Send a signal to a command after some time; return how long it took to end, and what is wrong.

    None where the command had ended before.
    """
    mark = secrets.token_hex(8)
    work, temporary = folder / mark, folder / f"{mark}-tmp"
    work.mkdir(parents=True)
    temporary.mkdir()
    given = {name: str(path) for name, path in places.items()}
    if arguments[-1] == "{run}":
        # Its run is replaced: it must be there, the old one or the new one.
        given["run"] = str(shutil.copytree(places["run"], work / "run"))
    process = subprocess.Popen(
        [*ICRTOOL, *(each.format(**given) for each in arguments)],
        cwd=work, env={**os.environ, "MARK_OF_TEST": mark, "TMPDIR": str(temporary)},
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    wait_until_it_handles_signals(process)
    with suppress(subprocess.TimeoutExpired):
        process.wait(after_s)
    begin = time.monotonic()
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    took = time.monotonic() - begin
    if process.returncode == 0:
        return None, []
    wrong = []
    if process.returncode != 128 + number:
        wrong.append(f"exit status {process.returncode}: {errors}")
    if "Traceback" in errors:
        wrong.append(errors)
    end = time.monotonic() + 2
    while (left := processes_with(mark)) and time.monotonic() < end:
        time.sleep(0.05)
    wrong += [f"process {one} is left" for one in left]
    wrong += [f"left: {path}" for path in temporary.iterdir()]
    wrong += [f"left: {path}" for path in work.rglob("*") if path.suffix in (".partial", ".old")]
    wrong += [f"left: {path}" for path in work.iterdir() if path.name.startswith(".")]
    if arguments[-1] == "{run}" and not (work / "run" / "run.json").exists():
        wrong.append("the run is gone")
    shutil.rmtree(work)
    shutil.rmtree(temporary)
    return took, wrong


def check(names: Sequence[str], places: dict[str, Path], folder: Path, count: int, longest_s: float) -> None:
    """Interrupt commands at random moments, two at the same time."""
    rng = np.random.default_rng(0)
    jobs = [
        (name, (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)[(i + place) % 3], float(rng.uniform(0.0, longest_s)))
        for i in range(count)
        for place, name in enumerate(names)
    ]
    with ThreadPoolExecutor(2) as pool:
        done = list(pool.map(lambda job: interrupt(COMMANDS[job[0]], places, folder, job[1], job[2]), jobs))
    wrong = [f"{job}: {each}" for job, (_, errors) in zip(jobs, done, strict=True) for each in errors]
    took = {job: seconds for job, (seconds, _) in zip(jobs, done, strict=True) if seconds is not None}
    slow = [f"{job}: {seconds:.1f} s" for job, seconds in took.items() if seconds > BUSY * LONGEST_S]
    if took:
        ordered = np.sort(list(took.values()))
        print(f"{len(took)} of {len(jobs)} interrupted, median {np.median(ordered):.2f} s, longest {ordered[-5:]}")
    assert not wrong + slow, "\n".join(wrong + slow)
    assert took


def test_each_command_ends_at_once(places: dict[str, Path], tmp_path: Path) -> None:
    check(["fit again", "dropout-report", "batch", "study"], places, tmp_path, 1, 3.0)


@pytest.mark.stress
@pytest.mark.parametrize("name", COMMANDS)
def test_at_many_moments(places: dict[str, Path], tmp_path: Path, name: str) -> None:
    check([name], places, tmp_path, 40, 8.0)


SHORT = LOG.with_name("tracked_curved.bag")
TRACKED = ("--robot", "pentzer-tracked", "--plots", "none", "-q")
REPLACING = {
    "fit": ("fit", "log.bag", *TRACKED, "-o", "run", "--overwrite"),
    "dropout-report": ("dropout-report", "run", "--plots", "none", "-q"),
    "calibrate": ("calibrate", "run", "-o", "calibration.json", "-q"),
    "batch": ("batch", "logs", *TRACKED, "-o", "season", "-j", "2", "--redo"),
}
KILLS = 25
WRITING_S = 0.03
"""What a command takes to write its result, about."""


def start(arguments: Sequence[str], work: Path) -> subprocess.Popen[bytes]:
    environment = {**os.environ, "TMPDIR": str(work)}
    return subprocess.Popen(
        [*ICRTOOL, *arguments], cwd=work, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        start_new_session=True,
    )  # fmt: skip


def time_of(arguments: Sequence[str], work: Path) -> float:
    """Return how long a command takes, which must succeed."""
    began = time.monotonic()
    assert start(arguments, work).wait() == 0
    return time.monotonic() - began


def partial(work: Path) -> set[Path]:
    """Return what is being written, or was when a process was killed."""
    return {path for path in work.rglob("*.partial*") if ".partial" in path.name}


def results(work: Path) -> set[str]:
    """Open all that was written; return the names of the results."""
    # The processes of a killed batch may still remove what they were writing.
    visible = [Path(place, name) for place, _, names in os.walk(work) for name in names if ".partial" not in place]
    for file in visible:
        if file.name == "run.json":
            icrtool.open_run(file.parent)
        elif file.suffix == ".json":
            json.loads(file.read_bytes())
    return {
        file.relative_to(work).as_posix() for file in visible if file.suffix == ".json" and "rows" not in file.parts
    }


@pytest.mark.stress
@pytest.mark.parametrize("name", REPLACING)
def test_killed_at_any_moment_the_old_or_the_new_result_is_there(tmp_path: Path, name: str) -> None:
    rng = np.random.default_rng(1)
    (tmp_path / "logs").mkdir()
    for place in ("log.bag", "logs/one.bag", "logs/two.bag"):
        shutil.copy(SHORT, tmp_path / place)
    assert start(REPLACING["fit"], tmp_path).wait() == 0
    took_s = min(time_of(REPLACING[name], tmp_path) for _ in range(2))
    before = results(tmp_path)
    killed = 0
    for number in range(KILLS):
        left = partial(tmp_path)
        process = start(REPLACING[name], tmp_path)
        if number % 3:
            # While it writes, and exchanges the new result for the old one.
            while process.poll() is None and partial(tmp_path) <= left:
                time.sleep(0.002)
            time.sleep(rng.exponential(WRITING_S))
        else:
            with suppress(subprocess.TimeoutExpired):
                process.wait(took_s * rng.uniform(0.0, 0.9))
        killed += process.poll() is None
        process.send_signal((signal.SIGKILL, signal.SIGTERM, signal.SIGKILL, signal.SIGINT)[number % 4])
        process.wait(60)
        # A new run replaces the report of the old one with the run: it may not be made again yet.
        assert results(tmp_path) >= {one for one in before if name == "dropout-report" or "/dropout/" not in one}
        if number % 5 == 4:
            took_s = min(took_s, time_of(REPLACING[name], tmp_path))
            assert results(tmp_path) == before
            assert partial(tmp_path) == set(), "leftovers stay"
    assert killed > KILLS / 2
    print(f"{name}: {killed} of {KILLS} killed")
