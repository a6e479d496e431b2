"""What is no file of icrtool's is never replaced unasked, and what is no file at all is never waited for."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

Command = Callable[..., tuple[int, str, str]]

SAMPLES = Path(__file__).parents[2] / "sample_logs"
LOG = SAMPLES / "tracked_curved.bag"
OWN = b"log,status,my,own,table\n1,2,3,4,5\n"


@pytest.mark.parametrize("name", ["fleet.csv", "fleet.json", "report.html", "failures.csv", "plots/icrs.png"])
def test_a_batch_refuses_a_folder_in_which_a_file_of_its_names_is_not_its_own(
    icrtool: Command, run_place: Path, name: str
) -> None:
    own = run_place / "season" / name
    own.parent.mkdir(parents=True)
    own.write_bytes(OWN)
    status, _, errors = icrtool("batch", LOG, "-o", "season", "--plots", "none")
    assert status == 1
    assert name in errors
    assert own.read_bytes() == OWN
    assert not (run_place / "season" / "runs").exists()


def test_a_batch_goes_on_in_a_folder_of_its_own_and_keeps_a_page_of_somebody_else(
    icrtool: Command, run_place: Path
) -> None:
    (run_place / "bad.mcap").write_bytes(b"")
    season = run_place / "season"
    batch = ("batch", "bad.mcap", "-o", "season", "-q")
    assert icrtool(*batch, "--no-page")[0] == 1
    (season / "fleet.json").unlink()  # as after a batch that was killed while it wrote its tables
    (season / "plots" / "icrs.txt").write_bytes(OWN)
    assert "Error: bad.mcap" in icrtool("batch", "bad.mcap", "-o", "season", "--no-page")[2]
    assert (season / "fleet.json").is_file()
    (season / "report.html").write_bytes(OWN)
    status, _, errors = icrtool(*batch)
    assert status == 1
    assert "report.html" in errors
    assert (season / "report.html").read_bytes() == OWN
    assert (season / "plots" / "icrs.txt").read_bytes() == OWN


@pytest.mark.usefixtures("without_drawing")
def test_a_page_in_its_usual_place_replaces_only_a_page(icrtool: Command, run_place: Path, short_logs: Path) -> None:
    log = short_logs / "other.bag"
    assert icrtool("fit", log, "--robot", "husky-a200", "--plots", "none", "-q")[0] == 0
    assert icrtool("dropout-report", "--plots", "none", "--no-page", "--no-ladder", "-q")[0] == 0
    page = run_place / "icrtool-runs" / log.stem / "report.html"
    page.write_bytes(OWN)
    assert icrtool("report")[0] == 1
    assert page.read_bytes() == OWN
    assert icrtool("report", "-o", page, "-q") == (0, "", "")  # named by the user
    assert icrtool("report", "-q") == (0, "", "")


@pytest.mark.parametrize("log", ["tracked_curved.bag", "wheeled_lawnmower.mcap"])
@pytest.mark.parametrize(
    "command",
    [
        ("export", "--for", "foxglove", "RUN", "-o", "LOG"),
        ("export", "--for", "json", "RUN", "-o", "LOG"),
        ("report", "RUN", "-o", "LOG"),
        ("calibrate", "RUN", "-o", "LOG"),
        ("dropout-report", "RUN", "--plots", "none", "--markdown", "LOG"),
    ],
)
def test_a_log_is_not_replaced_by_a_result(
    icrtool: Command, run_place: Path, run: Path, log: str, command: tuple[str, ...]
) -> None:
    other = Path(shutil.copyfile(SAMPLES / log, run_place / f"other{Path(log).suffix}"))
    status, _, errors = icrtool(*(part.replace("RUN", str(run)).replace("LOG", str(other)) for part in command))
    assert status == 1
    assert other.name in errors
    assert other.read_bytes() == (SAMPLES / log).read_bytes()


def test_an_export_replaces_an_export(icrtool: Command, run: Path, run_place: Path) -> None:
    for _ in range(2):
        assert icrtool("export", "--for", "foxglove", run, "-o", run_place / "paths.mcap")[0] == 0


@pytest.mark.parametrize(
    ("name", "options"),
    [("filter.tum", ("evo",)), ("no_slip.kitti", ("kitti",)), ("paths.layout.json", ("foxglove",))],
)
def test_what_an_export_writes_under_a_name_of_its_own_replaces_only_its_like(
    icrtool: Command, run: Path, run_place: Path, name: str, options: tuple[str, ...]
) -> None:
    (run_place / "folder").mkdir()
    place = run_place / "folder" / ("paths.mcap" if options == ("foxglove",) else "")
    command = ("export", "--for", *options, run, "-o", place)
    assert icrtool(*command)[0] == 0
    assert icrtool(*command)[0] == 0
    before = {file: file.read_bytes() for file in place.parent.rglob("*") if file.is_file() and file.name != name}
    (run_place / "folder" / name).write_bytes(OWN)
    status, _, errors = icrtool(*command)
    assert status == 1
    assert name in errors
    assert (run_place / "folder" / name).read_bytes() == OWN
    assert {file: file.read_bytes() for file in before} == before


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, short_logs: Path) -> Path:
    import icrtool

    config = icrtool.load_config(robot="husky-a200")
    place = tmp_path_factory.mktemp("runs") / "run"
    icrtool.fit(icrtool.read_log(short_logs / "other.bag", config), config).write(place, plots=())
    return place


@pytest.mark.parametrize("kind", ["pipe", "device"])
@pytest.mark.parametrize(
    "command",
    [
        ("info", "FILE"),
        ("fit", "FILE"),
        ("batch", "FILE", "-o", "season"),
        ("batch", "manifest.csv", "-o", "season"),
        ("calibrate", "FILE"),
        ("compare", "a=FILE", "b=FILE"),
        ("report", "FILE"),
        ("fit", "LOG", "--config", "FILE"),
        ("fit", "LOG", "--warm-start", "FILE"),
        ("dropout-report", "LOG", "--calibration", "FILE"),
        ("dropout-report", "LOG", "--baseline", "FILE"),
        ("forecast", "--calibration", "FILE", "--path", "FILE"),
        ("simulate", "--speeds", "FILE", "-o", "x.mcap"),
        ("export", "--for", "evo", "FILE"),
    ],
    ids=" ".join,
)
@pytest.mark.parametrize("suffix", ["mcap", "csv"])
def test_a_pipe_or_a_device_is_refused_at_once(
    icrtool: Command, run_place: Path, command: tuple[str, ...], kind: str, suffix: str
) -> None:
    file = run_place / f"file.{suffix}"
    os.mkfifo(file) if kind == "pipe" else file.symlink_to("/dev/zero")
    (run_place / "manifest.csv").write_text(f"log\n{file.name}\n")
    status, _, errors = icrtool(*(part.replace("FILE", str(file)).replace("LOG", str(LOG)) for part in command))
    assert status == 1
    assert "not a regular file" in errors
    assert "save its output to a file" in errors
