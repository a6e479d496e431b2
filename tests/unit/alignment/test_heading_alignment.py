"""The heading detective: every convention is put right, and what no convention explains is refused."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from icrtool.alignment.corrections import align_streams
from icrtool.config import load_config
from icrtool.errors import DataError
from icrtool.kernels.arrays import Floats
from icrtool.pipeline import fit
from icrtool.records.notes import warnings_of
from icrtool.records.run import Run
from icrtool.records.samples import Datum, HeadingSamples, PositionFixes, WheelSamples
from icrtool.records.tables import RobotLog
from support.drives import ICRS, make_log
from support.matrix_filter import drive_states

WIDTH = "robot.track_width_m=0.8"
ICR_TOLERANCE_M = 0.02
OFFSET_TOLERANCE_DEG = 0.5
DECLINATION_DEG = -10.55


def clean() -> RobotLog:
    return replace(make_log(2, seconds=140.0, rate=20.0), datum=Datum(40.7934, -77.86, 350.0))


def told(log: RobotLog, psi: Floats) -> RobotLog:
    return replace(log, heading=replace(log.heading, heading_rad=np.angle(np.exp(1j * psi))))


def icrs(run: Run) -> np.ndarray:
    return np.array([run.summary["icr"]["final"][name] for name in ("y_icr_right_m", "y_icr_left_m", "x_icr_m")])


@cache
def icrs_of_the_clean_log() -> np.ndarray:
    return icrs(fit(clean(), load_config(sets=[WIDTH])))


@pytest.mark.parametrize(
    ("spoil", "offset_deg", "words"),
    [
        (lambda psi: psi + math.radians(12.0), 12.0, ""),
        (lambda psi: psi - math.radians(35.0), -35.0, ""),
        (lambda psi: psi + math.pi / 2, 90.0, "a quarter turn clockwise"),
        (lambda psi: psi - math.pi / 2, -90.0, "a quarter turn counter-clockwise"),
        (lambda psi: psi + math.pi, 180.0, "half a turn"),
        (lambda psi: psi - math.radians(DECLINATION_DEG), -DECLINATION_DEG, "magnetic declination here is -10.6"),
        (lambda psi: math.pi / 2 - psi, -90.0, "other convention (ENU/NED)"),
        (lambda psi: -psi, 0.0, "other convention (ENU/NED), offset +90"),
    ],
)
def test_each_convention_is_found_and_put_right(
    spoil: Callable[[Floats], Floats], offset_deg: float, words: str
) -> None:
    log = clean()
    run = fit(told(log, spoil(log.heading.heading_rad)), load_config(sets=[WIDTH]))
    assert np.abs(icrs(run) - icrs_of_the_clean_log()).max() < ICR_TOLERANCE_M
    applied = run.summary["heading"]["applied_offset_deg"]
    assert math.remainder(applied - offset_deg, 360.0) == pytest.approx(0.0, abs=OFFSET_TOLERANCE_DEG)
    assert any("applied" in warning and words in warning for warning in run.warnings)


def rows_to_and_fro() -> RobotLog:
    """Drive rows of 25 m with half a turn, left and right, at their ends."""
    log, step_s = clean(), 0.02
    row = np.concatenate([np.zeros(2500), np.full(157, 1.0), np.zeros(2500), np.full(157, -1.0)])
    turn = np.tile(row, 2)
    width = ICRS[0] - ICRS[1]
    v_left, v_right = 0.5 + turn * width / 2, 0.5 - turn * width / 2
    x = drive_states(np.array([0.0, 0.0, 0.4, *ICRS]), v_left, v_right, step_s)
    stamps = log.wheels.stamp_ns[0] + np.arange(len(turn)) * round(step_s * 1e9)
    known, rng = np.full(len(turn), 1e-4), np.random.default_rng(3)
    north, east = (x[:, :2] + rng.normal(0.0, 0.01, (len(turn), 2))).T
    return replace(
        log,
        wheels=WheelSamples(stamps, v_left, v_right),
        gnss=PositionFixes(stamps, north, east, known, known, 0 * known),
        heading=HeadingSamples(stamps, np.angle(np.exp(1j * (x[:, 2] + rng.normal(0.0, 0.01, len(turn))))), known),
    )


def test_the_other_convention_is_told_from_an_offset_by_the_turns_between_rows() -> None:
    log = rows_to_and_fro()
    assert not [warning for warning in warnings_of(align_streams(log, load_config()).notes) if "heading" in warning]
    other = align_streams(told(log, math.pi / 2 - log.heading.heading_rad), load_config())
    assert other.heading.agreement is not None
    assert other.heading.agreement > 0.8
    assert other.heading.applied_mirror
    assert [warning for warning in warnings_of(other.notes) if "other convention" in warning]
    paper = align_streams(other_log := told(log, -log.heading.heading_rad), load_config(sets=["filter.preset=paper"]))
    assert [warning for warning in warnings_of(paper.notes) if "set frames.heading" in warning]
    assert np.abs(icrs(fit(other_log, load_config(sets=[WIDTH]))) - ICRS).max() < ICR_TOLERANCE_M


def random(log: RobotLog) -> Floats:
    return np.random.default_rng(4).uniform(-math.pi, math.pi, len(log.heading.heading_rad))


def wandering(log: RobotLog) -> Floats:
    """A heading that turns smoothly, and has nothing to do with the robot's."""
    return 0.4 * (log.heading.stamp_ns - log.heading.stamp_ns[0]) / 1e9


def frozen(log: RobotLog) -> Floats:
    heading = log.heading.heading_rad.copy()
    heading[len(heading) // 3 :] = heading[len(heading) // 3]
    return heading


def constant(log: RobotLog) -> Floats:
    return np.full(len(log.heading.heading_rad), 1.0)


@pytest.mark.parametrize(
    ("make", "why"),
    [
        (random, "does not follow the course over ground"),
        (wandering, "does not follow the course over ground"),
        (frozen, "stays the same while the wheels turn the robot"),
        (constant, "stays the same"),
    ],
)
def test_a_heading_that_nothing_explains_is_refused_once_and_clearly(
    make: Callable[[RobotLog], Floats], why: str
) -> None:
    log = clean()
    spoilt = told(log, make(log))
    with pytest.raises(DataError, match=r"topics\.heading") as caught:
        fit(spoilt, load_config(sets=[WIDTH]))
    assert why in str(caught.value)
    insisting = fit(spoilt, load_config(sets=[WIDTH, "frames.heading_offset_deg=0.0"]))
    assert insisting.summary["heading"]["applied_offset_deg"] == 0.0
    fit(spoilt, load_config(sets=[WIDTH, "filter.preset=paper"]))


def rows(straight_m: float = 40.0, speed: float = 1.0) -> RobotLog:
    """Four straight rows at 50 Hz, half a turn between them; the exact heading in whole degrees."""
    turn_s, rate = math.pi * (ICRS[0] - ICRS[1]) / 0.8, 50.0
    row, turn = np.zeros(int(straight_m / speed * rate)), np.full(int(turn_s * rate), 0.4)
    ahead = np.concatenate([row, turn, row, -turn, row, turn, row])
    v_left, v_right = speed + ahead, speed - ahead
    x = drive_states(np.array([0.0, 0.0, 0.3, *ICRS]), v_left, v_right, 1 / rate, 0.5)
    stamps = clean().wheels.stamp_ns[0] + np.round(np.arange(len(x)) / rate * 1e9).astype(np.int64)
    fix = slice(0, None, 5)
    place = x[fix, :2] + np.random.default_rng(1).normal(0, 0.01, (len(x[fix]), 2))
    known = np.full(len(place), 1e-4)
    return replace(
        clean(),
        wheels=WheelSamples(stamps, v_left, v_right),
        gnss=PositionFixes(stamps[fix], *place.T, known, known, np.zeros(len(place))),
        heading=HeadingSamples(stamps, np.radians(np.round(np.degrees(x[:, 2]))), np.full(len(x), 3e-4)),
    )


@pytest.mark.parametrize("left_scale", [0.98, 1.0, 1.02])
def test_a_heading_in_whole_degrees_on_straight_rows_is_not_stuck(left_scale: float) -> None:
    log = rows()
    wheels = replace(log.wheels, left=left_scale * log.wheels.left)
    check = align_streams(replace(log, wheels=wheels), load_config(sets=[WIDTH]))
    assert not [warning for warning in warnings_of(check.notes) if "heading" in warning]
    assert check.heading.agreement is not None
    assert check.heading.agreement > 0.99


def test_a_heading_stuck_from_the_first_turn_on_is_refused_on_straight_rows() -> None:
    log = rows()
    stuck = np.where(np.arange(len(log.heading.heading_rad)) > 2000, log.heading.heading_rad[0], 0.3)
    with pytest.raises(DataError, match="stays the same while the wheels turn the robot"):
        align_streams(told(log, stuck), load_config(sets=[WIDTH]))


def test_a_noisy_heading_is_not_an_unexplained_one() -> None:
    log, rng = clean(), np.random.default_rng(5)
    noise = np.zeros(len(log.heading.heading_rad))
    for k in range(1, len(noise)):
        noise[k] = 0.98 * noise[k - 1] + rng.normal(0, math.radians(24) * math.sqrt(1 - 0.98**2))
    run = fit(told(log, log.heading.heading_rad + noise), load_config(sets=[WIDTH]))
    assert any("scatters by" in warning for warning in run.warnings)
    # The scatter shortens the way along the heading by some per cent: that is no wheel radius.
    assert run.summary["wheels"]["applied_scale"] == 1.0


def test_outliers_among_the_fixes_do_not_condemn_the_heading() -> None:
    log, rng = clean(), np.random.default_rng(6)
    far = 5.0 * (rng.random(len(log.gnss.north_m)) < 0.15)
    run = fit(replace(log, gnss=replace(log.gnss, north_m=log.gnss.north_m + far)), load_config(sets=[WIDTH]))
    assert run.summary["heading"]["applied_offset_deg"] == pytest.approx(0.0, abs=OFFSET_TOLERANCE_DEG)


def test_fixes_that_are_noisier_than_they_say_do_not_condemn_the_heading() -> None:
    log, rng = clean(), np.random.default_rng(7)
    north, east = (column + rng.normal(0.0, 0.5, len(column)) for column in (log.gnss.north_m, log.gnss.east_m))
    run = fit(replace(log, gnss=replace(log.gnss, north_m=north, east_m=east)), load_config(sets=[WIDTH]))
    heading = run.summary["heading"]
    assert heading["agreement"] > 0.9
    assert (heading["applied_offset_deg"], heading["applied_std_deg"]) == (0.0, 0.0)
    assert abs(heading["offset_deg"]) < 4 * heading["offset_std_deg"]
