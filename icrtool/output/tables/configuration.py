"""A configuration as TOML: a file to edit, with every key and its meaning, or only the keys that have a value."""

from __future__ import annotations

import json
import textwrap
from dataclasses import fields

from icrtool.config import SECTIONS, Config, describe_key, key_texts

CONFIGURATION_WIDTH = 110
"""Largest number of characters in a line of a configuration file."""

CONFIGURATION_HEAD = """\
# Configuration of icrtool, for --config FILE.toml; --set section.key=value changes single keys.
# Each key is shown with its default; remove the # before it and change it. Behind it: its type and bounds.
"""
"""First lines of a configuration file."""


def format_configuration(config: Config) -> str:
    """Return all keys as TOML that loads as this `config`; keys whose value differs from the default are set.

    Notes
    -----
    A default is a comment: a key that is set has precedence over what icrtool would find in the log.
    """
    texts, document, default = key_texts(), config.effective(), Config().effective()
    parts = [CONFIGURATION_HEAD]
    for section, section_type in SECTIONS.items():
        parts.append(f"\n[{section}]\n")
        for key in (field.name for field in fields(section_type)):
            about, value = texts[section][key], document[section][key]
            parts += [
                f"# {line}\n" for line in textwrap.wrap(about["text"], CONFIGURATION_WIDTH, break_long_words=False)
            ]
            mark = "#" if value == default[section][key] else ""
            note = f"{describe_key(section, key)}{'; no default, this is an example' if value is None else ''}"
            value_text = _toml(about["example"] if value is None else value)
            parts.append(f"{mark}{key} = {value_text}  # {note}\n\n")
        parts[-1] = parts[-1].removesuffix("\n")
    return "".join(parts)


def format_settings(config: Config) -> str:
    """Return the keys that have a value as TOML, one on each line."""
    lines = []
    for section, keys in config.effective().items():
        lines += [f"[{section}]", *(f"{key} = {_toml(value)}" for key, value in keys.items() if value is not None), ""]
    return "\n".join(lines)


def _toml(value: object) -> str:
    """Return a value of the configuration as TOML: JSON values are the same there, except the escapes of a text."""
    if isinstance(value, list):
        return f"[{', '.join(_toml(item) for item in value)}]"
    if isinstance(value, float) and value.is_integer() and abs(value) < 1e6:
        return f"{value:.1f}"
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
