from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import icrtool
from icrtool.errors import OutputError, RunError
from icrtool.output import figure_catalogue as catalogue
from icrtool.output.dropout_directory import write_report
from icrtool.output.figures import style as figure_style
from icrtool.output.files import run_columns
from icrtool.output.files.formats import SOURCES_FILE, file_b2sum, json_bytes, read_sums
from icrtool.output.run_directory import check_target, open_run, write_run
from icrtool.records.run import Run
from support.contract import RUN_KEYS


@pytest.fixture
def written(tmp_path: Path, run: Run) -> Path:
    write_run(run, tmp_path / "barn", plots=())
    return tmp_path / "barn"


@pytest.fixture
def no_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw figures, but write files without pixels: for tests of the names of files."""
    monkeypatch.setattr(figure_style, "picture_bytes", lambda figure, form: form.encode())


def names_in(directory: Path) -> list[str]:
    return sorted(str(path.relative_to(directory)) for path in directory.rglob("[!.]*") if path.is_file())


@pytest.mark.usefixtures("no_pixels")
def test_a_run_directory_holds_what_the_contract_says(tmp_path: Path, run: Run) -> None:
    write_run(run, tmp_path / "runs" / "barn", plots=("png", "svg"))
    figures = ("trajectory", "icr_estimates", "gnss_difference")
    plots = [f"plots/{name}.{form}" for name in figures for form in ("png", "svg")]
    assert names_in(tmp_path / "runs" / "barn") == sorted(
        ["B2SUMS", "events.csv", "measurements.npz", "run.json", "states.csv", *plots]
    )
    write_run(run, tmp_path / "runs" / "barn", plots=("svg",), figures="all")
    drawn = sorted(path.stem for path in (tmp_path / "runs" / "barn" / "plots").iterdir())
    assert drawn == sorted([*figures, "icr_clusters"])
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["barn"]


def test_run_json_has_every_key_of_the_contract(written: Path, run: Run) -> None:
    document = json.loads((written / "run.json").read_text(encoding="utf-8"))
    assert document["schema"] == "icrtool/run/1"
    assert document.keys() >= RUN_KEYS
    assert document["inputs"][0].keys() >= {"path", "bytes", "sha256"}
    assert document["streams"][0].keys() >= {"topic", "message_type", "rate_hz", "count", "why"}
    assert document["drive"].keys() >= {"duration_s", "distance_m", "speed_mean_mps", "speed_std_mps"}
    assert document["gnss"].keys() >= {"used", "rejected", "mean_difference_m", "max_difference_m", "datum"}
    for key in ("final", "mean", "std", "convergence_s"):
        assert document["icr"][key].keys() == {"y_icr_right_m", "y_icr_left_m", "x_icr_m"}
    assert document["config"] == run.config.effective()


def test_run_json_is_the_summary_of_the_run(written: Path, run: Run) -> None:
    document = json.loads((written / "run.json").read_text(encoding="utf-8"))
    assert document == run.summary


def test_what_is_not_a_number_becomes_null_and_letters_stay() -> None:
    data = {
        "a": float("nan"),
        "b": (np.float64("inf"), np.int64(3)),
        "c": "Wiese °",
        "d": "bad \udcff name",
        "e": np.eye(1),
    }
    text = json_bytes(data)
    assert json.loads(text) == {"a": None, "b": [None, 3], "c": "Wiese °", "d": "bad \udcff name", "e": [[1.0]]}
    assert "Wiese °".encode() in text
    assert text.endswith(b"}\n")


def test_states_may_be_parquet(tmp_path: Path, run: Run) -> None:
    write_run(run, tmp_path / "barn", states="parquet", plots=())
    assert names_in(tmp_path / "barn") == ["B2SUMS", "events.csv", "measurements.npz", "run.json", "states.parquet"]
    assert open_run(tmp_path / "barn").table.north_m.tobytes() == run.table.north_m.tobytes()


@pytest.mark.skipif(shutil.which("b2sum") is None, reason="needs b2sum")
def test_the_sums_are_those_of_b2sum(written: Path) -> None:
    subprocess.run(["b2sum", "--check", "--strict", "--quiet", "B2SUMS"], cwd=written, check=True)


def listed(directory: Path) -> set[str]:
    """Return the files that the list of a run names, each with its sum."""
    sums = read_sums(directory)
    assert {name: file_b2sum(directory / name) for name in sums} == sums
    return set(sums)


def test_a_list_of_sums_of_60_megabytes_is_refused_unread(tmp_path: Path) -> None:
    """A sparse file costs its sender nothing; decoded and split it took 256 MB."""
    with (tmp_path / "B2SUMS").open("wb") as file:
        file.truncate(60 << 20)
    tracemalloc.start()
    with pytest.raises(RunError, match="no readable B2SUMS"):
        read_sums(tmp_path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 << 20


@pytest.mark.usefixtures("no_pixels")
def test_the_list_of_a_run_names_its_report_too_and_is_true_at_every_moment(written: Path, run: Run) -> None:
    files = set(names_in(written)) - {"B2SUMS"}
    assert listed(written) == files
    report = icrtool.dropout_report(run, horizons_m=[1.0, 5.0], ladder=False)
    report.write(written / "dropout", plots=("png",))
    first = listed(written)
    assert first == set(names_in(written)) - {"B2SUMS"}
    assert {"dropout/report.json", "dropout/plots/summary.png"} < first

    def fail(_: object) -> None:
        assert listed(written) == first
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OutputError):
        write_report(fail, written / "dropout")
    report.write(written / "dropout", plots=())
    assert listed(written) == {name for name in first if "/plots/" not in name}
    write_run(run, written, plots=())
    assert listed(written) == files


def test_a_list_beside_a_report_that_is_no_run_is_left_alone(tmp_path: Path, run: Run) -> None:
    (tmp_path / "B2SUMS").write_text("my own list of dropout/report.json\n")
    icrtool.dropout_report(run, horizons_m=[1.0], ladder=False).write(tmp_path / "dropout", plots=())
    assert (tmp_path / "B2SUMS").read_text() == "my own list of dropout/report.json\n"


def test_the_same_run_makes_the_same_bytes(tmp_path: Path, run: Run) -> None:
    for place in ("one", "two"):
        write_run(run, tmp_path / place, plots=("svg",))
    for name in names_in(tmp_path / "one"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes(), name


def test_an_old_run_is_replaced_with_its_dropout_analysis(written: Path, run: Run) -> None:
    (written / "dropout").mkdir()
    (written / "dropout" / "summary.csv").write_text("of the old states")
    (written / "report.html").write_text("of the old states")
    notes: list[str] = []
    write_run(run, written, states="parquet", plots=(), note=notes.append)
    assert notes == [f"{written}: replaced: removed dropout/, report.html, states.csv"]
    assert names_in(written) == ["B2SUMS", "events.csv", "measurements.npz", "run.json", "states.parquet"]
    assert [path.name for path in written.parent.iterdir()] == ["barn"]


@pytest.mark.usefixtures("no_pixels")
def test_a_run_replaced_from_inside_says_only_what_the_new_one_does_not_have(
    tmp_path: Path, run: Run, monkeypatch
) -> None:
    write_run(run, tmp_path / "run", plots=("png",))
    (tmp_path / "run" / "plots" / "icr_clusters.png").write_text("of the old states")
    monkeypatch.chdir(tmp_path / "run")
    notes: list[str] = []
    write_run(run, Path(), plots=("png",), note=notes.append)
    assert notes == [".: replaced: removed plots/icr_clusters.png"]


@pytest.mark.parametrize(
    "name", ["notes.txt", "plots/mine.png", "plots/histogram_mine.png", "dropout/notes.txt", "plots"]
)
def test_a_run_with_a_file_of_somebody_is_left_alone_whatever_is_asked(written: Path, run: Run, name: str) -> None:
    (written / name).parent.mkdir(exist_ok=True)
    (written / name).write_text("years of work")
    before = {name: (written / name).read_bytes() for name in names_in(written)}
    for overwrite in (False, True):
        with pytest.raises(OutputError, match=f"barn: holds {name}, which is no part of a run directory"):
            check_target(written, overwrite=overwrite)
    with pytest.raises(OutputError, match="holds"):
        write_run(run, written)
    assert {name: (written / name).read_bytes() for name in names_in(written)} == before


def test_a_run_and_a_report_that_were_damaged_are_made_again(written: Path, run: Run) -> None:
    report = icrtool.dropout_report(run, horizons_m=[1.0], ladder=False)
    report.write(written / "dropout", plots=())
    (written / "dropout" / "report.json").write_text("{")
    report.write(written / "dropout", plots=())
    assert json.loads((written / "dropout" / "report.json").read_bytes())
    (written / "run.json").write_text("{")
    (written / "notes.txt").write_text("years of work")
    with pytest.raises(OutputError, match=r"holds notes\.txt"):
        write_run(run, written, plots=())
    (written / "notes.txt").unlink()
    write_run(run, written, plots=())
    assert open_run(written).name == "barn"


def test_a_damaged_run_is_replaced_by_that_of_the_log_in_the_same_place_alone(written: Path, tmp_path: Path) -> None:
    mine, other = tmp_path / "mine.mcap", tmp_path / "other.mcap"
    for log in (mine, other):
        log.write_bytes(log.name.encode())
    sources = written / SOURCES_FILE
    sources.write_text(json.dumps({**json.loads(sources.read_bytes()), "made_from": [os.path.realpath(mine)]}))
    (written / "run.json").write_text("{")
    check_target(written, mine)
    with pytest.raises(OutputError, match=r"another recording \(its run.json is damaged\)"):
        check_target(written, other)
    check_target(written, other, overwrite=True)


@pytest.mark.usefixtures("no_pixels")
def test_every_file_that_icrtool_writes_is_known_as_its_own(tmp_path: Path, run: Run) -> None:
    report = icrtool.dropout_report(run, horizons_m=[1.0, 5.0, 10.0, 15.0, 20.0], outage_s=(4.0,), ladder=True)
    write_run(run, tmp_path / "run", plots=("png", "svg", "pdf"), figures="all")
    for plots in (("png", "svg"), ()):
        write_report(
            lambda _: report, tmp_path / "run" / "dropout", plots=plots, figures="all",
            stamp_ns=run.table.stamp_ns[:0],
        )  # fmt: skip
        if plots:
            assert len(names_in(tmp_path / "run")) > 30
    icrtool.write_page(run, report, tmp_path / "run" / "report.html")
    write_run(run, tmp_path / "run", plots=())


@pytest.mark.parametrize("content", ["{}", "[1]", "not json", '{"schema": 3}', '{"schema": "other/1"}'])
def test_a_run_json_that_is_not_ours_is_left_alone(tmp_path: Path, run: Run, content: str) -> None:
    (tmp_path / "run.json").write_text(content)
    with pytest.raises(OutputError, match="not a run directory"):
        check_target(tmp_path)
    with pytest.raises(OutputError, match="not a run directory"):
        write_run(run, tmp_path, plots=())
    assert names_in(tmp_path) == ["run.json"]


def test_a_run_of_a_later_version_may_be_replaced(tmp_path: Path, run: Run) -> None:
    (tmp_path / "run.json").write_text('{"schema": "icrtool/run/9"}')
    write_run(run, tmp_path, plots=())
    assert open_run(tmp_path).name == "barn"


@pytest.mark.parametrize(("module", "where"), [(run_columns, "write_states"), (catalogue, "draw_figures")])
def test_a_full_disk_is_said_and_leaves_the_old_run(
    written: Path, run: Run, monkeypatch: pytest.MonkeyPatch, module: Any, where: str
) -> None:
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    before = (written / "B2SUMS").read_bytes()
    monkeypatch.setattr(module, where, full)
    with pytest.raises(OutputError, match="barn: cannot be written; No space left on device"):
        write_run(run, written)
    assert (written / "B2SUMS").read_bytes() == before
    assert [path.name for path in written.parent.iterdir()] == ["barn"]


def test_an_interrupted_drawing_leaves_nothing(tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(catalogue, "draw_figures", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_run(run, tmp_path / "barn")
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_plot_format_is_a_mistake_of_the_caller(tmp_path: Path, run: Run) -> None:
    with pytest.raises(ValueError, match="gif"):
        write_run(run, tmp_path / "barn", plots=("gif",))


def test_many_states_are_written_as_parquet_and_that_is_noted(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    notes: list[str] = []
    monkeypatch.setattr("icrtool.output.run_directory.MOST_CSV_STATES", len(run.table) - 1)
    write_run(run, tmp_path / "many", plots=(), note=notes.append)
    assert (tmp_path / "many" / "states.parquet").is_file()
    assert not (tmp_path / "many" / "states.csv").exists()
    assert any("states.parquet" in note for note in notes)
    write_run(run, tmp_path / "asked", states="csv", plots=())
    assert (tmp_path / "asked" / "states.csv").is_file()
    assert len(open_run(tmp_path / "many").table) == len(run.table)
