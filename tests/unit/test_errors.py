"""Errors are one line that begins with what they are about; beside that name it is not repeated."""

from __future__ import annotations

from icrtool.errors import ConfigError, DataError
from icrtool.records.text import LogText


def test_beside_the_name_of_its_log_a_line_does_not_repeat_it() -> None:
    error = DataError("field", "too short", "drive longer")
    assert str(error) == "field: too short; drive longer"
    assert error.text_without("/logs/field", "field") == "too short; drive longer"
    assert error.text_without("other") == str(error)
    path = "/logs/" + "long/" * 30 + "field.mcap"
    assert DataError(LogText(path), "too short").text_without(path) == "too short"


def test_a_key_of_the_configuration_stays_in_its_line() -> None:
    assert ConfigError("robot.track_width_m", "is missing").text_without("field") == "robot.track_width_m: is missing"


def test_a_line_without_its_name_is_escaped_and_bounded_too() -> None:
    text = DataError("a", "\x1b[2J" + "n" * 10_000).text_without("a")
    assert text.isprintable()
    assert len(text) == len(str(DataError("a", "\x1b[2J" + "n" * 10_000)))
