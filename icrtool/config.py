"""The validated configuration. Its layers, the later ones win: built-in robot, TOML file, ``--set``, option.

``config_keys.toml`` has the meaning of each key; ``icrtool config`` prints it with types, bounds and defaults. run.json
holds the effective configuration as plain data.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from importlib import resources
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

import msgspec

from icrtool.errors import ConfigError
from icrtool.records.places import read_regular
from icrtool.records.presets import PRESETS, Preset
from icrtool.records.text import LONGEST_NAME, did_you_mean, shortened

LARGEST_FILE_BYTES = 1 << 20
MOST_LIST_ITEMS = 1000
"""Most entries in a list of horizons or outages."""

_DEEP_KEY = re.compile(r"(?<![\w\"'.-])(?:[\w\"'-]+\s*\.\s*){64}")
"""Pattern of a key of more than 64 parts, which is refused."""

_BARE_POINT = re.compile(r"(?<![\w.])(?=\.\d)|(?<=\d\.)(?![\w.])|(?<=\d\.)(?=[eE])")
"""Pattern of the places in numbers where TOML requires a zero that people leave out (``.5``, ``1.``)."""

Horizon = Annotated[float, msgspec.Meta(ge=0.001, le=1e5)]
Duration = Annotated[float, msgspec.Meta(gt=0, le=1e5)]
Positive = Annotated[float, msgspec.Meta(gt=0, le=1e9)]
Std = Annotated[float, msgspec.Meta(gt=0, le=1e4)]
Noise = Annotated[float, msgspec.Meta(ge=0, le=1e4)]
Coordinate = Annotated[float, msgspec.Meta(ge=-1000, le=1000)]
Delay = Annotated[float, msgspec.Meta(ge=-100, le=100)]
Degrees = Annotated[float, msgspec.Meta(ge=-720, le=720)]
SideScale = Annotated[float, msgspec.Meta(ge=-1000, le=1000)]
Width = Annotated[float, msgspec.Meta(ge=0.01, le=20)]
SkidFactor = Annotated[float, msgspec.Meta(gt=0, le=100)]
Radius = Annotated[float, msgspec.Meta(ge=0.001, le=5)]
Probability = Annotated[float, msgspec.Meta(gt=0, lt=1)]
Latitude = Annotated[float, msgspec.Meta(ge=-90, le=90)]
Longitude = Annotated[float, msgspec.Meta(ge=-180, le=360)]


@dataclass(frozen=True, slots=True)
class RobotConfig:
    """The robot: `track_width_m` is b of Eqs. 38-39, `skid_factor` the published multiplier of b."""

    name: str | None = None
    track_width_m: Width | None = None
    wheel_radius_m: Radius | None = None
    encoder_counts_per_rev: Positive | None = None
    skid_factor: SkidFactor | None = None


@dataclass(frozen=True, slots=True)
class TopicsConfig:
    """Topics by role, the clock of their stamps, and whether the stated status of fixes is used."""

    wheels: str | None = None
    wheel_left: str | None = None
    wheel_right: str | None = None
    twist_speed: str | None = None
    twist_turn: str | None = None
    gnss: str | None = None
    heading: str | None = None
    clock: Literal["auto", "header", "log"] = "auto"
    gnss_status: Literal["stated", "ignored"] = "stated"

    def __post_init__(self) -> None:
        if (self.wheel_left is None) != (self.wheel_right is None):
            raise ValueError("wheel_left: one side alone; wheel_left and wheel_right come together")
        if self.wheels is not None and self.wheel_left is not None:
            raise ValueError("wheels: the wheels are named twice; give it, or wheel_left and wheel_right")
        if (self.twist_speed is None) != (self.twist_turn is None):
            raise ValueError("twist_speed: one part alone; twist_speed and twist_turn come together")
        if self.twist_speed is not None and (self.wheels is not None or self.wheel_left is not None):
            raise ValueError("twist_speed: the wheels are named twice; give twist_speed and twist_turn, or the wheels")

    @property
    def fields_of_wheels(self) -> dict[str, str]:
        """The configured fields of the wheels by key: of both sides, or of a body twist; empty without fields."""
        keys = ("wheel_left", "wheel_right") if self.wheel_left is not None else ("twist_speed", "twist_turn")
        named = {key: getattr(self, key) for key in keys}
        return {} if None in named.values() else named


@dataclass(frozen=True, slots=True)
class WheelsConfig:
    """How wheel messages become speeds."""

    left_joints: tuple[str, ...] = ()
    right_joints: tuple[str, ...] = ()
    quantity: Literal["auto", "position", "velocity", "counts"] = "auto"
    unit: Literal["auto", "rad/s", "m/s", "rpm", "deg/s", "counts"] = "auto"
    twist_width_m: Width | None = None
    left_scale: Literal["auto"] | SideScale = "auto"
    right_scale: Literal["auto"] | SideScale = "auto"

    def __post_init__(self) -> None:
        for key in ("left_scale", "right_scale"):
            if getattr(self, key) == 0:
                raise ValueError(f"{key}: 0 would stop a side; found 0")


@dataclass(frozen=True, slots=True)
class FramesConfig:
    """Positions of sensors on the robot, and the convention, offset and delay of the heading."""

    heading: Literal["auto", "enu", "ned"] = "auto"
    heading_offset_deg: Literal["auto"] | Degrees = "auto"
    reference_delay_s: Literal["auto"] | Delay = "auto"
    heading_delay_s: Literal["auto"] | Delay = "auto"
    gyro_delay_s: Literal["auto"] | Delay = "auto"
    antenna_forward_m: Literal["auto"] | Coordinate = "auto"
    antenna_right_m: Literal["auto"] | Coordinate = "auto"
    datum: tuple[Latitude, Longitude] | None = None


@dataclass(frozen=True, slots=True)
class FilterConfig:
    """The EKF of Pentzer 2014, Section 3.

    `process_*` are the square roots of the diagonal of Q (Eq. 30) at the paper's 100 Hz. `gnss_std_m` and
    `heading_std_deg` are the standard deviations of R (Eq. 31). `terrain_icr_std_m` is described in Section 5.2. For a
    key without a value the preset has the value.
    """

    preset: Literal["field", "paper"] = "field"
    initial_y_icr_right_m: Coordinate | None = None
    initial_y_icr_left_m: Coordinate | None = None
    initial_x_icr_m: Coordinate | None = None
    initial_icr_std_m: Std | None = None
    process_position_mps: Literal["auto"] | Noise = "auto"
    process_heading_degps: Noise | None = None
    process_icr_mps: Noise = 0.01
    terrain_icr_std_m: Std | None = None
    gnss_std_m: Literal["auto"] | Std = "auto"
    gnss_std_floor_m: Std = 0.01
    heading_std_deg: Literal["auto"] | Std = "auto"
    heading_std_floor_deg: Std = 0.5
    heading_correlation_s: Noise = 0.5
    gate_probability: Probability = 0.9999
    wheel_gap_s: Duration = 0.5

    @property
    def rules(self) -> Preset:
        """The record of the preset."""
        return PRESETS[self.preset]


@dataclass(frozen=True, slots=True)
class DropoutConfig:
    """Distances and forced outages of the analysis without GNSS (Pentzer 2014, Section 6.4)."""

    horizons_m: tuple[Horizon, ...] = tuple(float(d) for d in range(1, 21))
    forced_outage_s: tuple[Duration, ...] = ()

    def __post_init__(self) -> None:
        for key in ("horizons_m", "forced_outage_s"):
            if (count := len(getattr(self, key))) > MOST_LIST_ITEMS:
                raise ValueError(f"{key}: {count} numbers; at most {MOST_LIST_ITEMS} are analysed")
        if not self.horizons_m:
            raise ValueError("horizons_m: is empty; give one distance or more")
        if len(set(self.horizons_m)) != len(self.horizons_m):
            raise ValueError("horizons_m: names a distance twice; give each once")


@dataclass(frozen=True, slots=True)
class Config:
    """All settings of a run; a frozen record. `icrtool config` explains each key, run.json holds the effective values.

    Attributes
    ----------
    robot : name, track width [m], wheel radius [m], encoder counts
    topics : where wheels, position and heading are read from; None: found by type and content
    wheels : joints, quantity and scales of the sides
    frames : heading convention and offset [deg], delays [s], antenna position [m], datum [deg, deg, m]
    filter : preset, start, noise, gates
    dropout : distances without GNSS [m], forced outages [s]
    given : the keys that robot, file or ``--set`` set, as ``section.key``; the other keys have their defaults
    """

    robot: RobotConfig = RobotConfig()
    topics: TopicsConfig = TopicsConfig()
    wheels: WheelsConfig = WheelsConfig()
    frames: FramesConfig = FramesConfig()
    filter: FilterConfig = FilterConfig()
    dropout: DropoutConfig = DropoutConfig()
    given: frozenset[str] = field(default=frozenset(), compare=False)

    def effective(self) -> dict[str, Any]:
        """Return the configuration as plain JSON data, section by section."""
        document: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(self))
        return {section: document[section] for section in SECTIONS}

    def with_filter(self, **changes: float | str) -> Config:
        """Return the configuration with other values in ``[filter]``."""
        return replace(self, filter=replace(self.filter, **changes))  # type: ignore[arg-type]  # as the caller names them


SECTIONS: dict[str, type] = {part.name: type(part.default) for part in fields(Config) if part.name != "given"}
"""Types of the sections of a configuration file, by name."""


def parse_config(document: Mapping[str, Any]) -> Config:
    """Return a configuration from plain data, section by section.

    Raises
    ------
    ConfigError
        Unknown key, wrong type or impossible value; the key is named.
    """
    sections, given = {}, []
    for name, values in document.items():
        if name not in SECTIONS:
            meant = did_you_mean(name, SECTIONS)
            raise ConfigError(name, "unknown configuration key", f"{meant}the sections are {', '.join(SECTIONS)}")
        if not isinstance(values, Mapping):
            raise ConfigError(name, "this is a section of the configuration", _found(values))
        keys = [key.name for key in fields(SECTIONS[name])]
        for key, value in values.items():
            if key not in keys:
                listed = f"{did_you_mean(key, keys)}[{name}] knows {', '.join(keys)}"
                raise ConfigError(f"{name}.{key}", "unknown configuration key", listed)
            if flaw := _flaw(value):
                raise ConfigError(f"{name}.{key}", flaw, _found(value))
        sections[name] = _parse_section(name, values)
        given += [f"{name}.{key}" for key in values]
    return Config(**sections, given=frozenset(given))


def builtin_robots() -> dict[str, dict[str, Any]]:
    """Return the robots known by name, with the source of their numbers."""
    return tomllib.loads(resources.files("icrtool").joinpath("robots.toml").read_text(encoding="utf-8"))


def key_texts() -> dict[str, dict[str, dict[str, Any]]]:
    """Return by section and key the meaning (``text``), and an ``example`` for a key without default."""
    return tomllib.loads(resources.files("icrtool").joinpath("config_keys.toml").read_text(encoding="utf-8"))


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
        robots = builtin_robots()
        if robot not in robots:
            others = f"{did_you_mean(robot, robots)}the robots are {', '.join(robots)}"
            advice = "of another one, give --set robot.track_width_m=… and --set robot.wheel_radius_m=…"
            raise ConfigError(f"robot {robot!r}", "not a built-in robot", f"{others}; {advice}")
        numbers = {key: value for key, value in robots[robot].items() if key != "source"}
        layers.append({"robot": {"name": robot, **numbers}})
    if path is not None:
        layers.append(_read_toml(Path(path)))
    layers.extend(_parse_set(text) for text in sets)
    merged: dict[str, Any] = {}
    for layer in layers:
        for section, values in layer.items():
            both = isinstance(values, Mapping) and isinstance(merged.get(section, {}), dict)
            merged[section] = {**merged.get(section, {}), **values} if both else values
    return parse_config(merged)


class ConfigSources(NamedTuple):
    """Sources of a configuration: the arguments of `load_config`."""

    file: Path | None = None
    robot: str | None = None
    sets: tuple[str, ...] = ()

    def load(self) -> Config:
        """Return the configuration; the errors are the errors of `load_config`."""
        return load_config(*self)


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return parse_toml(read_regular(path, most_bytes=LARGEST_FILE_BYTES).decode("utf-8-sig"))
    except RecursionError as err:
        raise ConfigError(path, "not a configuration", "its values are nested too deeply") from err
    except OSError as err:
        raise ConfigError(path, "cannot be read", err.strerror or str(err)) from err
    except ValueError as err:  # no UTF-8, no TOML, or an integer longer than Python reads
        raise ConfigError(path, "not a TOML file", str(err)) from err


def parse_toml(text: str) -> dict[str, Any]:
    """Return the content of a TOML text as dicts, lists, texts and numbers.

    Raises
    ------
    RecursionError
        Its values, or the parts of its keys, are nested too deeply: tomllib takes gigabytes for a key of 20,000 parts.
    ValueError
        The text is not TOML.
    """
    if _DEEP_KEY.search(text):
        raise RecursionError
    return tomllib.loads(text)


def _parse_set(text: str) -> dict[str, Any]:
    key, equals, value = text.partition("=")
    section, dot, name = key.strip().partition(".")
    if not (equals and dot and section and name):
        why, advice = "not of the form section.key=value", "for example --set topics.gnss=/gps/fix"
        owners = [
            f"{one}.{key.strip()}" for one, kind in SECTIONS.items() for two in fields(kind) if two.name == key.strip()
        ]
        if owners:
            why, advice = "the section of the key is missing", f"did you mean {' or '.join(owners)}?"
        raise ConfigError(f"--set {text}", why, advice)
    if not value.strip():
        raise ConfigError(key.strip(), "its value is empty", "leave the option out for the default")
    parsed: Any = value.strip()
    # The value is TOML, with numbers as people type them (.08, 1.); a value that is no TOML is a text.
    for toml in (value, _BARE_POINT.sub("0", value)):
        try:
            parsed = parse_toml(f"value = {toml}")["value"]
            break
        except RecursionError as err:
            raise ConfigError(key.strip(), "its value is nested too deeply") from err
        except ValueError:
            continue
    return {section: {name: parsed}}


def _found(value: object) -> str:
    """Return a value for a message: nearly as it was written, with TOML's words for true and false, not too long."""

    def as_toml(value: object) -> str:
        if isinstance(value, list | tuple) and len(value) > LONGEST_NAME:
            return f"{len(value)} values"
        if isinstance(value, list | tuple):
            return f"[{', '.join(map(as_toml, value))}]"
        return str(value).lower() if isinstance(value, bool) else repr(value)

    return f"found {shortened(as_toml(value), LONGEST_NAME)}"


def _flaw(value: object) -> str | None:
    """Return why a value is refused for a key of any type; empty for a valid value."""
    if isinstance(value, list | tuple):
        return next(filter(None, map(_flaw, value)), None)
    if isinstance(value, float) and not math.isfinite(value):
        return "not a finite number"
    # Lone surrogates, from an argument that is not UTF-8, cannot be printed or written to JSON.
    if isinstance(value, str) and not value.isprintable():
        return "has characters that do not print"
    return None


def _parse_section(name: str, values: Mapping[str, Any]) -> Any:  # noqa: ANN401 - the type of the section
    try:
        return msgspec.convert(dict(values), SECTIONS[name])
    except msgspec.ValidationError as err:
        # The words of a __post_init__ ("key: why; advice"), or "… - at `$.key[0]`"; the value may stand before it,
        # whatever it holds.
        _, _, place = str(err).rpartition(" - at `$.")
        key = place.rstrip("`").partition("[")[0]
        if key not in values:
            key, _, message = str(err).partition(": ")
            why, _, advice = message.partition("; ")
            raise ConfigError(f"{name}.{key}", why, advice) from err
        raise ConfigError(f"{name}.{key}", f"expected {describe_key(name, key)}", _found(values[key])) from err


def describe_key(section: str, key: str) -> str:
    """Return the type of a key and its bounds, as in ``a number ≥ 0.01 and ≤ 20``."""
    return _described(get_type_hints(SECTIONS[section], include_extras=True)[key])


def words_of_key(section: str, key: str) -> tuple[str, ...]:
    """Return the words that are values of a key, for example ``auto``; empty without words or for an unknown key."""
    if section not in SECTIONS:
        return ()
    return _literals(get_type_hints(SECTIONS[section]).get(key))


def _literals(kind: Any) -> tuple[str, ...]:  # noqa: ANN401 - a type, as annotations have it
    parts = get_args(kind)
    return parts if get_origin(kind) is Literal else tuple(word for part in parts for word in _literals(part))


def _described(kind: Any) -> str:  # noqa: ANN401 - a type, as annotations have it
    """Return the type of a key in the words of TOML."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Annotated:
        bounds = ((">", parts[1].gt), ("≥", parts[1].ge), ("<", parts[1].lt), ("≤", parts[1].le))
        words = " and ".join(f"{sign} {bound:g}" for sign, bound in bounds if bound is not None)
        return f"{_described(parts[0])} {words}"
    if origin is Literal:
        return " or ".join(f'"{word}"' for word in parts)
    if origin is tuple:
        each = [_described(part) for part in parts if part is not ...]
        return f"[{', '.join(each)}{', …' if ... in parts else ''}]"
    if parts:
        return " or ".join(_described(part) for part in parts if part is not NoneType)
    return "a number" if kind is float else "a text"
