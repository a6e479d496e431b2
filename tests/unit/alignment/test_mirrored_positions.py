"""Positions that are mirrored are named and exchanged back; gyro and wheels, and heading if any, are right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pymap3d import geodetic2ned, ned2geodetic

from icrtool.alignment.mirrored_positions import metres_per_radian, with_right_positions
from icrtool.config import load_config
from icrtool.pipeline import fit
from icrtool.records.samples import NO_HEADINGS, Datum, GyroAxes, GyroSamples
from icrtool.records.tables import RobotLog
from support.drives import EPOCH_NS, ICRS, make_log

CONFIG = load_config(sets=["robot.track_width_m=0.8"])
DATUM = Datum(49.0, 8.4, 120.0)


def log_of(*, gyro: bool = True, seed: int = 5) -> RobotLog:
    """Return a log with geodetic positions, a heading and a gyro that agree."""
    exact, log = make_log(seed, 180.0, rate=20.0, heading_std_deg=0.0), make_log(seed, 180.0, rate=20.0)
    t = (exact.heading.stamp_ns - EPOCH_NS) / 1e9
    rate = np.gradient(np.unwrap(exact.heading.heading_rad), t)
    rate += np.random.default_rng(seed).normal(0.0, 0.01, len(t))
    return replace(log, datum=DATUM, gyro=GyroSamples("/imu", log.heading.stamp_ns, rate) if gyro else None)


def read_as(log: RobotLog, *, latitude: int = 1, longitude: int = 1, exchanged: bool = False) -> RobotLog:
    """Return the log as it is read where latitudes and longitudes are sent with other signs, or exchanged."""
    fixes, origin = log.gnss, DATUM
    phi, lam, height = ned2geodetic(
        fixes.north_m, fixes.east_m, np.zeros(len(fixes.north_m)), DATUM.latitude_deg, DATUM.longitude_deg,
        DATUM.height_m,
    )  # fmt: skip
    phi, lam = latitude * phi, longitude * lam
    origin = Datum(latitude * DATUM.latitude_deg, longitude * DATUM.longitude_deg, DATUM.height_m)
    if exchanged:
        phi, lam = lam, phi
        origin = Datum(origin.longitude_deg, origin.latitude_deg, origin.height_m)
    north, east, _ = geodetic2ned(phi, lam, height, origin.latitude_deg, origin.longitude_deg, origin.height_m)
    return replace(log, datum=origin, gnss=replace(fixes, north_m=north, east_m=east))


SPOILT = [
    ({"longitude": -1}, "the longitude has the other sign"),
    ({"latitude": -1}, "the latitude has the other sign"),
    ({"exchanged": True}, "latitude and longitude are exchanged"),
]


@pytest.mark.parametrize(("how", "words"), SPOILT)
@pytest.mark.parametrize("seed", [5, 6])
def test_mirrored_positions_are_named_and_the_icrs_are_right(how: dict[str, int], words: str, seed: int) -> None:
    log = log_of(seed=seed)
    run = fit(read_as(log, **how), CONFIG)
    (text,) = [one.text for one in run.document.notes if one.code == "positions_mirrored"]
    assert words in text
    codes = {one.code for one in run.document.notes}
    assert not codes & {"sides_swapped", "side_reversed", "heading_convention_corrected", "heading_offset_corrected"}
    assert run.usable
    final, std = run.summary["icr"]["final"], run.summary["icr"]["final_std"]
    for name, true in zip(("y_icr_right_m", "y_icr_left_m", "x_icr_m"), ICRS, strict=True):
        assert abs(final[name] - true) < 3.0 * std[name]
    assert run.summary["gnss"]["datum"][:2] == pytest.approx([DATUM.latitude_deg, DATUM.longitude_deg])


@pytest.mark.parametrize(("how", "words"), SPOILT)
def test_positions_are_exchanged_back_exactly(how: dict[str, int], words: str) -> None:
    log = log_of()
    found = with_right_positions(read_as(log, **how), CONFIG)
    np.testing.assert_allclose(found.gnss.north_m, log.gnss.north_m, atol=2e-3)
    np.testing.assert_allclose(found.gnss.east_m, log.gnss.east_m, atol=2e-3)
    assert found.datum == DATUM


def test_positions_that_are_right_are_left_as_they_are() -> None:
    log = log_of()
    assert with_right_positions(log, CONFIG) is log
    # no gyro: the sense of the heading may be wrong as well as the sense of the positions
    bare = log_of(gyro=False)
    assert with_right_positions(bare, CONFIG) is bare


def test_a_heading_or_wheels_of_the_other_sense_are_not_called_mirrored_positions() -> None:
    log = log_of()
    assert log.gyro is not None
    heading = replace(log.heading, heading_rad=-log.heading.heading_rad)
    swapped = replace(log.wheels, left=log.wheels.right, right=log.wheels.left)
    gyro = replace(log.gyro, rate_radps=-log.gyro.rate_radps)
    for one in (replace(log, heading=heading), replace(log, wheels=swapped), replace(log, heading=heading, gyro=gyro)):
        assert with_right_positions(one, CONFIG) is one


def test_preset_paper_leaves_mirrored_positions_as_they_are() -> None:
    log = read_as(log_of(), longitude=-1)
    assert with_right_positions(log, load_config(sets=["filter.preset=paper"])) is log


@pytest.mark.parametrize("latitude_deg", [-60.0, 0.0, 35.0, 80.0])
def test_metres_per_radian_are_those_of_another_library(latitude_deg: float) -> None:
    step_deg = 1e-5
    north, _, _ = geodetic2ned(latitude_deg + step_deg, 10.0, 0.0, latitude_deg, 10.0, 0.0)
    _, east, _ = geodetic2ned(latitude_deg, 10.0 + step_deg, 0.0, latitude_deg, 10.0, 0.0)
    by_library = float(north) / np.radians(step_deg), float(east) / np.radians(step_deg)
    assert metres_per_radian(latitude_deg) == pytest.approx(by_library, rel=1e-6)


def lawn_log() -> RobotLog:
    """Return straight lines of 20 m with a half turn at each end, to the right and to the left by turns."""
    t = np.arange(0.0, 360.0, 0.05)
    phase = t % 30.0
    turn = np.where(phase > 24.0, np.pi / 6.0, 0.0) * np.where((t // 30.0) % 2 < 1.0, 1.0, -1.0)
    left, right = 0.8 - ICRS[1] * turn, 0.8 - ICRS[0] * turn
    log, rng = log_of(), np.random.default_rng(0)
    psi = 0.1 + np.append(0.0, np.cumsum(turn[:-1] * 0.05))
    step = np.exp(1j * psi) * (0.8 - 1j * ICRS[2] * turn) * 0.05
    place = np.append(0.0, np.cumsum(step[:-1]))[::2]
    stamps = EPOCH_NS + np.round(t * 1e9).astype(np.int64)
    noise, var = rng.normal(0.0, 0.014, (2, len(place))), np.full(len(place), 0.014**2)
    heading = np.angle(np.exp(1j * (psi + rng.normal(0.0, 0.01, len(t)))))
    assert log.gyro is not None
    return replace(
        log,
        wheels=replace(log.wheels, stamp_ns=stamps, left=left, right=right),
        gnss=replace(
            log.gnss, stamp_ns=stamps[::2], north_m=place.real + noise[0], east_m=place.imag + noise[1],
            var_north_m2=var, var_east_m2=var.copy(), cov_north_east_m2=np.zeros(len(place)),
        ),
        heading=replace(log.heading, stamp_ns=stamps, heading_rad=heading, var_rad2=np.full(len(t), 1e-4)),
        gyro=GyroSamples("/imu", stamps, turn + rng.normal(0.0, 0.01, len(t))),
    )  # fmt: skip


@pytest.mark.parametrize(("how", "words"), SPOILT)
def test_few_turns_between_long_lines_are_enough(how: dict[str, int], words: str) -> None:
    log = lawn_log()
    assert with_right_positions(log, CONFIG) is log
    found = with_right_positions(read_as(log, **how), CONFIG)
    assert [one.code for one in found.notes] == ["positions_mirrored"]
    assert words in found.notes[0].text
    np.testing.assert_allclose(found.gnss.east_m, log.gnss.east_m, atol=5e-3)


def without_heading(log: RobotLog, *, sense: int = 1, bias_radps: float = 0.003) -> RobotLog:
    """Return the log with the raw rates of a gyro (z up; with sense -1 down), and neither heading nor its choice."""
    gyro = log.gyro
    assert gyro is not None
    rates = np.random.default_rng(1).normal(0.0, 0.01, (len(gyro.rate_radps), 3))
    rates[:, 2] = bias_radps - sense * gyro.rate_radps
    return replace(log, heading=NO_HEADINGS, gyro=None, gyros=(GyroAxes("/imu", gyro.stamp_ns, rates),))


@pytest.mark.parametrize(("how", "words"), SPOILT)
@pytest.mark.parametrize("lawn", [False, True])
def test_without_a_heading_gyro_and_wheels_are_witnesses(how: dict[str, int], words: str, lawn: bool) -> None:
    log = lawn_log() if lawn else log_of()
    run = fit(read_as(without_heading(log), **how), CONFIG)
    (text,) = [one.text for one in run.document.notes if one.code == "positions_mirrored"]
    assert words in text
    assert "upside down" in text
    assert not {one.code for one in run.document.notes} & {"sides_swapped", "side_reversed", "wheels_filtered"}
    assert run.usable
    final, std = run.summary["icr"]["final"], run.summary["icr"]["final_std"]
    for name, true in zip(("y_icr_right_m", "y_icr_left_m", "x_icr_m"), ICRS, strict=True):
        assert abs(final[name] - true) < 3.0 * std[name]


def test_without_a_heading_metric_positions_are_mirrored_back() -> None:
    log = replace(without_heading(log_of()), datum=None)
    assert with_right_positions(log, CONFIG) is log
    for spoilt in (
        replace(log.gnss, east_m=-log.gnss.east_m),
        replace(log.gnss, north_m=log.gnss.east_m, east_m=log.gnss.north_m),
    ):
        run = fit(replace(log, gnss=spoilt), CONFIG)
        assert "positions_mirrored" in {one.code for one in run.document.notes}
        final, std = run.summary["icr"]["final"], run.summary["icr"]["final_std"]
        assert abs(final["y_icr_right_m"] - ICRS[0]) < 3.0 * std["y_icr_right_m"]
        assert abs(final["y_icr_left_m"] - ICRS[1]) < 3.0 * std["y_icr_left_m"]


@pytest.mark.parametrize("bias_radps", [0.0, 0.02])
def test_without_a_heading_right_positions_are_left_as_they_are(bias_radps: float) -> None:
    for one in (log_of(), log_of(seed=6), lawn_log()):
        right = without_heading(one, bias_radps=bias_radps)
        swapped = replace(right, wheels=replace(right.wheels, left=right.wheels.right, right=right.wheels.left))
        for log in (right, without_heading(one, sense=-1, bias_radps=bias_radps), swapped, replace(right, gyros=())):
            assert with_right_positions(log, CONFIG) is log
    # gyro and wheels must agree: a gyro upside down is no witness
    mirrored = read_as(without_heading(log_of(), sense=-1), longitude=-1)
    assert with_right_positions(mirrored, CONFIG) is mirrored


@pytest.mark.parametrize("heading", [True, False])
@pytest.mark.parametrize("seed", [5, 6])
def test_without_a_gyro_distances_show_that_latitude_and_longitude_are_exchanged(heading: bool, seed: int) -> None:
    log = log_of(gyro=False, seed=seed)
    log = log if heading else replace(log, heading=NO_HEADINGS)
    found = with_right_positions(read_as(log, exchanged=True), CONFIG)
    np.testing.assert_allclose(found.gnss.north_m, log.gnss.north_m, atol=2e-3)
    np.testing.assert_allclose(found.gnss.east_m, log.gnss.east_m, atol=2e-3)
    assert [one.code for one in found.notes] == ["positions_mirrored"]
    # where they are right, an exchange fits worse
    assert with_right_positions(log, CONFIG) is log


def test_without_gyro_and_heading_swapped_sides_and_mirrored_positions_are_both_named() -> None:
    run = fit(replace(read_as(log_of(gyro=False), longitude=-1), heading=NO_HEADINGS), CONFIG)
    (text,) = [one.text for one in run.document.notes if one.code == "sides_swapped"]
    assert "latitude or longitude" in text
