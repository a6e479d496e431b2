"""``--json``: one JSON document on standard output, and nothing else there."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, TypeVar

import click

if TYPE_CHECKING:
    import msgspec

Command = TypeVar("Command", bound=Callable[..., Any])


def json_option(command: Command) -> Command:
    """Add --json, as `as_json`; the command passes it on as `quiet` to what prints results."""
    text = "Print one JSON document on standard output, and nothing else there."
    return click.option("--json", "as_json", is_flag=True, help=text)(command)


def print_json(command: str, document: msgspec.Struct | Mapping[str, object]) -> None:
    """Print the document of a command; its schema is ``icrtool/<command>/1``, whatever `document` states.

    Parameters
    ----------
    command : its name on the command line
    document : a record, or plain data and numpy's; numbers that are not finite become null
    """
    from icrtool import __version__
    from icrtool.output.files.formats import json_bytes
    from icrtool.records.plain_data import plain

    own = {"schema": f"icrtool/{command}/1", "tool_version": __version__}
    click.echo(json_bytes(own | {key: value for key, value in plain(document).items() if key not in own}), nl=False)
