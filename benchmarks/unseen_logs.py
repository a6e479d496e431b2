"""Logs that nobody tuned for: true drives, measured with sensors and troubles drawn at random."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from unseen_drives import TrueDrive

from icrtool.kernels.arrays import Floats, Ints
from icrtool.records.samples import (
    FIXED_FIX,
    OTHER_FIX,
    Datum,
    GyroAxes,
    GyroSamples,
    HeadingSamples,
    OtherReceiver,
    PositionFixes,
    StreamChoice,
    WheelSamples,
)
from icrtool.records.tables import RobotLog

START_NS = 1_760_000_000_000_000_000
DATUM = Datum(47.0, -71.0, 100.0)
COUNTS_PER_REV = 2048
POSITIONS = ("rtk", "rtk", "ppk", "sbas", "lidar", "lidar", "camera")
WHEELS = ("velocity", "velocity", "positions", "ticks", "headerless", "odometry", "held", "quantised")
FAULTS = ("none",) * 6 + ("radius", "swapped", "reversed")
HEADINGS = ("ahrs", "ahrs", "ned", "offset", "drifting", "gyro", "gyro on its side", "antennas", "none")
ON_STAND = 0.05
WITH_DELAY = 0.4
LONGEST_DELAY_S = 0.3
ANTENNA_BASELINE_M = -0.8


@dataclass(frozen=True)
class Case:
    """One log: a drive, and how it was measured.

    Attributes
    ----------
    position_delay_s, heading_delay_s : by how much these streams lag the wheels
    antenna_m : of the position sensor, forward
    """

    number: int
    position: str
    wheels: str
    fault: str
    heading: str
    position_delay_s: float
    heading_delay_s: float
    antenna_m: float
    surface: str

    def troubles(self) -> tuple[str, ...]:
        """Return what a table of scores is made by."""
        delayed = max(self.position_delay_s, self.heading_delay_s) > 0.0
        words = {field.name: getattr(self, field.name) for field in fields(self)}
        return (
            *(f"{kind}: {words[kind]}" for kind in ("position", "wheels", "fault", "heading", "surface")),
            "delay: some" if delayed else "delay: none",
        )


def draw_case(number: int, surface: str) -> Case:
    """Draw how a drive is measured."""
    rng = np.random.default_rng([12, number])
    position, wheels, fault, heading = (str(rng.choice(one)) for one in (POSITIONS, WHEELS, FAULTS, HEADINGS))
    if position in ("lidar", "camera"):
        # such a pose holds an orientation, but for a few
        heading = heading if heading == "gyro" and rng.random() < 0.5 else "pose"
    if rng.random() < ON_STAND:
        surface = "stand"
    late = [float(rng.uniform(0.0, LONGEST_DELAY_S)) if rng.random() < WITH_DELAY else 0.0 for _ in range(2)]
    antenna = float(rng.choice([0.0, 0.0, 0.2, -0.3]))
    return Case(number, position, wheels, fault, heading, late[0], late[1], antenna, surface)


def make_log(drive: TrueDrive, case: Case) -> RobotLog:
    """Measure a drive."""
    rng = np.random.default_rng([13, case.number])
    if case.surface == "stand":
        still = np.zeros(len(drive.t_s))
        drive = TrueDrive(drive.name, drive.width_m, drive.radius_m, drive.t_s, still, still, still + 0.4,
                          drive.left_m, drive.right_m)  # fmt: skip
    wheels = _wheels(drive, case, rng)
    fixes, metric = _positions(drive, case, rng, case.antenna_m)
    heading, gyros = _heading(drive, case, rng)
    other: tuple[OtherReceiver, ...] = ()
    if case.heading == "antennas":
        rear, _ = _positions(drive, case, rng, case.antenna_m + ANTENNA_BASELINE_M)
        other = (OtherReceiver("/gps_rear/fix", rear),)
    together = case.heading == "pose"
    streams = [_stream("wheels", f"/{case.wheels}", wheels.stamp_ns), _stream("gnss", "/position", fixes.stamp_ns)]
    if len(heading.stamp_ns):
        streams.append(_stream("heading", "/position" if together else "/imu", heading.stamp_ns))
    rates = gyros[0] if gyros else None
    return RobotLog(
        f"case{case.number:03d}", wheels, fixes, heading, None if metric else DATUM, tuple(streams), (), {}, (), None,
        None if rates is None else GyroSamples("/imu", rates.stamp_ns, -rates.rates_radps[:, 2]), gyros, other,
    )  # fmt: skip


def true_log(drive: TrueDrive, antenna_m: float) -> RobotLog:
    """Return a log of true poses and speeds."""
    stamps = START_NS + np.rint(drive.t_s * 1e9).astype(np.int64)
    speeds = [np.diff(side, append=side[-1]) / 0.01 for side in (drive.left_m, drive.right_m)]
    few = slice(None, None, 10)
    place = _antenna(drive, antenna_m)[few]
    variance = np.full(len(place), 1e-4)
    psi = drive.heading_rad
    return RobotLog(
        "true", WheelSamples(stamps, *speeds),
        PositionFixes(stamps[few], place.real, place.imag, variance, variance.copy(), np.zeros(len(place))),
        HeadingSamples(stamps[few], np.angle(np.exp(1j * psi[few])), np.full(len(place), math.radians(0.5) ** 2)),
        None, (_stream("wheels", "/w", stamps), _stream("gnss", "/p", stamps[few]), _stream("heading", "/h", stamps)),
        (), {}, (),
    )  # fmt: skip


def _stream(role: str, topic: str, stamps: Ints) -> StreamChoice:
    rate = 1e9 / float(np.median(np.diff(stamps)))
    return StreamChoice(role, topic, "made/Made", len(stamps), rate, "header", 0.0, "made")  # type: ignore[arg-type]


def _stamps(t: Floats) -> Ints:
    return START_NS + np.rint(t * 1e9).astype(np.int64)


def _antenna(drive: TrueDrive, forward_m: float) -> np.ndarray[tuple[int], np.dtype[np.complex128]]:
    return drive.north_m + 1j * drive.east_m + forward_m * np.exp(1j * drive.heading_rad)


def _wheels(drive: TrueDrive, case: Case, rng: np.random.Generator) -> WheelSamples:
    rate = {"velocity": 50.0, "positions": 25.0, "ticks": 20.0, "headerless": 50.0, "odometry": 20.0, "held": 20.0,
            "quantised": 20.0}[case.wheels]  # fmt: skip
    t = np.arange(0.0, drive.t_s[-1], 1.0 / rate)
    sides = [np.interp(t, drive.t_s, side) for side in (drive.left_m, drive.right_m)]
    if case.fault == "radius":
        factor = float(rng.choice([1 / 1.05, 1.05]))
        sides = [side * factor for side in sides]
    if case.fault == "swapped":
        sides = sides[::-1]
    if case.fault == "reversed":
        sides[0] = -sides[0]
    if case.wheels in ("positions", "ticks"):
        step = 2 * math.pi * drive.radius_m / COUNTS_PER_REV
        counts = [np.floor(side / step) for side in sides]
        unit = "rad" if case.wheels == "positions" else "counts"
        factor = 2 * math.pi / COUNTS_PER_REV if unit == "rad" else 1.0
        speeds = [np.diff(side, append=side[-1]) * factor * rate for side in counts]
        return WheelSamples(_stamps(t), *speeds, unit=unit, from_position=True)  # type: ignore[arg-type]
    # a driver sends what the wheels did since the last message
    left, right = (np.diff(side, prepend=side[0]) * rate + rng.normal(0.0, 0.005, len(t)) for side in sides)
    if case.wheels == "held":
        some = 5 * (np.arange(len(t)) // 5)
        left, right = left[some], right[some]
    if case.wheels == "quantised":
        left, right = np.round(left / 0.04) * 0.04, np.round(right / 0.04) * 0.04
    if case.wheels == "headerless":
        t = np.sort(t + rng.exponential(0.004, len(t)))
        return WheelSamples(_stamps(t), left / drive.radius_m, right / drive.radius_m, unit="unknown")
    return WheelSamples(_stamps(t), left, right)


def _wander(t: Floats, std: float, time_s: float, rng: np.random.Generator) -> Floats:
    """Return a first-order Gauss-Markov process (n,)."""
    keep = np.exp(-np.diff(t) / time_s)
    value = np.empty(len(t))
    value[0] = rng.normal(0.0, std)
    push = rng.normal(0.0, 1.0, len(t))
    for k in range(1, len(t)):
        value[k] = keep[k - 1] * value[k - 1] + std * math.sqrt(1 - keep[k - 1] ** 2) * push[k]
    return value


def _positions(drive: TrueDrive, case: Case, rng: np.random.Generator, forward_m: float) -> tuple[PositionFixes, bool]:
    """Return fixes, and whether they are metric."""
    kind = case.position
    rate = {"rtk": 10.0, "ppk": 5.0, "sbas": float(rng.choice([1.0, 2.5])), "lidar": 10.0, "camera": 15.0}[kind]
    t = np.arange(0.3, drive.t_s[-1] - 0.5, 1.0 / rate)
    place = _antenna(drive, forward_m)
    at = np.interp(t - case.position_delay_s, drive.t_s, place.real) + 1j * np.interp(
        t - case.position_delay_s, drive.t_s, place.imag
    )
    n = len(t)

    def white(std: float) -> np.ndarray[tuple[int], np.dtype[np.complex128]]:
        return np.asarray(rng.normal(0.0, std, n) + 1j * rng.normal(0.0, std, n))

    stated = np.full(n, np.nan)
    stated_class = None
    if kind in ("rtk", "ppk"):
        at, stated[:] = at + white(0.015), 0.02**2
        stated_class = np.full(n, FIXED_FIX, np.uint8)
    elif kind == "sbas":
        at = at + white(0.1) + _wander(t, 0.8, 60.0, rng) + 1j * _wander(t, 0.8, 60.0, rng)
        stated[:], stated_class = 1.0, np.full(n, OTHER_FIX, np.uint8)
    else:
        turned, drift = frame_of(case)
        path = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(at)))])
        at = at + drift * path * np.exp(1j * 0.7) + white(0.01 if kind == "lidar" else 0.02)
        at = (at - at[0]) * np.exp(-1j * turned)
        if kind == "camera":
            at = np.conj(at)
    none = np.zeros(n)
    fixes = PositionFixes(_stamps(t), at.real, at.imag, stated, stated.copy(), none, stated_class)
    return fixes, kind in ("lidar", "camera")


def frame_of(case: Case) -> tuple[float, float]:
    """Return by what a local frame is turned [rad], and how far it drifts over the distance driven."""
    rng = np.random.default_rng([14, case.number])
    return float(rng.uniform(-math.pi, math.pi)), float(rng.uniform(0.0, 0.005))


def _heading(drive: TrueDrive, case: Case, rng: np.random.Generator) -> tuple[HeadingSamples, tuple[GyroAxes, ...]]:
    nothing = HeadingSamples(np.empty(0, np.int64), np.empty(0), np.empty(0))
    t = np.arange(0.2, drive.t_s[-1] - 0.4, 0.02)
    psi = np.interp(t - case.heading_delay_s, drive.t_s, drive.heading_rad)
    rate = np.gradient(np.interp(t - case.heading_delay_s, drive.t_s, drive.heading_rad), t)
    rate = rate + rng.normal(0.0, math.radians(0.4)) + rng.normal(0.0, 0.003, len(t))
    rate = rate + _wander(t, math.radians(0.1), 100.0, rng)
    small = [rng.normal(0.0, 0.02, len(t)) for _ in range(2)]
    axes = np.column_stack([*small, -rate])
    if case.heading == "gyro on its side":
        axes = np.column_stack([small[0], rate, small[1]])
    gyros = (GyroAxes("/imu", _stamps(t), axes),)
    if case.heading == "pose":
        return _pose_heading(drive, case, rng), ()
    if case.heading in ("gyro", "gyro on its side"):
        return nothing, gyros
    if case.heading in ("antennas", "none"):
        return nothing, gyros if case.heading == "antennas" and rng.random() < 0.5 else ()
    error = _wander(t, math.radians(0.85), 30.0, rng) + rng.normal(0.0, math.radians(0.4), len(t))
    if case.heading == "ned":
        heading = math.pi / 2 - (psi + error)
    elif case.heading == "offset":
        heading = psi + error + float(rng.uniform(-math.pi, math.pi))
    elif case.heading == "drifting":
        heading = psi[0] + np.concatenate([[0.0], np.cumsum(rate[:-1] * np.diff(t))]) + 1.0
    else:
        heading = psi + error
    variance = np.full(len(t), np.nan)
    return HeadingSamples(_stamps(t), np.angle(np.exp(1j * heading)), variance), gyros


def _pose_heading(drive: TrueDrive, case: Case, rng: np.random.Generator) -> HeadingSamples:
    """Return the orientation of a lidar's or a camera's pose, at its stamps."""
    rate = 10.0 if case.position == "lidar" else 15.0
    t = np.arange(0.3, drive.t_s[-1] - 0.5, 1.0 / rate)
    psi = np.interp(t - case.position_delay_s, drive.t_s, drive.heading_rad) - frame_of(case)[0]
    psi = psi + rng.normal(0.0, math.radians(0.2), len(t)) + _wander(t, math.radians(0.3), 60.0, rng)
    psi = -psi if case.position == "camera" else psi
    return HeadingSamples(_stamps(t), np.angle(np.exp(1j * psi)), np.full(len(t), np.nan))
