"""Measure what `icrtool.AdaptiveModel` costs: ``benchmarks/on_board.py [SECONDS] [--gyro]``, of a drive at 100 Hz."""

from __future__ import annotations

import argparse
import time

import numpy as np

from icrtool.motion.adaptive import AdaptiveModel
from icrtool.motion.robot_prior import prior_of_robots

RATE_HZ, WIDTH_M = 100.0, 0.6


def main() -> None:
    """Drive curves, and print microseconds a sample."""
    ask = argparse.ArgumentParser(description=__doc__)
    ask.add_argument("seconds", nargs="?", type=float, default=600.0)
    ask.add_argument("--gyro", action="store_true")
    given = ask.parse_args()
    rng, n = np.random.default_rng(0), int(given.seconds * RATE_HZ)
    t = np.arange(n) / RATE_HZ
    left, right = 0.6 + 0.35 * np.sin(0.5 * t), 0.6 + 0.3 * np.sin(0.31 * t + 1.0)
    omega = 0.55 * (left - right) / WIDTH_M
    heading = np.cumsum(omega) / RATE_HZ
    place = np.cumsum((left + right) / 2.0 * np.exp(1j * heading)) / RATE_HZ
    place += 0.01 * (rng.normal(size=n) + 1j * rng.normal(size=n))
    rows = zip(*(one.tolist() for one in (t, left, right, place.real, place.imag, heading, omega)), strict=True)
    model, lasting, solutions = AdaptiveModel(prior_of_robots(WIDTH_M), with_gyro=given.gyro), [], []
    for at, v_left, v_right, north, east, psi, gyro in rows:
        begin = time.perf_counter()
        solved = model.observe(at, v_left, v_right, (north, east, psi), gyro)
        lasting.append(time.perf_counter() - begin)
        if solved:
            solutions.append(lasting[-1])
    begin = time.perf_counter()
    for _ in range(1000):
        model.twist(0.5, 0.4, 0.1)
    twist_us = 1e3 * (time.perf_counter() - begin)
    us = 1e6 * np.array(lasting)
    print(f"{n:,} samples, {model.distance_m:.0f} m, {len(solutions)} solutions")
    print(f"observe: {us.mean():.1f} us a sample on average, {np.median(us):.1f} us the usual one")
    print(f"a solution: {1e3 * np.mean(solutions):.1f} ms on average, {1e3 * max(solutions):.1f} ms the longest")
    print(f"twist: {twist_us:.0f} us")


if __name__ == "__main__":
    main()
