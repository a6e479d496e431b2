"""The ladder: nothing held out reaches a fit or a choice, all rungs stand on the same trials."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icrtool.calibration.held_out_fits import clear_of
from icrtool.calibration.model_comparison import count_blocks, judge_ladder
from icrtool.calibration.model_trials import Along, cut_trials, predict
from icrtool.config import parse_config
from icrtool.errors import DataError
from icrtool.estimation.fit import fit
from icrtool.estimation.measured_heading import MeasuredHeading, measured_headings
from icrtool.kernels.open_loop_fast import open_loop_errors
from icrtool.kernels.trials import FrozenIcrs
from icrtool.motion.window_fit import cut_windows
from icrtool.records.run import Run
from support.drives import make_log

CONFIG = parse_config({"robot": {"track_width_m": 0.6}})
ROUNDING_M = 1e-9
CHORD_M = 1e-5
"""The lever's way is its arc along a measured heading, the chord of each turn in steps: over 5 m at 20 Hz, 3 um."""


@pytest.fixture(scope="module")
def run() -> Run:
    return fit(make_log(0, 180.0, rate=20.0), CONFIG)


def edges_of(run: Run) -> np.ndarray:
    total = float(run.table.distance_m[-1])
    return np.linspace(0.0, total, count_blocks(total) + 1)[1:-1]


def test_predictions_equal_the_direct_integration_of_their_model(run: Run) -> None:
    """Scales, bend, speed and delay against Euler steps with what they mean, spelt out."""
    trials = cut_trials(run, edges_of(run), (5.0, 10.0))
    blocks = count_blocks(run.table.distance_m[-1])
    p = np.array([0.5, -0.6, 0.1, 1.03, 0.96, -0.2, 0.1, 0.0])
    mine = predict(trials, np.tile(p, (blocks, 1)))
    drive, starts = trials.drive, np.flatnonzero(trials.ends[:, 1] >= 0)[::50]
    assert len(starts) > 5
    for start in starts:
        north = east = 0.0
        psi = drive.heading[start]
        for i in range(start, trials.ends[start, 1]):
            left, right = p[3] * drive.v_left[i], p[4] * drive.v_right[i]
            told = abs(drive.v_left[i]) + abs(drive.v_right[i])
            turning = abs(drive.v_left[i] - drive.v_right[i]) / told if told else 0.0
            omega = (left - right) / (1.1 * (1 + p[5] * turning + p[6] * told / 2))
            ahead, aside = (left * p[0] - right * p[1]) / 1.1, -p[2] * omega
            north += drive.dt_s[i] * (ahead * np.cos(psi) - aside * np.sin(psi))
            east += drive.dt_s[i] * (ahead * np.sin(psi) + aside * np.cos(psi))
            psi += drive.dt_s[i] * omega
        end = trials.ends[start, 1]
        miss = np.hypot(north - drive.north[end] + drive.north[start], east - drive.east[end] + drive.east[start])
        assert mine[start, 1] == pytest.approx(miss, abs=ROUNDING_M)


def test_a_delay_of_whole_samples_moves_the_wheels_by_them(run: Run) -> None:
    trials = cut_trials(run, edges_of(run), (5.0,))
    blocks = count_blocks(run.table.distance_m[-1])
    interval = float(np.median(np.diff(trials.t)))
    late = predict(trials, np.tile([0.5, -0.6, 0.1, 1, 1, 0, 0, 3 * interval], (blocks, 1)))
    ahead = {side: np.append(getattr(trials.drive, side)[3:], np.zeros(3)) for side in ("v_left", "v_right")}
    moved = open_loop_errors(trials.drive._replace(**ahead), FrozenIcrs.constant(0.5, -0.6, 0.1), trials.ends)
    tried = (trials.ends[:, 0] >= 0) & (trials.ends[:, 0] < len(trials.t) - 5)
    assert np.count_nonzero(tried) > 100
    assert np.allclose(late[tried], moved[tried], atol=1e-9)


def test_all_trials_stay_within_their_block(run: Run) -> None:
    trials = cut_trials(run, edges_of(run), (5.0, 10.0))
    start, h = np.nonzero(trials.ends >= 0)
    assert len(start) > 100
    assert np.array_equal(trials.block[start], trials.block[trials.ends[start, h]])


def test_along_a_true_heading_the_way_is_the_models_own(run: Run) -> None:
    """A gyro that turns as the wheels say with the ICRs: the way is that of steps along the middle of each turn."""
    trials = cut_trials(run, edges_of(run), (5.0,))
    blocks = count_blocks(run.table.distance_m[-1])
    icrs = FrozenIcrs.constant(0.5, -0.6, 0.1)
    dt = trials.drive.dt_s
    turned = np.concatenate([[0.0], np.cumsum(dt * (trials.drive.v_left - trials.drive.v_right) / 1.1)[:-1]])
    neutral = np.tile([0, 0, 0, 1, 1, 0, 0, 0.0], (blocks, 1))
    model = Along(trials, turned, from_reference=True)
    along = model.errors(model.place(neutral), icrs)
    ahead = (0.5 * trials.drive.v_left + 0.6 * trials.drive.v_right) / 1.1
    aside = -0.1 * (trials.drive.v_left - trials.drive.v_right) / 1.1
    step = (dt * (ahead + 1j * aside))[:-1] * np.exp(0.5j * (turned[1:] + turned[:-1]))
    place = np.concatenate([[0.0], np.cumsum(np.where(trials.drive.gap[:-1], 0.0, step))])
    reference = trials.drive.north + 1j * trials.drive.east
    start = np.flatnonzero(trials.ends[:, 0] >= 0)
    end = trials.ends[start, 0]
    assert len(start) > 1000
    nose = np.exp(1j * (trials.drive.heading - turned)[start])
    expected = np.abs(nose * (place[end] - place[start]) - (reference[end] - reference[start]))
    assert np.max(np.abs(along[start, 0] - expected)) < CHORD_M


def test_a_gyro_is_scaled_by_other_blocks_and_refused_where_it_does_not_turn(run: Run) -> None:
    heading = run.table.heading_rad
    gyro = MeasuredHeading("gyro", 0.97 * heading + 0.01 * run.table.t_s)
    exact = judge_ladder(run, [MeasuredHeading("gyro", heading.copy())])
    scaled = judge_ladder(run, [gyro])
    assert scaled.heading == "gyro"
    assert scaled.rung("icr_final_gyro").summary.p95[1] == pytest.approx(
        exact.rung("icr_final_gyro").summary.p95[1], abs=0.01
    )
    other = judge_ladder(run, [MeasuredHeading("gyro", 0.1 * heading)])
    assert other.heading == ""
    assert "does not turn with the robot" in other.notes[0]


def test_a_gyro_of_the_other_sign_is_turned_and_said(run: Run) -> None:
    told = 0.97 * run.table.heading_rad + 0.01 * run.table.t_s
    usual, turned = (judge_ladder(run, [MeasuredHeading("gyro", sign * told)]) for sign in (1, -1))
    assert usual.notes == ()
    assert turned.notes == ("the gyro counts turns the other way: its sign was turned",)
    for one, other in zip(usual.rungs, turned.rungs, strict=True):
        assert one.name == other.name
        assert np.allclose(one.summary.p95, other.summary.p95, atol=ROUNDING_M, equal_nan=True)


def test_no_window_of_a_fit_touches_the_block_held_out(run: Run) -> None:
    windows, edges = cut_windows(run), edges_of(run)
    borders = np.concatenate([[0.0], edges, [np.inf]])
    for block in range(len(borders) - 1):
        kept = windows.keep(clear_of(windows, edges, block))
        assert len(kept.start) > 0
        assert not np.any((kept.end_m > borders[block]) & (kept.start_m < borders[block + 1]))


def test_shuffled_reference_of_a_block_changes_neither_its_fit_nor_its_choice(run: Run) -> None:
    before = judge_ladder(run)
    block = 1
    borders = np.concatenate([[0.0], edges_of(run), [np.inf]])
    inside = np.flatnonzero((run.table.distance_m > borders[block]) & (run.table.distance_m < borders[block + 1]))
    rng = np.random.default_rng(0)
    north, east, heading = (column.copy() for column in (run.table.north_m, run.table.east_m, run.table.heading_rad))
    for column in (north, east, heading):
        column[inside] = column[rng.permutation(inside)]
    spoilt = replace(run, table=replace(run.table, north_m=north, east_m=east, heading_rad=heading))
    after = judge_ladder(spoilt)
    assert after.chosen[block] == before.chosen[block]
    for name in ("multiplier", "window", "window_scale", "window_late", "extended"):
        assert np.array_equal(after.held_out[name][block], before.held_out[name][block]), name
    assert not np.allclose(after.held_out["window"][0], before.held_out["window"][0], atol=1e-6)
    assert after.rung("window").summary.p95[1] > before.rung("window").summary.p95[1]


def test_all_rungs_are_judged_on_the_same_trials(run: Run) -> None:
    ladder = judge_ladder(run, measured_headings(run))
    names = [rung.name for rung in ladder.rungs]
    assert names == [
        "no_slip", "multiplier", "icr", "icr_final", "window", "extended", "no_slip_heading", "icr_heading",
        "icr_final_heading", "window_heading", "extended_heading",
    ]  # fmt: skip
    for rung in ladder.rungs:
        assert np.array_equal(rung.summary.trials, ladder.rungs[0].summary.trials)
        assert rung.measured_heading == rung.name.endswith("_heading")


def test_constant_icrs_predict_better_than_no_slip_and_momentary(run: Run) -> None:
    ladder = judge_ladder(run)
    p95 = {rung.name: float(rung.summary.p95[1]) for rung in ladder.rungs}
    assert p95["window"] < p95["icr"] < p95["no_slip"]


def test_too_short_a_drive_is_refused() -> None:
    with pytest.raises(DataError, match="too short to fit on one part"):
        judge_ladder(fit(make_log(0, 30.0), CONFIG))


def test_window_fit_beats_momentary_icrs_on_the_shared_logs(shared_logs) -> None:
    """The goal of issue 5: p95 at 10 m, held out, 1.5 times better, median over simulated logs."""
    from icrtool.config import load_config
    from icrtool.logs import read_log

    robots = {
        "tracked_curved.bag": "pentzer-tracked",
        "tracked_trouble": "pentzer-tracked",
        "wheeled_circle": "segway-rmp400",
    }
    ratios = []
    for name, robot in robots.items():
        config = load_config(robot=robot)
        ladder = judge_ladder(fit(read_log(shared_logs / "simulated" / name, config), config))
        ratios.append(ladder.rung("icr").summary.p95[1] / ladder.rung("window").summary.p95[1])
    assert np.median(ratios) > 1.5
