"""What a drive teaches for the next one: ``benchmarks/next_drive.py [--robots 28] [--seed 40] [--csv FILE]``.

Each simulated robot of `benchmarks/ground_drives.py` is calibrated from drive A. Drive B on the same ground, and C on
another one, are reported with this calibration; the reports of B and C without it show what robots in general teach.
Tables: error after 10 m, geometric mean over the robots whose drive A is usable, and its ratio to rows ``icr`` and
``calibration``; how often p95 of B and C, and the distance within 0.5 m, lie in the interval that the report of A
states of the next drive. A CSV holds every row of every report. A robot takes about 15 s of CPU.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from ground_drives import DRIVES, TrueDrive, measure, simulate

import icrtool
from icrtool.config import parse_config
from icrtool.errors import IcrToolError
from icrtool.records.fleet_document import BUDGET_M

AT_M = 10.0
ROWS = (
    "no_slip", "icr", "calibration", "recommended", "adaptive", "adaptive alone",
    "icr_gyro", "calibration_gyro", "recommended_gyro", "adaptive_gyro",
)  # fmt: skip


class Found(NamedTuple):
    """One row of the report of a drive at one horizon."""

    robot: int
    drive: str
    usable: bool
    model: str
    horizon_m: float
    trials: int
    expected_m: float
    p95_m: float
    p95_low_m: float
    p95_high_m: float
    p95_next_low_m: float
    p95_next_high_m: float
    within_m: float
    within_next_low_m: float
    within_next_high_m: float


NEXT_ROWS = {
    "no_slip": "no_slip", "icr": "icr", "recommended": "calibration", "adaptive": "adaptive alone",
    "icr_gyro": "icr_gyro", "recommended_gyro": "calibration_gyro", "adaptive_gyro": "adaptive_gyro alone",
}  # fmt: skip
"""Row of the report of drive A, and the row of drives B and C that drives with the same knowledge."""

SPREAD_AT_M = (5.0, 10.0, 20.0)


def report_robot(number: int, drives: dict[str, TrueDrive]) -> Iterator[Found]:
    """Yield the rows of the reports of a robot's drives, B and C with the calibration of A."""
    calibration = None
    for name in DRIVES:
        drive = drives[name]
        config = parse_config({"robot": {"track_width_m": drive.width_m, "wheel_radius_m": drive.radius_m}})
        run = icrtool.fit(measure(drive, 10 * number + ord(name)), config)
        used = [] if calibration is None else [calibration]
        yield from found(number, name, icrtool.dropout_report(run, calibrations=used, allow_unusable=True))
        if calibration is None:
            calibration = icrtool.calibrate(run, allow_unusable=True)
        else:
            alone = found(number, name, icrtool.dropout_report(run, allow_unusable=True))
            yield from (one._replace(model=f"{one.model} alone") for one in alone if one.model.startswith("adaptive"))


def found(number: int, name: str, report: icrtool.DropoutReport) -> Iterator[Found]:
    """Yield the rows of a report."""
    columns = ["horizon_m", "trials", "expected_error_m", "p95_m", "p95_low_m", "p95_high_m"]
    columns += ["p95_next_low_m", "p95_next_high_m"]
    within = {one.model: one for one in report.document.budgets if one.budget_m == BUDGET_M}
    for model, rows in report.summary.groupby("model", sort=False):
        one = within.get(str(model))
        reach = (np.nan, np.nan, np.nan)
        if one is not None:
            # an end that is not known stays within the budget at every horizon
            low_m = one.next_low_m if one.next_low_m is not None else one.distance_m if one.beyond else 0.0
            high_m = np.inf if one.next_high_m is None else one.next_high_m
            reach = np.inf if one.beyond else one.distance_m, low_m, high_m
        for row in rows[columns].itertuples(index=False):
            yield Found(number, name, report.usable, str(model), *row, *reach)


def geometric_means(rows: list[Found], drive: str) -> dict[str, tuple[float, float]]:
    """Return expected error and p95 at 10 m by model, over the robots whose drive A is usable."""
    usable = {row.robot for row in rows if row.drive == "A" and row.usable}
    means = {}
    for model in ROWS:
        errors = [
            (row.expected_m, row.p95_m)
            for row in rows
            if row.model == model and row.drive == drive and row.horizon_m == AT_M and row.robot in usable
        ]
        if errors:
            expected, p95 = np.exp(np.nanmean(np.log(errors), axis=0)).tolist()
            means[model] = expected, p95
    return means


def reaches(rows: list[Found], drive: str) -> Iterator[tuple[str, int, float, float]]:
    """Yield how often the distance within `BUDGET_M` of a drive is what the report of drive A states of the next one.

    Row, robots, share in the interval, share at or above its lower end (``within_next``).
    """
    usable = {row.robot for row in rows if row.drive == "A" and row.usable}
    by_key = {(row.robot, row.drive, row.model): row for row in rows if row.robot in usable}
    for before, after in NEXT_ROWS.items():
        pairs = [(by_key.get((robot, "A", before)), by_key.get((robot, drive, after))) for robot in usable]
        both = [(a, b) for a, b in pairs if a and b and np.isfinite([a.within_next_low_m]).all() and b.within_m >= 0.0]
        if both:
            reached = np.array([b.within_m >= a.within_next_low_m for a, b in both])
            inside = np.array([b.within_m <= a.within_next_high_m for a, b in both])
            yield before, len(both), float((reached & inside).mean()), float(reached.mean())


def spreads(rows: list[Found], drive: str) -> Iterator[tuple[str, float, int, float, float, float]]:
    """Yield what p95 of a drive is, over p95 of drive A of the same robot: the numbers of `icrtool.records.rows`.

    Row, horizon [m], robots, geometric mean of the ratio, standard deviation of its logarithm, and how often the drive
    lies in the interval that the report of drive A states of the next one.
    """
    usable = {row.robot for row in rows if row.drive == "A" and row.usable}
    by_key = {(row.robot, row.drive, row.model, row.horizon_m): row for row in rows if row.robot in usable}
    for before, after in NEXT_ROWS.items():
        for horizon_m in SPREAD_AT_M:
            pairs = [
                (by_key.get((robot, "A", before, horizon_m)), by_key.get((robot, drive, after, horizon_m)))
                for robot in usable
            ]
            both = [(a, b) for a, b in pairs if a and b and a.p95_m > 0.0 and b.p95_m > 0.0]
            if both:
                ratio = np.log([b.p95_m / a.p95_m for a, b in both])
                held = np.mean([a.p95_next_low_m <= b.p95_m <= a.p95_next_high_m for a, b in both])
                yield before, horizon_m, len(both), float(np.exp(ratio.mean())), float(ratio.std()), float(held)


def main() -> None:
    """Simulate, report and print."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("--robots", type=int, default=28)
    ask.add_argument("--seed", type=int, default=40)
    ask.add_argument("--csv", type=Path)
    given = ask.parse_args()
    rows: list[Found] = []
    for number, drives in enumerate(simulate(given.robots, given.seed)):
        try:
            rows += report_robot(number, drives)
        except IcrToolError as err:
            print(f"robot {number}: left out: {err}", flush=True)
    if given.csv is not None:
        with given.csv.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([Found._fields, *rows])
    for drive, words in (("A", "its own drive"), ("B", "the same ground"), ("C", "another ground")):
        means = geometric_means(rows, drive)
        print(f"\ndrive {drive}, {words}: expected / 95 % after {AT_M:g} m; expected over icr, over calibration")
        for model, (expected, p95) in means.items():
            over = [expected / means[one][0] if one in means else float("nan") for one in ("icr", "calibration")]
            print(f"{model:18} {expected:.3f} / {p95:.3f} m   {over[0]:.2f}  {over[1]:.2f}")
    for drive, words in (("B", "the same ground"), ("C", "another ground")):
        print(
            f"\ndrive {drive}, {words}: p95 over p95 of drive A: geometric mean, std of the logarithm, in the interval"
        )
        for model, horizon_m, count, mean, std, held in spreads(rows, drive):
            print(f"{model:18} {horizon_m:4g} m  {count:3} robots  {mean:.2f}  {std:.2f}  {held:.2f}")
        print(f"within {BUDGET_M:g} m: in the interval of the next drive, and at or above its lower end")
        for model, count, held, least in reaches(rows, drive):
            print(f"{model:18}         {count:3} robots  {held:.2f}  {least:.2f}")


if __name__ == "__main__":
    main()
