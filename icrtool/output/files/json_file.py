"""JSON files of ours: how they are written, and how an unknown one is recognised."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from icrtool.errors import RunError
from icrtool.records.fleet_document import FleetDocument, FleetLog
from icrtool.records.plain_data import plain
from icrtool.records.regular_file import check_folders, read_regular
from icrtool.records.text import LogText

FLEET_FILE = "fleet.json"
"""What a batch found, in its folder."""

FLEET_FAMILY = "icrtool/fleet/"
"""Schema of such a file, of whatever version."""


def read_fleet(directory: Path) -> FleetDocument:
    """Return what the fleet.json of a batch holds.

    Raises
    ------
    OSError, ValueError, RecursionError
        It cannot be read, or is not of this version.
    """
    return msgspec.convert(json.loads(read_regular(directory / FLEET_FILE, directory)), FleetDocument)


def logs_of_fleet(directory: Path) -> list[FleetLog]:
    """Return the logs of a batch that could be used.

    Raises
    ------
    RunError
        The folder does not hold the result of a batch.
    """
    try:
        found = [one for one in read_fleet(directory).logs if one.status != "failed"]
        for one in found:
            check_folders(directory / one.run, directory)
    except (OSError, ValueError, RecursionError) as err:
        raise RunError(directory, f"its {FLEET_FILE} cannot be read ({err})", "name the folder of a batch") from err
    return found


def schema_of(file: Path, inside: Path | None = None) -> str:
    """Return the schema that a JSON file states, for example ``icrtool/run/1``; empty where it states none.

    Parameters
    ----------
    inside : as in `open_regular`
    """
    try:
        schema = json.loads(read_regular(file, inside))["schema"]
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return ""
    return schema if isinstance(schema, str) else ""


def json_bytes(document: msgspec.Struct | Mapping[str, Any]) -> bytes:
    """Return JSON text as every file of ours has it: indented, UTF-8, null for what is not a finite number."""
    text = json.dumps(_as_in_the_log(plain(document)), indent=2, ensure_ascii=False, allow_nan=False)
    # A file name that is no text (lone surrogates) becomes the escapes that JSON has for it.
    return (text + "\n").encode("utf-8", errors="backslashreplace")


def _as_in_the_log(value: Any) -> Any:  # noqa: ANN401 - whatever JSON holds
    """Return plain data with the texts of a log unescaped: JSON has escapes of its own."""
    if isinstance(value, dict):
        return {key: _as_in_the_log(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_as_in_the_log(item) for item in value]
    return value.raw if isinstance(value, LogText) else value
