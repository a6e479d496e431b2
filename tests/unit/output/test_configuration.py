"""The configuration as a TOML file with comments."""

from __future__ import annotations

import re
import tomllib
from dataclasses import fields, replace

import pytest

from icrtool.config import SECTIONS, Config, key_texts, load_config, parse_config
from icrtool.output.tables.configuration import format_configuration

KEYS = [(section, field.name) for section, kind in SECTIONS.items() for field in fields(kind)]


def shown(text: str, section: str, key: str) -> str:
    """Return the line of a key, without the mark of a comment."""
    part = text.partition(f"\n[{section}]\n")[2].partition("\n[")[0]
    (line,) = re.findall(rf"^#?({key} = .*)$", part, re.MULTILINE)
    return str(line)


def test_every_key_has_its_text_and_no_other_has_one() -> None:
    assert [(section, key) for section, keys in key_texts().items() for key in keys] == KEYS


def test_the_file_of_the_defaults_sets_nothing() -> None:
    document = tomllib.loads(format_configuration(Config()))
    assert parse_config(document) == Config()
    assert not parse_config(document).given


@pytest.mark.parametrize(("section", "key"), KEYS)
def test_a_line_without_its_mark_sets_the_default_or_a_possible_value(section: str, key: str) -> None:
    document = tomllib.loads(shown(format_configuration(Config()), section, key))
    default = Config().effective()[section][key]
    if default is not None:
        assert document[key] == default
    if key in ("wheel_left", "wheel_right"):
        document = {"wheel_left": "/left", "wheel_right": "/right"} | document
    if key in ("twist_speed", "twist_turn"):
        document = {"twist_speed": "speed", "twist_turn": "turn"} | document
    assert parse_config({section: document})


def test_a_changed_configuration_comes_back() -> None:
    config = load_config(
        robot="jackal", sets=['robot.name="a \\"b\\" ü"', "dropout.horizons_m=[2.5]", "wheels.left_joints=['fl', 'rl']"]
    )
    back = parse_config(tomllib.loads(format_configuration(config)))
    assert replace(back, given=frozenset()) == replace(config, given=frozenset())
    of_jackal = {"robot.track_width_m", "robot.wheel_radius_m", "robot.skid_factor"}
    assert back.given == of_jackal | {"robot.name", "dropout.horizons_m", "wheels.left_joints"}


def test_bounds_stand_behind_the_value() -> None:
    line = shown(format_configuration(Config()), "robot", "track_width_m")
    assert line.endswith("# a number ≥ 0.01 and ≤ 20; no default, this is an example")
