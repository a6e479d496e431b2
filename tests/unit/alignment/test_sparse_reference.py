"""A reference with few poses, or with poses interpolated between few nodes, gives the answer of the full one."""

from __future__ import annotations

import functools
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import icrtool
from icrtool.alignment.align import align
from icrtool.alignment.sparse_reference import spans_of_measured, with_carried_heading, without_interpolated
from icrtool.config import Config, load_config
from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.track import Track
from icrtool.pipeline import fit
from icrtool.records.run import Run
from icrtool.records.samples import HeadingSamples, PositionFixes
from icrtool.records.tables import RobotLog
from support.drives import ICRS, make_log, make_pose_log

CONFIG = load_config(sets=["robot.track_width_m=0.8"])
MULTIPLIER = (ICRS[0] - ICRS[1]) / 0.8
EVERY_S = (1.0, 2.0, 3.0, 5.0)


def poses_of(log: RobotLog) -> RobotLog:
    """Return the log with its heading at the stamps of its fixes, as fields of one pose."""
    stamps, heading = log.gnss.stamp_ns, log.heading
    at = np.interp(stamps - stamps[0], heading.stamp_ns - stamps[0], np.unwrap(heading.heading_rad))
    one = HeadingSamples(stamps, np.angle(np.exp(1j * at)), np.full(len(stamps), math.radians(1.0) ** 2))
    gnss, wheels = replace(log.streams[0], role="gnss", topic="/pose"), log.streams[0]
    return replace(log, heading=one, streams=(wheels, gnss, replace(gnss, role="heading")), other_references=())


def thinned(log: RobotLog, every_s: float) -> RobotLog:
    """Return the log with the first pose of each `every_s`."""

    def rows(stamp_ns: Ints) -> slice | np.ndarray:
        kept = np.zeros(len(stamp_ns), np.bool_)
        cell = np.floor((stamp_ns - log.gnss.stamp_ns[0]) / 1e9 / every_s + 1e-6)
        kept[np.unique(cell, return_index=True)[1]] = True
        return kept

    return replace(
        log, gnss=log.gnss.cut(rows(log.gnss.stamp_ns)), heading=log.heading.cut(rows(log.heading.stamp_ns)),
        gyro=None, gyros=(), other_references=(),
    )  # fmt: skip


def interpolated(log: RobotLog, every_s: float = 0.1) -> RobotLog:
    """Return the log with poses on straight lines between its poses."""
    gnss, heading = log.gnss, log.heading
    stamps = np.arange(gnss.stamp_ns[0], gnss.stamp_ns[-1], round(every_s * 1e9))

    def between(own: Ints, column: Floats) -> Floats:
        return np.interp(stamps - stamps[0], own - stamps[0], column)

    names = ("north_m", "east_m", "var_north_m2", "var_east_m2", "cov_north_east_m2")
    angle = between(heading.stamp_ns, np.unwrap(heading.heading_rad))
    return replace(
        log,
        gnss=PositionFixes(stamps, *(between(gnss.stamp_ns, getattr(gnss, name)) for name in names)),
        heading=HeadingSamples(
            stamps, np.angle(np.exp(1j * angle)), between(heading.stamp_ns, heading.var_rad2)
        ),
    )  # fmt: skip


def multiplier_of(run: Run) -> tuple[float, float]:
    icr = run.summary["icr"]
    return icr["separation_multiplier"], icr["separation_multiplier_std"]


@pytest.mark.parametrize("every_s", EVERY_S)
@pytest.mark.parametrize("linear", [False, True])
def test_few_poses_give_the_multiplier_of_the_drive(every_s: float, linear: bool) -> None:
    log = thinned(poses_of(make_log(2, 240.0)), every_s)
    run = fit(interpolated(log) if linear else log, CONFIG)
    assert "wheels_filtered" not in {one.code for one in run.document.notes}
    assert run.usable
    value, std = multiplier_of(run)
    assert abs(value - MULTIPLIER) < 2.0 * std
    assert ("positions_interpolated" in {one.code for one in run.document.notes}) is linear


@pytest.mark.parametrize("std_m", [0.0, 1e-5, 1e-3])
def test_poses_that_were_measured_are_not_called_interpolated(std_m: float) -> None:
    log = make_pose_log(1, std_m, math.degrees(std_m))
    assert without_interpolated(log) is log
    assert without_interpolated(thinned(log, 2.0)).notes == ()


def test_the_nodes_of_interpolated_poses_are_the_poses_themselves() -> None:
    log = thinned(poses_of(make_log(3, 120.0)), 3.0)
    found = without_interpolated(interpolated(log))
    assert len(found.gnss.stamp_ns) == pytest.approx(len(log.gnss.stamp_ns), abs=1)
    inside = found.gnss.stamp_ns[1:-1]
    np.testing.assert_array_equal(inside, log.gnss.stamp_ns[1 : 1 + len(inside)])
    np.testing.assert_allclose(found.heading.heading_rad[1:-1], log.heading.heading_rad[1 : 1 + len(inside)], atol=1e-9)
    assert "3 s apart" in found.notes[-1].text


def test_nodes_between_the_samples_are_found_once() -> None:
    log = interpolated(thinned(poses_of(make_log(3, 120.0)), 2.0), 0.3)
    found = without_interpolated(log)
    assert len(found.gnss.stamp_ns) == pytest.approx(60, abs=2)
    assert np.median(np.diff(found.gnss.stamp_ns)) / 1e9 == pytest.approx(2.0, abs=0.31)


def spinning(every_s: float, rate_radps: float) -> tuple[Track, Floats]:
    """Return the track of a robot that turns by turns of its own, headings `every_s` apart, and its true heading."""
    t = np.arange(0.0, 120.0, 0.05)
    apart = rate_radps * (1.0 + 0.5 * np.sin(t))
    true = np.concatenate([[0.0], np.cumsum(apart[:-1] * 0.05)])
    held, none = np.append(np.full(len(t) - 1, 0.05), 0.0), np.zeros(len(t), np.bool_)
    rows = slice(None, None, round(every_s / 0.05))
    # the ratio of the turn to the difference of the sides is 1 / 1.25 per metre
    side, zero = 1.25 * apart / 2, np.zeros(len(t))
    wrapped = np.unwrap(np.angle(np.exp(1j * true[rows])))
    track = Track(t, held, side, -side, t, zero, zero, t[rows], wrapped, zero, none, none, none)
    return track, true


def test_a_heading_is_carried_over_more_than_half_a_turn() -> None:
    track, true = spinning(5.0, 1.1)
    found = with_carried_heading(track)
    inside = track.t <= track.heading_t[-1]
    np.testing.assert_allclose(found.heading_at(track.t)[inside], true[inside], atol=1e-6)
    assert found.measured_t is not None
    np.testing.assert_array_equal(found.measured_t, track.heading_t)


def test_a_heading_that_is_not_rare_or_not_of_these_wheels_is_not_carried() -> None:
    track, _ = spinning(0.25, 1.1)
    assert with_carried_heading(track) is track
    rare, _ = spinning(2.0, 0.5)
    other = rare._replace(heading=np.random.default_rng(0).uniform(-3.0, 3.0, len(rare.heading_t)))
    assert with_carried_heading(other) is other


def test_spans_begin_and_end_at_measured_headings() -> None:
    begin, end = spans_of_measured(np.array([0.0, 1.0, 1.5, 4.0, 6.0]), 2.0, 2)
    np.testing.assert_array_equal(begin, [0.0, 1.0, 1.5])
    np.testing.assert_array_equal(end, [4.0, 4.0, 6.0])


RARE = (*((every_s, False) for every_s in EVERY_S), (2.0, True), (5.0, True))
"""Time between poses, and whether others are interpolated between them."""

REAL = ("warthog_asphalt", "warthog_grass.bag", "warthog_grass_0718", "warthog_grass_0729", "warthog_grass_0808")


@functools.cache
def recorded(path: Path) -> tuple[RobotLog, Config, tuple[float, float]]:
    """Return a recorded log, its configuration, and the multiplier by all its poses."""
    config = icrtool.load_config(robot="warthog")
    log = replace(icrtool.read_log(path, config), other_references=())
    return log, config, multiplier_of(fit(log, config))


@pytest.mark.parametrize("name", REAL)
@pytest.mark.parametrize(("every_s", "linear"), RARE)
def test_recorded_poses_may_be_rare(shared_logs: Path, name: str, every_s: float, linear: bool) -> None:
    log, config, full = recorded(shared_logs / "real" / name)
    rare = thinned(log, every_s)
    run = fit(interpolated(rare) if linear else rare, config)
    assert run.usable, run.summary["unusable_because"]
    value, std = multiplier_of(run)
    assert abs(value - full[0]) < 2.0 * math.hypot(std, full[1])


@functools.cache
def simulated(path: Path) -> tuple[RobotLog, Config, tuple[float, float]]:
    """Return a simulated log with poses, its configuration, and the multiplier by all its poses."""
    made = json.loads(path.with_name(f"{path.name}.json").read_text())
    keys = {"track_width_m": "track_width_m", "wheel_radius_m": "radius_m", "encoder_counts_per_rev": "counts_per_rev"}
    config = icrtool.load_config(sets=[f"robot.{key}={made[own]}" for key, own in keys.items()])
    log = poses_of(icrtool.read_log(path, config))
    return log, config, multiplier_of(fit(replace(log, gyro=None, gyros=()), config))


@pytest.mark.parametrize("name", ["tracked_curved.bag", "wheeled_lawnmower"])
@pytest.mark.parametrize(("every_s", "linear"), RARE)
def test_simulated_poses_may_be_rare(shared_logs: Path, name: str, every_s: float, linear: bool) -> None:
    log, config, full = simulated(shared_logs / "simulated" / name)
    rare = thinned(log, every_s)
    run = fit(interpolated(rare) if linear else rare, config)
    if not run.usable:
        assert "wheels_filtered" not in {one.code for one in run.document.notes}
        return
    value, std = multiplier_of(run)
    assert abs(value - full[0]) < 2.0 * math.hypot(std, full[1])


def test_preset_paper_takes_interpolated_poses_as_they_are() -> None:
    log = interpolated(thinned(poses_of(make_log(2, 60.0)), 2.0))
    paper = load_config(sets=["robot.track_width_m=0.8", "filter.preset=paper"])
    assert len(align(log, paper).sensors.fixes.stamp_ns) == len(log.gnss.stamp_ns)
