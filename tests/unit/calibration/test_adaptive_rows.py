"""Row ``adaptive`` of a report: what a robot that observes the same samples on board knows at each start."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import icrtool
from icrtool.calibration.adaptive_rows import adapt, prior_for
from icrtool.calibration.pooled import recording_of
from icrtool.calibration.run_models import adaptive_rows, with_poses_of
from icrtool.config import parse_config
from icrtool.dropout_analysis.starts import with_smoothed_reference
from icrtool.motion.adaptive import WHEELS_MODEL
from icrtool.motion.recording import cut_trials
from icrtool.motion.robot_prior import OTHER_ROBOTS, between_drives, prior_of_robots
from icrtool.output.tables.dropout import format_dropout
from icrtool.records.run import Run
from support.drives import make_log

CONFIG = parse_config({"robot": {"track_width_m": 0.6}})
SAME_STAMP_S = 1e-6
JOINED_M = 0.001
"""The report joins two samples to a step of 0.1 s, and turns within it."""


@pytest.fixture(scope="module")
def run() -> Run:
    return icrtool.fit(make_log(0, 150.0, rate=20.0), CONFIG)


@pytest.fixture(scope="module")
def calibration() -> icrtool.Calibration:
    return icrtool.calibrate(icrtool.fit(make_log(1, 150.0, rate=20.0), CONFIG))


def test_a_robot_on_board_knows_what_the_report_states(run: Run, calibration: icrtool.Calibration) -> None:
    """From the public states of the run alone, with stamps since 1970 [s]."""
    drive = adapt(recording_of(run), calibration.prior())
    model, found = icrtool.AdaptiveModel(calibration.prior()), []
    columns = run.states[["stamp_ns", "v_left_mps", "v_right_mps", "north_m", "east_m", "heading_rad"]]
    (left, right), begin_ns = run.wheel_scales, int(columns.stamp_ns.iloc[0])
    for stamp_ns, v_left, v_right, *pose in columns.itertuples(index=False):
        if model.observe((stamp_ns - begin_ns) / 1e9, v_left / left, v_right / right, pose):
            found.append(model.now)
    assert len(found) == len(drive.learned) - 1 > 20
    for one, other in zip(drive.learned[1:], found, strict=True):
        assert one.t_s == pytest.approx(other.t_s, abs=SAME_STAMP_S)
        assert np.abs(one.fitted.parameters - other.fitted.parameters).max() < 1e-9
        assert np.abs(np.subtract(one.constants, other.constants)).max() < 1e-9


def test_a_trial_is_driven_with_the_twist_that_was_known_at_its_start(
    run: Run, calibration: icrtool.Calibration
) -> None:
    recording = recording_of(run)
    drive, trials = adapt(recording, calibration.prior()), cut_trials(recording, (5.0,))
    track, errors = recording.track, drive.errors(trials).position
    wheels = recording.wheels()
    for k in np.flatnonzero(trials.ends[:, 0] >= 0)[::60]:
        start, end = int(trials.starts[k]), int(trials.ends[k, 0])
        known = [one for one in drive.learned if one.t_s <= track.t[start]][-1]
        constants = known.constants
        model = icrtool.AdaptiveModel(replace(calibration.prior(), mean=known.fitted.parameters))
        psi, place = 0.0, 0j
        # the wheels are read later than the poses by a constant of the drive
        since, until = track.t[start] + constants.wheels_later_s, track.t[end] + constants.wheels_later_s
        for i in range(start - 20, end + 20):
            begin = max(wheels.t[i], since)
            lasting = min(wheels.t[i + 1], until) - begin
            if lasting > 0.0:
                v_x, v_y, omega = model.twist(float(wheels.v_left[i]), float(wheels.v_right[i]))
                place += lasting * (v_x + 1j * v_y) * np.exp(1j * (psi - omega * (begin - wheels.t[i])))
                psi += lasting * omega
        turn = np.exp(1j * (track.heading[start] + constants.heading_offset_rad))
        missed = turn * place - (track.north[end] - track.north[start]) - 1j * (track.east[end] - track.east[start])
        assert errors[k, 0] == pytest.approx(abs(missed), abs=JOINED_M)


def test_the_row_begins_with_the_calibration_given_unless_it_knows_this_log(
    run: Run, calibration: icrtool.Calibration
) -> None:
    recording = replace(recording_of(run), sha256="abc")
    own = calibration.logs[0].__class__("own", "own", "abc", 100.0, 0.0, 0.0)
    knows = icrtool.Calibration(**{**{name: getattr(calibration, name) for name in calibration.__struct_fields__},
                                   "logs": (own,)})  # fmt: skip
    assert prior_for(recording, [calibration]).source == "calibration"
    assert prior_for(recording, [knows]).source == OTHER_ROBOTS
    assert prior_for(recording, [knows, calibration]).source == "calibration"
    (row,) = adaptive_rows(recording, "", [calibration])
    assert row.knows.startswith("calibration, and the drive before each start")


def test_a_prior_of_a_calibration_is_as_wide_as_drives_differ(calibration: icrtool.Calibration) -> None:
    prior, fitted = calibration.prior(), calibration.fitted
    assert np.array_equal(prior.mean, fitted.parameters)
    assert np.allclose(prior.covariance, fitted.covariance + between_drives(WHEELS_MODEL.terms), rtol=1e-12)


def test_a_report_has_the_row_everywhere_and_it_learns(run: Run, calibration: icrtool.Calibration) -> None:
    alone = icrtool.dropout_report(run, horizons_m=[5.0, 10.0, 20.0])
    known = icrtool.dropout_report(
        run, horizons_m=[5.0, 10.0, 20.0], calibrations=[calibration], gates=["adaptive.p95@10m <= 1"]
    )
    for report in (alone, known):
        assert {"adaptive", "adaptive_heading"} <= set(report.summary.model)
        assert "adaptive" in {one.name for one in report.document.ladder.models}
        assert "adaptive" in {one.model for one in report.document.budgets}
    expected = [one.result("adaptive").column("expected_error_m")[1] for one in (alone, known)]
    assert expected[1] < 0.7 * expected[0]
    assert known.document.gates[0].model == "adaptive"


def test_the_prior_of_robots_holds_the_robots_that_are_known() -> None:
    prior = prior_of_robots(0.6)
    std = np.sqrt(np.diag(prior.covariance))
    turn = WHEELS_MODEL.terms.index("omega_w")
    for gain in (0.439, 0.533, 0.564, 0.667):
        assert abs(gain - prior.mean[turn]) < 2.0 * std[turn]


def test_with_a_smoothed_reference_the_row_learns_from_what_the_filter_knew() -> None:
    """The smoother knows the rest of the drive, so only starts and ends of trials are taken from it."""
    run = icrtool.fit(make_log(0, 60.0, rate=20.0), CONFIG, smooth=True)
    compared, prior = with_smoothed_reference(run), prior_of_robots(0.6)
    plain = adapt(recording_of(run), prior)
    recording = recording_of(compared)
    drive = adapt(recording, prior, with_poses_of(recording, run))
    assert len(drive.learned) == len(plain.learned) > 10
    for one, other in zip(drive.learned, plain.learned, strict=True):
        np.testing.assert_array_equal(one.fitted.parameters, other.fitted.parameters)
    knowing = adapt(recording, prior)
    assert np.abs(knowing.learned[-1].fitted.parameters - plain.learned[-1].fitted.parameters).max() > 0.0
    report = icrtool.dropout_report(run, reference="smoothed", horizons_m=[5.0])
    expected = np.nanmean(drive.errors(cut_trials(recording, (5.0,))).position)
    assert report.result("adaptive").column("expected_error_m")[0] == pytest.approx(expected, rel=1e-6)
    assert "which knows all of the drive" in format_dropout(report)
