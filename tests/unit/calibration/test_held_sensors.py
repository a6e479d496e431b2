"""Sensors' constants of a calibration: held in other drives of the robot, contradicted, refitted, known of the past."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

import icrtool
from icrtool.calibration.adaptive_rows import prior_for
from icrtool.calibration.calibration_rows import calibrated_drive
from icrtool.calibration.held_sensors import (
    BETWEEN_DRIVES_STD,
    constants_document,
    known_constants,
    pooled_constants,
    remaining_constants,
)
from icrtool.calibration.pooled import turning_recording_of
from icrtool.calibration.record import Calibration
from icrtool.config import parse_config
from icrtool.motion.recording import LogConstants, cut_trials
from icrtool.motion.window_fit import CONSTANT_STD, KnownConstants
from icrtool.output.tables.dropout import format_dropout
from icrtool.records.calibration_document import CalibrationLog, LogSensors
from icrtool.records.run import Run
from icrtool.records.samples import GyroSamples
from icrtool.records.tables import RobotLog
from support.drives import make_log

CONFIG = parse_config({"robot": {"track_width_m": 0.6}})
OFFSET_DEG, DELAY_S, GYRO_SCALE, GYRO_BIAS = 5.0, 0.2, 1.02, 0.004
MOVED_DEG = 3.0
FEW_PERCENT = 1.06
BIAS_LEARNED_S = 90.0
"""The bias of the gyro is learned from the past of the drive; early it is known less well than from all of it."""


def drive(seed: int, faster: float = 1.0, *, moved_deg: float = 0.0, later_s: float = DELAY_S) -> RobotLog:
    """Return a drive of one robot: its heading is off, its poses lag the wheels, its gyro has scale and bias."""
    log = make_log(seed, 150.0, rate=20.0, heading_offset_deg=OFFSET_DEG + moved_deg, faster=faster)
    # a gyro on the clock of the wheels
    rate = np.gradient(np.unwrap(make_log(0, 150.0, rate=20.0, faster=faster, heading_std_deg=0.0).heading.heading_rad))
    stamps = log.wheels.stamp_ns
    noise = np.random.default_rng([seed, 3]).normal(0.0, 0.002, len(stamps))
    gyro = GyroSamples("/gyro", stamps, (20.0 * rate - GYRO_BIAS) / GYRO_SCALE + noise)
    lag = round(later_s * 1e9)
    return replace(
        log,
        gnss=replace(log.gnss, stamp_ns=log.gnss.stamp_ns + lag),
        heading=replace(log.heading, stamp_ns=log.heading.stamp_ns + lag),
        gyro=gyro,
    )


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return icrtool.calibrate(icrtool.fit(drive(1), CONFIG))


@pytest.fixture(scope="module")
def other() -> Run:
    return icrtool.fit(drive(2, 0.8), CONFIG)


@pytest.fixture(scope="module")
def moved() -> Run:
    """A drive after which somebody has turned the heading sensor by 3 degrees."""
    return icrtool.fit(drive(2, 0.8, moved_deg=MOVED_DEG), CONFIG)


def expected_m(calibration: Calibration, run: Run, *, with_gyro: bool, refit: bool, since_s: float = 0.0) -> float:
    recording = turning_recording_of(run)
    trials = cut_trials(recording, (10.0,))
    late = recording.track.t[trials.starts] >= since_s
    tested = calibrated_drive(calibration, recording, "calibration", with_gyro=with_gyro, refit_sensors=refit)
    return float(np.nanmean(tested.drive.errors(trials).position[late]))


def test_a_calibration_states_the_constants_of_the_sensors_as_they_were_sent(calibration: Calibration) -> None:
    (log,) = calibration.logs
    assert log.sensors is not None
    assert log.sensors.heading_source == "orientation"
    for of_model in (log.sensors.wheels, log.sensors.gyro):
        assert of_model is not None
        assert of_model.heading_offset_deg.value == pytest.approx(-OFFSET_DEG, abs=0.1)
        assert of_model.reference_delay_s.value == pytest.approx(DELAY_S, abs=0.02)
    assert log.sensors.gyro.gyro_bias_degps.value == pytest.approx(np.degrees(GYRO_BIAS), abs=0.05)
    assert log.sensors.gyro.gyro_delay_s.value == pytest.approx(0.0, abs=0.05)
    assert log.sensors.wheels.gyro_bias_degps is None


def test_constants_held_from_another_drive_cost_little(calibration: Calibration, other: Run) -> None:
    wheels = [expected_m(calibration, other, with_gyro=False, refit=refit) for refit in (False, True)]
    assert wheels[0] < FEW_PERCENT * wheels[1]
    gyro = [
        expected_m(calibration, other, with_gyro=True, refit=refit, since_s=BIAS_LEARNED_S) for refit in (False, True)
    ]
    assert gyro[0] < FEW_PERCENT * gyro[1]


def test_a_sensor_that_was_moved_is_noted_and_refitted_on_request(calibration: Calibration, moved: Run) -> None:
    held, refit = (
        icrtool.dropout_report(moved, horizons_m=[10.0], calibrations=[calibration], refit_sensors=one)
        for one in (False, True)
    )
    code = "sensors_contradict_calibration"
    (found,) = (one for one in held.document.notes if one.code == code)
    assert "heading offset" in found.text
    assert "--refit-sensors" in found.text
    assert found.text.count("±") == 2
    assert not [one for one in refit.document.notes if one.code == code]
    texts = [" ".join(format_dropout(one).split()) for one in (held, refit)]
    assert "heading offset: the calibration holds" in texts[0]
    assert "the calibration holds" not in texts[1]
    assert "not fitted to this log; sensors refitted" in texts[1]
    errors = [one.result("calibration").column("expected_error_m")[0] for one in (held, refit)]
    # 3 degrees over 10 m are 0.52 m
    assert errors[0] > 0.4
    assert errors[1] < 0.1
    knows = [next(row.knows for row in one.document.models if row.name == "calibration") for one in (held, refit)]
    assert "held" in knows[0]
    assert "refitted in this drive (--refit-sensors)" in knows[1]
    sensors = [one.document.calibrations[0].sensors for one in (held, refit)]
    assert [one.refitted for one in sensors] == [False, True]
    assert sensors[0].held.heading_offset_deg.value == pytest.approx(-OFFSET_DEG, abs=0.1)
    assert sensors[0].measured.heading_offset_deg.value == pytest.approx(-OFFSET_DEG - MOVED_DEG, abs=0.1)


def test_no_contradiction_is_noted_where_nothing_was_moved(calibration: Calibration, other: Run) -> None:
    recording = turning_recording_of(other)
    for with_gyro in (False, True):
        assert calibrated_drive(calibration, recording, "calibration", with_gyro=with_gyro).notes == ()


def test_a_calibration_without_constants_finds_them_in_the_log_and_says_so(
    calibration: Calibration, moved: Run
) -> None:
    old = msgspec.structs.replace(
        calibration, logs=tuple(msgspec.structs.replace(one, sensors=None) for one in calibration.logs)
    )
    recording = turning_recording_of(moved)
    tested = calibrated_drive(old, recording, "calibration")
    assert "heading offset, delay of the poses behind the wheels from this drive" in tested.knows
    assert tested.notes == ()
    errors = [expected_m(old, moved, with_gyro=False, refit=refit) for refit in (False, True)]
    assert errors[0] == pytest.approx(errors[1], rel=1e-9)
    assert old.prior().constants.std == LogConstants(*CONSTANT_STD)


def test_the_prior_of_row_adaptive_is_left_of_the_corrections_of_its_log(calibration: Calibration, moved: Run) -> None:
    recording = turning_recording_of(moved)
    prior = prior_for(recording, [calibration])
    assert np.degrees(prior.constants.mean.heading_offset_rad) == pytest.approx(MOVED_DEG, abs=0.2)
    assert prior.constants.mean.wheels_later_s == 0.0
    assert prior.turned_constants.mean.gyro_bias_radps == pytest.approx(GYRO_BIAS, abs=0.001)
    without = prior_for(recording, [calibration], refit_sensors=True)
    assert without.constants.mean == LogConstants()
    # on board nothing is corrected before
    on_board = calibration.prior()
    assert np.degrees(on_board.constants.mean.heading_offset_rad) == pytest.approx(-OFFSET_DEG, abs=0.1)
    assert on_board.constants.mean.wheels_later_s == pytest.approx(-DELAY_S, abs=0.02)


def test_a_heading_of_another_source_does_not_get_the_offset(calibration: Calibration) -> None:
    assert np.isnan(pooled_constants(calibration.logs, "antenna_pair").mean.heading_offset_rad)
    known = pooled_constants(calibration.logs, "orientation")
    assert np.isfinite(known.mean.heading_offset_rad)
    assert pooled_constants(calibration.logs) == known


def log_of(offset_rad: float, std_rad: float) -> CalibrationLog:
    one = constants_document(KnownConstants(LogConstants(offset_rad), LogConstants(std_rad, 0.1, np.nan, np.nan)))
    return CalibrationLog("a", "", "", 9.0, 0.0, 0.0, sensors=LogSensors("orientation", one))


def test_logs_are_pooled_with_the_spread_between_them() -> None:
    """Against the weighted mean and the moments of DerSimonian and Laird, written out; offsets on both sides of pi."""
    values, std = np.pi + np.array([0.02, -0.03, 0.05, 0.0]), np.array([0.004, 0.006, 0.005, 0.004])
    known = pooled_constants([log_of(*pair) for pair in zip(np.angle(np.exp(1j * values)), std, strict=True)])
    weights = std**-2.0
    mean = (weights * values).sum() / weights.sum()
    q = (weights * (values - mean) ** 2).sum()
    between = (q - 3) / (weights.sum() - (weights**2).sum() / weights.sum())
    between = (6.0 * BETWEEN_DRIVES_STD.heading_offset_rad**2 + 3.0 * between) / 9.0
    weights = 1.0 / (std**2 + between)
    turned = known.mean.heading_offset_rad - (weights * values).sum() / weights.sum()
    assert np.remainder(turned + np.pi, 2 * np.pi) - np.pi == pytest.approx(0.0, abs=1e-12)
    assert known.std.heading_offset_rad == pytest.approx(np.sqrt(1.0 / weights.sum() + between), rel=1e-12)
    (one,) = (log_of(0.1, 0.004),)
    alone = pooled_constants([one]).std.heading_offset_rad
    assert alone == pytest.approx(np.sqrt(0.004**2 + 2.0 * BETWEEN_DRIVES_STD.heading_offset_rad**2), rel=1e-3)


def test_constants_come_back_from_their_document_and_corrections_add_up() -> None:
    known = KnownConstants(LogConstants(0.1, -0.2, 0.003, 0.04), LogConstants(0.01, 0.02, 0.001, 0.004))
    document = constants_document(known)
    assert document.heading_offset_deg.value == pytest.approx(np.degrees(0.1))
    assert document.reference_delay_s.value == pytest.approx(0.2)
    for one, other in zip(known_constants(document), known, strict=True):
        assert one == pytest.approx(other, rel=1e-12)
    corrected = LogConstants(3.1, 0.05, 0.0, -0.1)
    left = remaining_constants(known, corrected).mean
    assert corrected.plus(left) == pytest.approx(known.mean, abs=1e-12)
    assert abs(left.heading_offset_rad) <= np.pi
