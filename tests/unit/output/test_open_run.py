"""Runs read back: equal in every field, printed and drawn the same; what is no run is refused in one line."""

from __future__ import annotations

import copy
import json
import os
import pickle
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import icrtool
from icrtool.dropout_analysis.dropout_report import dropout_report
from icrtool.dropout_analysis.report import DropoutReport
from icrtool.errors import RunError
from icrtool.output.figure_catalogue import FIGURES
from icrtool.output.figures import style as figure_style
from icrtool.output.figures.style import picture_bytes
from icrtool.output.files.formats import file_b2sum, json_bytes
from icrtool.output.run_directory import log_of, newest_run, open_run, write_run
from icrtool.output.tables.dropout import format_dropout
from icrtool.output.tables.run import format_run
from icrtool.pipeline import fit
from icrtool.records.run import Run
from icrtool.records.samples import GyroSamples
from support.barn import configured, simulate
from support.documents import with_summary


@pytest.fixture(scope="module")
def whole() -> Run:
    """A run with all that a run can have: gyro, smoothed states, terrain change, warm start."""
    log = simulate()
    rate = np.gradient(np.unwrap(log.heading.heading_rad), log.heading.stamp_ns / 1e9)
    log = replace(log, gyro=GyroSamples("/imu/data", log.heading.stamp_ns, rate))
    begin = fit(log, configured()).ended_with
    return fit(log, configured(), warm_start=begin, changes_s=(25.0,), smooth=True)


@pytest.fixture(scope="module")
def stored(whole: Run, tmp_path_factory: pytest.TempPathFactory) -> Run:
    directory = tmp_path_factory.mktemp("runs") / "barn"
    whole.write(directory, plots=())
    return open_run(directory)


@pytest.fixture
def written(tmp_path: Path, run: Run) -> Path:
    write_run(run, tmp_path / "barn", plots=())
    return tmp_path / "barn"


def differences(one: Any, other: Any, where: str = "run") -> list[str]:
    """Return the places where two records differ, to the last bit."""
    if type(one) is not type(other):
        return [f"{where}: {type(one)} and {type(other)}"]
    if isinstance(one, np.ndarray):
        same = one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
        return [] if same else [where]
    if is_dataclass(one):
        names = [field.name for field in fields(one) if field.compare]
        return [d for name in names for d in differences(getattr(one, name), getattr(other, name), f"{where}.{name}")]
    return [] if one == other else [where]


def test_a_run_read_back_is_equal_in_every_field(whole: Run, stored: Run) -> None:
    assert whole.directory is None
    assert stored.directory is not None
    assert whole.in_gap.sum() == 1
    assert len(whole.outages_ns) == 1
    assert len(whole.changes_s) == 1
    assert differences(whole, replace(stored, directory=None)) == []
    assert differences(whole.began_with, stored.began_with) == []
    assert differences(whole.ended_with, stored.ended_with) == []


@pytest.mark.parametrize(
    "drive",
    [
        {},
        {"troubles": False, "track_width_m": None, "datum": False, "duration_s": 20.0},
        {"speed_mps": 0.01, "duration_s": 20.0},
    ],
    ids=["usual", "bare", "parked"],
)
def test_other_runs_come_back_too(drive: dict[str, Any], make_run: Callable[..., Run], tmp_path: Path) -> None:
    run = make_run(**drive)
    write_run(run, tmp_path / "barn", plots=(), states="parquet")
    assert differences(run, replace(open_run(tmp_path / "barn"), directory=None)) == []


@pytest.fixture
def lean(whole: Run, tmp_path: Path) -> Run:
    """A run of which the standard deviations are read where they are used."""
    write_run(whole, tmp_path / "barn", plots=(), states="parquet")
    return open_run(tmp_path / "barn", whole=False)


def test_columns_that_are_not_held_are_equal_to_those_that_are(whole: Run, lean: Run) -> None:
    assert lean.smoothed is not None
    assert whole.smoothed is not None
    for one, other in ((lean.table, whole.table), (lean.smoothed, whole.smoothed)):
        assert list(one.columns()) == list(other.columns())
        for name, column in one.columns().items():
            np.testing.assert_array_equal(column, getattr(other, name), err_msg=name)
        assert one.std_north_m is not one.std_north_m
    pd.testing.assert_frame_equal(lean.states, whole.states)
    assert differences(whole.table, copy.copy(lean.table)) == []
    assert differences(whole.table, pickle.loads(pickle.dumps(lean.table))) == []


def test_changed_columns_stay_beside_those_that_are_not_held(lean: Run) -> None:
    other = np.zeros(len(lean.table))
    changed = lean.table.changed(std_north_m=other).changed(east_m=other)
    assert changed.std_north_m is other
    assert changed.east_m is other
    np.testing.assert_array_equal(changed.std_x_icr_m, lean.table.std_x_icr_m)


@pytest.mark.parametrize("how", ["replaced", "edited", "removed"])
def test_a_file_that_changes_while_a_run_is_in_use_is_noticed(lean: Run, how: str) -> None:
    assert lean.directory is not None
    states = lean.directory / "states.parquet"
    if how == "replaced":
        other = states.with_name("other")
        other.write_bytes(states.read_bytes())
        other.replace(states)
    elif how == "edited":
        with states.open("r+b") as file:
            file.write(b"PAR2")
        os.utime(states, ns=(0, 0))
    else:
        states.unlink()
    with pytest.raises(RunError, match=r"states\.parquet"):
        assert lean.table.std_north_m


def reported(run: Run, reference: Any) -> DropoutReport:
    return dropout_report(
        run,
        horizons_m=[1.0, 5.0],
        outage_s=[4.0],
        outage_at_s=[12.0],
        gates=["icr.p95@2m <= 9"],
        reference=reference,
        allow_unusable=True,
    )


@pytest.fixture(scope="module", params=["filter", "smoothed"])
def fresh(request: pytest.FixtureRequest, whole: Run) -> tuple[str, DropoutReport]:
    """A reference, and the report of the run that was not read back."""
    return request.param, reported(whole, request.param)


def test_a_run_that_holds_fewer_columns_reports_the_same(fresh: tuple[str, DropoutReport], lean: Run) -> None:
    reference, report = fresh
    assert json_bytes(reported(lean, reference).document) == json_bytes(report.document)


def test_a_run_read_back_prints_the_same(whole: Run, stored: Run) -> None:
    assert format_run(stored) == format_run(whole)
    assert repr(stored) == repr(whole)
    assert stored._repr_html_() == whole._repr_html_()


@pytest.mark.parametrize("name", [name for name, entry in FIGURES.items() if entry.subject == "run"])
def test_a_run_read_back_draws_the_same(name: str, whole: Run, stored: Run) -> None:
    first, second = (picture_bytes(FIGURES[name].draw(one), "png") for one in (whole, stored))
    assert first == second


def test_a_run_read_back_reports_the_same(fresh: tuple[str, DropoutReport], stored: Run) -> None:
    reference, report = fresh
    read = reported(stored, reference)
    assert json_bytes(read.document) == json_bytes(report.document)
    assert format_dropout(read) == format_dropout(report)
    assert {outage.kind for outage in read.document.outages} == {"forced", "real"}
    assert read.document.ladder.models
    assert {verdict.horizon_m for verdict in read.document.gates} <= set(read.horizons_m)


def test_the_library_gives_what_the_command_gives(stored: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(figure_style, "picture_bytes", lambda figure, form: form.encode())  # the names alone
    report = icrtool.dropout_report(stored, horizons_m=[1.0, 5.0], allow_unusable=True)
    report.write(tmp_path / "report")
    names = {path.name for path in (tmp_path / "report").iterdir()}
    assert names == {
        "summary.csv",
        "histogram.csv",
        "worst.csv",
        "report.json",
        "plots",
    }
    assert {"summary.png", "histogram.png", "worst.png", "outages.png", "error_map.png"} == {
        path.name for path in (tmp_path / "report" / "plots").iterdir()
    }
    report.write(plots=())
    assert stored.directory is not None
    assert (stored.directory / "dropout" / "summary.csv").read_bytes() == (
        tmp_path / "report" / "summary.csv"
    ).read_bytes()
    for figure in (
        icrtool.figures.trajectory(stored), icrtool.figures.icr_estimates(stored), icrtool.figures.icr_clusters(stored),
        icrtool.figures.gnss_difference(stored), icrtool.figures.dropout_summary(report),
        icrtool.figures.dropout_histogram(report, 5.0), icrtool.figures.dropout_examples(report),
        icrtool.figures.dropout_histograms(report, 5.0),
        icrtool.figures.dropout_worst(report), icrtool.figures.dropout_outages(report),
    ):  # fmt: skip
        assert figure.axes
    assert "<pre>" in report._repr_html_()
    assert len(repr(report)) < 200


def test_figures_say_what_a_report_lacks(stored: Run) -> None:
    report = icrtool.dropout(stored, [1.0])
    with pytest.raises(icrtool.IcrToolError, match="no worst trials"):
        icrtool.figures.dropout_worst(report)
    with pytest.raises(ValueError, match="horizon_m"):
        icrtool.figures.dropout_histogram(report, 3.0)


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
        (remove("measurements.npz"), "measurements.npz is missing"),
        (cut("measurements.npz"), "measurements.npz was edited or cut short"),
        (remove("B2SUMS"), "no readable B2SUMS"),
        (change("B2SUMS", b"states.csv", b"other.csv"), "B2SUMS names no states"),
        (change("B2SUMS", b"measurements.npz", b"headings.npz"), "B2SUMS names no measurements.npz; fit the log again"),
    ],
)
def test_a_spoilt_run_is_refused_in_one_line(written: Path, spoil: Callable[[Path], None], sentence: str) -> None:
    spoil(written)
    with pytest.raises(RunError) as caught:
        open_run(written)
    assert str(caught.value).startswith(f"{written}: {sentence}")
    assert "\n" not in str(caught.value)


def forge(directory: Path, document: Any) -> None:
    """Write another run.json, with sums that agree."""
    (directory / "run.json").write_bytes(json_bytes(document))
    sign(directory)


def sign(directory: Path) -> None:
    names = [path.name for path in directory.iterdir() if path.is_file() and path.name != "B2SUMS"]
    sums = {name: file_b2sum(directory / name) for name in names}
    (directory / "B2SUMS").write_text("".join(f"{sum_}  {name}\n" for name, sum_ in sums.items()))


def test_a_forged_measurements_file_is_one_line(written: Path) -> None:
    with np.load(written / "measurements.npz") as file:
        columns = dict(file)
    for spoilt in (
        {name: column for name, column in columns.items() if name != "fixes_nis"},
        {**columns, "fixes_north_m": columns["fixes_north_m"][:-1]},
        {**columns, "headings_nis": columns["headings_nis"][:-1]},
        {**columns, "fixes_code": columns["fixes_code"].astype(np.float64)},
        {**columns, "headings_stamp_ns": columns["headings_stamp_ns"].reshape(-1, 1)},
    ):
        np.savez(written / "measurements.npz", **spoilt)
        sign(written)
        with pytest.raises(RunError, match="cannot be read"):
            open_run(written)
    (written / "measurements.npz").write_bytes(b"no archive")
    sign(written)
    with pytest.raises(RunError, match="cannot be read"):
        open_run(written)


def test_what_is_not_there_is_no_run(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="no such run directory"):
        open_run(tmp_path / "nowhere")


def test_a_configuration_of_another_version_is_refused(written: Path) -> None:
    document = json.loads((written / "run.json").read_text())
    forge(written, {**document, "config": {"robot": {"wings": 2}}})
    with pytest.raises(RunError, match=r"its configuration is not of this version \(robot.wings\)"):
        open_run(written)


def test_a_run_hands_on_the_icrs_it_ended_with(written: Path, run: Run) -> None:
    start = open_run(written).ended_with
    table = run.table
    assert start.icrs_m.tolist() == [table.y_icr_right_m[-1], table.y_icr_left_m[-1], table.x_icr_m[-1]]
    std = [table.std_y_icr_right_m[-1], table.std_y_icr_left_m[-1], table.std_x_icr_m[-1]]
    assert np.sqrt(np.diag(start.covariance_m2)) == pytest.approx(std)
    assert start.track_width_m == run.track_width_m


def test_the_newest_run_is_that_of_the_youngest_run_json(tmp_path: Path, run: Run) -> None:
    runs = tmp_path / "runs"
    for age, name in enumerate(("a", "c", "b")):
        write_run(run, runs / name, plots=())
        os.utime(runs / name / "run.json", ns=(age, 10**18 - age))
    (runs / "other").mkdir()
    (runs / "other" / "run.json").write_text("{}", encoding="utf-8")
    assert newest_run(runs) == runs / "a"


def test_no_run_is_an_error_that_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="holds no run; name a run directory or a log, or make a run with icrtool fit"):
        newest_run(tmp_path / "icrtool-runs")


def with_inputs(run: Run, *paths: Path) -> Run:
    inputs: list[dict[str, Any]] = [{"path": str(path), "bytes": 1, "sha256": "0"} for path in paths]
    return with_summary(run, inputs=inputs)


def test_a_log_is_its_file_or_its_bag_directory(run: Run, tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    bag.mkdir()
    first, second, packed = bag / "bag_0.db3", bag / "bag_1.db3", bag / "bag_0.mcap.zstd"
    for file in (first, second, packed):
        file.touch()
    assert log_of(with_inputs(run, first)) == first
    assert log_of(with_inputs(run, first, second)) == bag
    assert log_of(with_inputs(run, packed)) == packed
    (bag / "metadata.yaml").touch()
    assert log_of(with_inputs(run, first)) == bag
    with pytest.raises(RunError, match="the log it was made from is gone"):
        log_of(with_inputs(run, tmp_path / "nowhere.mcap"))
    with pytest.raises(RunError, match="is gone"):
        log_of(with_inputs(run))
