"""Of several position references the one that agrees with wheels and heading is used."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icrtool.alignment.align import choose_reference, measure_agreement
from icrtool.config import load_config
from icrtool.pipeline import fit
from icrtool.records.samples import StreamChoice
from icrtool.records.tables import RobotLog
from support.drives import make_log

CONFIG = load_config(sets=["robot.track_width_m=0.8"])
ROBOT_SECONDS = 240.0


def named(log: RobotLog, topic: str, others: tuple[RobotLog, ...] = ()) -> RobotLog:
    streams = tuple(StreamChoice(role, topic, "x/Y", 100, 5.0, "header", 0.0, "") for role in ("wheels", "gnss"))
    return replace(log, streams=streams, other_references=others)


def with_noise(log: RobotLog, std_m: float, *, correlated_s: float = 0.0, stated_m: float = 0.02) -> RobotLog:
    """Return the log with errors of its fixes that they do not state."""
    rng, count = np.random.default_rng(0), len(log.gnss.north_m)
    noise = rng.normal(0.0, std_m, (2, count))
    if correlated_s:
        t = log.gnss.stamp_ns / 1e9
        cell = np.unique(np.floor(t / correlated_s), return_inverse=True)[1]
        noise = rng.normal(0.0, std_m, (2, int(cell.max()) + 1))[:, cell]
    stated = np.full(count, stated_m**2)
    gnss = replace(log.gnss, north_m=log.gnss.north_m + noise[0], east_m=log.gnss.east_m + noise[1],
                   var_north_m2=stated, var_east_m2=stated)  # fmt: skip
    return replace(log, gnss=gnss)


@pytest.fixture(scope="module")
def good() -> RobotLog:
    return make_log(seconds=ROBOT_SECONDS)


@pytest.mark.parametrize(("std_m", "correlated_s"), [(4.0, 0.0), (3.0, 12.0)])
def test_a_good_pose_takes_the_place_of_hopeless_gnss(good: RobotLog, std_m: float, correlated_s: float) -> None:
    """White noise of metres, and jumps that hold for a while."""
    pose = named(good, "/lidar/pose")
    log = named(with_noise(good, std_m, correlated_s=correlated_s), "/gps/fix", (pose,))
    chosen = choose_reference(log, CONFIG)
    assert chosen.streams[1].topic == "/lidar/pose"
    assert any("/lidar/pose" in warning and "topics.gnss" in warning for warning in chosen.warnings)
    run = fit(log, CONFIG)
    assert run.summary["streams"][1]["topic"] == "/lidar/pose"
    assert run.summary["gnss"]["mean_difference_m"] < 0.05


def test_good_gnss_is_kept_beside_a_better_pose(good: RobotLog) -> None:
    log = named(with_noise(good, 0.1), "/gps/fix", (named(good, "/lidar/pose"),))
    assert choose_reference(log, CONFIG) is log


def test_poor_gnss_is_kept_beside_a_pose_that_is_no_better_or_short(good: RobotLog) -> None:
    poor = with_noise(good, 4.0)
    short = replace(good, gnss=good.gnss.cut(slice(0, 1500))) if hasattr(good.gnss, "cut") else poor
    for other in (poor, short):
        log = named(poor, "/gps/fix", (named(other, "/lidar/pose"),))
        assert choose_reference(log, CONFIG) is log


def test_preset_paper_keeps_what_was_chosen(good: RobotLog) -> None:
    log = named(with_noise(good, 4.0), "/gps/fix", (named(good, "/lidar/pose"),))
    assert choose_reference(log, load_config(sets=["filter.preset=paper"])) is log


def test_the_residual_is_that_of_the_positions(good: RobotLog) -> None:
    assert measure_agreement(good, CONFIG).residual_m < 0.1
    assert measure_agreement(with_noise(good, 1.0), CONFIG).residual_m == pytest.approx(np.sqrt(2) * 2.146, rel=0.25)


@pytest.mark.parametrize("delay_s", [5.0, 18.0])
def test_configured_delays_move_the_references_before_they_are_compared(good: RobotLog, delay_s: float) -> None:
    late = replace(good, gnss=replace(good.gnss, stamp_ns=good.gnss.stamp_ns + round(delay_s * 1e9)))
    drifts = with_noise(good, 0.7, correlated_s=12.0)
    log = named(late, "/gps/fix", (named(drifts, "/lidar/pose"),))
    config = load_config(sets=["robot.track_width_m=0.8", f"frames.reference_delay_s={delay_s}"])
    assert measure_agreement(late, config).residual_m == pytest.approx(
        measure_agreement(good, CONFIG).residual_m, rel=1e-6
    )
    assert measure_agreement(late, CONFIG).residual_m > 1.0
    assert choose_reference(log, config) is log


def test_configured_delays_move_the_fixes_before_the_unit_of_the_wheels_is_found(good: RobotLog) -> None:
    delay_s = 12.0
    in_radians = replace(good.wheels, left=good.wheels.left / 0.2, right=good.wheels.right / 0.2, unit="rad")
    late = replace(good, gnss=replace(good.gnss, stamp_ns=good.gnss.stamp_ns + round(delay_s * 1e9)))
    config = load_config(sets=["robot.track_width_m=0.8", f"frames.reference_delay_s={delay_s}"])
    found, of_good = (
        fit(replace(one, wheels=in_radians), with_delay).document
        for one, with_delay in ((late, config), (good, load_config(sets=["robot.track_width_m=0.8"])))
    )
    by_late, by_good = (
        [note.text for note in one.notes if note.code == "wheel_unit_estimated"] for one in (found, of_good)
    )
    assert by_late == by_good != []
