"""Calibrations and the recommended model as rows of the dropout report; one answer wherever it is asked for."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pandas as pd
import pytest

import icrtool
from icrtool.calibration.calibration_rows import calibrated_drive
from icrtool.calibration.pooled import recording_of
from icrtool.calibration.record import Calibration
from icrtool.dropout_analysis import trials
from icrtool.dropout_analysis.dropout_report import dropout_report
from icrtool.dropout_analysis.report import DropoutReport
from icrtool.errors import ConfigError
from icrtool.kernels.error_statistics import error_summary
from icrtool.motion.recording import cut_trials
from icrtool.output.exports.controllers import format_export
from icrtool.output.figures import style as figure_style
from icrtool.output.tables.dropout import format_dropout
from icrtool.records.run import Run
from support.documents import with_summary

HORIZONS = (5.0, 10.0, 20.0)


@pytest.fixture(scope="module")
def drive(make_run: Callable[..., Run]) -> Run:
    run = make_run(duration_s=120.0, troubles=False)
    return with_summary(run, inputs=[{"path": "a", "bytes": 1, "sha256": "a"}])


@pytest.fixture(scope="module")
def own(drive: Run) -> Calibration:
    return icrtool.calibrate(drive)


@pytest.fixture(scope="module")
def report(drive: Run, own: Calibration, tmp_path_factory: pytest.TempPathFactory) -> DropoutReport:
    """With the run's own calibration and one that says it is of other logs, both read back from files."""
    folder = tmp_path_factory.mktemp("calibrations")
    other = msgspec.structs.replace(own, logs=(msgspec.structs.replace(own.logs[0], sha256="b"),))
    files = [own.write(folder / "own.json"), other.write(folder / "last.season.json")]
    calibrations = [icrtool.open_calibration(file) for file in files]
    gates = ["calibration:last.season.p95@10m <= 9", "recommended.expected@5m <= 0", "controller.p95@10m <= 9"]
    return dropout_report(drive, horizons_m=HORIZONS, calibrations=calibrations, gates=gates, starts="all")


def test_a_calibration_is_tested_in_the_trials_of_the_other_rows(
    drive: Run, own: Calibration, report: DropoutReport
) -> None:
    recording = recording_of(drive)
    trials = cut_trials(recording, HORIZONS)
    expected = error_summary(calibrated_drive(own, recording, "calibration").drive.errors(trials).position)
    for name in ("calibration:own", "calibration:last.season"):
        result = report.result(name)
        assert result is not None
        np.testing.assert_array_equal(result.column("trials"), (trials.ends >= 0).sum(axis=0))
        np.testing.assert_allclose(result.column("p95_m"), expected.p95, rtol=1e-6)
        assert np.all(result.column("p95_low_m")[:1] < result.column("p95_m")[:1])


def test_ranges_of_starts_without_a_trial_have_no_errors(
    drive: Run, own: Calibration, report: DropoutReport, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the last metres of a drive no trial starts."""
    monkeypatch.setattr(trials, "STARTS_AT_ONCE", 100)
    pieces = dropout_report(
        drive, horizons_m=HORIZONS, calibrations=[msgspec.structs.replace(own, name="own")], starts="all"
    )
    for name, known in (("recommended", "recommended"), ("calibration", "calibration:own")):
        ours, theirs = pieces.result(name), report.result(known)
        assert ours is not None
        assert theirs is not None
        np.testing.assert_array_equal(ours.column("trials"), theirs.column("trials"))
        np.testing.assert_allclose(ours.column("p95_m"), theirs.column("p95_m"), rtol=1e-6)


def test_the_report_states_whether_the_log_was_fitted_to(report: DropoutReport) -> None:
    assert [one.fitted_to_this for one in report.document.calibrations] == [True, False]
    text = format_dropout(report)
    assert "own: " in text
    assert "not fitted to this log" in text


def test_what_is_recommended_is_not_better_than_what_knew_the_drive(report: DropoutReport) -> None:
    held_out, in_sample = report.result("recommended"), report.result("calibration:own")
    assert held_out is not None
    assert in_sample is not None
    assert np.all(held_out.column("expected_error_m") != in_sample.column("expected_error_m"))
    assert held_out.column("expected_error_m")[0] < 2.0 * in_sample.column("expected_error_m")[0]
    np.testing.assert_array_equal(held_out.column("trials"), in_sample.column("trials"))


def test_calibrate_report_and_export_give_the_same_numbers(own: Calibration, report: DropoutReport) -> None:
    assert report.calibration is not None
    numbers, exported = report.calibration.controller, json.loads(format_export(own, "json"))
    assert numbers == own.controller
    assert exported["separation_multiplier"] == numbers.multiplier
    assert exported["separation_multiplier_std"] == numbers.multiplier_std
    assert f"wheel_separation_multiplier {numbers.multiplier:.3f} ± {numbers.multiplier_std:.3f}" in " ".join(
        format_dropout(report).split()
    )
    assert exported["left_radius_multiplier"] == numbers.left_radius
    # the controller's model is tested in the same trials as the whole one
    for key, row in (("full_p95_m", "recommended"), ("p95_m", "controller")):
        assert (result := report.result(row)) is not None
        assert exported[key] == pytest.approx(result.column("p95_m")[1], rel=1e-9)
    assert exported["p95_m"] != exported["full_p95_m"]
    pooled = {(one.model, one.horizon_m): one.p95_m for one in own.held_out_pooled}
    assert pooled["recommended", 10.0] == exported["full_p95_m"]
    assert own.held_out_m("recommended", 10.0)[0] == exported["full_p95_m"]
    assert f"within {exported['full_p95_m']:.2f} m" in repr(own)


def test_gates_and_budgets_know_every_row(report: DropoutReport) -> None:
    assert [verdict.passed for verdict in report.document.gates] == [True, False, True]
    assert {one.model for one in report.document.budgets} <= {one.name for one in report.results}
    known = [one for one in report.document.budgets if one.low_m is not None]
    assert all(one.low_m <= one.distance_m <= (one.high_m or np.inf) for one in known)


def test_files_and_figures_hold_every_row(
    report: DropoutReport, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(figure_style, "picture_bytes", lambda figure, form: form.encode())  # drawn, without pixels
    report.write(tmp_path / "dropout")
    rows = {"icr", "no_slip", "icr_final", "controller", "recommended", "adaptive"}
    names = rows | {f"{row}_heading" for row in rows} | {"calibration:own", "calibration:last.season"}
    assert set(pd.read_csv(tmp_path / "dropout" / "summary.csv")["model"]) == names
    assert set(pd.read_csv(tmp_path / "dropout" / "histogram.csv")["model"]) == names
    document = json.loads((tmp_path / "dropout" / "report.json").read_bytes())
    assert [one["fitted"] for one in document["calibrations"]] == ["fitted to this log", "not fitted to this log"]
    assert document["recommended"]["model"] == report.calibration.recommended  # type: ignore[union-attr]
    assert (tmp_path / "dropout" / "plots" / "histogram.png").is_file()


def test_one_calibration_has_the_plain_name_and_no_comparison_no_recommended_row(drive: Run, own: Calibration) -> None:
    report = dropout_report(drive, horizons_m=[5.0], calibrations=[own], ladder=False)
    assert [result.name for result in report.results] == ["icr", "no_slip", "icr_final", "calibration"]
    wide = msgspec.structs.replace(own.robot, track_width_m=1.0)
    with pytest.raises(ConfigError, match="width"):
        dropout_report(drive, calibrations=[msgspec.structs.replace(own, robot=wide)])
    with pytest.raises(ConfigError, match="recommended"):
        dropout_report(drive, horizons_m=[5.0], ladder=False, gates=["recommended.p95@5m < 1"])
