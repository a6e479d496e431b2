"""``icrtool export``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, cast

import click

from icrtool.cli.fit import RUNS

if TYPE_CHECKING:
    from icrtool.calibration.record import Calibration
    from icrtool.output.exports.controllers import Target

TARGETS = ("diff_drive_controller", "clearpath", "nav2", "husarion", "json", "icr")


@click.command("export")
@click.argument("source", metavar="[RUN|CAL.json]", required=False, type=click.Path(path_type=Path))
@click.option("--for", "target", required=True, type=click.Choice(TARGETS), help="What the text is for.")
@click.option("-o", "--output", metavar="FILE", type=click.Path(path_type=Path), help="Write it here.")
def command(source: Path | None, target: str, output: Path | None) -> None:
    """Print a calibration, ready to paste into a robot's controller or filter.

    CAL.json is a file that `icrtool calibrate -o` wrote. A RUN, a directory that `icrtool fit` wrote, is calibrated
    first, with the same result; without an argument, the newest run below icrtool-runs/. The covariances are measured
    on distance held out of the fit. Target icr: the whole motion model as JSON, in REP-103 (y left).

    \b
    Example:
      icrtool export --for clearpath icrtool-runs/field
      icrtool export --for icr season.json -o twist.json
    """  # noqa: D301 - click reads the escape
    from icrtool.output.atomic_file import check_place, atomic_file
    from icrtool.output.exports.controllers import format_export

    if output is not None:
        check_place(output)
    text = format_export(_calibration(source), cast("Target", target))
    if output is None:
        click.echo(text)
        return
    with atomic_file(output) as partial:
        partial.write_text(f"{text}\n", encoding="utf-8")


def _calibration(source: Path | None) -> Calibration:
    """Read a calibration file, or calibrate from a run."""
    from icrtool.output.stored_run import newest_run, open_run

    if source is not None and source.is_file() and source.suffix == ".json":
        from icrtool.output.calibration_file import open_calibration

        return open_calibration(source)
    from icrtool.calibration.from_runs import calibrate

    return calibrate(open_run(source if source is not None else newest_run(RUNS)))
