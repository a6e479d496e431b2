"""The kernels of the analysis without GNSS against direct integration, both compiled: a section of `make bench`."""

from __future__ import annotations

import numpy as np
from table import Table, cpu_seconds_of

from icrtool.kernels.arrays import Floats
from icrtool.kernels.error_statistics import RankedTrials, block_sums, cut_blocks, error_intervals, error_summary
from icrtool.kernels.open_loop import open_loop_errors, open_loop_errors_direct
from icrtool.kernels.track import FrozenIcrs, Track, trial_ends
from icrtool.records.rows import GIVEN_SPREAD

RATE_HZ = 100
HORIZONS_M = np.arange(1.0, 21.0)
NO_SLIP = FrozenIcrs.constant(0.305, -0.305, 0.0)
LARGEST_DIFFERENCE_M = 1e-6
"""Both add up a hundred thousand steps, in another order."""


def drive_around(hours: float) -> tuple[Track, FrozenIcrs]:
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
    left, right, held = speed - turn * y_left, speed - turn * y_right, np.full(n, 1.0 / RATE_HZ)
    return Track.of_states(t, held, left, right, north, east, heading, distance), FrozenIcrs(y_right, y_left, x)


def open_loop_rows(table: Table, hours: float, repeats: int) -> None:
    """Add the times of the analysis of one model; one core, compilation is not counted."""
    tiny = drive_around(0.01)
    open_loop_errors_direct(*tiny, np.zeros((1, 1), np.int32))
    drive, icrs = drive_around(hours)
    ends = trial_ends(drive, HORIZONS_M)
    by_direct = "by direct integration, compiled"
    for name, model in (("momentary ICRs", icrs), ("no slip", NO_SLIP)):
        [direct] = cpu_seconds_of(lambda model=model: open_loop_errors_direct(drive, model, ends), 1, warm_up=False)
        fast = cpu_seconds_of(lambda model=model: open_loop_errors(drive, model, ends), repeats)
        table.add(f"open loop, {name}, {len(HORIZONS_M)} horizons", fast, direct, by_direct, goal="100 times")
        apart_m = np.nanmax(np.abs(open_loop_errors(drive, model, ends) - open_loop_errors_direct(drive, model, ends)))
        if not apart_m < LARGEST_DIFFERENCE_M:
            raise SystemExit(f"open loop, {name}: {apart_m:.1e} m apart from direct integration")
    errors = open_loop_errors(drive, NO_SLIP, ends)

    summary = error_summary(errors)

    def intervals() -> None:
        for h, horizon in enumerate(HORIZONS_M):
            blocks, p95 = cut_blocks(ends[:, h] >= 0, drive.distance, horizon), float(summary.p95[h])
            ranked = RankedTrials.from_errors(errors[:, h])
            sums = block_sums(errors[:, h], blocks, ranked, float(summary.p50[h]), p95)
            error_intervals(errors[:, h], blocks, sums, float(summary.p50[h]), p95, GIVEN_SPREAD)

    jobs = {
        "trial ends, for all models": lambda: trial_ends(drive, HORIZONS_M),
        "percentiles of a model": lambda: error_summary(errors),
        "intervals of a model": intervals,
    }
    for name, job in jobs.items():
        table.add(name, cpu_seconds_of(job, repeats), direct, f"for its errors {by_direct}")
