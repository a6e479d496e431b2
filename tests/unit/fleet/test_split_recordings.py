"""Files that a recorder split or restarted are one recording, by name and by time; others are not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from icrtool.config import load_config
from icrtool.fleet.recordings import find_recordings, logs_among
from icrtool.logs.containers.recording_files import numbered_file, split_files, split_path
from icrtool.logs.read_log import read_log
from icrtool.logs.write_log import SensorColumns, WriteOptions, write_log

START_NS = 1_760_000_000_000_000_000
CONFIG = load_config(sets=["robot.track_width_m=0.55", "robot.wheel_radius_m=0.165"])


def part(begin_s: float, end_s: float) -> SensorColumns:
    """A part of a drive straight ahead."""
    t = np.arange(begin_s, end_s, 0.1)
    stamps = START_NS + np.round(t * 1e9).astype(np.int64)
    same = np.full(len(t), 1.0)
    return SensorColumns(
        wheel_stamp_ns=stamps, wheel_position_left_m=t, wheel_position_right_m=t, wheel_v_left_mps=same,
        wheel_v_right_mps=same, gnss_stamp_ns=stamps, latitude_deg=47.0 + t / 111_180, longitude_deg=8.0 * same,
        height_m=same, gnss_std_m=0.02 * same, gnss_status=2 * np.ones(len(t), np.int64), heading_stamp_ns=stamps,
        heading_rad=0.0 * same, yaw_rate_radps=0.0 * same,
    )  # fmt: skip


def write(file: Path, begin_s: float, end_s: float, wheels: str = "joint_states") -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    kind = file.suffix[1:]
    options = WriteOptions(wheel_radius_m=0.165, track_width_m=0.55, container=kind, wheels=wheels)  # type: ignore[arg-type]
    return write_log(file, part(begin_s, end_s), options)


def logs(folder: Path) -> list[str]:
    return [one.log for one in find_recordings([folder])]


@pytest.mark.parametrize(
    ("name", "series", "number"),
    [
        ("drive_0.bag", "drive_", "0"),
        ("husky1_12.bag", "husky1_", "12"),
        ("p_2024-05-01-10-00-00_3.bag", "p_", "2024-05-01-10-00-00_3"),
        ("robot_1_2024-05-01-10-00-00.mcap", "robot_1_", "2024-05-01-10-00-00"),
        ("0.mcap", "", "0"),
    ],
)
def test_the_count_or_date_at_the_end_of_a_name_is_found(name: str, series: str, number: str) -> None:
    found = numbered_file(Path("x", name))
    assert found is not None
    assert (found.series[1], found.number) == (series, number)


@pytest.mark.parametrize("name", ["drive.bag", "drive2.bag", "drive_a.bag", "a_1.b"])
def test_other_names_have_none(name: str) -> None:
    found = numbered_file(Path(name))
    assert found is None or found.series[2] == ".b"


def test_a_split_is_one_recording_and_read_as_one(tmp_path: Path) -> None:
    whole = write(tmp_path / "whole.bag", 0, 30)
    for number, (begin, end) in enumerate([(0, 10), (10, 20), (20, 30)]):
        write(tmp_path / "s" / f"drive_{number + 8}.bag", begin, end)
    (one,) = find_recordings([tmp_path / "s"])
    assert (one.log, one.name) == ("drive_{8..10}.bag", "drive_8")
    joined, expected = read_log(one.path, CONFIG), read_log(whole, CONFIG)
    np.testing.assert_array_equal(joined.wheels.stamp_ns, expected.wheels.stamp_ns)
    np.testing.assert_array_equal(joined.gnss.north_m, expected.gnss.north_m)
    assert [Path(file.path).name for file in joined.inputs] == ["drive_8.bag", "drive_9.bag", "drive_10.bag"]
    assert logs_among([tmp_path / "s"])[0] == [one.path]
    assert split_path(split_files(one.path)) == one.path


def test_a_recorder_that_was_restarted_goes_on_within_a_minute(tmp_path: Path) -> None:
    write(tmp_path / "field_2024-05-01-10-00-00.mcap", 0, 10)
    write(tmp_path / "field_2024-05-01-10-00-40.mcap", 40, 50)
    write(tmp_path / "field_2024-05-01-10-05-00.mcap", 300, 310)
    assert logs(tmp_path) == [
        "field_2024-05-01-10-05-00.mcap",
        "field_{2024-05-01-10-00-00..2024-05-01-10-00-40}.mcap",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("names", "spans"),
    [
        (("husky_0.bag", "husky_2.bag"), ((0, 10), (10, 20))),
        (("husky1_0.bag", "husky2_0.bag"), ((0, 10), (10, 20))),
        (("robot_1.bag", "robot_2.bag"), ((0, 10), (5, 15))),
        (("robot_1_2024-01-01.bag", "robot_2_2024-01-01.bag"), ((0, 10), (10, 20))),
        (("drive_1.bag", "drive_2.bag"), ((0, 10), (600, 610))),
        (("drive_1.bag", "drive_2.bag"), ((10, 20), (0, 10))),
        (("drive_1.bag", "drive_2.mcap"), ((0, 10), (10, 20))),
        (("a/drive_1.bag", "b/drive_2.bag"), ((0, 10), (10, 20))),
    ],
)
def test_other_files_stay_apart(tmp_path: Path, names: tuple[str, str], spans: tuple[tuple[int, int], ...]) -> None:
    for name, span in zip(names, spans, strict=True):
        write(tmp_path / name, *span)
    assert sorted(logs(tmp_path)) == sorted(names)


def test_a_file_of_a_named_range_counts_once(tmp_path: Path) -> None:
    write(tmp_path / "drive_0.bag", 0, 10)
    write(tmp_path / "drive_1.bag", 10, 20)
    places = [tmp_path / "drive_{0..1}.bag", tmp_path / "drive_1.bag", tmp_path]
    assert [one.path for one in find_recordings(places)] == places[:1]
    assert split_files(tmp_path / "drive_{0..}.bag") == []
    assert split_files(tmp_path / "other_{0..1}.bag") == []


def test_a_damaged_file_of_a_series_stays_a_log_of_its_own(tmp_path: Path) -> None:
    write(tmp_path / "drive_0.bag", 0, 10)
    write(tmp_path / "drive_1.bag", 10, 20)
    (tmp_path / "drive_2.bag").write_bytes(b"#ROSBAG V2.0\n")
    assert logs(tmp_path) == ["drive_2.bag", "drive_{0..1}.bag"]


def test_a_range_names_only_files_that_begin_as_it_does(tmp_path: Path) -> None:
    for name in ("drive_20.bag", "drive_21.bag", "drive_0021.bag"):
        (tmp_path / name).touch()
    assert [file.name for file in split_files(tmp_path / "drive_2{0..3}.bag")] == ["drive_20.bag", "drive_21.bag"]
