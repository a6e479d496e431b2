"""Terrain changes that are given: the ICRs between them stand in every result."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from icrtool.config import parse_config
from icrtool.output.figures.filter_estimates import icr_estimates
from icrtool.output.tables.run import format_run
from icrtool.pipeline import fit
from icrtool.records.run import ICR_COLUMNS, Run
from icrtool.records.tables import Icrs, RobotLog
from icrtool.simulation.drives import DrivePlan, PathPlan, Sensors, drive_plan, sense_motion
from icrtool.simulation.study_runs import readings_log

CONFIG = parse_config({"robot": {"track_width_m": 0.6}})
ICRS: Icrs = (0.5, -0.75, -0.25)
WIDER: Icrs = (0.6, -0.9, -0.35)
WIDTH_M = ICRS[0] - ICRS[1]
PATHS = {
    "curved": PathPlan("curved", 0.5, 1.0),
    "figure eights": PathPlan("figure-eight", 0.5, 1.5),
    "spins": PathPlan("spins", 0.4),
    "lawnmower": PathPlan("lawnmower", 0.7, 1.0, 8.0),
}
SLIP = 0.03
"""Part of the width by which the ICRs of a robot on one terrain scatter here, anew every two seconds."""


def drive(
    seed: int, path: PathPlan, duration_s: float, changes: tuple[tuple[float, Icrs], ...] = (), slip: float = SLIP
) -> RobotLog:
    rng = np.random.default_rng(seed)
    wandering, icrs = np.zeros(3), np.array(ICRS)
    slips: list[tuple[float, Icrs]] = []
    for t in np.arange(2.0, duration_s, 2.0):
        icrs = np.array([new for time, new in ((0.0, ICRS), *changes) if time <= t][-1])
        wandering = 0.6 * wandering + 0.8 * slip * WIDTH_M * rng.standard_normal(3)
        slips.append((float(t), tuple(icrs + wandering)))
    path = replace(path, phase_rad=rng.uniform(0, 6))
    plan = DrivePlan(icrs_m=ICRS, changes=tuple(slips) if slip else changes, path=path, duration_s=duration_s)
    sensors = Sensors(input_noise_mps=0.03)
    return readings_log(sense_motion(drive_plan(plan, 0.01), sensors, duration_s, rng), sensors)


@cache
def changing_log() -> RobotLog:
    return drive(3, PATHS["curved"], 240.0, ((80.0, WIDER), (160.0, ICRS)), slip=0.0)


@cache
def changed() -> Run:
    return fit(changing_log(), CONFIG, changes_s=(80.0, 160.0))


def test_segments_have_their_own_icrs_and_stand_in_every_result() -> None:
    run = changed()
    summary = json.loads(json.dumps(run.summary, allow_nan=False))
    assert run.changes_s == (80.0, 160.0)
    assert [change["t_s"] for change in summary["terrain"]["changes"]] == [80.0, 160.0]
    for segment, truth in zip(summary["segments"], (ICRS, WIDER, ICRS), strict=True):
        assert [segment["mean"][column] for column in ICR_COLUMNS] == pytest.approx(truth, abs=0.02)
        assert all(0 <= segment["std"][column] < 0.02 for column in ICR_COLUMNS)
    assert f"{summary['segments'][1]['mean']['x_icr_m']:+.3f} ± " in format_run(run)
    panels = icr_estimates(run).axes
    for t in run.changes_s:
        assert any(t in np.asarray(line.get_xdata()) for axes in panels for line in axes.lines)


@pytest.mark.parametrize("path", ["curved", "figure eights", "spins"])
def test_icrs_of_a_terrain_that_the_drive_hardly_saw_are_not_shown(path: str) -> None:
    log = drive(1, PATHS[path], 121.0, ((120.0, WIDER),))
    before, after = (fit(log, CONFIG, changes_s=changes_s) for changes_s in ((), (120.0,)))
    assert before.document.excitation.verdict.shows_sides
    assert after.document.excitation.verdict.not_shown == ICR_COLUMNS
    assert not after.usable


def test_final_sigma_is_that_of_the_last_terrain() -> None:
    log = drive(1, PATHS["curved"], 140.0, ((120.0, WIDER),))
    run = fit(log, CONFIG, changes_s=(120.0,))
    final, std = ([run.summary["icr"][key][column] for column in ICR_COLUMNS] for key in ("final", "final_std"))
    assert np.all(np.abs(np.subtract(final, WIDER)) < 2.0 * np.array(std))
    # windows on both terrains together show a σ of y that is up to twice as large
    assert max(std[:2]) < 0.04 * (WIDER[0] - WIDER[1])


def test_a_change_given_twice_is_one() -> None:
    log = drive(0, PATHS["curved"], 30.0)
    once, twice = (fit(log, CONFIG, changes_s=(20.0,) * times) for times in (1, 2))
    assert twice.summary["terrain"] == once.summary["terrain"]
    assert twice.summary["segments"] == once.summary["segments"]
    np.testing.assert_array_equal(twice.table.std_x_icr_m, once.table.std_x_icr_m)


def test_a_change_beyond_the_drive_is_none_and_said() -> None:
    run = fit(drive(0, PATHS["curved"], 30.0), CONFIG, changes_s=(10.0, 31.0))
    assert run.changes_s == (10.0,)
    assert len(run.summary["segments"]) == 2
    assert any("no terrain change at 31 s" in warning for warning in run.warnings)
