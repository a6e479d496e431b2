"""``icrtool export``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, cast

import click

from icrtool.cli.fit import RUNS

if TYPE_CHECKING:
    from icrtool.output.exports.controllers import Target

TARGETS = ("diff_drive_controller", "clearpath", "nav2", "husarion", "json")


@click.command("export")
@click.argument("run", metavar="[RUN]", required=False, type=click.Path(path_type=Path))
@click.option("--for", "target", required=True, type=click.Choice(TARGETS), help="What the text is for.")
@click.option("--force", is_flag=True, help="Also of a run whose ICRs are not usable; the text then says so.")
def command(run: Path | None, target: str, force: bool) -> None:
    """Print a run's calibration, ready to paste into a robot's controller or filter.

    RUN is a directory that `icrtool fit` wrote; without it, the newest below icrtool-runs/. The multipliers are fitted
    to predict the place after 5 to 10 m, the covariances measured on distance held out of the fit.

    \b
    Example:
      icrtool export --for clearpath icrtool-runs/field
      icrtool export --for json > calibration.json
    """  # noqa: D301 - click reads the escape
    from icrtool.calibration.controller_numbers import export_numbers
    from icrtool.errors import DataError
    from icrtool.output.exports.controllers import format_export
    from icrtool.output.stored_run import newest_run, open_run

    opened = open_run(run if run is not None else newest_run(RUNS))
    if not (opened.usable or force):
        why = f"its ICRs are not usable: {opened.summary['unusable_because']}"
        raise DataError(opened.name, why, "drive again, with turns to both sides; --force exports it all the same")
    click.echo(format_export(export_numbers(opened), cast("Target", target)))
