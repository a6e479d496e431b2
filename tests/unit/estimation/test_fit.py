"""Fit: the filter over a whole log, its presets, and what it says of itself."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from icrtool.config import load_config
from icrtool.errors import ConfigError, DataError
from icrtool.estimation.filter_setup import chi2_gate
from icrtool.kernels.filter_records import GATED
from icrtool.pipeline import fit
from icrtool.records.run import WarmStart
from icrtool.records.samples import PositionFixes, WheelSamples
from icrtool.records.tables import RobotLog
from icrtool.simulation.drives import DrivePlan, PathPlan, Sensors, drive_plan, sense_motion
from icrtool.simulation.study_runs import readings_log
from support.contract import RUN_KEYS
from support.drives import ICRS, make_log

WIDTH = "robot.track_width_m=0.8"
ICR_TOLERANCE_M = 0.05


def test_the_icrs_of_a_known_robot_are_learned_within_their_own_sigmas() -> None:
    run = fit(make_log(), load_config(sets=[WIDTH]))
    final, std = run.summary["icr"]["final"], run.summary["icr"]["final_std"]
    for column, truth in zip(("y_icr_right_m", "y_icr_left_m", "x_icr_m"), ICRS, strict=True):
        assert final[column] == pytest.approx(truth, abs=min(4 * std[column], ICR_TOLERANCE_M))


def test_the_summary_is_plain_json_with_the_contracts_keys() -> None:
    summary = fit(make_log(), load_config(sets=[WIDTH])).summary
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary
    assert {"schema"} | RUN_KEYS <= set(summary)
    assert {"duration_s", "distance_m", "speed_mean_mps", "speed_std_mps"} <= set(summary["drive"])
    assert {"used", "rejected", "mean_difference_m", "max_difference_m", "datum"} <= set(summary["gnss"])
    for part in ("final", "mean", "std", "convergence_s"):
        assert set(summary["icr"][part]) == {"y_icr_right_m", "y_icr_left_m", "x_icr_m"}


def test_states_are_a_frame_with_a_row_per_wheel_sample_and_an_unwrapped_heading() -> None:
    log = make_log(seconds=120.0)
    frame = fit(log, load_config(sets=[WIDTH])).states
    assert list(frame.columns)[:5] == ["stamp_ns", "t_s", "north_m", "east_m", "heading_rad"]
    assert len(frame) == len(log.wheels.stamp_ns)
    assert np.abs(np.diff(frame.heading_rad)).max() < math.pi
    assert (np.diff(frame.distance_m) >= 0).all()


def test_without_a_track_width_fit_runs_from_a_default_start() -> None:
    run = fit(make_log())
    assert run.table.y_icr_right_m[0] == pytest.approx(ICRS[0], abs=0.1)
    assert run.track_width_m is None


def test_preset_paper_starts_where_the_paper_does_and_gates_nothing() -> None:
    log = make_log()
    north = log.gnss.north_m.copy()
    north[400] += 50.0
    log = replace(log, gnss=replace(log.gnss, north_m=north))
    run = fit(log, load_config(sets=["filter.preset=paper", WIDTH]))
    assert run.table.std_x_icr_m[0] == 1.0
    assert (run.table.y_icr_right_m[0], run.table.y_icr_left_m[0], run.table.x_icr_m[0]) == (1.0, -1.0, 1.0)
    assert not (run.gnss.code == GATED).any()


def test_one_wild_fix_is_rejected_and_counted_in_preset_field() -> None:
    log = make_log()
    north = log.gnss.north_m.copy()
    north[400] += 5.0
    run = fit(replace(log, gnss=replace(log.gnss, north_m=north)), load_config(sets=[WIDTH]))
    assert run.gnss.code[400] == GATED
    assert run.summary["gnss"]["rejected"] == 1


def test_a_heading_offset_is_found_applied_and_said() -> None:
    run = fit(make_log(heading_offset_deg=12.0), load_config(sets=[WIDTH]))
    assert run.summary["heading"]["applied_offset_deg"] == pytest.approx(12.0, abs=0.5)
    assert any("applied" in warning for warning in run.warnings)
    assert run.table.x_icr_m[-1] == pytest.approx(ICRS[2], abs=ICR_TOLERANCE_M)


def test_a_configured_heading_offset_is_used_as_it_is() -> None:
    config = load_config(sets=[WIDTH, "frames.heading_offset_deg=-12.0"])
    run = fit(make_log(heading_offset_deg=12.0), config)
    assert run.summary["heading"]["applied_offset_deg"] == pytest.approx(12.0)
    assert not any("off the course" in warning for warning in run.warnings)


def test_the_distance_is_that_of_the_positions_where_wheels_spin_in_place() -> None:
    log = make_log(seconds=60.0)
    wheels = log.wheels
    spinning = np.abs((wheels.stamp_ns - wheels.stamp_ns[0]) / 1e9 - 30.0) < 4.0
    spoilt = WheelSamples(wheels.stamp_ns, wheels.left + 1.5 * spinning, wheels.right + 1.5 * spinning)
    clean, slipped = (fit(one, load_config()) for one in (log, replace(log, wheels=spoilt)))
    distance = clean.summary["drive"]["distance_m"]
    assert distance == pytest.approx(float(clean.table.distance_m[-1]), rel=0.03)
    assert slipped.summary["drive"]["distance_m"] == pytest.approx(distance, rel=0.05)


def test_a_gap_in_the_wheel_data_is_no_burst_of_speed() -> None:
    log = make_log(seconds=60.0)
    kept = np.abs((log.wheels.stamp_ns - log.wheels.stamp_ns[0]) / 1e9 - 30.0) > 1.5
    columns = (column[kept] for column in (log.wheels.stamp_ns, log.wheels.left, log.wheels.right))
    whole, gappy = (
        fit(one, load_config()).summary["drive"] for one in (log, replace(log, wheels=WheelSamples(*columns)))
    )
    assert gappy["distance_m"] == pytest.approx(whole["distance_m"], rel=0.02)
    assert gappy["speed_std_mps"] == pytest.approx(whole["speed_std_mps"], abs=0.02)


def test_a_clean_log_gives_no_warning() -> None:
    assert fit(make_log(), load_config(sets=[WIDTH])).warnings == ()


def test_a_heading_of_the_other_convention_is_turned_over_and_said() -> None:
    log = make_log()
    other = math.pi / 2 - log.heading.heading_rad
    wrong = replace(log, heading=replace(log.heading, heading_rad=np.angle(np.exp(1j * other))))
    run = fit(wrong, load_config(sets=[WIDTH]))
    assert run.summary["heading"]["applied_mirror"]
    assert any("other convention" in warning for warning in run.warnings)
    assert run.table.y_icr_right_m[-1] == pytest.approx(ICRS[0], abs=ICR_TOLERANCE_M)
    kept = fit(wrong, load_config(sets=[WIDTH, "frames.heading=enu"]))
    assert not kept.summary["heading"]["applied_mirror"]
    assert any("set frames.heading" in warning for warning in kept.warnings)


def test_a_configured_lever_arm_is_taken_off_the_fixes() -> None:
    sets = [WIDTH, "frames.antenna_forward_m=0.4", "frames.antenna_right_m=-0.2"]
    run = fit(make_log(lever=(0.4, -0.2)), load_config(sets=sets))
    assert run.table.x_icr_m[-1] == pytest.approx(ICRS[2], abs=ICR_TOLERANCE_M)
    assert run.table.y_icr_right_m[-1] == pytest.approx(ICRS[0], abs=ICR_TOLERANCE_M)


def test_a_warm_start_begins_with_the_other_runs_icrs_and_certainty() -> None:
    first = fit(make_log(), load_config(sets=[WIDTH]))
    start = WarmStart(np.array(ICRS), first.ended_with.covariance_m2)
    second = fit(make_log(seed=1), load_config(sets=[WIDTH]), warm_start=start)
    assert second.table.y_icr_right_m[0] == ICRS[0]
    assert second.table.std_y_icr_right_m[0] < 0.1 * 0.4
    # certain ICRs that stay as certain are shown
    assert second.usable
    assert second.summary["icr"]["final_std"]["y_icr_right_m"] < ICR_TOLERANCE_M


@pytest.mark.parametrize(("width_m", "off_m"), [(0.15, 0.04), (2.0, 0.01)])
def test_a_track_width_of_another_robot_hardly_changes_the_icrs(width_m: float, off_m: float) -> None:
    run = fit(make_log(), load_config(sets=[f"robot.track_width_m={width_m}"]))
    assert run.usable
    assert run.table.icrs_at(-1) == pytest.approx(ICRS, abs=off_m)
    assert any("of the track width apart" in warning for warning in run.warnings)


def test_a_track_width_that_is_far_too_small_is_not_usable() -> None:
    """The filter starts where a robot of that width does, and learns that it is another too slowly."""
    assert not fit(make_log(), load_config(sets=["robot.track_width_m=0.05"])).usable


def test_a_terrain_change_opens_the_icrs_and_gives_segments() -> None:
    """By the robot's width, the paper's 10 m, or what is configured."""
    for settings, std in ((), 0.8), (("filter.preset=paper",), 10.0), (("filter.terrain_icr_std_m=3.0",), 3.0):
        run = fit(make_log(), load_config(sets=[WIDTH, *settings]), changes_s=(30.0,))
        k = int(np.searchsorted(run.table.t_s, 30.0))
        assert run.table.std_y_icr_right_m[k] == pytest.approx(std, rel=0.02)
        assert run.table.std_y_icr_right_m[k - 1] < 0.2
        assert [segment["begin_s"] for segment in run.summary["segments"]] == [0.0, 30.0]


def test_wheels_that_contradict_the_fixes_raise_the_position_noise_and_say_so() -> None:
    log = make_log(faster=8.0)
    slip = np.repeat(np.random.default_rng(0).normal(1.0, 0.3, len(log.wheels.stamp_ns) // 25 + 1), 25)
    slip = slip[: len(log.wheels.stamp_ns)]
    late = replace(log.wheels, left=slip * log.wheels.left, right=slip * log.wheels.right)
    run = fit(replace(log, wheels=late), load_config(sets=[WIDTH]))
    assert run.document.filter.process_position_mps > 0.3
    assert any("position noise raised" in warning for warning in run.warnings)
    fixed = fit(replace(log, wheels=late), load_config(sets=[WIDTH, "filter.process_position_mps=0.3"]))
    assert fixed.document.filter.process_position_mps == 0.3


def still(log: RobotLog) -> RobotLog:
    """The same log with wheels that never turn."""
    return replace(log, wheels=replace(log.wheels, left=0 * log.wheels.v_left_mps, right=0 * log.wheels.v_right_mps))


def test_a_robot_that_never_moved_is_refused() -> None:
    log = still(make_log())
    n = len(log.gnss.stamp_ns)
    noise = np.random.default_rng(0).normal(0.0, 0.01, (2, n))
    gnss = PositionFixes(log.gnss.stamp_ns, *noise, *(np.full(n, 1e-4) for _ in range(2)), np.zeros(n))
    heading = replace(log.heading, heading_rad=0 * log.heading.heading_rad)
    with pytest.raises(DataError, match="never moved"):
        fit(replace(log, gnss=gnss, heading=heading), load_config(sets=[WIDTH]))


def test_wheels_that_never_turn_while_the_position_moves_are_refused_for_that() -> None:
    with pytest.raises(DataError, match=r"wheels never turn .* yet the position moves by"):
        fit(still(make_log()), load_config(sets=[WIDTH]))


def spun(seconds: float, speed_mps: float = 0.3) -> RobotLog:
    """A robot that turns on the spot: its origin goes hardly anywhere."""
    icrs, plan = (0.5, -0.5, 0.0), PathPlan("spins", speed_mps)
    sensors = Sensors(input_noise_mps=0.01)
    truth = drive_plan(DrivePlan(icrs_m=icrs, path=plan, duration_s=seconds), 0.01)
    return readings_log(sense_motion(truth, sensors, seconds, np.random.default_rng(0)), sensors)


def test_a_robot_that_spun_on_the_spot_has_learned_its_icrs_and_is_told_no_less() -> None:
    run = fit(spun(60.0), load_config(sets=[WIDTH]))
    assert run.summary["drive"]["distance_m"] < 1.0
    final = run.summary["icr"]["final"]
    assert [final[name] for name in final] == pytest.approx([0.5, -0.5, 0.0], abs=ICR_TOLERANCE_M)
    assert not any("turns" in warning for warning in run.warnings)


def test_a_parked_robot_whose_heading_drifts_is_refused() -> None:
    with pytest.raises(DataError, match="never moved"):
        fit(still(spun(60.0)), load_config(sets=[WIDTH]))


def test_a_robot_that_hardly_moved_has_nothing_to_show() -> None:
    log = make_log(faster=0.01)
    run = fit(log, load_config(sets=[WIDTH]))
    assert any("hardly any turns" in warning for warning in run.warnings)
    assert not run.usable
    assert run.summary["unusable_because"].startswith("this drive does not show")
    assert set(run.summary["icr"]["final"].values()) == {None}
    assert run.summary["icr"]["separation_multiplier"] is None


def cut(log: RobotLog, rows: slice) -> RobotLog:
    return replace(
        log,
        heading=replace(
            log.heading,
            stamp_ns=log.heading.stamp_ns[rows],
            heading_rad=log.heading.heading_rad[rows],
            var_rad2=log.heading.var_rad2[rows],
        ),
    )


def test_streams_that_do_not_overlap_are_refused() -> None:
    log = make_log()
    with pytest.raises(DataError, match="do not overlap"):
        fit(replace(log, heading=replace(log.heading, stamp_ns=log.heading.stamp_ns + 10**12)))


def test_a_single_sample_is_refused() -> None:
    with pytest.raises(DataError, match="1 usable heading samples"):
        fit(cut(make_log(), slice(0, 1)))


def spoilt(log: RobotLog, stream: str, column: str, value: float) -> RobotLog:
    table = getattr(log, stream)
    values = getattr(table, column).copy()
    values[500] = value
    return replace(log, **{stream: replace(table, **{column: values})})


@pytest.mark.parametrize("preset", ["field", "paper"])
@pytest.mark.parametrize(
    ("stream", "column", "value", "why"),
    [
        ("wheels", "left", math.nan, "1 wheel samples are not finite numbers, the first at row 500"),
        ("wheels", "right", 1e160, r"a wheel speed of 1e\+160 m/s"),
        ("gnss", "east_m", math.inf, "1 position samples are not finite"),
        ("heading", "heading_rad", math.nan, "1 heading samples are not finite"),
        ("gnss", "var_north_m2", -1.0, "a position variance is negative, the first at row 500"),
        ("heading", "var_rad2", -1.0, "a heading variance is negative"),
        ("wheels", "stamp_ns", 0, "the wheel stamps go back at row 500"),
        ("heading", "stamp_ns", 0, "the heading stamps go back at row 500"),
    ],
)
def test_values_that_are_no_measurement_are_refused(
    preset: str, stream: str, column: str, value: float, why: str
) -> None:
    config = load_config(sets=[f"filter.preset={preset}"])
    with pytest.raises(DataError, match=why):
        fit(spoilt(make_log(), stream, column, value), config)


def test_an_empty_stream_is_refused() -> None:
    log = make_log()
    none = WheelSamples(log.wheels.stamp_ns[:0], log.wheels.v_left_mps[:0], log.wheels.v_right_mps[:0])
    with pytest.raises(DataError, match="no orientation"):
        fit(cut(log, slice(0, 0)), load_config(sets=["filter.preset=paper"]))
    with pytest.raises(DataError, match="0 usable wheel samples"):
        fit(replace(log, wheels=none))


@pytest.mark.parametrize(("degrees", "quantile"), [(1, 15.1367), (2, 18.4207)])
def test_gates_are_chi_squared_quantiles(degrees: int, quantile: float) -> None:
    assert chi2_gate(0.9999, degrees) == pytest.approx(quantile, abs=1e-4)


@pytest.mark.parametrize(("side", "metres"), [("right", -0.6), ("left", 0.6), ("left", 0.0)])
def test_a_start_on_the_other_side_is_refused_in_preset_field_and_taken_in_paper(side: str, metres: float) -> None:
    key = f"filter.initial_y_icr_{side}_m"
    log = make_log(seconds=30.0)
    with pytest.raises(
        ConfigError, match=rf"{key}: preset field .*\(right > 0 > left\); found {metres:g}; preset paper"
    ):
        fit(log, load_config(sets=[f"{key}={metres}"]))
    run = fit(log, load_config(sets=[f"{key}={metres}", "filter.preset=paper", "filter.initial_icr_std_m=1e-6"]))
    assert getattr(run.table, f"y_icr_{side}_m")[0] == pytest.approx(metres, abs=1e-3)


def test_the_start_knows_nothing_of_the_log_but_the_skid_factor_of_its_robot() -> None:
    starts = {}
    for settings in ((), ("robot.skid_factor=1.4",), ("filter.initial_icr_std_m=0.1",)):
        for icrs in (ICRS, (0.7, -0.7, 0.0)):
            run = fit(make_log(icrs=icrs), load_config(sets=[WIDTH, *settings]))
            started = run.document.filter.icr_start
            assert started is not None
            assert run.table.icrs_at(0) == started.icrs_m
            assert starts.setdefault(settings, started) == started
    usual, stated, configured = starts.values()
    assert usual.icrs_m == pytest.approx((0.6, -0.6, 0.0))
    assert usual.std_m == pytest.approx((0.4, 0.4, 0.4))
    assert stated.icrs_m == pytest.approx((0.56, -0.56, 0.0))
    assert stated.std_m == pytest.approx((0.16, 0.16, 0.4))
    assert configured.std_m == (0.1, 0.1, 0.1)


def test_an_icr_that_happens_to_start_right_converges_by_its_certainty() -> None:
    """By the fall of its standard deviation; a warm start has learned before."""
    run = fit(make_log(icrs=(0.6, -0.6, 0.0)), load_config(sets=[WIDTH]))
    for name, span in run.convergence_s.items():
        assert span is not None
        std = getattr(run.table, f"std_{name}")
        begin, end = np.searchsorted(run.table.t_s, span)
        final = float(np.median(std[len(std) // 2 :]))
        fallen = [(std[0] - std[row]) / (std[0] - final) for row in (begin, end)]
        assert fallen[0] >= 0.1
        assert fallen[1] >= 0.9
        assert span[1] < 30.0
    again = fit(make_log(seed=1, icrs=(0.6, -0.6, 0.0)), load_config(sets=[WIDTH]), warm_start=run.ended_with)
    assert set(again.convergence_s.values()) == {None}
