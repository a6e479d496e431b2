from __future__ import annotations

import errno
import json
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from icrtool.errors import OutputError, RunError
from icrtool.estimation.fit import FilterRun
from icrtool.output import run_directory
from icrtool.output.figures import run_figures as figures
from icrtool.output.run_directory import check_target, json_bytes, read_run, read_warm_start, write_run


@pytest.fixture
def written(tmp_path: Path, run: FilterRun) -> Path:
    write_run(run, tmp_path / "barn", plots=())
    return tmp_path / "barn"


def names_in(directory: Path) -> list[str]:
    return sorted(str(path.relative_to(directory)) for path in directory.rglob("[!.]*") if path.is_file())


def test_a_run_directory_holds_what_the_contract_says(tmp_path: Path, run: FilterRun) -> None:
    write_run(run, tmp_path / "runs" / "barn", plots=("png", "svg"))
    plots = [f"plots/{name}.{form}" for name in figures.FIGURES for form in ("png", "svg")]
    assert names_in(tmp_path / "runs" / "barn") == sorted(["B2SUMS", "headings.npz", "run.json", "states.csv", *plots])
    assert {"trajectory", "icr_estimates", "icr_clusters", "gnss_difference"} == set(figures.FIGURES)
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["barn"]


def test_run_json_has_every_key_of_the_contract(written: Path, run: FilterRun) -> None:
    document = json.loads((written / "run.json").read_text(encoding="utf-8"))
    assert document["schema"] == "icrtool/run/1"
    assert document.keys() >= {
        "tool_version",
        "inputs",
        "config",
        "streams",
        "warnings",
        "drive",
        "icr",
        "gnss",
        "filter",
    }
    assert document["inputs"][0].keys() >= {"path", "bytes", "sha256"}
    assert document["streams"][0].keys() >= {"topic", "message_type", "rate_hz", "count", "why"}
    assert document["drive"].keys() >= {"duration_s", "distance_m", "speed_mean_mps", "speed_std_mps"}
    assert document["gnss"].keys() >= {"used", "rejected", "mean_difference_m", "max_difference_m", "datum"}
    for key in ("final", "mean", "std", "convergence_s"):
        assert document["icr"][key].keys() == {"y_icr_right_m", "y_icr_left_m", "x_icr_m"}
    assert document["config"] == run.config.effective()


def test_run_json_is_the_summary_of_the_run(written: Path, run: FilterRun) -> None:
    document = json.loads((written / "run.json").read_text(encoding="utf-8"))
    summary = json.loads(json_bytes(run.summary))
    assert {key: document[key] for key in summary} == summary
    assert document.keys() - summary.keys() <= {"outages_ns", "wheel_gaps_ns"}


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


def test_a_run_comes_back_as_it_was(written: Path, run: FilterRun) -> None:
    stored = read_run(written)
    assert stored.name == "barn"
    assert stored.directory == written
    assert stored.track_width_m == run.config.robot.track_width_m
    for name, column in run.table.columns().items():
        assert getattr(stored.table, name).tobytes() == column.tobytes(), name
    assert run.in_gap.sum() == 1
    assert np.array_equal(stored.in_gap, run.in_gap)
    assert len(run.outages_ns) == 1
    assert np.array_equal(stored.outages_ns, run.outages_ns)
    assert stored.summary == json.loads(json_bytes(run.summary))


def test_states_may_be_parquet(tmp_path: Path, run: FilterRun) -> None:
    write_run(run, tmp_path / "barn", states="parquet", plots=())
    assert names_in(tmp_path / "barn") == ["B2SUMS", "headings.npz", "run.json", "states.parquet"]
    assert read_run(tmp_path / "barn").table.north_m.tobytes() == run.table.north_m.tobytes()


def test_a_run_without_gap_or_outage_or_width_comes_back(tmp_path: Path, make_run: Callable[..., FilterRun]) -> None:
    write_run(make_run(troubles=False, track_width_m=None, duration_s=20.0), tmp_path / "barn", plots=())
    stored = read_run(tmp_path / "barn")
    assert not stored.in_gap.any()
    assert stored.outages_ns.shape == (0, 2)
    assert stored.track_width_m is None


@pytest.mark.skipif(shutil.which("b2sum") is None, reason="needs b2sum")
def test_the_sums_are_those_of_b2sum(written: Path) -> None:
    subprocess.run(["b2sum", "--check", "--strict", "--quiet", "B2SUMS"], cwd=written, check=True)


def test_the_same_run_makes_the_same_bytes(tmp_path: Path, run: FilterRun) -> None:
    for place in ("one", "two"):
        write_run(run, tmp_path / place, plots=("png", "svg"))
    for name in names_in(tmp_path / "one"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes(), name


def test_an_old_run_is_replaced_with_its_dropout_analysis(written: Path, run: FilterRun) -> None:
    (written / "dropout").mkdir()
    (written / "dropout" / "summary.csv").write_text("of the old states")
    write_run(run, written, states="parquet", plots=())
    assert names_in(written) == ["B2SUMS", "headings.npz", "run.json", "states.parquet"]
    assert [path.name for path in written.parent.iterdir()] == ["barn"]


@pytest.mark.parametrize("content", ["{}", "[1]", "not json", '{"schema": 3}', '{"schema": "other/1"}'])
def test_a_run_json_that_is_not_ours_is_left_alone(tmp_path: Path, run: FilterRun, content: str) -> None:
    (tmp_path / "run.json").write_text(content)
    with pytest.raises(OutputError, match="not a run directory"):
        check_target(tmp_path)
    with pytest.raises(OutputError, match="not a run directory"):
        write_run(run, tmp_path, plots=())
    assert names_in(tmp_path) == ["run.json"]


def test_a_run_of_a_later_version_may_be_replaced(tmp_path: Path, run: FilterRun) -> None:
    (tmp_path / "run.json").write_text('{"schema": "icrtool/run/9"}')
    write_run(run, tmp_path, plots=())
    assert read_run(tmp_path).name == "barn"


@pytest.mark.parametrize("where", ["write_states", "_write_figures"])
def test_a_full_disk_is_said_and_leaves_the_old_run(
    written: Path, run: FilterRun, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    before = (written / "B2SUMS").read_bytes()
    monkeypatch.setattr(run_directory, where, full)
    with pytest.raises(OutputError, match="barn: cannot be written; No space left on device"):
        write_run(run, written)
    assert (written / "B2SUMS").read_bytes() == before
    assert [path.name for path in written.parent.iterdir()] == ["barn"]


def test_an_interrupted_drawing_leaves_nothing(tmp_path: Path, run: FilterRun, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(figures, "draw_figures", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_run(run, tmp_path / "barn")
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_plot_format_is_a_mistake_of_the_caller(tmp_path: Path, run: FilterRun) -> None:
    with pytest.raises(ValueError, match="gif"):
        write_run(run, tmp_path / "barn", plots=("gif",))


def remove(name: str) -> Callable[[Path], None]:
    return lambda directory: (directory / name).unlink()


def change(name: str, old: bytes, new: bytes) -> Callable[[Path], None]:
    def changed(directory: Path) -> None:
        content = (directory / name).read_bytes()
        assert old in content
        (directory / name).write_bytes(content.replace(old, new, 1))

    return changed


def cut(name: str) -> Callable[[Path], None]:
    return lambda directory: (directory / name).write_bytes((directory / name).read_bytes()[:-1000])


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (remove("run.json"), "not a run directory; it holds no readable run.json"),
        (cut("run.json"), "run.json is not JSON"),
        (change("run.json", b"icrtool/run/1", b"icrtool/run/2"), "its schema is icrtool/run/2, this icrtool reads"),
        (change("run.json", b"icrtool/run/1", b"elsewhere"), "not a run directory; its run.json is not icrtool's"),
        (change("run.json", b'"barn"', b'"shed"'), "run.json was edited or cut short"),
        (remove("states.csv"), "states.csv is missing"),
        (cut("states.csv"), "states.csv was edited or cut short"),
        (change("states.csv", b"0.", b"1."), "states.csv was edited or cut short"),
        (remove("B2SUMS"), "no readable B2SUMS"),
        (change("B2SUMS", b"states.csv", b"other.csv"), "B2SUMS names no states"),
    ],
)
def test_a_spoilt_run_is_refused_in_one_line(written: Path, spoil: Callable[[Path], None], sentence: str) -> None:
    spoil(written)
    with pytest.raises(RunError) as caught:
        read_run(written)
    assert str(caught.value).startswith(f"{written}: {sentence}")
    assert "\n" not in str(caught.value)


def test_a_run_hands_on_the_icrs_it_ended_with(written: Path, run: FilterRun) -> None:
    start = read_warm_start(written)
    table = run.table
    assert start[0].tolist() == [table.y_icr_right_m[-1], table.y_icr_left_m[-1], table.x_icr_m[-1]]
    assert np.array_equal(start[1], run.covariance[3:, 3:])


def test_a_run_that_did_not_record_its_covariance_starts_no_other(tmp_path: Path, run: FilterRun) -> None:
    icr = {key: value for key, value in run.summary["icr"].items() if key != "final_covariance_m2"}
    write_run(replace(run, summary={**run.summary, "icr": icr}), tmp_path / "barn", plots=())
    with pytest.raises(RunError, match="does not say what ICRs and covariance it ended with"):
        read_warm_start(tmp_path / "barn")


def test_what_is_not_there_is_no_run(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="no such run directory"):
        read_run(tmp_path / "nowhere")


def test_sums_of_a_run_that_lacks_keys_do_not_make_it_one(written: Path) -> None:
    document = json.loads((written / "run.json").read_text())
    del document["outages_ns"]
    (written / "run.json").write_bytes(json_bytes(document))
    sums = {name: run_directory.file_b2sum(written / name) for name in ("run.json", "states.csv")}
    (written / "B2SUMS").write_text("".join(f"{sum_}  {name}\n" for name, sum_ in sums.items()))
    with pytest.raises(RunError, match="cannot be read"):
        read_run(written)
