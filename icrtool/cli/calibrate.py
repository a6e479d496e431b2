"""``icrtool calibrate``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from icrtool.cli import options

if TYPE_CHECKING:
    from icrtool.config import Config
    from icrtool.records.tables import RobotLog


@click.command("calibrate")
@click.argument("source", metavar="LOG|RUN", type=click.Path(path_type=Path))
@click.option(
    "-o", "--output", metavar="FILE|DIR", type=click.Path(path_type=Path), help="Write calibration.json here."
)
@click.option(
    "--x-icr", metavar="METRES", type=float, help="Where the ICRs are known to lie, forward: gives the antenna's place."
)
@click.option(
    "--plot", metavar="FILE", type=click.Path(path_type=Path), help="Draw the misses before and after: png, svg, pdf."
)
@options.configuration
@options.verbosity
def command(
    source: Path, output: Path | None, x_icr: float | None, plot: Path | None,
    config_file: Path | None, robot: str | None, sets: tuple[str, ...], quiet: bool, verbose: bool,
) -> None:  # fmt: skip
    """Estimate antenna place, heading offset, delays, wheel scales and ICRs from one log, each with its doubt.

    What the drive could not show is said, never guessed. A RUN is calibrated from the log it was made from, with its
    configuration.

    \b
    Example:
      icrtool calibrate field.mcap --robot husky-a200
      icrtool calibrate icrtool-runs/field -o calibration.json
    """  # noqa: D301 - click reads the escape
    from icrtool.output.figures.calibration_picture import check_picture, write_picture
    from icrtool.output.tables.calibration import calibration_file, format_calibration, write_calibration

    config = options.load(config_file, robot, sets)
    if output is not None:
        calibration_file(output)
    if plot is not None:
        check_picture(plot)
    log, config = _read(source, config, quiet=quiet)
    from icrtool.calibration.findings import calibrate

    found = calibrate(log, config, x_icr_m=x_icr)
    options.warn(log.warnings, quiet=quiet)
    if not quiet:
        click.echo(format_calibration(found))
    if output is not None:
        file = write_calibration(found, output)
        if not quiet:
            click.echo(f"\nwritten to {file}")
    if plot is not None:
        write_picture(found, plot)
        if not quiet:
            click.echo(f"\ndrawn to {plot}")
    if verbose:
        for stream in log.streams:
            click.echo(f"{stream.role}: {stream.topic}: {stream.why}", err=True)


def _read(source: Path, config: Config, *, quiet: bool) -> tuple[RobotLog, Config]:
    """Read a log, or the log of a run with the run's configuration."""
    from icrtool.logs import read_log
    from icrtool.output.run_directory import is_run_directory

    path = source
    if is_run_directory(source):
        from icrtool.errors import ConfigError
        from icrtool.output.stored_run import log_of, open_run

        if config.given_sections:
            section = min(config.given_sections)
            raise ConfigError(
                f"[{section}]", "a finished run keeps the configuration it was made with", "name its log instead"
            )
        run = open_run(source)
        path, config = log_of(run), run.config
    with options.progress_bar(f"reading {path.name}", quiet=quiet) as progress:
        return read_log(path, config, progress), config
