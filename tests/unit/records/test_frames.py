"""A log from data frames: what the columns mean, and the same ICRs as the log that they were written from."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from icrtool import RobotLog, fit, load_config, read_log
from icrtool.errors import DataError
from icrtool.records.tables import RobotLog as Log
from support.drives import EPOCH_NS, make_log

ICR_TOLERANCE_M = 1e-9
"""Speeds are divided by the radius and multiplied again; the filter carries the rounding on."""

CONFIG = load_config(sets=["robot.track_width_m=1.0", "robot.wheel_radius_m=0.2"])


def frames_of(log: Log) -> dict[str, pd.DataFrame]:
    t_s = {name: (getattr(log, name).stamp_ns - EPOCH_NS) / 1e9 for name in ("wheels", "gnss", "heading")}
    wheels = pd.DataFrame(
        {"t_s": t_s["wheels"], "v_left_radps": log.wheels.left / 0.2, "v_right_radps": log.wheels.right / 0.2}
    )
    gnss = log.gnss
    std = {"north_std_m": np.sqrt(gnss.var_north_m2), "east_std_m": np.sqrt(gnss.var_east_m2)}
    position = pd.DataFrame({"t_s": t_s["gnss"], "north_m": gnss.north_m, "east_m": gnss.east_m, **std})
    yaw = math.pi / 2 - log.heading.heading_rad
    heading = pd.DataFrame({"t_s": t_s["heading"], "yaw_rad": yaw, "heading_std_rad": np.sqrt(log.heading.var_rad2)})
    return {"wheels": wheels, "position": position, "heading": heading}


def icrs(log: Log) -> list[float]:
    final = fit(log, CONFIG).summary["icr"]["final"]
    return [final[key] for key in ("y_icr_right_m", "y_icr_left_m", "x_icr_m")]


@pytest.fixture(scope="module")
def log() -> Log:
    return make_log()


def test_frames_give_the_icrs_of_the_log(log: Log) -> None:
    assert icrs(RobotLog.from_frames(**frames_of(log))) == pytest.approx(icrs(log), abs=ICR_TOLERANCE_M)


def test_one_sparse_table_in_any_order_gives_the_icrs_of_the_log(log: Log, tmp_path: Path) -> None:
    path = tmp_path / "drive.csv"
    table = pd.concat(frames_of(log).values(), ignore_index=True)
    table.sample(frac=1, random_state=1).to_csv(path, index=False)
    assert icrs(read_log(path, CONFIG)) == pytest.approx(icrs(log), abs=ICR_TOLERANCE_M)


def test_a_table_is_cut_by_its_stamps(log: Log, tmp_path: Path) -> None:
    path = tmp_path / "drive.csv"
    pd.concat(frames_of(log).values(), ignore_index=True).to_csv(path, index=False)
    whole, part = read_log(path, CONFIG), read_log(path, CONFIG, start=5, end=15.0)
    first = min(whole.wheels.stamp_ns[0], whole.gnss.stamp_ns[0], whole.heading.stamp_ns[0])
    inside = (whole.wheels.stamp_ns >= first + 5 * 10**9) & (whole.wheels.stamp_ns < first + 15 * 10**9)
    assert part.wheels.stamp_ns.tolist() == whole.wheels.stamp_ns[inside].tolist()


@pytest.mark.parametrize(
    ("group", "change", "named"),
    [
        ("wheels", {"drop": "v_right_radps"}, "v_left_radps"),
        ("wheels", {"drop": "t_s"}, "stamp_ns or t_s"),
        ("position", {"drop": "north_m"}, "north_m and east_m"),
        ("heading", {"drop": "yaw_rad"}, "heading_rad or heading_deg"),
        ("position", {"text": "east_m"}, "column east_m"),
        ("position", {"drop": "east_std_m"}, "only north_std_m of a pair"),
        ("heading", {"empty": "yaw_rad"}, "yaw_rad"),
        ("heading", {"huge": "t_s"}, "column t_s"),
    ],
)
def test_a_bad_column_is_named(log: Log, group: str, change: dict[str, str], named: str) -> None:
    frames = frames_of(log)
    ((how, column),) = change.items()
    bad = {"text": "north", "empty": np.nan, "huge": 1e300}
    frame = frames[group].drop(columns=column) if how == "drop" else frames[group].assign(**{column: bad[how]})
    with pytest.raises(DataError, match=named):
        RobotLog.from_frames(**{**frames, group: frame})


def test_geographic_positions_are_about_the_first_one() -> None:
    t = np.arange(3.0)
    wheels = pd.DataFrame({"t_s": t, "pos_left_m": t, "pos_right_m": 2 * t})
    position = pd.DataFrame({"t_s": t, "latitude_deg": 50 + 1e-5 * t, "longitude_deg": 8.0, "height_m": 100.0})
    log = RobotLog.from_frames(wheels, position, pd.DataFrame({"t_s": t, "heading_deg": [350.0, 10.0, 90.0]}))
    assert log.gnss.north_m == pytest.approx([0.0, 1.1123, 2.2246], abs=1e-3)
    assert log.wheels.v_right_mps.tolist() == [2.0, 2.0, 2.0]
    assert log.heading.heading_rad == pytest.approx(np.radians([-10, 10, 90]))
