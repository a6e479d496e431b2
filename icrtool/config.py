"""Validated configuration: built-in robot < TOML file < ``--set`` < option. Out again as plain data for run.json."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from icrtool.errors import ConfigError

Positive = Annotated[float, Field(strict=True, gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(strict=True, ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Probability = Annotated[float, Field(strict=True, gt=0, lt=1)]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class RobotConfig(_Section):
    """The robot: `track_width_m` is b of Eqs. 38-39, the distance between the centre lines of the tracks."""

    name: str | None = None
    track_width_m: Positive | None = None
    wheel_radius_m: Positive | None = None
    encoder_counts_per_rev: Positive | None = None


class TopicsConfig(_Section):
    """Topics by role. What is left out is found by type and content."""

    wheels: str | None = None
    wheel_left: str | None = None
    wheel_right: str | None = None
    gnss: str | None = None
    heading: str | None = None

    @model_validator(mode="after")
    def _one_way_to_name_the_wheels(self) -> TopicsConfig:
        if (self.wheel_left is None) != (self.wheel_right is None):
            raise ValueError("wheel_left and wheel_right come together")
        if self.wheels is not None and self.wheel_left is not None:
            raise ValueError("give wheels, or wheel_left and wheel_right, not both")
        return self


class WheelsConfig(_Section):
    """How wheel messages become speeds.

    Scales multiply the travel of a side (1.02: the wheel is 2 % larger); ``auto`` is 1, or what the position reference
    says of both sides where that is clear (preset ``field``).
    """

    left_joints: tuple[str, ...] = ()
    right_joints: tuple[str, ...] = ()
    quantity: Literal["auto", "position", "velocity", "counts"] = "auto"
    left_scale: Literal["auto"] | Finite = "auto"
    right_scale: Literal["auto"] | Finite = "auto"

    @model_validator(mode="after")
    def _possible(self) -> WheelsConfig:
        if self.left_scale == 0 or self.right_scale == 0:
            raise ValueError("a scale of 0 would stop a side")
        return self


class FramesConfig(_Section):
    """Where sensors sit and what their yaw means.

    `antenna_*`: the antenna from the body origin; ``auto`` is what the log's own ``/tf_static`` says, else 0.
    `reference_delay_s`, `heading_delay_s`: how late position reference and heading are against the wheels; ``auto``
    takes out what is clear (preset ``field``).
    """

    heading: Literal["auto", "enu", "ned"] = "auto"
    heading_offset_deg: Literal["auto"] | Finite = "auto"
    reference_delay_s: Literal["auto"] | Finite = "auto"
    heading_delay_s: Literal["auto"] | Finite = "auto"
    antenna_forward_m: Literal["auto"] | Finite = "auto"
    antenna_right_m: Literal["auto"] | Finite = "auto"
    datum: tuple[Annotated[float, Field(ge=-90, le=90)], Annotated[float, Field(ge=-180, le=360)]] | None = None


class FilterConfig(_Section):
    """The EKF of Section 3. A value left out is the preset's.

    `process_*` are the square roots of Q's diagonal (Eq. 30), as at the paper's 100 Hz; `gnss_std_m` and
    `heading_std_deg` those of R (Eq. 31), used where the messages do not say. `process_position_mps` is 0.2 (Eq. 30);
    in preset ``field``, ``auto`` starts at 0.3 and raises it when the fixes contradict wheels this good.
    `process_heading_degps` is 5 (Eq. 30), in preset ``field`` 7.
    `terrain_icr_std_m` is how uncertain the ICRs are after a terrain change: 10 (Section 5.2), in preset ``field`` the
    robot's width.
    `heading_correlation_s` is how long an AHRS errs alike: closer samples are not independent (``field`` only).
    """

    preset: Literal["field", "paper"] = "field"
    initial_y_icr_right_m: Finite | None = None
    initial_y_icr_left_m: Finite | None = None
    initial_x_icr_m: Finite | None = None
    initial_icr_std_m: Positive | None = None
    process_position_mps: Literal["auto"] | NotNegative = "auto"
    process_heading_degps: NotNegative | None = None
    process_icr_mps: NotNegative = 0.01
    terrain_icr_std_m: Positive | None = None
    gnss_std_m: Positive = 0.01
    gnss_std_floor_m: Positive = 0.01
    heading_std_deg: Positive = 1.0
    heading_std_floor_deg: Positive = 0.5
    heading_correlation_s: NotNegative = 0.5
    gate_probability: Probability = 0.9999
    wheel_gap_s: Positive = 0.5


class DropoutConfig(_Section):
    """The analysis of Section 6.4."""

    horizons_m: tuple[Positive, ...] = tuple(float(d) for d in range(1, 21))
    forced_outage_s: tuple[Positive, ...] = ()

    @model_validator(mode="after")
    def _at_least_one(self) -> DropoutConfig:
        if not self.horizons_m:
            raise ValueError("horizons_m is empty")
        if len(set(self.horizons_m)) != len(self.horizons_m):
            raise ValueError("horizons_m names a distance twice")
        return self


class Config(_Section):
    """Everything a scientist would change. Frozen; `effective` is what run.json records."""

    robot: RobotConfig = RobotConfig()
    topics: TopicsConfig = TopicsConfig()
    wheels: WheelsConfig = WheelsConfig()
    frames: FramesConfig = FramesConfig()
    filter: FilterConfig = FilterConfig()
    dropout: DropoutConfig = DropoutConfig()

    def effective(self) -> dict[str, Any]:
        """Return the configuration as plain JSON data, section by section."""
        return self.model_dump(mode="json")


def builtin_robots() -> dict[str, dict[str, Any]]:
    """Return the robots known by name, with the source of their numbers."""
    return tomllib.loads(resources.files("icrtool").joinpath("robots.toml").read_text(encoding="utf-8"))


def load_config(path: str | Path | None = None, robot: str | None = None, sets: Iterable[str] = ()) -> Config:
    """Load a configuration: built-in robot < TOML file < `sets`.

    Parameters
    ----------
    path : TOML file, or None
    robot : name of a built-in robot, or None
    sets : ``section.key=value`` texts; the value is TOML, or a bare word for a string

    Raises
    ------
    ConfigError
        Unknown robot, unreadable file, unknown key, wrong type or impossible value; the key is named.
    """
    layers: list[Mapping[str, Any]] = []
    if robot is not None:
        layers.append({"robot": _builtin_robot(robot)})
    if path is not None:
        layers.append(_read_toml(Path(path)))
    layers.extend(_parse_set(text) for text in sets)
    merged: dict[str, Any] = {}
    for layer in layers:
        for section, values in layer.items():
            if isinstance(values, Mapping) and isinstance(merged.get(section, {}), dict):
                merged[section] = {**merged.get(section, {}), **values}
            else:
                merged[section] = values
    try:
        return Config.model_validate(merged)
    except ValidationError as err:
        raise _first_problem(err) from err


def _builtin_robot(name: str) -> dict[str, Any]:
    robots = builtin_robots()
    if name not in robots:
        raise ConfigError(
            f"robot {name!r}",
            "not a built-in robot",
            f"one of {', '.join(robots)}, or --set robot.track_width_m=… robot.wheel_radius_m=…",
        )
    return {"name": name, **{key: value for key, value in robots[name].items() if key != "source"}}


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as err:
        raise ConfigError(path, "cannot be read", err.strerror or str(err)) from err
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as err:
        raise ConfigError(path, "not a TOML file", str(err)) from err


def _parse_set(text: str) -> dict[str, Any]:
    key, equals, value = text.partition("=")
    section, dot, name = key.strip().partition(".")
    if not (equals and dot and section and name):
        raise ConfigError(
            f"--set {text}", "not of the form section.key=value", "for example --set topics.gnss=/gps/fix"
        )
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        parsed = value.strip()
    return {section: {name: parsed}}


def _first_problem(err: ValidationError) -> ConfigError:
    problem = err.errors(include_url=False)[0]
    location = [str(part) for part in problem["loc"]]
    key = ".".join(part for part in location[:2]) or "configuration"
    if problem["type"] == "extra_forbidden":
        return ConfigError(key, "unknown configuration key", _known_keys(location))
    message = problem["msg"].removeprefix("Value error, ")
    given = problem["input"]
    found = f"found {given!r}" if isinstance(given, str | int | float | bool | list) else "see the configuration page"
    return ConfigError(key, message[:1].lower() + message[1:], found)


def _known_keys(location: list[str]) -> str:
    sections = Config.model_fields
    if len(location) > 1 and location[0] in sections:
        model = sections[location[0]].annotation
        fields = model.model_fields if model is not None else {}
        return f"[{location[0]}] knows {', '.join(fields)}"
    return f"the sections are {', '.join(sections)}"
