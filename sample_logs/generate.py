"""Make the sample logs: drives of physics-simulated robots, measured with the sensors of Pentzer 2014, Section 4.

Run as ``python sample_logs/generate.py`` from the project's root (``make samples``) with icrtool installed.
README.md describes the files beside each log (``*.truth.csv``, ``*.json``).
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pymap3d
from skid_steer import (
    SAMPLE_S,
    TRACKED,
    WHEELED,
    Driver,
    Motion,
    Robot,
    drive,
    plan_curved,
    plan_figure_eight,
    plan_lawnmower,
)

from icrtool.logs.write_log import SensorColumns, WriteOptions, write_log

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

START_NS = 1_760_000_000_000_000_000
DATUM = (40.7934, -77.86, 350.0)
COUNTS_PER_REV = 8192
GNSS_EVERY = 5
GNSS_STD_M = 0.01
HEIGHT_STD_M = 0.02
# The paper's AHRS has 1 degree rms. A real one has slow errors (magnetic) and white noise: 1 degree together.
HEADING_SLOW_STD_RAD = np.radians(0.85)
HEADING_SLOW_TIME_S = 30.0
HEADING_WHITE_STD_RAD = np.radians(0.5)
HEADING_RESOLUTION_RAD = np.radians(0.05)
GYRO_STD_RADPS = 0.003


@dataclass(frozen=True)
class Sample:
    """One log: robot, path, and how it is recorded."""

    name: str
    robot: Robot
    plan: Callable[[float, float], Floats]
    duration_s: float
    speed_mps: float
    start_heading_rad: float
    seed: int
    options: WriteOptions


def list_samples() -> tuple[Sample, ...]:
    """Return the three logs: one for each of the most common containers, wheel messages and heading conventions."""
    wheeled, tracked = (
        WriteOptions(
            wheel_radius_m=robot.wheel_radius_m, track_width_m=2 * robot.half_track_m, counts_per_rev=COUNTS_PER_REV
        )
        for robot in (WHEELED, TRACKED)
    )
    mcap = replace(wheeled, container="mcap", wheels="joint_states", heading="enu", compression="zstd")
    bag = replace(tracked, container="bag", wheels="float64_pair", heading="ned", compression="lz4")
    db3 = replace(wheeled, container="db3", wheels="odometry", heading="enu", compression="zstd")
    return (
        Sample("wheeled_lawnmower.mcap", WHEELED, plan_lawnmower, 200.0, 0.6, 0.5, 21, mcap),
        Sample("tracked_curved.bag", TRACKED, plan_curved, 180.0, 0.5, 1.2, 22, bag),
        Sample("wheeled_figure_eight", WHEELED, plan_figure_eight, 120.0, 0.6, -0.8, 23, db3),
    )


def main() -> None:
    """Make every sample log beside this file, in place of the ones that are there."""
    folder = Path(__file__).parent
    for sample in list_samples():
        started = time.perf_counter()
        summary = make_sample(sample, folder)
        icr, check = summary["icr_least_squares"], summary["open_loop"]
        print(f"{sample.name}: {time.perf_counter() - started:.0f} s; {json.dumps(icr)} {json.dumps(check)}")


def make_sample(sample: Sample, folder: Path) -> dict[str, object]:
    """Drive, sense, and write the log, its truth and its description into `folder`."""
    drive_rng, sensor_rng = (np.random.default_rng([sample.seed, stream]) for stream in (0, 1))
    path = sample.plan(2.0 * sample.speed_mps * sample.duration_s, sample.start_heading_rad)
    # Skid-steering needs about twice the difference of speeds of a no-slip turn.
    driver = Driver(path, sample.speed_mps, 4 * sample.robot.half_track_m, drive_rng)
    # One sample more than is recorded: the last wheel speed is the displacement to it.
    motion = drive(sample.robot, driver, sample.start_heading_rad, round(sample.duration_s / SAMPLE_S) + 1)
    columns = sense(motion, sample.robot, sensor_rng)
    log = folder / sample.name
    if log.is_dir():
        shutil.rmtree(log)
    log.unlink(missing_ok=True)
    write_log(log, columns, sample.options)
    write_truth(folder / f"{log.stem}.truth.csv", motion)
    summary = describe(sample, motion, columns)
    (folder / f"{log.stem}.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    return summary


def sense(motion: Motion, robot: Robot, rng: np.random.Generator) -> SensorColumns:
    """Return the measurements of encoders and AHRS at 100 Hz and RTK GNSS at 20 Hz, all stamped at sampling.

    The antenna is above the body origin. A wheel speed stamped k is the encoder's displacement from k to k + 1.
    """
    n = len(motion.t_s) - 1
    stamp_ns = START_NS + np.rint(motion.t_s[:n] * 1e9).astype(np.int64)
    metres_per_count = 2 * np.pi * robot.wheel_radius_m / COUNTS_PER_REV
    left, right = (
        np.floor(angle / (2 * np.pi) * COUNTS_PER_REV) * metres_per_count
        for angle in (motion.angle_left_rad, motion.angle_right_rad)
    )
    fixes = slice(0, n, GNSS_EVERY)
    m = len(range(n)[fixes])
    north = motion.north_m[fixes] + rng.normal(0, GNSS_STD_M, m)
    east = motion.east_m[fixes] + rng.normal(0, GNSS_STD_M, m)
    latitude, longitude, height = pymap3d.ned2geodetic(north, east, rng.normal(0, HEIGHT_STD_M, m), *DATUM)
    heading = motion.heading_rad[:n] + heading_error(n, rng)
    heading = np.rint(heading / HEADING_RESOLUTION_RAD) * HEADING_RESOLUTION_RAD
    return SensorColumns(
        wheel_stamp_ns=stamp_ns,
        wheel_position_left_m=left[:n],
        wheel_position_right_m=right[:n],
        wheel_v_left_mps=np.diff(left) / SAMPLE_S,
        wheel_v_right_mps=np.diff(right) / SAMPLE_S,
        gnss_stamp_ns=stamp_ns[fixes],
        latitude_deg=np.asarray(latitude),
        longitude_deg=np.asarray(longitude),
        height_m=np.asarray(height),
        gnss_std_m=np.full(m, GNSS_STD_M),
        gnss_status=np.full(m, 2),
        heading_stamp_ns=stamp_ns,
        heading_rad=np.angle(np.exp(1j * heading)),
        yaw_rate_radps=np.diff(motion.heading_rad) / SAMPLE_S + rng.normal(0, GYRO_STD_RADPS, n),
    )


def heading_error(n: int, rng: np.random.Generator) -> Floats:
    """Return the AHRS's error [rad], (n,): a slow first-order wander and white noise."""
    kept = np.exp(-SAMPLE_S / HEADING_SLOW_TIME_S)
    push = rng.normal(0, HEADING_SLOW_STD_RAD * np.sqrt(1 - kept**2), n)
    slow = np.empty(n)
    slow[0] = rng.normal(0, HEADING_SLOW_STD_RAD)
    for k in range(1, n):
        slow[k] = kept * slow[k - 1] + push[k]
    return slow + rng.normal(0, HEADING_WHITE_STD_RAD, n)


def write_truth(path: Path, motion: Motion) -> None:
    """Write the true pose of the body origin at every wheel stamp, to the micrometre and microradian."""
    n = len(motion.t_s) - 1
    table = np.column_stack([motion.t_s, motion.north_m, motion.east_m, motion.heading_rad])[:n]
    table = np.round(table, 6) + 0.0  # no -0.00000
    header = "t_s,north_m,east_m,heading_rad"
    np.savetxt(path, table, fmt=["%.2f", "%.6f", "%.6f", "%.6f"], delimiter=",", header=header, comments="")


def fit_constant_icrs(motion: Motion, robot: Robot) -> tuple[float, float, float]:
    """Return the constant (y_icr_right, y_icr_left, x_icr) [m] that best explain the true body velocities.

    Notes
    -----
    With d = V_l - V_r and y_r > y_l, Eqs. 8-10 read omega = d/W, v_x = V_r + (y_r/W) d, v_y = -(x_v/W) d: three least
    squares in one unknown each. Velocities are displacements over a sample, in the body frame at its middle.
    """
    middle = (motion.heading_rad[1:] + motion.heading_rad[:-1]) / 2
    north, east = np.diff(motion.north_m) / SAMPLE_S, np.diff(motion.east_m) / SAMPLE_S
    forward = north * np.cos(middle) + east * np.sin(middle)
    rightward = -north * np.sin(middle) + east * np.cos(middle)
    turn = np.diff(motion.heading_rad) / SAMPLE_S
    v_left = np.diff(motion.angle_left_rad) / SAMPLE_S * robot.wheel_radius_m
    v_right = np.diff(motion.angle_right_rad) / SAMPLE_S * robot.wheel_radius_m
    d = v_left - v_right
    width = (d @ d) / (d @ turn)
    y_right = (d @ (forward - v_right)) / (d @ d) * width
    return float(y_right), float(y_right - width), float(-(d @ rightward) / (d @ d) * width)


def open_loop_errors(motion: Motion, columns: SensorColumns, icrs: tuple[float, float, float]) -> dict[str, float]:
    """Return the distance [m] between the truth and Eqs. 32-34 with the recorded wheel speeds alone.

    ``p95_10m`` and ``expected_10m``: from every true pose until 10 m have been driven. ``end`` and ``max``: from the
    first pose over the whole drive.
    """
    y_right, y_left, x = icrs
    v_left, v_right = columns.wheel_v_left_mps, columns.wheel_v_right_mps
    width = abs(y_left - y_right)
    turn = (v_left - v_right) / width
    velocity = (v_left * y_right - v_right * y_left) / width - 1j * turn * x
    heading = np.concatenate([[0.0], np.cumsum(turn) * SAMPLE_S])
    track = np.concatenate([[0.0], np.cumsum(velocity * np.exp(1j * heading[:-1])) * SAMPLE_S])
    truth = motion.north_m + 1j * motion.east_m
    distance = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(truth)))])
    ends = np.searchsorted(distance, distance + 10.0)
    starts = np.flatnonzero(ends < len(truth))
    ends = ends[starts]
    align = np.exp(1j * (motion.heading_rad - heading))
    window = np.abs((track[ends] - track[starts]) * align[starts] - (truth[ends] - truth[starts]))
    whole = np.abs((track - track[0]) * align[0] - (truth - truth[0]))
    found = {
        "p95_10m": np.percentile(window, 95),
        "expected_10m": window.mean(),
        "end": whole[-1],
        "max": whole.max(),
    }
    return {name: round(float(value), 3) for name, value in found.items()}


def describe(sample: Sample, motion: Motion, columns: SensorColumns) -> dict[str, object]:
    """Return the content of the log's .json."""
    import mujoco

    robot = sample.robot
    icrs = fit_constant_icrs(motion, robot)
    half = robot.half_track_m
    path_m = float(np.hypot(np.diff(motion.north_m), np.diff(motion.east_m)).sum())
    return {
        "log": sample.name,
        "robot": robot.name,
        "seed": sample.seed,
        "duration_s": sample.duration_s,
        "distance_m": round(path_m, 2),
        "wheel_radius_m": robot.wheel_radius_m,
        "track_width_m": 2 * half,
        "encoder_counts_per_rev": COUNTS_PER_REV,
        "container": sample.options.container,
        "compression": sample.options.compression,
        "wheels": sample.options.wheels,
        "heading": sample.options.heading,
        "datum": {"latitude_deg": DATUM[0], "longitude_deg": DATUM[1], "height_m": DATUM[2]},
        "start_stamp_ns": START_NS,
        "icr_least_squares": {
            name: round(value, 4)
            for name, value in zip(("y_icr_right_m", "y_icr_left_m", "x_icr_m"), icrs, strict=True)
        },
        "open_loop": {
            "icr_m": open_loop_errors(motion, columns, icrs),
            "no_slip_m": open_loop_errors(motion, columns, (half, -half, 0.0)),
        },
        "mujoco": mujoco.__version__,
    }


if __name__ == "__main__":
    main()
