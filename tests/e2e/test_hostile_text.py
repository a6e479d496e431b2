"""Hostile text in every field of every format that holds text, and every output looked at: it stays text.

Terminal escapes, line breaks, bidirectional overrides, markup, formulas and very long names, in names of topics, types,
joints, frames, files, runs and robots. None reaches a terminal, a page or a table as anything but its letters.
"""

from __future__ import annotations

import csv
import io
import json
import shutil
import sqlite3
import unicodedata
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from icrtool.logs.write_log import (
    TopicMessages,
    WriteOptions,
    header_stamps,
    load_typestore,
    serialise_topic,
    topic_plans,
    write_mcap,
    write_rosbag,
)
from tests.e2e.test_bad_input import OPTIONS, drive

Command = Callable[..., tuple[int, str, str]]

HOSTILE = (
    "\x1b[2J\x1b]0;t\x07\r\nError: forged\u202egnp\u2028\x9b31m$^{<script>alert(1)</script>|`[x](javascript:y)&\"'"
)
FORMULA = "=cmd|' -C calc'!A0"
LONG = "n" * 70_000
ROBOT = ("--set", "robot.track_width_m=0.55", "--set", "robot.wheel_radius_m=0.165")
FORBIDDEN = {"Cc", "Cf", "Zl", "Zp", "Cs", "Co", "Cn"}
LONGEST_LINE = 6000


def messages(options: WriteOptions, container: str) -> tuple[TopicMessages, ...]:
    """The messages of a short drive with hostile names in all texts; a string topic, and a second receiver."""
    columns, ros1 = drive(20.0), container == "bag"
    store = load_typestore(ros1=ros1)
    wheels, position, heading = topic_plans(columns, options)
    joints = [f"{name}{HOSTILE}" for name in wheels.fixed["name"]]
    joints[0] += LONG
    frames = {"header.frame_id": f"base_link{HOSTILE}"}
    plans = (
        replace(wheels, topic=f"{FORMULA}/joint_states{HOSTILE}", fixed={**wheels.fixed, **frames, "name": joints}),
        replace(position, topic=f"/gps/fix{HOSTILE}", fixed={**position.fixed, **frames}),
        replace(position, topic=f"/gps/other{HOSTILE}", fixed={**position.fixed, **frames}),
        replace(heading, topic=f"/imu/data{HOSTILE}", fixed={**heading.fixed, **frames}),
        replace(heading, topic=f"/imu/{LONG}{HOSTILE}", fixed={**heading.fixed, **frames},
                stamp_ns=heading.stamp_ns[:2], columns=header_stamps(heading.stamp_ns[:2])),
    )  # fmt: skip
    return tuple(serialise_topic(plan, store, ros1=ros1) for plan in plans)


def mcap(folder: Path) -> Path:
    topics = messages(OPTIONS, "mcap")
    unknown = f"x/msg/{HOSTILE}{LONG}"
    topics += (TopicMessages(f"/a{HOSTILE}", unknown, topics[0].stamp_ns[:1], np.zeros((1, 8), np.uint8)),)
    path = folder / f"{FORMULA.replace('/', '')}\x1b[2J\n\u202e$^{{<script>.mcap"
    store = load_typestore(ros1=False)
    write_mcap(path, topics, store, compression="none", metadata={HOSTILE: HOSTILE})
    return path


def bag(folder: Path) -> Path:
    path = folder / "\x1b[2J\n\u202e$^{<script>.bag"
    write_rosbag(path, messages(OPTIONS, "bag"), load_typestore(ros1=True), replace(OPTIONS, container="bag"))
    return path


def db3(folder: Path) -> Path:
    path = folder / "log"
    write_rosbag(path, messages(OPTIONS, "db3"), load_typestore(ros1=False), replace(OPTIONS, container="db3"))
    with sqlite3.connect(path / "log.db3") as database:
        database.execute("INSERT INTO topics SELECT 99, name || ?, ?, ?, '', '' FROM topics LIMIT 1", (HOSTILE,) * 3)
    database.close()
    return path.rename(folder / "\x1b[2J\n\u202e$^{<script>")


def table(folder: Path) -> Path:
    columns = drive(20.0)
    names = ("t_s", "v_left_mps", "v_right_mps", "north_m", "east_m", "heading_rad", HOSTILE.replace('"', ""))
    t = (columns.wheel_stamp_ns - columns.wheel_stamp_ns[0]) / 1e9
    north, east = 2.7 * np.sin(0.3 * t), 2.7 * (1 - np.cos(0.3 * t))
    rows = zip(t, columns.wheel_v_left_mps, columns.wheel_v_right_mps, north, east, columns.heading_rad, strict=True)
    path = folder / "\x1b[2J\n\u202e$^{<script>.csv"
    quoted = [f'"{name}"' for name in names]
    path.write_text("\n".join([",".join(quoted), *(",".join(map(repr, map(float, row))) + "," for row in rows)]))
    return path


def check_printed(text: str, where: str) -> None:
    """Refuse any character that a terminal acts on, and lines of an unreasonable length."""
    # A word joiner behind an at sign is ours: it keeps Markdown from addressing people.
    text = text.replace("@\N{WORD JOINER}", "@")
    bad = {letter for letter in text if unicodedata.category(letter) in FORBIDDEN and letter not in "\n\t"}
    assert not bad, f"{where}: {bad}"
    lines = text.split("\n")
    assert not [line for line in lines if line.startswith("Error: forged")], where
    assert max(map(len, lines)) < LONGEST_LINE, where


def check_files(folder: Path) -> None:
    """Look at every text that was written."""
    for path in sorted(folder.rglob("*")):
        if not path.is_file():
            continue
        if path.suffix in (".json", ".geojson", ".icrtool-files"):
            json.loads(path.read_text())
        elif path.suffix == ".csv":
            for row in csv.reader(io.StringIO(path.read_text())):
                assert not [cell for cell in row if cell[:1] in "=@\t\r" and cell], path
                for cell in row:
                    check_printed(cell, str(path))
        elif path.suffix in (".svg", ".xml", ".kml"):
            found = {element.tag.rpartition("}")[2] for element in ET.parse(path).iter()}
            assert "script" not in found, path
            check_printed(path.read_text(), str(path).replace(str(folder), "")) if path.suffix == ".xml" else None
        elif path.suffix in (".html", ".md"):
            text = path.read_text()
            assert "<script>alert" not in text, path
            if path.suffix == ".md":
                assert "](javascript:" not in text, path
                check_printed(text, str(path))


@pytest.mark.usefixtures("without_drawing")
@pytest.mark.parametrize("make", [bag, db3, table])
def test_text_from_a_log_stays_text(make: Callable[[Path], Path], tmp_path: Path, icrtool: Command) -> None:
    check_text(make, tmp_path, icrtool)


def test_text_from_a_log_stays_text_in_all_that_is_written_of_it(tmp_path: Path, icrtool: Command) -> None:
    check_text(mcap, tmp_path, icrtool)


def check_text(make: Callable[[Path], Path], tmp_path: Path, icrtool: Command) -> None:
    """Call commands on a log; of an MCAP log all of them, and pictures are drawn."""
    logs, out = tmp_path / "logs", tmp_path / "out"
    logs.mkdir()
    out.mkdir()
    path = make(logs)
    run = out / "run"
    plots = "svg" if make is mcap else "none"
    calls: list[tuple[object, ...]] = [
        ("info", path, *ROBOT),
        ("fit", path, *ROBOT, "-o", run, "--plots", plots, "-v"),
        ("dropout-report", run, "--plots", plots, "--gate", "icr.p95@5m <= 0.0001", "--junit", out / "j.xml",
         "--markdown", out / "m.md", *(() if make is mcap else ("--no-ladder",))),
        ("calibrate", run, "-o", out / "cal.json"),
    ]  # fmt: skip
    if make is mcap:
        calls += [
            ("batch", logs, *ROBOT, "-o", out / "season", "--plots", "none", "--no-ladder", "-j", "1"),
            ("compare", f"a{HOSTILE.replace('/', '')}={run}", f"{FORMULA}={run}", "--csv", out / "c.csv"),
            ("compare", f"a={run}", f"{FORMULA}={run}", "-o", out / "c.json", "-q"),
            ("export", run, "--for", "qgis", "-o", out / "q.geojson"),
            ("export", run, "--for", "google-earth", "-o", out / "g.kml"),
            ("export", out / "cal.json", "--for", "clearpath"),
            ("export", out / "cal.json", "--for", "nav2"),
            ("fit", path, *ROBOT, "--set", f'robot.name="{HOSTILE[:4]}"'),
            ("fit", logs / f"gone{HOSTILE.replace('/', '')}"),
            ("fit", path, "--set", f"{HOSTILE}={HOSTILE}"),
            ("dropout-report", out / "run", "--gate", HOSTILE),
            ("fit", path, "--robot", HOSTILE),
        ]  # fmt: skip
    for call in calls:
        status, printed, errors = icrtool(*call)
        name = str(call[0])
        assert status in (0, 1, 2, 3), (name, errors)
        assert "Traceback" not in errors, errors
        check_printed(printed, f"{name}: stdout")
        check_printed(errors, f"{name}: stderr")
        if name in ("fit", "info") and call[1] == path and len(call) > 4 and "robot.name" not in str(call):
            assert status == 0, errors
    check_files(out)
    topics = {stream["topic"] for stream in json.loads((run / "run.json").read_text())["streams"]}
    if make is not table:
        assert any(HOSTILE in topic for topic in topics), "JSON holds the text as it is in the log"
    shutil.rmtree(out)
