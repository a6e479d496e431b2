"""Rows `icr`, `calibration`, also with a gyro, know nothing of what follows a trial: cut logs, corrections fixed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import icrtool
from icrtool.calibration.calibration_rows import calibrated_drive
from icrtool.calibration.pooled import recording_of
from icrtool.calibration.run_models import _errors_turned, models_of
from icrtool.config import Config, load_config
from icrtool.estimation.odometry import measured_headings
from icrtool.kernels.open_loop import open_loop_errors
from icrtool.kernels.track import ends_from
from icrtool.motion.recording import Trials, past_gyro_lines
from icrtool.pipeline import fit
from icrtool.records.run import Run, track_of
from icrtool.records.samples import GyroSamples
from icrtool.records.tables import RobotLog
from support.drives import make_log

HORIZONS_M = np.array([1.0, 5.0])
ROUNDING_M = 1e-9
"""Sums along a log are the same until its cut; only their order of addition may differ."""
FIXED = (
    "robot.track_width_m=0.8",
    "frames.heading=ned",
    "frames.heading_offset_deg=0",
    "frames.reference_delay_s=0",
    "frames.heading_delay_s=0",
    "frames.gyro_delay_s=0",
    "frames.antenna_forward_m=0",
    "frames.antenna_right_m=0",
    "wheels.left_scale=1",
    "wheels.right_scale=1",
    "filter.process_position_mps=0.3",
    "filter.process_heading_degps=7",
    "filter.gnss_std_m=0.01",
    "filter.heading_std_deg=1",
)


def with_gyro(log: RobotLog, scale: float = 1.02, bias: float = 0.004) -> RobotLog:
    t = (log.heading.stamp_ns - log.heading.stamp_ns[0]) / 1e9
    rate = np.gradient(np.unwrap(log.heading.heading_rad), t)
    smooth = np.convolve(rate, np.full(41, 1 / 41), mode="same")
    return replace(log, gyro=GyroSamples("/gyro", log.heading.stamp_ns, (smooth - bias) / scale))


def cut(log: RobotLog, seconds: float) -> RobotLog:
    """Return what was recorded until some time after the first wheel sample."""
    end = log.wheels.stamp_ns[0] + round(seconds * 1e9)

    def until(samples):  # type: ignore[no-untyped-def]
        return samples.cut(slice(0, int(np.searchsorted(samples.stamp_ns, end))))

    return replace(
        log, wheels=until(log.wheels), gnss=until(log.gnss), heading=until(log.heading), gyro=until(log.gyro)
    )


def errors_of(run: Run) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where the trials of all starts end, and the errors of `icr` and `icr_gyro` there."""
    track, icr = track_of(run), models_of(run)[0].icrs
    starts = np.arange(len(run.table))
    ends = ends_from(track, HORIZONS_M, starts)
    recording = recording_of(run, next(iter(measured_headings(run))))
    assert recording.track.gyro is not None
    turned = _errors_turned(run, recording, icr, lambda: past_gyro_lines(recording.track), Trials(starts, ends))
    return ends, open_loop_errors(track, icr, ends), turned.position


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config(sets=list(FIXED))


def test_trials_that_end_before_a_cut_have_the_same_errors_without_what_follows(config: Config) -> None:
    log = with_gyro(make_log(3, 90.0))
    ends, *whole = errors_of(fit(log, config))
    for seconds in (25.0, 40.0, 61.7):
        part_ends, *part = errors_of(fit(cut(log, seconds), config))
        tried = part_ends >= 0
        assert np.count_nonzero(tried) > 500
        np.testing.assert_array_equal(ends[: len(part_ends)][tried], part_ends[tried])
        for all_errors, errors in zip(whole, part, strict=True):
            assert np.abs(all_errors[: len(errors)][tried] - errors[tried]).max() < ROUNDING_M


def test_the_last_line_of_a_gyro_has_its_scale_and_bias(config: Config) -> None:
    run = fit(with_gyro(make_log(3, 90.0)), config)
    recording = recording_of(run, next(iter(measured_headings(run))))
    lines = past_gyro_lines(recording.track)
    assert (lines.scale[0], lines.bias_radps[0]) == (1.0, 0.0)
    assert lines.scale[-1] == pytest.approx(1.02, abs=0.005)
    assert lines.bias_radps[-1] == pytest.approx(0.004, abs=0.001)


def test_a_calibration_is_tested_without_what_follows(config: Config) -> None:
    """Constants held, bias of the gyro from the past: `--refit-sensors` alone knows what follows."""
    log = with_gyro(make_log(3, 90.0))
    calibration = icrtool.calibrate(fit(with_gyro(make_log(4, 90.0, faster=0.9)), config))

    def errors(run: Run, *, turned: bool, refit: bool = False) -> tuple[np.ndarray, np.ndarray]:
        recording = recording_of(run, next(iter(measured_headings(run))))
        starts = np.arange(0, len(run.table), 10)
        ends = ends_from(recording.track, HORIZONS_M, starts)
        tested = calibrated_drive(calibration, recording, "calibration", with_gyro=turned, refit_sensors=refit)
        return ends, tested.drive.errors(Trials(starts, ends)).position

    whole, part = fit(log, config), fit(cut(log, 45.0), config)
    # a delay of the wheels is read from samples until half a second later
    last = len(part.table) - 50
    for turned in (False, True):
        _, known = errors(whole, turned=turned)
        ends, cut_short = errors(part, turned=turned)
        tried = (ends >= 0) & (ends < last)
        assert np.count_nonzero(tried) > 100
        assert np.abs(known[: len(ends)][tried] - cut_short[tried]).max() < ROUNDING_M
        with_future, without = (errors(run, turned=turned, refit=True)[1] for run in (whole, part))
        assert np.abs(with_future[: len(ends)][tried] - without[tried]).max() > ROUNDING_M
