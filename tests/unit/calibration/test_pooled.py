"""Calibrations from several recordings: nothing left out reaches a fit or a choice; files come back as they were."""

from __future__ import annotations

import json
from dataclasses import astuple, replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from icrtool.calibration.held_out import hold_out, left_out, plan_folds
from icrtool.calibration.pooled import (
    CalibrationResult,
    calibrate_recordings,
    predictor,
    recording_of,
    robot_of,
    use_notes,
    with_turn_rate,
)
from icrtool.config import parse_config
from icrtool.errors import ConfigError, DataError, RunError
from icrtool.kernels.arrays import Bools
from icrtool.kernels.track import Windows
from icrtool.motion.models import MODELS
from icrtool.motion.recording import Recording, Trials, cut_trials, cut_windows, predicted_path
from icrtool.motion.window_fit import Pool, own_constants
from icrtool.output.files.formats import open_calibration, write_calibration
from icrtool.output.tables.calibration import calibration_blocks
from icrtool.output.text_blocks import format_blocks
from icrtool.pipeline import fit
from icrtool.records.calibration_document import CalibratedRobot
from icrtool.records.measurements import MeasuredHeading
from icrtool.records.samples import TWIST_TYPES
from support.drives import make_log
from support.recordings import SIX, WIDTH_M, make_recording, table_errors, trials_from_all

WHOLE = MODELS["recommended"]
TRUTH = np.array([0.96, -0.1, 0.6, -0.02, 0.1, -0.12])


def logs(count: int = 3, *, gyro: bool = False) -> list[Recording]:
    return [make_recording(SIX, TRUTH, seed, 200.0, gyro=gyro, name=f"log {seed}") for seed in range(count)]


@pytest.fixture(scope="module")
def result() -> CalibrationResult:
    return calibrate_recordings(
        logs(gyro=True), CalibratedRobot(name="made", wheel_radius_m=0.1, track_width_m=WIDTH_M)
    )


def test_the_parameters_that_made_the_logs_come_back(result: CalibrationResult) -> None:
    chosen = result.calibration.fitted
    assert set(SIX.terms) <= set(chosen.model.terms)
    for term, value in zip(SIX.terms, TRUTH, strict=True):
        k = chosen.model.terms.index(term)
        assert abs(chosen.parameters[k] - value) < 4.0 * chosen.std[k]
    table = result.table
    expected = {row.name: row.together.expected for row in table.scores}
    assert np.all(expected["recommended"] < expected["controller"])
    assert np.all(expected["controller"] < 0.2 * expected["no_slip"])


def test_a_gyro_on_a_circle_turns_with_the_robot() -> None:
    """A noisy gyro of constant rate: a scale of 0.9 with a bias makes the same turns as a scale of one."""
    made, rng = make_recording(SIX, TRUTH, seconds=120.0), np.random.default_rng(4)
    circle = replace(made, track=made.track._replace(heading=0.18 * made.track.t))
    angle = circle.track.heading + np.cumsum(rng.normal(0.0, 0.003, len(made.track.t)))
    found = with_turn_rate(circle, MeasuredHeading("gyro", angle))
    assert found.track.gyro is not None
    other = np.cumsum(rng.normal(0.0, 0.003, len(made.track.t)))
    assert with_turn_rate(circle, MeasuredHeading("gyro", other)).track.gyro is None


def test_wheels_and_gyro_together_are_not_worse_than_either(result: CalibrationResult) -> None:
    both = result.table.score("recommended_gyro").together.expected
    assert np.all(both < 1.05 * result.table.score("recommended").together.expected)
    assert np.all(both < 1.05 * result.table.score("no_slip_gyro").together.expected)


def test_a_log_is_tested_with_parameters_of_the_others() -> None:
    """Against a fit that never saw the log, with the log's own constants."""
    recordings = logs(3)
    table = hold_out(recordings, (5.0, 10.0))
    alone = Pool([cut_windows(one) for one in recordings[:2]], [WIDTH_M] * 2).fit(WHOLE)
    own = own_constants(cut_windows(recordings[2]), alone, WIDTH_M)
    path = predicted_path(recordings[2], alone, own)
    errors = table_errors(recordings[2], cut_trials(recordings[2], (5.0, 10.0)), path)
    # the two fits stop within a small share of their standard deviation of one another
    assert table.score("recommended").folds[2].expected == pytest.approx(np.nanmean(errors, axis=0), rel=0.02)


def test_a_block_that_is_spoilt_does_not_change_what_it_is_predicted_by() -> None:
    clean = logs(1)[0]
    folds, drive = plan_folds([clean]), clean.track
    inside = (drive.distance > folds[-1].begin_m) & (drive.distance <= folds[-1].end_m)
    spoilt = replace(clean, track=drive._replace(north=drive.north * np.where(inside, 1.5, 1.0)))
    before, after = (hold_out([one], (5.0,)) for one in (clean, spoilt))
    of_last = [one.fit_without("recommended", folds[-1]) for one in (before, after)]
    assert of_last[0] is not None
    assert of_last[1] is not None
    assert of_last[1][0].parameters == pytest.approx(of_last[0][0].parameters, abs=1e-2)
    assert after.score("recommended").folds[-1].expected[0] > 1.0
    assert after.fits["recommended"].parameters != pytest.approx(before.fits["recommended"].parameters, abs=1e-2)


def test_a_file_comes_back_as_it_was(result: CalibrationResult, tmp_path: Path) -> None:
    file = write_calibration(result.calibration, tmp_path)
    document = json.loads(file.read_text())
    keys = {"schema", "model", "terms", "parameters", "covariance", "robot", "logs", "held_out", "recommended"}
    assert keys | {"created", "tool_version"} <= set(document)
    assert document["logs"][0].keys() >= {"path", "sha256"}
    assert document["held_out"][0].keys() == {"model", "horizon_m", "p95_m", "expected_m", "log"}
    again = open_calibration(file)
    np.testing.assert_array_equal(again.fitted.parameters, result.calibration.fitted.parameters)
    assert again.summary() == json.loads(json.dumps(result.calibration.summary()))


@pytest.mark.parametrize("spoil", [{"schema": "other"}, {"terms": []}, {"parameters": {}}, {"robot": {}}, {"gyro": 3}])
def test_what_is_no_calibration_is_one_error(
    result: CalibrationResult, tmp_path: Path, spoil: dict[str, object]
) -> None:
    file = tmp_path / "cal.json"
    file.write_text(json.dumps(result.calibration.summary() | spoil))
    with pytest.raises(RunError, match="not a calibration"):
        open_calibration(file)


def test_twist_and_odometry_are_the_models(result: CalibrationResult) -> None:
    calibration = result.calibration
    v_x, v_y, omega = calibration.twist(0.5, 0.3)
    assert (v_x, omega) == pytest.approx((0.96 * 0.4 - 0.1 * 0.1, 0.6 * 0.2 / WIDTH_M - 0.02 * 0.4 / WIDTH_M), abs=0.02)
    log = make_log(0, 30.0)
    path = calibration.odometry(log)
    assert len(path.stamp_ns) == len(log.wheels.stamp_ns)
    assert np.hypot(path.forward_m[-1], path.right_m[-1]) > 3.0
    step = np.hypot(path.forward_m[1], path.right_m[1])
    assert step == pytest.approx(
        np.hypot(*calibration.twist(log.wheels.v_left_mps[0], log.wheels.v_right_mps[0])[:2]) * 0.02
    )
    icrs, covariance, *_ = astuple(calibration.warm_start())
    assert icrs[0] > 0.0 > icrs[1]
    assert np.all(np.linalg.eigvalsh(covariance) > -1e-12)
    del v_y


@pytest.mark.parametrize(("unit", "metres"), [("rad", 0.165), ("counts", 2.0 * np.pi * 0.165 / 4096.0)])
def test_odometry_takes_wheels_in_the_unit_of_the_log(result: CalibrationResult, unit: str, metres: float) -> None:
    robot = CalibratedRobot(wheel_radius_m=0.165, encoder_counts_per_rev=4096.0, track_width_m=WIDTH_M)
    calibration, log = msgspec.structs.replace(result.calibration, robot=robot), make_log(0, 30.0)
    sent = replace(log.wheels, left=log.wheels.left / metres, right=log.wheels.right / metres, unit=unit)
    for found, expected in zip(calibration.odometry(replace(log, wheels=sent)), calibration.odometry(log), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-9)


def test_a_calibration_is_tested_in_the_trials_of_other_models(result: CalibrationResult) -> None:
    new = make_recording(SIX, TRUTH, 9, 200.0, gyro=True, name="new")
    trials = trials_from_all(new, (5.0, 10.0))
    errors = predictor(result.calibration, new)(trials).position
    np.testing.assert_array_equal(np.isfinite(errors), trials.ends >= 0)
    assert np.nanmean(errors[:, 1]) < 0.5
    assert np.nanmean(predictor(result.calibration, new, with_gyro=True)(trials).position[:, 1]) < 0.5
    assert not result.calibration.fitted_to(new.sha256)
    assert result.calibration.fitted_to("log 1")
    with pytest.raises(ConfigError, match="width"):
        predictor(result.calibration, replace(new, width_m=1.0))


def kept_of(windows: Windows, kept: Bools) -> Windows:
    return replace(windows, begin=windows.begin[kept], end=windows.end[kept], length_m=windows.length_m[kept])


@pytest.mark.parametrize("horizon_m", [5.0, 20.0])
def test_a_trial_is_predicted_without_what_is_near_it(horizon_m: float) -> None:
    """Against fits made here to the windows that keep clear of the trial, but for what slip shortens: 0.1 % of 5 m."""
    recording = logs(1)[0]
    table = hold_out([recording], (horizon_m,))
    distance, windows = recording.track.distance, cut_windows(recording)
    trials = cut_trials(recording, (horizon_m,))
    errors = table.errors("recommended", 0, trials).position
    differs = []
    for row in np.flatnonzero(trials.ends[:, 0] >= 0)[::400]:
        one = Trials(trials.starts[[row]], trials.ends[[row]])
        begin, end = distance[[one.starts[0], one.ends[0, 0]]]
        ((fold, _),) = left_out(table.folds, 0, np.array([begin]), np.array([end]))
        assert fold.begin_m <= begin
        assert end <= fold.end_m
        clear = (distance[windows.end] <= fold.begin_m) | (distance[windows.begin] >= fold.end_m)
        apart, whole = (Pool([kept_of(windows, kept)], [WIDTH_M]).fit(WHOLE) for kept in (clear, clear | True))
        expected, in_sample = (
            table_errors(recording, one, predicted_path(recording, fitted, fitted.constants(0)))[0, 0]
            for fitted in (apart, whole)
        )
        assert errors[row, 0] == pytest.approx(expected, rel=0.03, abs=5e-3)
        differs.append(abs(in_sample - expected) > 0.03 * expected + 3e-3)
    assert any(differs)


def test_a_trial_that_leaves_too_little_has_no_error_in_any_row() -> None:
    recording = make_recording(SIX, TRUTH, 1, 60.0)
    table = hold_out([recording], (5.0, 40.0))
    errors = table.errors("recommended", 0, cut_trials(recording, (5.0, 40.0))).position
    assert np.isfinite(errors[:, 0]).any()
    assert not np.isfinite(errors[:, 1]).any()
    for name in ("recommended", "controller"):
        assert np.array_equal(table.score(name).together.trials, np.isfinite(errors).sum(axis=0))


def test_a_log_given_twice_and_robots_of_two_widths_are_refused() -> None:
    one, two = logs(2)
    with pytest.raises(ConfigError, match="given twice"):
        calibrate_recordings([one, two, one])
    with pytest.raises(ConfigError, match="one robot at a time"):
        calibrate_recordings([one, replace(two, width_m=1.0)])
    with pytest.raises(DataError):
        calibrate_recordings([make_recording(SIX, TRUTH, 0, 12.0)])


@pytest.mark.parametrize("scales", [(0.95, 0.95), (0.96, 1.03)])
def test_a_run_with_configured_scales_gives_the_same_calibration(scales: tuple[float, float]) -> None:
    log = make_log(0, 60.0)
    given = {"left_scale": scales[0], "right_scale": scales[1]}
    runs = [fit(log, parse_config({"robot": {"track_width_m": 0.6}, "wheels": wheels})) for wheels in ({}, given)]
    assert runs[1].wheel_scales == pytest.approx(scales)
    assert runs[1].table.v_left_mps == pytest.approx(scales[0] / runs[0].wheel_scales[0] * runs[0].table.v_left_mps)
    for one, other in zip(*(recording_of(run).wheels()[2:4] for run in runs), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)
    robots = [robot_of(run, 0.6) for run in runs]
    assert robots[0] == robots[1]


@pytest.mark.parametrize("message_type", sorted(TWIST_TYPES))
def test_wheels_of_any_body_twist_keep_the_width_of_their_controller(message_type: str) -> None:
    log = make_log(0, 60.0)
    of_twist = replace(log, streams=tuple(replace(one, message_type=message_type) for one in log.streams))
    wide = {"robot": {"track_width_m": 0.6}, "wheels": {"twist_width_m": 0.9}}
    known, unknown = (fit(of_twist, parse_config({**wide, **wheels})) for wheels in ({}, {"wheels": {}}))
    assert robot_of(known, 0.6).twist_width_m == 0.9
    assert robot_of(unknown, 0.6).twist_width_m is msgspec.UNSET
    assert len(use_notes(unknown)) == len(use_notes(known)) + 1
    assert robot_of(fit(log, parse_config(wide)), 0.6).twist_width_m is msgspec.UNSET


def test_the_tables_name_what_they_show(result: CalibrationResult) -> None:
    text = format_blocks(calibration_blocks(result, None))
    assert f"Motion model: {result.calibration.fitted.model.label}" in text
    assert "each log left out in turn (3 logs)" in text
    assert max(map(len, text.splitlines())) <= 110
