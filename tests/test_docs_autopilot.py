"""The page on autopilots: its Python turns a log of each autopilot into a table, and its commands find the ICRs."""

from __future__ import annotations

import json
import math
import re
import shlex
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from pymap3d import ned2geodetic

from icrtool.cli.commands import icrtool as command_line
from support.drives import EPOCH_NS, ICRS, make_log

PAGE = (Path(__file__).resolve().parents[1] / "docs" / "how-to" / "autopilot.md").read_text(encoding="utf-8")
RADIUS_M = 0.15
DRIVE = make_log(4, 60.0)
LATITUDE, LONGITUDE, _ = ned2geodetic(DRIVE.gnss.north_m, DRIVE.gnss.east_m, 0.0, 48.1, 11.6, 0.0)
STEP_S = np.diff(DRIVE.wheels.stamp_ns, prepend=DRIVE.wheels.stamp_ns[0]) / 1e9
SIDES = DRIVE.wheels.v_left_mps, DRIVE.wheels.v_right_mps
LEFT_M, RIGHT_M = (np.cumsum(np.append(0.0, side[:-1]) * STEP_S) for side in SIDES)


def micros(stamps_ns: np.ndarray) -> list[int]:
    """Return times since the autopilot started."""
    return ((stamps_ns - EPOCH_NS) // 1000 + 5_000_000).tolist()


def write_ulog(path: Path) -> None:
    """Write what PX4 logs of the drive (https://docs.px4.io/main/en/dev_log/ulog_file_format)."""
    formats = {
        "wheel_encoders": "uint64_t timestamp;float[2] wheel_speed;float[2] wheel_angle;",
        "vehicle_gps_position": "uint64_t timestamp;double latitude_deg;double longitude_deg;float eph;"
        "uint8_t fix_type;",
        "vehicle_attitude": "uint64_t timestamp;float[4] q;",
    }
    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)]

    def add(kind: str, content: bytes) -> None:
        parts.append(struct.pack("<Hc", len(content), kind.encode()) + content)

    add("B", bytes(40))
    for name, fields in formats.items():
        add("F", f"{name}:{fields}".encode())
    for number, name in enumerate(formats):
        add("A", struct.pack("<BH", 0, number) + name.encode())
    for i, t_us in enumerate(micros(DRIVE.wheels.stamp_ns)):
        angles = RIGHT_M[i] / RADIUS_M, LEFT_M[i] / RADIUS_M
        add("D", struct.pack("<HQ4f", 0, t_us, 0.0, 0.0, *angles))
    for i, t_us in enumerate(micros(DRIVE.gnss.stamp_ns)):
        place = (LATITUDE[i], LONGITUDE[i]) if i % 50 else (0.0, 0.0)
        add("D", struct.pack("<HQ2dfB", 1, t_us, *place, 0.01, 6 if i % 50 else 0))
    for t_us, heading in zip(micros(DRIVE.heading.stamp_ns), DRIVE.heading.heading_rad.tolist(), strict=True):
        add("D", struct.pack("<HQ4f", 2, t_us, math.cos(heading / 2), 0.0, 0.0, math.sin(heading / 2)))
    path.write_bytes(b"".join(parts))


def write_dataflash(path: Path) -> None:
    """Write what ArduPilot logs of the drive (libraries/AP_Logger/LogStructure.h)."""
    formats = {
        129: ("WENC", "Qfbfb", "<Qfbfb", "TimeUS,Dist0,Qual0,Dist1,Qual1"),
        130: ("GPS", "QBLL", "<QBii", "TimeUS,Status,Lat,Lng"),
        131: ("GPA", "QC", "<QH", "TimeUS,HAcc"),
        132: ("ATT", "Qf", "<Qf", "TimeUS,Yaw"),
    }
    parts = [
        b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", 128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")
    ]
    for number, (name, kinds, packed, columns) in formats.items():
        described = (name.encode(), kinds.encode(), columns.encode())
        size = struct.calcsize(packed) + 3
        parts.append(b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", number, size, *described))

    def add(number: int, *values: float) -> None:
        parts.append(b"\xa3\x95" + bytes([number]) + struct.pack(formats[number][2], *values))

    for i, t_us in enumerate(micros(DRIVE.wheels.stamp_ns)):
        add(129, t_us, LEFT_M[i], 100, RIGHT_M[i], 100)
        add(132, t_us, math.degrees(DRIVE.heading.heading_rad[i]) % 360)
    for i, t_us in enumerate(micros(DRIVE.gnss.stamp_ns)):
        add(131, t_us, 1)
        add(130, t_us, 6 if i % 50 else 0, round(LATITUDE[i] * 1e7), round(LONGITUDE[i] * 1e7))
    path.write_bytes(b"".join(parts))


@pytest.mark.parametrize(
    ("section", "library", "write", "log"),
    [("PX4", "pyulog", write_ulog, "rover.ulg"), ("ArduPilot", "pymavlink", write_dataflash, "rover.bin")],
)
def test_the_recipe_of_an_autopilot_makes_a_table_that_fits(
    section: str,
    library: str,
    write: Callable[[Path], None],
    log: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip(library)
    monkeypatch.chdir(tmp_path)
    write(tmp_path / log)
    recipe = re.findall(r"```python\n(.*?)```", PAGE.split(f"\n## {section}\n")[1], re.DOTALL)[0]
    exec(recipe, {})
    commands = re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)[-1].splitlines()
    for line in commands:
        result = CliRunner().invoke(command_line, shlex.split(line)[1:])
        assert result.exit_code == 0, (line, result.output)
    run = json.loads((tmp_path / "icrtool-runs" / "rover" / "run.json").read_text(encoding="utf-8"))
    found = [run["icr"]["final"][name] for name in ("y_icr_right_m", "y_icr_left_m", "x_icr_m")]
    np.testing.assert_allclose(found, ICRS, atol=0.06)
    assert run["usable"]
