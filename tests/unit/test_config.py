"""Configuration: layers, and errors that name the key."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import icrtool
from icrtool.config import builtin_robots, load_config, parse_config
from icrtool.errors import ConfigError


def test_robot_file_and_set_override_each_other_in_this_order(tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    file.write_text("[robot]\ntrack_width_m = 0.6\n[filter]\npreset = 'paper'\n")
    config = load_config(file, robot="husky-a200", sets=["filter.preset=field"])
    assert config.robot.name == "husky-a200"
    assert config.robot.track_width_m == 0.6
    assert config.robot.wheel_radius_m == 0.1651
    assert config.filter.preset == "field"


@pytest.mark.parametrize("name", builtin_robots())
def test_every_built_in_robot_loads_and_names_its_source(name: str) -> None:
    assert load_config(robot=name).robot.track_width_m
    assert builtin_robots()[name]["source"]


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("filter.foo=1", "filter.foo"),
        ("robots.name=x", "robots"),
        ("robot.track_width_m=-1", "robot.track_width_m"),
        ("robot.track_width_m='0.5'", "robot.track_width_m"),
        ("robot.track_width_m=true", "robot.track_width_m"),
        ("frames.heading=north", "frames.heading"),
        ("filter.gnss_std_m=nan", "filter.gnss_std_m"),
        ("filter.gate_probability=1.0", "filter.gate_probability"),
        ("wheels.left_scale=0", "wheels"),
        ("topics.wheel_left=/a", "topics"),
        ("dropout.horizons_m=[]", "dropout"),
        ("dropout.horizons_m=[1, 1]", "dropout"),
        ("frames.datum=[100, 0]", "frames.datum"),
        ("frames.heading=north - at `$.yaw`", "frames.heading"),
        ("robot.name=bo\udcff", "robot.name"),
        ("robot.track_width_m=1" + 5000 * "0", "robot.track_width_m"),
    ],
)
def test_an_unusable_value_is_an_error_that_names_its_key(text: str, key: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(sets=[text])
    assert str(caught.value).startswith(key)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["robot", "robot=1", "=", "robot.=1", ".x=1"])
def test_a_set_that_is_not_section_key_value_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match=r"section\.key=value"):
        load_config(sets=[text])


def test_an_unknown_robot_lists_the_known_ones() -> None:
    with pytest.raises(ConfigError, match="husky-a200"):
        load_config(robot="r2d2")


@pytest.mark.parametrize("content", [b"[robot", b"\xff\xfe\x00", b"[robot]\ntrack_width_m = 1" + 5000 * b"0"])
def test_a_file_that_is_no_toml_is_refused(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "bad.toml"
    file.write_bytes(content)
    with pytest.raises(ConfigError, match="not a TOML file"):
        load_config(file)


def test_a_bare_word_is_a_string() -> None:
    assert load_config(sets=["topics.gnss=/gps/fix"]).topics.gnss == "/gps/fix"


def test_the_effective_configuration_loads_back_as_itself() -> None:
    config = load_config(robot="jackal", sets=["dropout.horizons_m=[1, 2.5]", "frames.datum=[40.0, -77.0]"])
    assert parse_config(config.effective()) == config


def test_the_package_face_has_the_names_it_promises() -> None:
    for name in icrtool.__all__:
        assert getattr(icrtool, name) is not None
    with pytest.raises(AttributeError):
        _ = icrtool.nonsense


@pytest.mark.parametrize(
    ("sets", "message"),
    [
        (["wheels.left_scale=0"], "wheels.left_scale: 0 would stop a side; found 0"),
        (["topics.wheel_left=/l"], "topics.wheel_left: one side alone; wheel_left and wheel_right come together"),
        (["dropout.horizons_m=[]"], "dropout.horizons_m: is empty; give one distance or more"),
        (["dropout.horizons_m=[1, 1]"], "dropout.horizons_m: names a distance twice; give each once"),
        (["robot.name=true"], "robot.name: expected a text; found true"),
        (["topics.gnss="], "topics.gnss: its value is empty; leave the option out for the default"),
    ],
)
def test_what_is_wrong_is_said_of_a_key_in_the_words_of_toml(sets: list[str], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(sets=sets)
    assert str(caught.value) == message


def test_a_file_may_begin_with_a_byte_order_mark(tmp_path: Path) -> None:
    (tmp_path / "robot.toml").write_text("[robot]\ntrack_width_m = 0.5\n", encoding="utf-8-sig")
    assert load_config(tmp_path / "robot.toml").robot.track_width_m == 0.5


@pytest.mark.parametrize(
    ("typed", "number"), [(".08", 0.08), ("8e-2", 0.08), ("+.5", 0.5), ("1.", 1.0), ("2.e-1", 0.2), ("1", 1.0)]
)
def test_numbers_are_read_as_people_type_them(typed: str, number: float) -> None:
    assert load_config(sets=[f"robot.wheel_radius_m={typed}"]).robot.wheel_radius_m == number


def test_numbers_in_a_list_are_read_as_people_type_them() -> None:
    assert load_config(sets=["dropout.horizons_m=[.5, 1., 2]"]).dropout.horizons_m == (0.5, 1.0, 2.0)


@pytest.mark.parametrize("text", ["/gps.5/fix", "v.1", "1.2.3"])
def test_a_text_with_points_stays_as_it_is(text: str) -> None:
    assert load_config(sets=[f"topics.gnss={text}"]).topics.gnss == text


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        ({"robot": "husky"}, "husky-a200"),
        ({"robot": "Jackel"}, "jackal"),
        ({"sets": ["robot.trackwidth_m=1"]}, "track_width_m"),
        ({"sets": ["robots.name=x"]}, "robot"),
    ],
)
def test_the_error_about_a_misspelled_name_proposes_the_right_one(given: dict[str, Any], meant: str) -> None:
    with pytest.raises(ConfigError, match=rf"did you mean {meant}\?"):
        load_config(**given)


def test_a_name_unlike_all_others_gets_no_proposal() -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(robot="turtle")
    assert "did you mean" not in str(caught.value)
    assert "jackal" in str(caught.value)
