"""What field logs get wrong, done to a rigid-body simulated robot: the ICRs stay those of the clean log."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import icrtool
from icrtool.pipeline import fit
from icrtool.records.run import Run
from icrtool.records.samples import HeadingSamples, PositionFixes
from icrtool.records.tables import RobotLog

LOG = Path(__file__).parents[3] / "sample_logs" / "wheeled_lawnmower.mcap"
CONFIG = icrtool.load_config(robot="segway-rmp400")
ICR_TOLERANCE_M, OFFSET_TOLERANCE_DEG = 0.05, 0.5
"""What the field preset promises against the clean version of a log."""

MINUTE_NS = 60_000_000_000
ANTENNA_M = (0.2, -0.1)

Spoil = Callable[[RobotLog], RobotLog]


@pytest.fixture(scope="module")
def clean() -> RobotLog:
    return icrtool.read_log(LOG, CONFIG)


@pytest.fixture(scope="module")
def clean_run(clean: RobotLog) -> Run:
    return fit(clean, CONFIG)


@pytest.fixture(scope="module")
def expected(clean_run: Run) -> np.ndarray:
    return icrs(clean_run)


def icrs(run: Run) -> np.ndarray:
    return np.array([run.summary["icr"]["final"][name] for name in ("y_icr_right_m", "y_icr_left_m", "x_icr_m")])


def turned(degrees: float) -> Spoil:
    def spoil(log: RobotLog) -> RobotLog:
        psi = log.heading.heading_rad + math.radians(degrees)
        return replace(log, heading=replace(log.heading, heading_rad=np.angle(np.exp(1j * psi))))

    return spoil


def other_convention(log: RobotLog) -> RobotLog:
    psi = np.angle(np.exp(1j * (math.pi / 2 - log.heading.heading_rad)))
    return replace(log, heading=replace(log.heading, heading_rad=psi))


def outliers(share: float) -> Spoil:
    def spoil(log: RobotLog) -> RobotLog:
        rng = np.random.default_rng(8)
        count = len(log.gnss.stamp_ns)
        away = 5.0 * np.exp(2j * np.pi * rng.random(count)) * (rng.random(count) < share)
        return with_fixes(log, log.gnss.north_m + away.real, log.gnss.east_m + away.imag)

    return spoil


def with_fixes(log: RobotLog, north: np.ndarray, east: np.ndarray) -> RobotLog:
    return replace(log, gnss=replace(log.gnss, north_m=north, east_m=east))


def lost(log: RobotLog) -> RobotLog:
    t = (log.gnss.stamp_ns - log.gnss.stamp_ns[0]) / 1e9
    seen = np.flatnonzero((t < 100.0) | (t >= 120.0))
    gnss = PositionFixes(
        *(getattr(log.gnss, name)[seen] for name in PositionFixes.__slots__ if name != "stated_class"), None
    )
    return replace(log, gnss=gnss)


def parked(log: RobotLog) -> RobotLog:
    """Stand for a minute before the drive, the sensors' noise going on."""
    wheels, gnss, heading = log.wheels, log.gnss, log.heading
    rng = np.random.default_rng(9)
    wait = {
        name: table.stamp_ns[table.stamp_ns < table.stamp_ns[0] + MINUTE_NS]
        for name, table in (("wheels", wheels), ("gnss", gnss), ("heading", heading))
    }
    still, fixes, samples = (len(wait[name]) for name in ("wheels", "gnss", "heading"))

    def first(column: np.ndarray, count: int, std: float = 0.0) -> np.ndarray:
        return np.concatenate([column[0] + std * rng.normal(size=count), column])

    stamps = {
        name: np.concatenate([wait[name], table.stamp_ns + MINUTE_NS])
        for name, table in (("wheels", wheels), ("gnss", gnss), ("heading", heading))
    }
    standing = np.zeros(still)
    return replace(
        log,
        wheels=replace(
            wheels,
            stamp_ns=stamps["wheels"],
            left=np.concatenate([standing, wheels.left]),
            right=np.concatenate([standing, wheels.right]),
        ),
        gnss=PositionFixes(
            stamps["gnss"],
            first(gnss.north_m, fixes, 0.01),
            first(gnss.east_m, fixes, 0.01),
            *(first(getattr(gnss, name), fixes) for name in ("var_north_m2", "var_east_m2", "cov_north_east_m2")),
        ),
        heading=HeadingSamples(
            stamps["heading"], first(heading.heading_rad, samples, 0.01), first(heading.var_rad2, samples)
        ),
    )


def held(log: RobotLog) -> RobotLog:
    row = np.arange(len(log.wheels.stamp_ns)) // 10 * 10
    return with_wheels(log, log.wheels.left[row], log.wheels.right[row])


def with_wheels(log: RobotLog, left: np.ndarray, right: np.ndarray) -> RobotLog:
    return replace(log, wheels=replace(log.wheels, left=left, right=right))


def swapped(log: RobotLog) -> RobotLog:
    return with_wheels(log, log.wheels.right, log.wheels.left)


def one_side_backwards(log: RobotLog) -> RobotLog:
    return with_wheels(log, -log.wheels.left, log.wheels.right)


def twice(log: RobotLog) -> RobotLog:
    return with_wheels(log, 2 * log.wheels.left, 2 * log.wheels.right)


def late_fixes(log: RobotLog) -> RobotLog:
    return replace(log, gnss=replace(log.gnss, stamp_ns=log.gnss.stamp_ns + 300_000_000))


def late_heading(log: RobotLog) -> RobotLog:
    return replace(log, heading=replace(log.heading, stamp_ns=log.heading.stamp_ns + 200_000_000))


@pytest.mark.parametrize(
    ("spoil", "offset_deg"),
    [
        (turned(-35.0), -35.0),
        (other_convention, -90.0),
        (outliers(0.05), 0.0),
        (lost, 0.0),
        (parked, 0.0),
        (held, 0.0),
        (swapped, 0.0),
        (one_side_backwards, 0.0),
        (twice, 0.0),
        (late_fixes, 0.0),
        (late_heading, 0.0),
    ],
    ids=["h-35", "NED", "5 %", "lost", "parked", "held", "swapped", "back", "twice", "fixes", "heading"],
)
def test_trouble_leaves_the_icrs_of_the_clean_log(
    spoil: Spoil, offset_deg: float, clean: RobotLog, expected: np.ndarray
) -> None:
    run = fit(spoil(clean), CONFIG)
    assert np.abs(icrs(run) - expected).max() < ICR_TOLERANCE_M
    applied = run.summary["heading"]["applied_offset_deg"]
    assert math.remainder(applied - offset_deg, 360.0) == pytest.approx(0.0, abs=OFFSET_TOLERANCE_DEG)


def test_an_antenna_off_centre_moves_the_icrs_by_its_place_until_it_is_told(
    clean: RobotLog, clean_run: Run, expected: np.ndarray
) -> None:
    """Position tells x_icr minus forward and the middle of the ICRs minus right, never either by itself."""
    forward, right = ANTENNA_M
    psi = np.interp(clean.gnss.stamp_ns, clean.heading.stamp_ns, np.unwrap(clean.heading.heading_rad))
    spoilt = with_fixes(
        clean,
        clean.gnss.north_m + forward * np.cos(psi) - right * np.sin(psi),
        clean.gnss.east_m + forward * np.sin(psi) + right * np.cos(psi),
    )
    run = fit(spoilt, CONFIG)
    assert icrs(run) - expected == pytest.approx([-right, -right, -forward], abs=0.01)
    assert [one for one in run.warnings if "both ICRs lie 0.10 m to the right of the position sensor" in one]
    assert not [one for one in clean_run.warnings if "both ICRs" in one]
    ahead = with_fixes(
        clean, clean.gnss.north_m + 2 * forward * np.cos(psi), clean.gnss.east_m + 2 * forward * np.sin(psi)
    )
    assert [one for one in fit(ahead, CONFIG).warnings if "is counted from the position sensor" in one]
    given = icrtool.load_config(
        robot="segway-rmp400", sets=[f"frames.antenna_forward_m={forward}", f"frames.antenna_right_m={right}"]
    )
    told = fit(spoilt, given)
    assert icrs(told) == pytest.approx(expected, abs=0.01)
    assert not [one for one in told.warnings if "both ICRs" in one]
