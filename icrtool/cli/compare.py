"""``icrtool compare``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from icrtool.cli import options
from icrtool.cli.inputs import runs_of, runs_or_logs
from icrtool.cli.options import NEW_FILE, NEW_PICTURE, option
from icrtool.cli.printing import Printer
from icrtool.records.text import LogText
from icrtool.records.urls import UrlPath, place_of

if TYPE_CHECKING:
    from icrtool.config import ConfigSources
    from icrtool.records.run import Run


@click.command("compare")
@click.argument("sources", metavar="[NAME=]RUN|LOG|FOLDER...", nargs=-1, required=True)
@option("--csv", "FILE", NEW_FILE, "Write the transfer matrix: the errors of each calibration in each group.")
@option("-o --output", "FILE", NEW_FILE, "Write the comparison as JSON, for icrtool report.")
@option("--plot", "FILE", NEW_PICTURE, "Draw the comparison: png, svg, pdf.")
@options.CONFIGURATION
@options.printing(options.AS_JSON, options.QUIET, options.VERBOSE)
def command(
    sources: tuple[str, ...],
    csv: Path | None,
    output: Path | None,
    plot: Path | None,
    settings: ConfigSources,
    printer: Printer,
) -> None:
    """Compare groups of runs: ICRs, multiplier and errors, and what the calibration of one costs on another.

    Each argument is a group: a run, a log, or a folder of runs or logs; arguments of one NAME are one group. The first
    group is compared with each of the others. The folder of a batch, given alone, stands for its robots and groups.

    \b
    Example:
      icrtool compare old=season1/ new=season2/
      icrtool compare grass=icrtool-runs/monday asphalt=icrtool-runs/tuesday --json
    """  # noqa: D301 - click reads the escape
    from icrtool.calibration.transfer import compare_groups
    from icrtool.output.files.atomic import write_file
    from icrtool.output.files.formats import json_bytes, save_picture
    from icrtool.output.tables.calibration import transfer_blocks, transfer_csv

    config = settings.load()
    places = _groups(sources)
    found = [(name, one) for name, paths in places.items() for path in paths for one in runs_or_logs(path)]
    groups: dict[str, list[Run]] = {}
    runs = runs_of([path for _, path in found], config, printer)
    for (name, _), run in zip(found, runs, strict=True):
        groups.setdefault(name, []).append(run)
    compared = compare_groups(groups)
    for file, content in ((csv, transfer_csv(compared)), (output, json_bytes(compared))):
        if file is not None:
            write_file(file, content)
    if plot is not None:
        from icrtool.output.figures.calibrations import transfer as transfer_figure

        save_picture(transfer_figure(compared), plot)
    printer.json("compare", compared)
    printer.show(transfer_blocks(compared))


def _groups(sources: tuple[str, ...]) -> dict[LogText, list[Path]]:
    """Return the places of each group; the only argument may be the folder of a batch, which has groups of its own.

    Raises
    ------
    ConfigError
        There is only one group.
    RunError
        The table of the batch cannot be read.
    """
    from icrtool.errors import ConfigError
    from icrtool.fleet.roll_up import is_fleet, runs_of_fleet

    places: dict[LogText, list[Path]] = {}
    for source in sources:
        name, path = _named(source)
        if len(sources) == 1 and is_fleet(path):
            places = {LogText(group): runs for group, runs in runs_of_fleet(path).items()}
        else:
            places.setdefault(name, []).append(path)
    if len(places) < 2:
        raise ConfigError("compare", "names one group only", "name two or more: old=season1/ new=season2/")
    return places


def _named(source: str) -> tuple[LogText, Path]:
    """Return the group's name and the place of one argument."""
    whole = place_of(source)
    name, sign, place = source.partition("=")
    # An address may have an equals sign in its query.
    if sign and name and place and not isinstance(whole, UrlPath) and not whole.exists():
        return LogText(name), place_of(place)
    return LogText(whole.name or str(whole)), whole
