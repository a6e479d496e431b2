"""Runs from a stranger: no file of the user is changed or shown, nothing hangs, every refusal is one line."""

from __future__ import annotations

import os
import re
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from random import Random

import pytest

from icrtool.cli import main
from icrtool.pipeline import fit, report_into
from icrtool.records.requests import ReportRequest, ResultFiles
from support.barn import configured, simulate
from support.forged import Home, forge, remove
from support.pictures import blank_pictures

pytestmark = pytest.mark.usefixtures("without_drawing")

LOG = Path(__file__).parents[2] / "sample_logs" / "tracked_curved.bag"

Command = Callable[..., tuple[int, str, str]]

LONGEST_S = 60
"""Of a command, on a machine that others use too; without a fault it takes about one second."""

COMMANDS = (
    ("report", "RUN"),
    ("dropout-report", "RUN", "--plots", "none", "--no-ladder"),
    ("export", "--for", "evo", "RUN", "-o", "paths"),
    ("export", "--for", "json", "RUN"),
    ("calibrate", "RUN", "-o", "RUN"),
    ("compare", "RUN", "other=OWN"),
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with its report, pictures and page."""
    directory = tmp_path_factory.mktemp("runs") / "barn"
    run = fit(simulate(duration_s=60.0), configured())
    with blank_pictures():
        run.write(directory)
        report_into(directory, run, ReportRequest(ladder=False), ResultFiles(), lambda _: None)
    return directory


@pytest.fixture
def home(tmp_path: Path, made: Path) -> Home:
    found = Home(tmp_path)
    found.add_run(made)
    return found


@pytest.fixture
def place(made: Path, tmp_path: Path, run_place: Path) -> Path:
    return Path(shutil.copytree(made, run_place / "from-a-stranger"))


@contextmanager
def time_limit() -> Iterator[None]:
    """Fail where a command waits for what never comes."""

    def end(*_: object) -> None:
        raise AssertionError(f"not done after {LONGEST_S} s")

    before = signal.signal(signal.SIGALRM, end)
    signal.alarm(LONGEST_S)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def use(icrtool: Command, place: Path, home: Home, command: tuple[str, ...]) -> tuple[int, str]:
    """Run a command on a run; its home is as it was, and nothing of it is shown."""
    given = [part.replace("RUN", str(place)).replace("OWN", str(home.run)) for part in command]
    with time_limit():
        status, output, errors = icrtool(*given)
    assert home.is_untouched(), command
    assert not (shown := home.is_shown_in(Path.cwd())), (command, shown)
    assert "Traceback" not in errors
    assert status in (0, 1), (command, errors)
    assert bool(status) == ("Error: " in errors)
    assert all(line.isprintable() and len(line) < 4200 for line in (output + errors).splitlines())
    return status, errors


@pytest.mark.parametrize("command", [("report", "RUN"), ("dropout-report", "RUN", "--plots", "none", "--no-ladder")])
@pytest.mark.parametrize("target", ["secret.txt", "not-there"])
def test_a_link_in_the_place_of_the_page_is_replaced_and_its_target_stays(
    icrtool: Command, place: Path, home: Home, command: tuple[str, ...], target: str
) -> None:
    page = place / "report.html"
    remove(page)
    page.symlink_to(home.folder / target)
    assert use(icrtool, place, home, command) == (0, "")
    assert not page.is_symlink()
    assert b"<!DOCTYPE html>" in page.read_bytes()[:100]


@pytest.mark.parametrize("name", ["plots", "dropout/plots", "dropout"])
def test_a_directory_that_is_a_link_is_refused(icrtool: Command, place: Path, home: Home, name: str) -> None:
    assert home.run is not None
    remove(place / name)
    (place / name).symlink_to(home.run / name)
    command = ("dropout-report", "RUN", "--plots", "none") if name == "dropout" else ("report", "RUN")
    status, errors = use(icrtool, place, home, command)
    assert status == 1
    assert name in errors


@pytest.mark.parametrize("target", ["not-there", "folder/not-there", "secret.txt"])
def test_a_link_in_the_place_of_a_directory_is_refused_whatever_it_leads_to(
    icrtool: Command, place: Path, home: Home, target: str
) -> None:
    remove(place / "dropout")
    (place / "dropout").symlink_to(home.folder / target)
    status, errors = use(icrtool, place, home, ("dropout-report", "RUN", "--plots", "none", "--no-ladder"))
    assert status == 1
    assert "dropout is a link" in errors


@pytest.mark.parametrize("target", ["secret.txt", "folder/trajectory.png"])
def test_a_picture_that_is_a_link_is_not_shown(icrtool: Command, place: Path, home: Home, target: str) -> None:
    for name in ("plots/trajectory.png", "dropout/plots/summary.png"):
        forged = Path(shutil.copytree(place, place.with_name(name.replace("/", "-"))))
        remove(forged / name)
        (forged / name).symlink_to(home.folder / target)
        status, errors = use(icrtool, forged, home, ("report", "RUN"))
        assert status == 1
        assert name in errors


@pytest.mark.parametrize("name", ["plots/trajectory.png", "dropout/plots/summary.png", "dropout/report.json"])
def test_what_a_page_shows_is_as_it_was_written(icrtool: Command, place: Path, home: Home, name: str) -> None:
    file = place / name
    for content in (b"something else", file.read_bytes() + b" "):
        file.write_bytes(content)
        status, errors = use(icrtool, place, home, ("report", "RUN"))
        assert status == 1
        assert name in errors
    if name.startswith("dropout"):
        assert use(icrtool, place, home, ("dropout-report", "RUN", "--plots", "none", "--no-ladder"))[0] == 0
        assert use(icrtool, place, home, ("report", "RUN"))[0] == 0


@pytest.mark.parametrize("number", ["NaN", "-Infinity", "1e999"])
@pytest.mark.parametrize("command", [("compare", "RUN", "other=OWN"), ("calibrate", "RUN", "-o", "season.json")])
def test_a_number_that_is_not_finite_is_refused(
    icrtool: Command, place: Path, home: Home, number: str, command: tuple[str, ...]
) -> None:
    text = (place / "run.json").read_text()
    scale = re.search(r'"applied_right_scale": ([^,]+),', text)
    assert scale is not None
    (place / "run.json").write_text(text.replace(scale[0], f'"applied_right_scale": {number},'))
    status, errors = use(icrtool, place, home, command)
    assert status == 1
    assert "run.json" in errors


def test_a_run_without_one_of_the_findings_shows_no_sensors(icrtool: Command, place: Path, home: Home) -> None:
    text = (place / "run.json").read_text()
    assert '"heading_offset_deg": {' in text
    (place / "run.json").write_text(text.replace('"heading_offset_deg": {', '"another": {'))
    assert use(icrtool, place, home, ("calibrate", "RUN", "-o", "season.json"))[0] in (0, 1)


@pytest.mark.parametrize(
    "name", ["run.json", "B2SUMS", "states.csv", "measurements.npz", "dropout/report.json", "plots/trajectory.png"]
)
@pytest.mark.parametrize("device", [None, "/dev/zero"])
def test_a_pipe_or_a_device_in_a_run_is_refused_at_once(
    icrtool: Command, place: Path, home: Home, name: str, device: str | None
) -> None:
    remove(place / name)
    if device is None:
        os.mkfifo(place / name)
    else:
        (place / name).symlink_to(device)
    assert use(icrtool, place, home, ("report", "RUN"))[0] == 1


def test_the_directory_that_the_user_names_may_be_a_link(icrtool: Command, place: Path, home: Home) -> None:
    moved = place.rename(place.with_name("large-disk"))
    place.symlink_to(moved)
    assert use(icrtool, place, home, ("report", "RUN")) == (0, "")
    assert use(icrtool, place, home, ("dropout-report", "RUN", "--plots", "none", "--no-ladder"))[0] == 0
    assert place.is_symlink()


@pytest.mark.parametrize(
    ("first", "count"), [(0, 12), *(pytest.param(n, 100, marks=pytest.mark.stress) for n in (100, 200, 300))]
)
def test_no_forged_run_changes_shows_or_hangs(
    icrtool: Command, made: Path, home: Home, run_place: Path, first: int, count: int
) -> None:
    for seed in range(first, first + count):
        random = Random(seed)
        place = Path(shutil.copytree(made, run_place / f"run-{seed}", symlinks=True))
        done = forge(place, home, random)
        command = random.choice(COMMANDS)
        try:
            use(icrtool, place, home, command)
        except AssertionError as err:
            raise AssertionError(f"seed {seed}: {command[0]} after {done}: {err}") from err
        shutil.rmtree(place)


def linked(place: Path, target: Path) -> None:
    """Put a link in a place."""
    remove(place)
    place.symlink_to(target)


def test_a_folder_of_runs_may_be_a_link_and_a_run_in_it_may_not(icrtool: Command, home: Home, run_place: Path) -> None:
    (run_place / "large-disk").mkdir()
    (run_place / "icrtool-runs").symlink_to(run_place / "large-disk")
    assert icrtool("fit", LOG, "--plots", "none", "-q") == (0, "", "")
    assert (run_place / "large-disk" / LOG.stem / "run.json").is_file()
    assert home.run is not None
    linked(run_place / "icrtool-runs" / LOG.stem, home.run)
    for command in ("fit", "dropout-report"):
        status, _, errors = icrtool(command, LOG, "--plots", "none", "--overwrite")
        assert status == 1
        assert LOG.stem in errors
        assert home.is_untouched()


@pytest.mark.parametrize("name", ["fleet.csv", "fleet.json", "failures.csv", "report.html", "fleet.parquet"])
def test_a_table_of_a_batch_that_is_a_link_is_replaced(
    icrtool: Command, home: Home, run_place: Path, name: str
) -> None:
    batch = ("batch", run_place / "empty.mcap", "-o", "season", "-q", "-j", "1")
    (run_place / "empty.mcap").write_bytes(b"")
    assert icrtool(*batch)[0] == 1
    linked(run_place / "season" / name, home.file)
    assert icrtool(*batch)[0] == 1
    assert home.is_untouched()
    assert not (run_place / "season" / name).is_symlink()


@pytest.fixture(scope="module")
def season(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a short log, and what a batch made of it."""
    folder = tmp_path_factory.mktemp("season")
    drive = ("--path", "curved", "--duration", "30", "--wheel-rate", "20", "--robot", "pentzer-tracked")
    for arguments in (("simulate", "-o", folder / "short.mcap", *drive), ("batch", *BATCH, "-o", folder / "season")):
        given = [str(folder / one) if one == "short.mcap" else str(one) for one in arguments]
        with pytest.MonkeyPatch.context() as patch, suppress(SystemExit):
            patch.setattr(sys, "argv", ["icrtool", *given, "-q"])
            main()
    assert (folder / "season" / "runs" / "short" / "run.json").is_file()
    return folder


BATCH = ("short.mcap", "-j", "1", "--robot", "pentzer-tracked", "--plots", "none", "--no-page", "--no-ladder")


@pytest.mark.parametrize("name", ["plots", ".rows", "runs", "runs/short"])
def test_a_folder_of_a_batch_that_is_a_link_is_refused(
    icrtool: Command, home: Home, run_place: Path, season: Path, name: str
) -> None:
    shutil.copytree(season, run_place, dirs_exist_ok=True)
    assert home.run is not None
    linked(run_place / "season" / name, home.run if name.startswith("runs/") else home.folder / "folder")
    plots = ("--plots", "png") if name == "plots" else ()
    status, _, errors = icrtool("batch", *BATCH, "-o", "season", "--redo", "--overwrite", *plots)
    assert status == 1
    assert "a link, which is not followed" in errors
    assert home.is_untouched()


@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("calibration.json", ("calibrate", "RUN", "-o", "DIR")),
        ("filter.tum", ("export", "--for", "evo", "RUN", "-o", "DIR")),
        ("x.layout.json", ("export", "--for", "foxglove", "RUN", "-o", "DIR/x.mcap")),
        ("x.mcap.truth.csv", ("simulate", "--duration", "20", "-o", "DIR/x.mcap", "--force")),
    ],
)
def test_what_is_written_beside_or_into_a_place_replaces_links(
    icrtool: Command, made: Path, home: Home, run_place: Path, name: str, command: tuple[str, ...]
) -> None:
    (run_place / "folder").mkdir()
    linked(run_place / "folder" / name, home.file)
    given = [part.replace("RUN", str(made)).replace("DIR", str(run_place / "folder")) for part in command]
    assert icrtool(*given)[0] == 0
    assert home.is_untouched()
    assert not (run_place / "folder" / name).is_symlink()


@pytest.mark.parametrize("failing", [("--outage-at", "5"), ("--gate", "calibration.p95@10m <= 1")])
def test_a_report_that_fails_keeps_the_old_run_whole(
    icrtool: Command, home: Home, run_place: Path, made: Path, short_logs: Path, failing: tuple[str, ...]
) -> None:
    old = Path(shutil.copytree(made, run_place / "old"))
    before = {path: path.read_bytes() for path in old.rglob("*") if path.is_file()}
    asked = ("--robot", "husky-a200", "--plots", "none", "--no-ladder", "--overwrite", "-q")
    command = ("dropout-report", short_logs / "field.mcap", *asked)
    status, _, errors = icrtool(*command, "-o", old, *failing)
    assert status in (1, 2)
    assert "Error: " in errors
    assert {path: path.read_bytes() for path in old.rglob("*") if path.is_file()} == before
    assert icrtool(*command, "-o", old)[0] == 0
    assert (old / "run.json").read_bytes() != before[old / "run.json"]
    assert (old / "dropout" / "report.json").is_file()
