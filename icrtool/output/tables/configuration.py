"""A configuration as a TOML file with comments; docs/configuration.md holds that of the defaults."""

from __future__ import annotations

import json
import textwrap
from dataclasses import fields

from icrtool.config import SECTIONS, Config, describe_key, key_texts

WIDTH = 110

HEAD = """\
# Configuration of icrtool. Use it with --config FILE.toml; --set section.key=value changes single keys.
# In brackets: type and bounds. A key in a comment has no default: its value is an example.
"""


def format_configuration(config: Config) -> str:
    """Return all keys with their meaning, their type and bounds, and their value; TOML that loads as this `config`."""
    texts, document = key_texts(), config.effective()
    parts = [HEAD]
    for section, kind in SECTIONS.items():
        parts.append(f"\n[{section}]\n")
        for key in (field.name for field in fields(kind)):
            about, value = texts[section][key], document[section][key]
            comment = f"{about['text']} [{describe_key(section, key)}]"
            parts += [f"# {line}\n" for line in textwrap.wrap(comment, WIDTH, break_long_words=False)]
            parts.append(f"# {key} = {_toml(about['example'])}\n" if value is None else f"{key} = {_toml(value)}\n")
    return "".join(parts)


def _toml(value: object) -> str:
    """Return a value of the configuration as TOML: what JSON has is the same there, but for the escapes of a text."""
    if isinstance(value, list):
        return f"[{', '.join(_toml(item) for item in value)}]"
    if isinstance(value, float) and value.is_integer() and abs(value) < 1e6:
        return f"{value:.1f}"
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
