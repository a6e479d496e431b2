"""Slip events in kinematic drives whose slip is known, and in drives where only the reference errs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from icrtool.alignment.slip_events import find_disagreements
from icrtool.kernels.arrays import Floats
from icrtool.records.measurements import Fixes, SensorData, SlipEvent
from icrtool.records.samples import HeadingSamples, WheelSamples
from support.slip_drives import RATE_HZ, SECONDS, START_NS, WIDTH_M, Y_LEFT, Y_RIGHT, curves, drive

HOLD = (60.0, 63.0)
LEFT_FAST = (64.5, 67.5)
"""When the left side makes most of the motion."""
TIMING_S = 0.3


def hold(t: Floats, span: tuple[float, float] = HOLD) -> Floats:
    inside = 1.0 * ((t >= span[0]) & (t < span[1]))
    return np.array([inside, inside, 0 * t])


def found_events(sensors: SensorData, width_m: float) -> tuple[SlipEvent, ...]:
    return find_disagreements(sensors, width_m).events


def span_s(event: SlipEvent) -> tuple[float, float]:
    return (event.begin_ns - START_NS) / 1e9, (event.end_ns - START_NS) / 1e9


@pytest.mark.parametrize("fix_hz", [20, 10, 5, 2])
@pytest.mark.parametrize("gyro", [True, False])
def test_a_robot_that_is_held_is_found_with_begin_and_end(fix_hz: int, gyro: bool) -> None:
    (event,) = found_events(drive(hold, fix_hz=fix_hz, gyro=gyro), WIDTH_M)
    assert event.kind == "immobilised"
    assert span_s(event) == pytest.approx(HOLD, abs=TIMING_S)
    assert event.severity > 0.9
    assert event.confidence > 0.95
    assert event.distance_m < 0.2


def spin_and_stand(t: Floats, seed: int) -> Floats:
    """Drive curves; every minute spin from the 25th second to the 35th, and stand until the 40th."""
    spin = 0.16 + np.array([[-0.3], [0.3]]) * np.ones(len(t))
    phase = t % 60.0
    return np.select([phase < 25.0, phase < 35.0, phase < 40.0], [curves(t, seed), spin, 0.0 * spin], curves(t, seed))


@pytest.mark.parametrize("fix_hz", [20, 10, 5])
@pytest.mark.parametrize("seconds", [1.0, 3.0, 6.0])
def test_a_pause_of_the_wheel_data_is_no_slip(fix_hz: int, seconds: float) -> None:
    sensors = drive(wheels=spin_and_stand, fix_hz=fix_hz)
    t = (sensors.wheels.stamp_ns - START_NS) / 1e9
    for begin in (20.0, 28.0, 30.0, 33.0):
        kept = (t < begin) | (t > begin + seconds)
        assert not found_events(replace(sensors, wheels=sensors.wheels.cut(kept)), WIDTH_M)


def after_parking(sensors: SensorData, seconds: float = 300.0) -> SensorData:
    """Let the robot park first, its heading without noise, as units hold it while nothing turns."""
    parked = START_NS + np.rint(np.arange(seconds * RATE_HZ) / RATE_HZ * 1e9).astype(np.int64)
    later, n, rng = round(seconds * 1e9), len(parked), np.random.default_rng(9)
    wheels, fixes, headings = sensors.wheels, sensors.fixes, sensors.headings
    m, still = len(parked[:: RATE_HZ // 20]), np.zeros(n)

    def joined(first: Floats, then: Floats) -> Floats:
        return np.concatenate([first, then])

    return replace(
        sensors,
        wheels=WheelSamples(
            np.concatenate([parked, wheels.stamp_ns + later]),
            joined(still, wheels.v_left_mps), joined(still, wheels.v_right_mps),
        ),
        fixes=Fixes(
            np.concatenate([parked[:: RATE_HZ // 20], fixes.stamp_ns + later]),
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
    (event,) = found_events(after_parking(drive(lambda t: hold(t, span), gyro=False)), WIDTH_M)
    assert event.kind == "immobilised"
    assert np.array(span_s(event)) - 300.0 == pytest.approx(span, abs=TIMING_S)


@pytest.mark.parametrize("seed", range(6))
def test_holds_of_a_second_and_a_half_are_all_found(seed: int) -> None:
    begins = 15.0 + 20.0 * np.arange(5) + np.random.default_rng(seed).uniform(0, 8, 5)
    spans = [(begin, begin + 1.5) for begin in begins]
    events = found_events(drive(lambda t: np.maximum.reduce([hold(t, span) for span in spans]), seed=seed), WIDTH_M)
    assert [span_s(event) for event in events] == [pytest.approx(span, abs=TIMING_S) for span in spans]


SPIN = (55.0, 68.0)


def spinning(t: Floats, seed: int) -> Floats:
    """Drive curves, but turn on the spot for a while."""
    inside = (t >= SPIN[0]) & (t < SPIN[1])
    return np.where(inside, np.array([[0.6], [-0.6]]), curves(t, seed))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("fix_hz", [20, 5])
@pytest.mark.parametrize("antenna", [0.0, 0.4])
def test_a_hold_while_the_wheels_spin_on_the_spot_is_found(seed: int, fix_hz: int, antenna: float) -> None:
    sensors = drive(hold, wheels=spinning, seed=seed, fix_hz=fix_hz)
    if antenna:
        psi = np.interp(sensors.fixes.stamp_ns, sensors.headings.stamp_ns, np.unwrap(sensors.headings.heading_rad))
        fixes = replace(
            sensors.fixes, north_m=sensors.fixes.north_m + antenna * np.cos(psi),
            east_m=sensors.fixes.east_m + antenna * np.sin(psi),
        )  # fmt: skip
        sensors = replace(sensors, fixes=fixes)
    (event,) = found_events(sensors, WIDTH_M)
    assert event.kind == "immobilised"
    assert span_s(event) == pytest.approx(HOLD, abs=TIMING_S)


@pytest.mark.parametrize("seed", range(9))
def test_one_event_of_a_side_without_grip_is_found_also_where_it_is_dragged_along(seed: int) -> None:
    """The driver steers against it: the side is first slower than the ground, then faster."""
    rng = np.random.default_rng(seed)
    begin, side = 40.0 + rng.uniform(0.0, 20.0), seed % 2
    middle, end = begin + rng.uniform(1.5, 2.5), begin + rng.uniform(4.0, 5.0)

    def no_grip(t: Floats) -> Floats:
        missed = np.zeros((3, len(t)))
        missed[side] = np.where((t >= begin) & (t < middle), -1.2, np.where((t >= middle) & (t < end), 0.85, 0.0))
        return missed

    events = found_events(drive(no_grip, seed=seed), WIDTH_M)
    assert events
    assert all(event.kind in {"slip", "spin"} for event in events)
    first, last = span_s(events[0])[0], span_s(events[-1])[1]
    assert (first, last) == pytest.approx((begin, end), abs=TIMING_S)


@pytest.mark.parametrize(("side", "span"), [(0, LEFT_FAST), (1, HOLD)])
def test_a_side_that_loses_a_quarter_of_its_motion_is_found(side: int, span: tuple[float, float]) -> None:
    def weak(t: Floats) -> Floats:
        missed = np.zeros((3, len(t)))
        missed[side] = 0.25 * hold(t, span)[side]
        return missed

    (event,) = found_events(drive(weak, seed=3), WIDTH_M)
    assert span_s(event) == pytest.approx(span, abs=2 * TIMING_S)


def test_a_spin_on_the_spot_in_which_the_inner_side_slips_more_is_no_event() -> None:
    def inner(t: Floats) -> Floats:
        missed = np.zeros((3, len(t)))
        missed[1] = np.where((t >= SPIN[0]) & (t < SPIN[1]), 0.2, 0.0)
        return missed

    assert not found_events(drive(inner, wheels=spinning, seed=4), WIDTH_M)


def test_a_side_without_grip_is_slip_and_not_a_robot_that_stands() -> None:
    def left_side(t: Floats) -> Floats:
        return hold(t, LEFT_FAST) * np.array([[0.9], [0.0], [0.0]])

    (event,) = found_events(drive(left_side), WIDTH_M)
    assert event.kind in {"slip", "spin"}
    assert span_s(event) == pytest.approx(LEFT_FAST, abs=TIMING_S)
    assert event.severity == pytest.approx(0.45, abs=0.1)


def test_motion_sideways_is_a_skid() -> None:
    def sideways(t: Floats) -> Floats:
        return np.array([0 * t, 0 * t, 0.35 * hold(t)[0]])

    (event,) = found_events(drive(sideways), WIDTH_M)
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

    (event,) = found_events(drive(straight_on), WIDTH_M)
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
    (one,), (other,) = found_events(sensors, WIDTH_M), found_events(mirrored, WIDTH_M)
    assert span_s(one) == pytest.approx(span_s(other), abs=1e-6)
    assert (one.kind, one.severity) == (other.kind, pytest.approx(other.severity, abs=1e-6))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("fix_hz", [20, 2])
def test_a_clean_drive_has_no_event(seed: int, fix_hz: int) -> None:
    assert found_events(drive(seed=seed, fix_hz=fix_hz), WIDTH_M) == ()


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
    assert found_events(drive(fix_hz=fix_hz, position_error=lambda t: size_m * error(t)), WIDTH_M) == ()


def test_a_hold_is_found_beside_jumps_of_the_position() -> None:
    jumps = drive(hold, position_error=lambda t: 0.5 * np.floor(t / 17.0))
    assert [span_s(event) for event in found_events(jumps, WIDTH_M)] == [pytest.approx(HOLD, abs=TIMING_S)]


def test_a_reference_that_is_worse_than_it_states_gives_no_events() -> None:
    """A position that jitters by decimetres for a second at a time, stated as 1 cm: too much motion, and too little."""

    def jitter(t: Floats) -> Floats:
        knots = np.arange(0.0, SECONDS + 1, 0.7)
        return np.interp(t, knots, np.random.default_rng(3).normal(0, 0.25, len(knots)))

    assert found_events(drive(position_error=jitter), WIDTH_M) == ()


def test_a_drive_that_is_too_short_has_no_event() -> None:
    sensors = drive()
    few = replace(sensors, fixes=sensors.fixes.cut(slice(0, 5)))
    assert found_events(few, WIDTH_M) == ()
