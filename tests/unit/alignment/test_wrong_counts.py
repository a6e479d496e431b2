"""Wheels whose radius or resolution is wrong by a factor of two, and bases that restart while they drive."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from icrtool.config import load_config
from icrtool.dropout_analysis.dropout_report import dropout_report
from icrtool.logs.read_log import read_log
from icrtool.pipeline import fit
from icrtool.records.run import Run
from support.drives import ICRS
from support.field_logs import RADIUS_M, ROBOT, WIDTH_M, joint_states, make_drive, reference, write_messages

DRIVE = make_drive(100.0)
MULTIPLIER = (ICRS[0] - ICRS[1]) / WIDTH_M
REPORTED = (2.0, 0.1, 0.3)
"""Factors of the radius for which the rows of a report are looked at: too large, too small, corrected by the scales of
the configuration."""


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    where = tmp_path_factory.mktemp("radius") / "drive.mcap"
    return write_messages(where, joint_states(DRIVE), reference(DRIVE))


def fitted(path: Path, *sets: str) -> Run:
    config = load_config(sets=[f"robot.track_width_m={WIDTH_M}", *sets])
    return fit(read_log(path, config), config)


@pytest.mark.parametrize(
    ("radius", "sets"),
    [
        (2.0, ()),
        (0.5, ()),
        (3.0, ()),
        (0.1, ()),
        (10.0, ()),
        (1.3, ()),
        (2.0, ("wheels.left_scale=0.5", "wheels.right_scale=0.5")),
        (0.3, ("wheels.left_scale=3.3333", "wheels.right_scale=3.3333")),
        # a tenth is nearly the factor from rpm to rad/s
        (10.0, ("wheels.left_scale=0.1", "wheels.right_scale=0.1", "wheels.quantity=velocity")),
    ],
    ids=[
        "twice",
        "half",
        "three times",
        "a tenth",
        "ten times",
        "1.3 times",
        "configured half",
        "configured third",
        "configured tenth",
    ],
)
def test_every_row_sees_wheels_that_were_corrected(path: Path, radius: float, sets: tuple[str, ...]) -> None:
    run = fitted(path, f"robot.wheel_radius_m={radius * RADIUS_M}", *sets)
    assert run.usable
    assert ("wheel_size_wrong" in [one.code for one in run.document.notes]) is not bool(sets)
    assert run.document.alignment["wheel_scale"].applied == pytest.approx(1.0 if sets else 1 / radius, rel=0.01)
    numbers = run.document.controller
    assert numbers is not None
    assert numbers.multiplier == pytest.approx(MULTIPLIER, abs=0.02)
    assert (numbers.left_radius, numbers.right_radius) == pytest.approx((1 / radius, 1 / radius), rel=0.01)
    if radius not in REPORTED:
        return
    found = dropout_report(run, horizons_m=[10.0])
    for name in ("controller", "recommended", "icr_final"):
        result = found.result(name)
        assert result is not None
        assert result.column("p95_m")[0] < 0.3
    assert found.calibration is not None
    assert found.calibration.controller.left_radius == pytest.approx(1 / radius, rel=0.01)


@pytest.mark.parametrize(
    ("gap_s", "at_s", "begins"),
    [(0.8, 40.0, 0.0), (0.8, 70.0, -3.0), (2.0, 40.0, -3.0), (2.0, 70.0, 0.0), (4.5, 40.0, 0.0), (4.5, 70.0, -3.0)],
)
def test_a_base_that_restarts_leaves_a_gap(tmp_path: Path, gap_s: float, at_s: float, begins: float) -> None:
    drive = DRIVE
    t = (drive.stamp_ns - drive.stamp_ns[0]) / 1e9
    kept = (t < at_s) | (t >= at_s + gap_s)
    first = int(np.searchsorted(t, at_s + gap_s))
    angles = (np.where(t >= at_s + gap_s, side - side[first] + begins, side) for side in (drive.left, drive.right))
    left, right = angles
    wheels = replace_columns(drive._replace(left=left, right=right), kept)
    path = write_messages(tmp_path / "restart.mcap", joint_states(wheels), reference(DRIVE))
    config = load_config(sets=ROBOT)
    run = fit(read_log(path, config), config)
    whole = float(np.hypot(np.diff(drive.north), np.diff(drive.east)).sum())
    assert run.usable
    assert 0.9 * whole < run.document.drive.distance_m < 1.02 * whole
    assert "wheel_positions_restart" in [one.code for one in run.document.notes]
    assert "wheel_gaps_bridged" not in [one.code for one in run.document.notes]
    numbers = run.document.controller
    assert numbers is not None
    assert numbers.multiplier == pytest.approx(MULTIPLIER, abs=0.03)


def replace_columns(drive, kept):  # type: ignore[no-untyped-def]
    """Return some samples of a drive."""
    return drive._make(column[kept] for column in drive)


def test_a_gap_in_which_the_fixes_contradict_the_wheels_is_not_bridged(tmp_path: Path) -> None:
    drive = DRIVE
    t = (drive.stamp_ns - drive.stamp_ns[0]) / 1e9
    kept = (t < 50.0) | (t >= 53.0)
    # no faster than elsewhere, yet not what the fixes show
    back = [np.where(t >= 53.0, side - 0.9 * (side[1060] - side[1000]), side) for side in (drive.left, drive.right)]
    for sides, bridged in ((back, False), ([drive.left, drive.right], True)):
        wheels = replace_columns(drive._replace(left=sides[0], right=sides[1]), kept)
        path = write_messages(tmp_path / "gap.mcap", joint_states(wheels), reference(DRIVE))
        config = load_config(sets=ROBOT)
        found = [one.code for one in fit(read_log(path, config), config).document.notes]
        assert ("wheel_gaps_bridged" in found) is bridged
