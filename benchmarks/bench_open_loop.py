"""Time the dropout kernels: fast against direct integration on 1 h at 100 Hz, and cost per state from 10 min to 10 h.

Run it on an idle machine: ``python benchmarks/bench_open_loop.py [--quick]``. One core; compilation is not counted.
"""

from __future__ import annotations

import statistics
import sys
import time
import tracemalloc
from collections.abc import Callable

import numpy as np

from icrtool.kernels.arrays import Floats
from icrtool.kernels.equal_steps import ROWS_AT_ONCE
from icrtool.kernels.open_loop.direct import open_loop_errors_direct, trial_ends
from icrtool.kernels.open_loop.error_statistics import bootstrap_intervals, cut_blocks, error_summary
from icrtool.kernels.open_loop.prefix_sums import open_loop_errors
from icrtool.kernels.open_loop.trials import Drive, FrozenIcrs

RATE_HZ = 100
HORIZONS_M = np.arange(1.0, 21.0)
NO_SLIP = FrozenIcrs.constant(0.305, -0.305, 0.0)


def drive_around(hours: float) -> tuple[Drive, FrozenIcrs]:
    """Return a winding drive at 1 m/s whose ICRs converge in the first seconds and then change slowly."""
    rng = np.random.default_rng(0)
    n = int(hours * 3600 * RATE_HZ)
    t = np.arange(n) / RATE_HZ
    speed = 1.0 + 0.3 * np.sin(t / 9.5)
    turn = 0.4 * np.sin(t / 5.9) + 0.3 * np.sin(t / 1.8)
    wander = np.cumsum(rng.normal(0.0, 6e-5, (2, n)), axis=1)
    wander -= np.linspace(0.0, 1.0, n) * wander[:, -1:]
    y_right = 0.75 + wander[0] + 0.02 * np.sin(t / 48.0) - 0.45 * np.exp(-t / 5.0)
    y_left = -0.72 + wander[1] + 0.02 * np.sin(t / 34.0) + 0.41 * np.exp(-t / 6.0)
    x = 0.05 + 0.01 * np.sin(t / 15.0)

    def integral(rate: Floats) -> Floats:
        return np.concatenate([np.zeros(1), np.cumsum(rate / RATE_HZ)[:-1]])

    heading = integral(turn)
    north = integral(speed * np.cos(heading) + turn * x * np.sin(heading))
    east = integral(speed * np.sin(heading) - turn * x * np.cos(heading))
    distance = integral(np.hypot(speed, turn * x))
    none = np.zeros(n, dtype=bool)
    dt_s = np.full(n, 1.0 / RATE_HZ)
    drive = Drive(dt_s, speed - turn * y_left, speed - turn * y_right, north, east, heading, distance, none, none)
    return drive, FrozenIcrs(y_right, y_left, x)


def seconds(job: Callable[[], object], repeats: int) -> float:
    """Return the median time of `job`."""
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        job()
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def by_ranges(drive: Drive, icrs: FrozenIcrs) -> None:
    """Compute all errors, a range of starts at a time, as memory allows on the longest logs."""
    n = len(drive.dt_s)
    for lo in range(0, n, ROWS_AT_ONCE):
        ends = trial_ends(drive, HORIZONS_M, lo, min(lo + ROWS_AT_ONCE, n))
        open_loop_errors(drive, icrs, ends, lo)


def compare(hours: float) -> None:
    """Print the times of the fast and the direct integration, and of the statistics of one model."""
    drive, icrs = drive_around(hours)
    ends = trial_ends(drive, HORIZONS_M)
    print(f"{hours * 60:.0f} min at {RATE_HZ} Hz, {len(drive.dt_s)} starts x {len(HORIZONS_M)} horizons, one core")
    print(f"  trial ends, for all models   {seconds(lambda: trial_ends(drive, HORIZONS_M), 9):8.3f} s")
    for name, model in (("momentary ICRs", icrs), ("no-slip", NO_SLIP)):
        fast = seconds(lambda model=model: open_loop_errors(drive, model, ends), 9)
        begin = time.perf_counter()
        expected = open_loop_errors_direct(drive, model, ends)
        direct = time.perf_counter() - begin
        apart = np.nanmax(np.abs(open_loop_errors(drive, model, ends) - expected))
        print(
            f"  {name:14s} direct {direct:7.2f} s, fast {fast:6.3f} s: {direct / fast:4.0f} x, equal to {apart:.0e} m"
        )
    errors = open_loop_errors(drive, NO_SLIP, ends)
    print(f"  percentiles of a model       {seconds(lambda: error_summary(errors), 5):8.3f} s")

    def bootstrap() -> None:
        blocks = [cut_blocks(column >= 0, drive.distance, h) for column, h in zip(ends.T, HORIZONS_M, strict=True)]
        bootstrap_intervals(errors, blocks, seed=0)

    resampling = seconds(bootstrap, 5)
    print(f"  bootstrap of a model         {resampling:8.3f} s")


def grow(hours: list[float]) -> None:
    """Print the cost per state and the memory as the log grows."""
    for length in hours:
        drive, icrs = drive_around(length)
        n = len(drive.dt_s)
        cost = seconds(lambda drive=drive, icrs=icrs: by_ranges(drive, icrs), max(1, int(5 / max(length, 1))))
        tracemalloc.start()
        by_ranges(drive, icrs)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        print(f"{length * 60:6.0f} min: {cost:7.3f} s, {1e6 * cost / n:5.2f} us a state, peak {peak / 1e6:.0f} MB")


def main() -> None:
    """Print all measurements; ``--quick`` leaves out what takes longer than a few seconds."""
    quick = "--quick" in sys.argv[1:]
    by_ranges(*drive_around(0.01))
    open_loop_errors_direct(*drive_around(0.01), np.zeros((1, 1), dtype=np.int64))
    compare(1 / 6 if quick else 1.0)
    print(f"ends and errors by ranges of {ROWS_AT_ONCE} starts, momentary ICRs")
    grow([1 / 6, 1.0] if quick else [1 / 6, 1.0, 10.0])


if __name__ == "__main__":
    main()
