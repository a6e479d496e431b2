"""``icrtool calibrate``."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import click

from icrtool.cli import options
from icrtool.cli.inputs import check_run_config, runs_of, runs_or_logs
from icrtool.cli.options import FILE, NEW_PICTURE, option
from icrtool.cli.printing import Printer

if TYPE_CHECKING:
    from icrtool.config import Config, ConfigSources
    from icrtool.records.calibration_document import CalibrationFile, SensorDocument
    from icrtool.records.run import Run


@click.command("calibrate")
@click.argument("sources", metavar="LOG|RUN|FOLDER...", nargs=-1, required=True, type=options.LOG)
@option("-o --output", "FILE|DIR", FILE, "Write the calibration file here.")
@option("--x-icr", "METRES", float, "Forward position of the ICRs, where known: it gives that of the antenna. One log.")
@option("--plot", "FILE", NEW_PICTURE, "Draw the residuals before and after the calibration: png, svg, pdf. One log.")
@options.ALLOW_UNUSABLE
@options.CONFIGURATION
@options.printing(options.AS_JSON, options.QUIET, options.VERBOSE)
def command(
    sources: tuple[Path, ...],
    output: Path | None,
    x_icr: float | None,
    plot: Path | None,
    allow_unusable: bool,
    settings: ConfigSources,
    printer: Printer,
) -> None:
    """Calibrate the motion model of a robot from one log or many, tested on what it was not fitted to.

    Several logs are fitted together, and each is left out in turn to test the model. With one log, each trial is
    predicted by a fit to the rest of the drive; position of the antenna, heading offset, delays and wheel scales are
    estimated as well. A RUN keeps the configuration that it was fitted with. A FOLDER stands for
    the runs in it, or else for its logs. Logs that are not usable, too short, copies or a part of another are left out.

    \b
    Example:
      icrtool calibrate field.mcap --robot husky-a200
      icrtool calibrate monday.mcap tuesday.mcap --robot warthog -o warthog.json
      icrtool calibrate icrtool-runs -o calibration.json
    """  # noqa: D301 - click reads the escape
    from icrtool.errors import IcrToolError
    from icrtool.output.files.formats import calibration_file, write_calibration

    config = settings.load()
    sources = tuple(one for source in sources for one in runs_or_logs(source))
    if len(sources) > 1 and (plot is not None or x_icr is not None):
        raise click.UsageError("--plot and --x-icr are for one log")
    if output is not None:
        calibration_file(output)
    runs = _runs(sources, config, printer)
    from icrtool.calibration.one_log import with_sensors
    from icrtool.calibration.pooled import calibrate_runs

    sensors = _sensors(runs[0], x_icr, printer) if len(runs) == 1 else None
    result = None
    try:
        result = calibrate_runs(runs, allow_unusable=allow_unusable)
        printer.warn(map(str, result.left_out))
    except IcrToolError as err:
        if sensors is None or not (runs[0].usable or allow_unusable):
            raise
        printer.warn([f"no motion model: {err}"])
    from icrtool.output.tables.calibration import calibration_blocks

    texts = []
    document: CalibrationFile | None = sensors
    if result is not None:
        document = result.calibration if sensors is None else with_sensors(result.calibration, sensors)
    if output is not None and document is not None:
        texts.append(f"written to {write_calibration(document, output)}")
    if plot is not None:
        _draw(sources[0], runs[0], plot)
        texts.append(f"drawn to {plot}")
    printer.json("calibrate", {"calibration": document})
    printer.show(calibration_blocks(result, sensors))
    for text in texts:
        printer.text(f"\n{text}" if printer.verbose else text)


def _runs(sources: tuple[Path, ...], config: Config, printer: Printer) -> list[Run]:
    """Read runs, and fit logs."""
    from icrtool.output.run_directory import is_run_directory

    finished = all(is_run_directory(source) for source in sources)
    if finished:
        check_run_config(config)
    with ThreadPoolExecutor(1) as other:
        if finished:
            # takes as long as to read a run of an hour, most of which is done outside of the interpreter
            other.submit(import_module, "icrtool.calibration.pooled")
        return runs_of(sources, config, printer)


def _sensors(run: Run, x_icr: float | None, printer: Printer) -> SensorDocument:
    """Return what one log shows of antenna, offsets, delays and scales."""
    from icrtool.calibration.one_log import calibrate_log

    printer.warn_of(run)
    return calibrate_log(run, x_icr_m=x_icr)


def _draw(source: Path, run: Run, plot: Path) -> None:
    """Draw the residuals of one log's alignment."""
    from icrtool.alignment.align import choose_reference
    from icrtool.alignment.corrections import align_streams
    from icrtool.alignment.estimator import residuals_by_estimate
    from icrtool.alignment.wheel_units import with_wheel_speeds
    from icrtool.logs.read_log import read_log
    from icrtool.output.figures.calibrations import residuals_figure
    from icrtool.output.files.formats import save_picture
    from icrtool.output.run_directory import log_of

    log = read_log(source if run.directory is None else log_of(run), run.config)
    fit = align_streams(with_wheel_speeds(choose_reference(log, run.config), run.config), run.config).fit
    if fit is not None:
        save_picture(residuals_figure(run.name, residuals_by_estimate(fit)), plot)
