"""Definitions as Windows, editors and recorders leave them are read; a bundled type survives a damaged one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from icrtool.config import load_config
from icrtool.errors import DefinitionError
from icrtool.logs.containers.container import Channel
from icrtool.logs.messages.definition_text import SEPARATOR, plain_definition
from icrtool.logs.messages.definitions import definition_note, ros_definitions
from icrtool.logs.read_log import read_log, survey_log
from icrtool.records.text import LogText
from support.field_logs import ROBOT, joint_states, make_drive, reference, write_messages

STORE = get_typestore(Stores.ROS2_HUMBLE)
ROS1 = get_typestore(Stores.ROS1_NOETIC)
TYPES = ["sensor_msgs/msg/JointState", "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/Imu", "nav_msgs/msg/Odometry"]
DRIVE = make_drive(20.0)

WRITTEN: dict[str, Callable[[str], str]] = {
    "CRLF": lambda text: text.replace("\n", "\r\n"),
    "CR": lambda text: text.replace("\n", "\r"),
    "byte order mark": lambda text: f"\ufeff{text}",
    "byte order mark and CRLF": lambda text: "\ufeff" + text.replace("\n", "\r\n"),
    "no newline before a separator": lambda text: text.replace(f"\n{SEPARATOR}", SEPARATOR),
    "blank lines": lambda text: text.replace("\n", "\n\n"),
    "blank lines of spaces and CRLF": lambda text: text.replace("\n", " \r\n\t\r\n"),
    "short separators": lambda text: text.replace(SEPARATOR, "=" * 40),
    "a separator at the end": lambda text: f"{text}\n{SEPARATOR}\n",
    "no newline at the end": lambda text: text.rstrip("\n"),
    "names with msg": lambda text: text.replace("MSG: std_msgs/", "MSG: std_msgs/msg/"),
    "zeros at the end": lambda text: f"{text}\0\0",
    "comments with a line of signs": lambda text: f"# {SEPARATOR}\n# more\n#{SEPARATOR}\n{text}",
    "sentences for separators": lambda text: text.replace(f"{SEPARATOR}\nMSG: ", "Definition of "),
    "sentences after separators": lambda text: text.replace("MSG: ", "Definition of "),
}


def described(kind: str, text: str, encoding: str = "cdr") -> Channel:
    return Channel(0, LogText("/topic"), LogText(kind.replace("/msg/", "/")), LogText(encoding), text)


def fields(kind: str, text: str, encoding: str = "cdr") -> dict[str, object]:
    """The fields of a type and of all types in it."""
    definitions, left, found = ros_definitions(described(kind, text, encoding)), [kind], {}
    while left:
        name = left.pop()
        found[name] = [(field, int(node), str(detail)) for field, (node, detail) in definitions[name][1]]
        for _, (node, detail) in definitions[name][1]:
            inner = detail[0] if int(node) > 2 else (node, detail)
            left += [inner[1]] if int(inner[0]) == 2 and inner[1] not in found else []
    return found


@pytest.mark.parametrize("written", WRITTEN.values(), ids=WRITTEN)
@pytest.mark.parametrize("kind", TYPES)
def test_a_definition_is_read_however_its_lines_end(kind: str, written: Callable[[str], str]) -> None:
    text = STORE.generate_msgdef(kind, ros_version=2)[0]
    assert fields(kind, written(text)) == fields(kind, text)
    assert not definition_note(described(kind, written(text)))


@pytest.mark.parametrize("written", WRITTEN.values(), ids=WRITTEN)
def test_an_own_type_of_which_nothing_is_bundled_is_read_however_its_lines_end(
    written: Callable[[str], str],
) -> None:
    text = f"std_msgs/Header header\nown_msgs/Side[2] sides\n{SEPARATOR}\nMSG: own_msgs/Side\nint32 ticks\n"
    found = fields("own_msgs/msg/Base", written(text))
    assert found["own_msgs/msg/Side"] == [("ticks", 1, "('int32', 0)")]
    assert [name for name, *_ in found["own_msgs/msg/Base"]] == ["header", "sides"]


@pytest.mark.parametrize("kind", TYPES)
@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_a_definition_that_ends_anywhere_gives_the_fields_of_the_bundled_one(kind: str, encoding: str) -> None:
    store, version = (STORE, 2) if encoding == "cdr" else (ROS1, 1)
    text = store.generate_msgdef(kind, ros_version=version)[0].rstrip("\n") + "\n"
    whole = fields(kind, text, encoding)
    # Of a long text every 23rd place, and all of its first lines.
    for length in [*range(1, min(len(text), 400)), *range(400, len(text), 23)]:
        assert fields(kind, text[:length], encoding) == whole, text[:length]


def test_a_type_that_is_not_bundled_is_read_where_the_end_of_a_standard_type_is_missing() -> None:
    text = (
        f"std_msgs/Header header\nfloat64 left\n{SEPARATOR}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstr"
    )
    found = fields("own_msgs/msg/Base", text)
    assert [name for name, *_ in found["std_msgs/msg/Header"]] == ["stamp", "frame_id"]
    assert "ends within std_msgs/msg/Header" in definition_note(described("own_msgs/msg/Base", text))


def test_why_a_definition_is_not_read_names_its_line() -> None:
    text = "float64 left\nfloat64 right and then some words # not a definition\n"
    with pytest.raises(DefinitionError, match=r"cannot be parsed: at 'float64\[ right'"):
        ros_definitions(described("own_msgs/Base", "float64 left\nfloat64[ right\n"))
    assert plain_definition(text, "own_msgs/Base") == text
    with pytest.raises(DefinitionError, match="contains own_msgs/msg/Side, which is not defined there"):
        ros_definitions(described("own_msgs/Base", "Side left\nSide right\n"))


@pytest.mark.parametrize(
    "text", ["This file is not a definition.\n", "float64[ x\n", "<<<<<<< HEAD\nfloat64 x\n", "{}"], ids=repr
)
def test_a_bundled_type_with_a_damaged_definition_is_read_and_named(tmp_path: Path, text: str) -> None:
    damaged = {"sensor_msgs/msg/JointState": text}
    path = write_messages(tmp_path / "log.mcap", joint_states(DRIVE), reference(DRIVE), definitions=damaged)
    log = read_log(path, load_config(sets=ROBOT))
    np.testing.assert_allclose(log.wheels.left[:-1], DRIVE.left_radps[:-1], rtol=1e-6)
    (warning,) = (one for one in log.warnings if "bundled definition" in one)
    assert warning.startswith("log.mcap: /joint_states: the definition in the log ")


def test_a_ros1_connection_without_a_definition_uses_the_bundled_one() -> None:
    assert "seq" in [name for name, *_ in fields("sensor_msgs/msg/Imu", "", "ros1")["std_msgs/msg/Header"]]
    with pytest.raises(DefinitionError, match="carries no definition and not bundled"):
        ros_definitions(described("own_msgs/Base", "", "ros1"))


def test_a_log_recorded_on_windows_is_read_as_any_other(tmp_path: Path) -> None:
    streams = joint_states(DRIVE), reference(DRIVE)
    path = write_messages(tmp_path / "log.mcap", *streams, definitions=WRITTEN["byte order mark and CRLF"])
    log = read_log(path, load_config(sets=ROBOT))
    np.testing.assert_allclose(log.wheels.right[:-1], DRIVE.right_radps[:-1], rtol=1e-6)
    assert len(log.gnss.stamp_ns) == 100
    assert not log.warnings


def test_the_shared_log_with_definitions_of_windows_has_all_streams(shared_logs: Path) -> None:
    found = survey_log(shared_logs / "reports" / "07_definition_crlf.mcap").candidates
    assert [sources[0].problem for sources in found.by_role().values()] == ["", "", ""]
