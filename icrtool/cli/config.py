"""``icrtool config``."""

from __future__ import annotations

from pathlib import Path

import click

from icrtool.cli import options
from icrtool.cli.printing import write_or_print


@click.command("config")
@options.configuration
@click.option("-o", "--output", metavar="FILE", type=options.NEW_FILE, help="File to write; default: standard output.")
def command(config_file: Path | None, robot: str | None, sets: tuple[str, ...], output: Path | None) -> None:
    """Print all configuration keys as a TOML file: meaning, type and bounds, and value.

    Without options these are the defaults; --robot, --config and --set change them. Keys without default stand in
    comments, with an example. Edit the result, and use it with --config.

    \b
    Example:
      icrtool config --robot husky-a200 -o my-husky.toml
      icrtool fit field.mcap --config my-husky.toml
    """  # noqa: D301 - click reads the escape
    from icrtool.output.tables.configuration import format_configuration

    write_or_print(format_configuration(options.load(config_file, robot, sets)), output)
