"""``icrtool calibrate``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from icrtool.cli import options
from icrtool.cli.json_output import json_option, print_json

if TYPE_CHECKING:
    from icrtool.calibration.findings import Calibration as Findings
    from icrtool.calibration.pooled import CalibrationResult
    from icrtool.config import Config
    from icrtool.records.run import Run
    from icrtool.records.tables import RobotLog


@click.command("calibrate")
@click.argument("sources", metavar="LOG|RUN...", nargs=-1, required=True, type=options.LOG)
@click.option(
    "-o", "--output", metavar="FILE|DIR", type=click.Path(path_type=Path), help="Write the calibration file here."
)
@click.option(
    "--x-icr",
    metavar="METRES",
    type=float,
    help="Known forward position of the ICRs; gives the antenna's position. One log.",
)
@click.option(
    "--plot",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="Draw the residuals before and after the calibration: png, svg, pdf. One log.",
)
@json_option
@options.configuration
@options.verbosity
def command(
    sources: tuple[Path, ...], output: Path | None, x_icr: float | None, plot: Path | None, as_json: bool,
    config_file: Path | None, robot: str | None, sets: tuple[str, ...], quiet: bool, verbose: bool,
) -> None:  # fmt: skip
    """Calibrate the motion model of a robot from one log or many, tested on what it was not fitted to.

    Several logs are pooled; each is left out in turn to test the models and to choose one. Of one log, blocks are left
    out, and antenna place, heading offset, delays and wheel scales are estimated, too. A RUN is used as it was fitted,
    with its configuration.

    \b
    Example:
      icrtool calibrate field.mcap --robot husky-a200
      icrtool calibrate monday.mcap tuesday.mcap --robot warthog -o warthog.json
      icrtool calibrate icrtool-runs/* -o calibration.json
    """  # noqa: D301 - click reads the escape
    from icrtool.errors import IcrToolError
    from icrtool.output.calibration_file import calibration_file, write_calibration
    from icrtool.output.figures.calibration_picture import check_picture, write_picture
    from icrtool.output.tables.calibration import format_calibration
    from icrtool.output.tables.held_out import format_result

    config = options.load(config_file, robot, sets)
    if len(sources) > 1 and (plot is not None or x_icr is not None):
        raise click.UsageError("--plot and --x-icr are for one log")
    if output is not None:
        calibration_file(output)
    if plot is not None:
        check_picture(plot)
    findings = _findings(sources[0], config, x_icr, quiet=quiet, verbose=verbose) if len(sources) == 1 else None
    result = None
    try:
        result = _pooled(sources, config, quiet=quiet)
    except IcrToolError as err:
        if findings is None:
            raise
        options.warn([f"no motion model: {err}"], quiet=quiet)
    texts = [format_result(result)] if result is not None else []
    document = result.calibration.summary() if result is not None else {}
    if findings is not None:
        texts.append(format_calibration(findings))
        document = findings.summary() | document | {"alignment": findings.summary()["parameters"]}
    if output is not None:
        texts.append(f"written to {write_calibration(document, output)}")
    if plot is not None and findings is not None:
        write_picture(findings, plot)
        texts.append(f"drawn to {plot}")
    if as_json:
        print_json("calibrate", {"calibration": document})
    elif not quiet:
        click.echo("\n\n".join(texts))


def _pooled(sources: tuple[Path, ...], config: Config, *, quiet: bool) -> CalibrationResult:
    """Fit and test the motion models on all sources."""
    from icrtool.calibration.from_runs import calibrate_runs
    from icrtool.errors import ConfigError
    from icrtool.output.run_directory import is_run_directory

    if config.given_sections and all(is_run_directory(source) for source in sources):
        section = min(config.given_sections)
        advice = "name the logs instead"
        raise ConfigError(f"[{section}]", "a finished run keeps the configuration it was made with", advice)
    with options.progress_bar("reading", quiet=quiet) as progress:
        found = []
        for i, source in enumerate(sources):
            found.append(_run(source, config))
            if progress is not None:
                progress((i + 1) / len(sources))
    return calibrate_runs(found)


def _run(source: Path, config: Config) -> Run:
    """Read a run, or fit a log."""
    from icrtool.output.run_directory import is_run_directory

    if is_run_directory(source):
        from icrtool.output.stored_run import open_run

        return open_run(source)
    from icrtool.estimation.fit import fit
    from icrtool.logs import read_log

    return fit(read_log(source, config), config)


def _findings(source: Path, config: Config, x_icr: float | None, *, quiet: bool, verbose: bool) -> Findings:
    """Estimate antenna, offsets, delays and scales of one log."""
    from icrtool.calibration.findings import calibrate

    log, config = _read(source, config, quiet=quiet)
    found = calibrate(log, config, x_icr_m=x_icr)
    options.warn(log.warnings, quiet=quiet)
    if verbose:
        for stream in log.streams:
            click.echo(f"{stream.role}: {stream.topic}: {stream.why}", err=True)
    return found


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
