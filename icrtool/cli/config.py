"""``icrtool config``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from icrtool.cli import options
from icrtool.cli.printing import write_or_print

if TYPE_CHECKING:
    from icrtool.config import ConfigSources


@click.command("config")
@options.CONFIGURATION
@options.option("-o --output", "FILE", options.NEW_FILE, "File to write; default: standard output.")
def command(settings: ConfigSources, output: Path | None) -> None:
    """Print all configuration keys as a TOML file: meaning, type and bounds, and value.

    Without options these are the defaults; --robot, --config and --set change them. Keys without default stand in
    comments, with an example. Edit the result, and use it with --config.

    \b
    Example:
      icrtool config --robot husky-a200 -o my-husky.toml
      icrtool fit field.mcap --config my-husky.toml
    """  # noqa: D301 - click reads the escape
    from icrtool.output.tables.configuration import format_configuration

    write_or_print(format_configuration(settings.load()), output)
