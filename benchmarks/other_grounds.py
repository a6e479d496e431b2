"""Whether the interval of another ground holds: ``benchmarks/other_grounds.py [--robots 30] [--seed 7] [--gyro]``.

Each simulated robot of `benchmarks/ground_drives.py` drives on four grounds. The interval that two or three of them
give for p95 on a further one (9 of 10; `icrtool.calibration.other_grounds`) is compared with p95 on a ground that is in
none of them, driven with the numbers of these two or three. Table: rows and distances, how often p95 lies in the
interval, and how often below its upper end. A robot takes about 15 s of CPU, with ``--gyro`` 30 s.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Sequence
from itertools import combinations

import numpy as np
from ground_drives import TrueDrive, measure, simulate_grounds

import icrtool
from icrtool.calibration.other_grounds import leave_grounds_out
from icrtool.calibration.pooled import turning_recording_of
from icrtool.config import parse_config
from icrtool.errors import IcrToolError
from icrtool.kernels.error_statistics import ground_interval
from icrtool.motion.recording import Recording
from icrtool.records.calibration_document import GroundScore
from icrtool.records.rows import row_of

GROUNDS, AT_M = 4, (5.0, 10.0, 20.0)
Key = tuple[int, str, float]
"""Number of grounds that are known, row, distance [m]."""


def recordings_of(number: int, drives: dict[str, TrueDrive], *, gyro: bool) -> dict[str, Recording]:
    """Return the recordings of a robot by ground, of the drives that are usable."""
    found = {}
    for place, (name, drive) in enumerate(drives.items()):
        config = parse_config({"robot": {"track_width_m": drive.width_m, "wheel_radius_m": drive.radius_m}})
        run = icrtool.fit(measure(drive, 100 * number + place, gyro=gyro), config)
        if run.usable:
            found[name] = turning_recording_of(run)
    return found


def by_row(scores: Sequence[GroundScore]) -> dict[tuple[str, float], dict[str, float]]:
    """Return p95 [m] of each row and distance, by ground."""
    found: dict[tuple[str, float], dict[str, float]] = defaultdict(dict)
    for one in scores:
        found[one.model, one.horizon_m][one.ground] = one.p95_m
    return found


def compare(recordings: dict[str, Recording], held: dict[Key, list[tuple[bool, bool]]]) -> None:
    """Add whether p95 on the last ground lies in the interval of each two and each three of the others."""
    *others, last = recordings
    for count in range(2, len(others) + 1):
        for known in combinations(others, count):
            some = [recordings[name] for name in known]
            given = by_row(leave_grounds_out(some, known))
            shown = by_row(leave_grounds_out([*some, recordings[last]], [*known, last]))
            for (row, metres), p95_m in given.items():
                true_m = shown.get((row, metres), {}).get(last)
                if metres in AT_M and len(p95_m) == count and true_m is not None:
                    low, high = ground_interval(np.array(list(p95_m.values())), row_of(row).spread.grounds)
                    held[count, row, metres].append((low <= true_m <= high, true_m <= high))


def main() -> None:
    """Simulate, compare and print."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("--robots", type=int, default=30)
    ask.add_argument("--seed", type=int, default=7)
    ask.add_argument("--gyro", action="store_true")
    given = ask.parse_args()
    held: dict[Key, list[tuple[bool, bool]]] = defaultdict(list)
    for number, drives in enumerate(simulate_grounds(given.robots, given.seed, GROUNDS)):
        try:
            compare(recordings_of(number, drives, gyro=given.gyro), held)
        except IcrToolError as err:
            print(f"robot {number}: left out: {err}", flush=True)
        print(f"{number + 1} robots", flush=True)
    for (count, row, metres), pairs in sorted(held.items()):
        inside, below = np.mean(pairs, axis=0).tolist()
        print(f"{count} grounds  {row:18} {metres:4g} m  {len(pairs):4} intervals  {inside:.2f}  {below:.2f}")


if __name__ == "__main__":
    main()
