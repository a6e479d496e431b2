"""No trial and no fitted window crosses a jump of the reference; a slide of the robot stays its error."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from icrtool.calibration.pooled import recording_of
from icrtool.config import load_config
from icrtool.dropout_analysis.dropout_report import dropout, dropout_report
from icrtool.dropout_analysis.report import DropoutReport
from icrtool.kernels.arrays import Floats
from icrtool.kernels.track import JUMP, trial_ends
from icrtool.motion.recording import cut_trials, cut_windows
from icrtool.output.run_directory import open_run
from icrtool.pipeline import fit
from icrtool.records.run import Run, track_of
from icrtool.records.samples import GyroSamples, HeadingSamples
from support.drives import make_log

HORIZONS_M = (1.0, 5.0, 10.0)
JUMP_M, AT_S = 3.0, 90.0
FIELD = ["robot.track_width_m=0.8"]


def fitted(wrong: Callable[[Floats], Floats], sets: list[str] = FIELD) -> Run:
    """Fit a drive whose positions are wrong by so many metres north at times (m,)."""
    log = make_log(seconds=180.0)
    t = (log.gnss.stamp_ns - log.gnss.stamp_ns[0]) / 1e9
    return fit(replace(log, gnss=replace(log.gnss, north_m=log.gnss.north_m + wrong(t))), load_config(sets=sets))


def step(t: Floats) -> Floats:
    return JUMP_M * (t >= AT_S)


@pytest.fixture(scope="module")
def jumping() -> Run:
    return fitted(step)


@pytest.fixture(scope="module")
def report(jumping: Run) -> DropoutReport:
    return dropout_report(jumping, horizons_m=HORIZONS_M)


def test_the_jump_is_in_the_run_with_time_and_size(jumping: Run) -> None:
    (jump,) = jumping.summary["reference_jumps"]
    assert jump["begin_s"] <= AT_S <= jump["end_s"] < AT_S + 10.0
    assert jump["size_m"] == pytest.approx(JUMP_M, abs=0.2)
    assert jump["undecided"] is False


def test_no_trial_of_any_row_crosses_it(jumping: Run, report: DropoutReport) -> None:
    begin, end = (jumping.summary["reference_jumps"][0][key] for key in ("begin_s", "end_s"))
    t, ends = jumping.table.t_s, trial_ends(track_of(jumping), np.array(HORIZONS_M))
    starts, horizons = np.nonzero(ends >= 0)
    assert not ((t[starts] < begin) & (t[ends[starts, horizons]] > end)).any()
    recording = recording_of(jumping)
    held_out = cut_trials(recording, HORIZONS_M)
    starts, horizons = np.nonzero(held_out.ends >= 0)
    assert not ((t[held_out.starts[starts]] < begin) & (t[held_out.ends[starts, horizons]] > end)).any()
    windows = cut_windows(recording)
    first, last = (windows.track.place_t[rows] for rows in (windows.begin, windows.end))
    assert not ((first < begin) & (last > end)).any()
    assert {one.name for one in report.results} >= {"icr", "no_slip", "icr_final", "recommended"}
    for one in report.results:
        assert (one.column("max_m") < JUMP_M / 2).all() or one.name == "no_slip"


def test_left_out_trials_are_counted_and_all_starts_add_up(report: DropoutReport) -> None:
    assert (report.counts.crosses_jump > 0).all()
    assert (np.sum(report.counts, axis=0) == report.states).all()
    for row, count in zip(report.document.trials, report.counts.crosses_jump, strict=True):
        assert row.no_trial["crosses_jump"] == count


def test_with_jumps_brings_them_back_and_shows_their_size(jumping: Run, report: DropoutReport) -> None:
    whole = dropout_report(jumping, horizons_m=HORIZONS_M, ladder=False, with_jumps=True)
    assert not whole.counts.crosses_jump.any()
    assert (whole.counts.trials >= report.counts.trials + report.counts.crosses_jump - whole.counts.standing).all()
    icr = whole.result("icr")
    assert icr is not None
    assert icr.column("max_m")[-1] > 0.8 * JUMP_M


def test_preset_paper_leaves_nothing_out() -> None:
    run = fitted(step, [*FIELD, "filter.preset=paper"])
    assert run.summary["reference_jumps"] == []
    assert not dropout(run, HORIZONS_M).counts.crosses_jump.any()


def test_a_run_read_back_has_its_jumps(jumping: Run, tmp_path) -> None:
    jumping.write(tmp_path / "run", plots=())
    assert open_run(tmp_path / "run").sensors.jumps == jumping.sensors.jumps


@pytest.mark.parametrize("speed_mps", [0.3, 0.6, 1.0, 1.5])
def test_a_slide_without_a_gyro_stays_in_the_headline(speed_mps: float) -> None:
    run = fitted(lambda t: speed_mps * np.clip(t - AT_S, 0.0, 2.0))
    assert all(jump["undecided"] for jump in run.summary["reference_jumps"])
    found = dropout(run, HORIZONS_M)
    assert not found.counts.crosses_jump.any()
    whole = dropout(replace(run, sensors=replace(run.sensors, jumps=())), HORIZONS_M)
    for one, other in zip(found.results, whole.results, strict=True):
        np.testing.assert_array_equal(one.column("p95_m"), other.column("p95_m"))


def relocated(gyro_deg: float | None) -> Run:
    """Fit a drive whose poses jump by 0.5 m and 20 degrees, as those of SLAM do; its gyro turns by so much then."""
    log = make_log(seconds=180.0, heading_std_deg=0.2)
    stamps, psi = log.gnss.stamp_ns, np.unwrap(log.heading.heading_rad)
    every = (log.heading.stamp_ns - stamps[0]) / 1e9
    rate = np.gradient(np.convolve(np.pad(psi, 25, "edge"), np.ones(51) / 51, "valid"), every)
    rate += np.radians(gyro_deg or 0.0) / 0.1 * ((every >= AT_S - 0.1) & (every < AT_S))
    t = (stamps - stamps[0]) / 1e9
    turned = np.exp(1j * np.radians(20.0) * (t >= AT_S))
    place = log.gnss.north_m + 1j * log.gnss.east_m
    about = place[np.searchsorted(t, AT_S)]
    place = about + (place - about) * turned + 0.5 * (t >= AT_S)
    heading = np.angle(np.exp(1j * np.interp(t, every, psi)) * turned)
    poses = HeadingSamples(stamps, heading, np.full(len(t), np.radians(0.2) ** 2))
    seen = None if gyro_deg is None else GyroSamples("/imu", log.heading.stamp_ns, 1.01 * rate + 0.002)
    gnss = replace(log.gnss, north_m=place.real, east_m=place.imag)
    return fit(replace(log, gnss=gnss, heading=poses, gyro=seen), load_config(sets=FIELD))


def test_a_pose_that_turns_where_gyro_and_wheels_do_not_jumps() -> None:
    decided = [jump for jump in relocated(0.0).summary["reference_jumps"] if not jump["undecided"]]
    assert len(decided) == 1
    assert abs(decided[0]["turn_deg"]) == pytest.approx(20.0, abs=3.0)
    assert decided[0]["begin_s"] - 0.2 <= AT_S <= decided[0]["end_s"] + 0.2


@pytest.mark.parametrize("gyro_deg", [20.0, None])
def test_a_pose_that_turns_with_the_gyro_or_without_one_is_the_robots(gyro_deg: float | None) -> None:
    assert all(jump["undecided"] for jump in relocated(gyro_deg).summary["reference_jumps"])


def test_an_excursion_that_the_filter_rejects_is_no_jump_of_its_states() -> None:
    run = fitted(lambda t: 8.0 * ((t >= AT_S) & (t < AT_S + 1.0)))
    assert run.gnss.rejected.sum() >= 18
    assert run.summary["reference_jumps"] == []


def test_the_mark_of_a_trial_across_a_jump_is_its_own(jumping: Run) -> None:
    drive = track_of(jumping)
    ends = trial_ends(drive, np.array([10.0]))[:, 0]
    free = trial_ends(drive._replace(jump=np.zeros_like(drive.jump)), np.array([10.0]))[:, 0]
    crossing = ends == JUMP
    np.testing.assert_array_equal(ends[~crossing], free[~crossing])
    before = np.concatenate([[0], np.cumsum(drive.jump)])
    expected = (free >= 0) & (before[np.maximum(free, 0)] > before[np.arange(len(free))])
    np.testing.assert_array_equal(crossing, expected)
