"""Slip events in kinematic drives whose slip is known, and in drives where only the reference errs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from icrtool.alignment.slip.slip_events import find_slip_events
from icrtool.kernels.arrays import Floats
from icrtool.records.events import SlipEvent
from icrtool.records.measurements import Fixes, SensorData
from icrtool.records.samples import GyroSamples, HeadingSamples, WheelSamples

START_NS = 1_760_000_000_000_000_000
RATE_HZ, SECONDS, WIDTH_M = 100, 120.0, 0.6
Y_RIGHT, Y_LEFT, X = 0.55, -0.5, 0.1
HOLD = (60.0, 63.0)
LEFT_FAST = (64.5, 67.5)
"""When the left side makes most of the motion."""
TIMING_S = 0.3

Slip = Callable[[Floats], Floats]
"""Shares missed by left and right, and speed sideways [m/s], at times (n,): (3, n)."""


def no_slip(t: Floats) -> Floats:
    return np.zeros((3, len(t)))


def hold(t: Floats, span: tuple[float, float] = HOLD) -> Floats:
    inside = 1.0 * ((t >= span[0]) & (t < span[1]))
    return np.array([inside, inside, 0 * t])


def drive(
    slip: Slip = no_slip, *, seed: int = 0, fix_hz: int = 20, fix_std_m: float = 0.01, gyro: bool = True,
    position_error: Callable[[Floats], Floats] | None = None,
) -> SensorData:  # fmt: skip
    """Drive curves with sensors as in Pentzer 2014, Section 4; `position_error` gives north errors [m]."""
    rng = np.random.default_rng(seed)
    n = int(SECONDS * RATE_HZ)
    t = np.arange(n) / RATE_HZ
    left = 0.5 + 0.25 * np.sin(0.5 * t) + 0.05 * np.sin(1.3 * t + seed)
    right = 0.5 + 0.2 * np.sin(0.31 * t + 1.0)
    share_left, share_right, aside = slip(t)
    true_left, true_right = (1 - share_left) * left, (1 - share_right) * right
    omega = (true_left - true_right) / (Y_RIGHT - Y_LEFT)
    ahead = (true_left * Y_RIGHT - true_right * Y_LEFT) / (Y_RIGHT - Y_LEFT)
    psi = np.concatenate([[0.4], 0.4 + np.cumsum(omega)[:-1] / RATE_HZ])
    step = (ahead + 1j * (aside - omega * X)) * np.exp(1j * (psi + omega / RATE_HZ / 2)) / RATE_HZ
    place = np.concatenate([[0.0], np.cumsum(step)[:-1]])
    stamps = START_NS + np.rint(t * 1e9).astype(np.int64)
    rows = np.arange(0, n, RATE_HZ // fix_hz)
    m = len(rows)
    wrong = position_error(t[rows]) if position_error is not None else np.zeros(m)
    none = np.zeros(m, np.bool_)
    variance = np.full(m, fix_std_m**2)
    return SensorData(
        name="made",
        wheels=WheelSamples(stamps, left, right),
        fixes=Fixes(
            stamps[rows], place.real[rows] + wrong + rng.normal(0, fix_std_m, m),
            place.imag[rows] + rng.normal(0, fix_std_m, m), variance, variance.copy(), np.zeros(m, np.uint8),
            none, none,
        ),
        headings=HeadingSamples(
            stamps, np.angle(np.exp(1j * (psi + rng.normal(0, 0.009, n)))), np.full(n, np.radians(1) ** 2)
        ),
        gyro=GyroSamples("/imu", stamps, omega + rng.normal(0, 0.003, n)) if gyro else None,
        heading_from_position=False,
        heading_correlation_s=0.0,
        antenna_m=(0.0, 0.0),
        losses_ns=np.empty((0, 2), np.int64),
    )  # fmt: skip


def span_s(event: SlipEvent) -> tuple[float, float]:
    return (event.begin_ns - START_NS) / 1e9, (event.end_ns - START_NS) / 1e9


@pytest.mark.parametrize("fix_hz", [20, 10, 5, 2])
@pytest.mark.parametrize("gyro", [True, False])
def test_a_robot_that_is_held_is_found_with_begin_and_end(fix_hz: int, gyro: bool) -> None:
    (event,) = find_slip_events(drive(hold, fix_hz=fix_hz, gyro=gyro), WIDTH_M)
    assert event.kind == "immobilised"
    assert span_s(event) == pytest.approx(HOLD, abs=TIMING_S)
    assert event.severity > 0.9
    assert event.confidence > 0.95
    assert event.distance_m < 0.2


def after_parking(sensors: SensorData, seconds: float = 300.0) -> SensorData:
    """Let the robot park first, its heading without noise, as units hold it while nothing turns."""
    parked = START_NS + np.rint(np.arange(seconds * RATE_HZ) / RATE_HZ * 1e9).astype(np.int64)
    later, n, rng = round(seconds * 1e9), len(parked), np.random.default_rng(9)
    wheels, fixes, headings = sensors.wheels, sensors.fixes, sensors.headings
    m, still = len(parked[::5]), np.zeros(n)

    def joined(first: Floats, then: Floats) -> Floats:
        return np.concatenate([first, then])

    return replace(
        sensors,
        wheels=WheelSamples(
            np.concatenate([parked, wheels.stamp_ns + later]),
            joined(still, wheels.v_left_mps), joined(still, wheels.v_right_mps),
        ),
        fixes=Fixes(
            np.concatenate([parked[::5], fixes.stamp_ns + later]),
            joined(rng.normal(0, 0.01, m), fixes.north_m), joined(rng.normal(0, 0.01, m), fixes.east_m),
            *(np.concatenate([np.full(m, one[0]), one]) for one in (
                fixes.var_north_m2, fixes.var_east_m2, fixes.fix_class, fixes.misreported, fixes.down_weighted,
            )),
        ),
        headings=HeadingSamples(
            np.concatenate([parked, headings.stamp_ns + later]),
            joined(still + headings.heading_rad[0], headings.heading_rad),
            joined(still + headings.var_rad2[0], headings.var_rad2),
        ),
    )  # fmt: skip


def test_a_hold_right_after_parking_is_found_where_the_parked_heading_has_no_noise() -> None:
    span = (1.0, 4.0)
    (event,) = find_slip_events(after_parking(drive(lambda t: hold(t, span), gyro=False)), WIDTH_M)
    assert event.kind == "immobilised"
    assert np.array(span_s(event)) - 300.0 == pytest.approx(span, abs=TIMING_S)


@pytest.mark.parametrize("seed", range(6))
def test_holds_of_a_second_and_a_half_are_all_found(seed: int) -> None:
    begins = 15.0 + 20.0 * np.arange(5) + np.random.default_rng(seed).uniform(0, 8, 5)
    spans = [(begin, begin + 1.5) for begin in begins]
    events = find_slip_events(drive(lambda t: np.maximum.reduce([hold(t, span) for span in spans]), seed=seed), WIDTH_M)
    assert [span_s(event) for event in events] == [pytest.approx(span, abs=TIMING_S) for span in spans]


def test_a_side_without_grip_is_slip_and_not_a_robot_that_stands() -> None:
    def left_side(t: Floats) -> Floats:
        return hold(t, LEFT_FAST) * np.array([[0.9], [0.0], [0.0]])

    (event,) = find_slip_events(drive(left_side), WIDTH_M)
    assert event.kind in {"slip", "spin"}
    assert span_s(event) == pytest.approx(LEFT_FAST, abs=TIMING_S)
    assert event.severity == pytest.approx(0.45, abs=0.1)


def test_motion_sideways_is_a_skid() -> None:
    def sideways(t: Floats) -> Floats:
        return np.array([0 * t, 0 * t, 0.35 * hold(t)[0]])

    (event,) = find_slip_events(drive(sideways), WIDTH_M)
    assert event.kind == "skid"
    assert span_s(event) == pytest.approx(HOLD, abs=TIMING_S)


def test_turning_wheels_without_a_turn_are_a_spin() -> None:
    def straight_on(t: Floats) -> Floats:
        """Both sides do what their mean does: what is ahead goes to the other."""
        left = 0.5 + 0.25 * np.sin(0.5 * t) + 0.05 * np.sin(1.3 * t)
        right = 0.5 + 0.2 * np.sin(0.31 * t + 1.0)
        middle = (left * Y_RIGHT - right * Y_LEFT) / (Y_RIGHT - Y_LEFT)
        inside = (t >= 21.3) & (t < 23.6)
        return np.array([inside * (1 - middle / left), inside * (1 - middle / right), 0 * t])

    (event,) = find_slip_events(drive(straight_on), WIDTH_M)
    assert event.kind == "spin"


def test_left_and_right_mirrored_give_the_same_events() -> None:
    def left_side(t: Floats) -> Floats:
        return hold(t, LEFT_FAST) * np.array([[0.9], [0.0], [0.0]])

    sensors = drive(left_side)
    assert sensors.gyro is not None
    mirrored = replace(
        sensors,
        wheels=replace(sensors.wheels, left=sensors.wheels.right, right=sensors.wheels.left),
        fixes=replace(sensors.fixes, east_m=-sensors.fixes.east_m),
        headings=replace(sensors.headings, heading_rad=-sensors.headings.heading_rad),
        gyro=replace(sensors.gyro, rate_radps=-sensors.gyro.rate_radps),
    )  # fmt: skip
    (one,), (other,) = find_slip_events(sensors, WIDTH_M), find_slip_events(mirrored, WIDTH_M)
    assert span_s(one) == pytest.approx(span_s(other), abs=1e-6)
    assert (one.kind, one.severity) == (other.kind, pytest.approx(other.severity, abs=1e-6))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("fix_hz", [20, 2])
def test_a_clean_drive_has_no_event(seed: int, fix_hz: int) -> None:
    assert find_slip_events(drive(seed=seed, fix_hz=fix_hz), WIDTH_M) == ()


@pytest.mark.parametrize("size_m", [0.1, 0.3, 1.0, 5.0])
@pytest.mark.parametrize("fix_hz", [20, 5, 2])
@pytest.mark.parametrize(
    "error",
    [
        lambda t: 1.0 * (t >= 60.0),
        lambda t: 1.0 * ((t >= 60.0) & (t < 62.0)),
        lambda t: np.interp(t, [60.0, 62.0, 62.01], [0.0, 1.0, 0.0]),
        lambda t: 1.0 * (np.arange(len(t)) == len(t) // 2),
    ],
    ids=["jump", "excursion", "drift and return", "outlier"],
)
def test_an_error_of_the_position_is_no_event(error: Callable[[Floats], Floats], fix_hz: int, size_m: float) -> None:
    assert find_slip_events(drive(fix_hz=fix_hz, position_error=lambda t: size_m * error(t)), WIDTH_M) == ()


def test_a_hold_is_found_beside_jumps_of_the_position() -> None:
    jumps = drive(hold, position_error=lambda t: 0.5 * np.floor(t / 17.0))
    assert [span_s(event) for event in find_slip_events(jumps, WIDTH_M)] == [pytest.approx(HOLD, abs=TIMING_S)]


def test_a_reference_that_is_worse_than_it_states_gives_no_events() -> None:
    """A position that jitters by decimetres for a second at a time, stated as 1 cm: too much motion, and too little."""

    def jitter(t: Floats) -> Floats:
        knots = np.arange(0.0, SECONDS + 1, 0.7)
        return np.interp(t, knots, np.random.default_rng(3).normal(0, 0.25, len(knots)))

    assert find_slip_events(drive(position_error=jitter), WIDTH_M) == ()


def test_a_drive_that_is_too_short_has_no_event() -> None:
    sensors = drive()
    few = replace(sensors, fixes=sensors.fixes.cut(slice(0, 5)))
    assert find_slip_events(few, WIDTH_M) == ()
