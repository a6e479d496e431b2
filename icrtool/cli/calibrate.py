"""``icrtool calibrate``, and ``icrtool forecast`` with the resulting calibration."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from icrtool.cli import lazy_imports, options
from icrtool.cli.inputs import check_run_config, grounds_of, read_calibration, runs_named
from icrtool.cli.options import FILE, NEW_FILE, NEW_PICTURE, PLACE, option
from icrtool.cli.printing import Printer

with lazy_imports():
    from icrtool import errors
    from icrtool.alignment import align, corrections, estimator, wheel_units
    from icrtool.calibration import error_growth, pooled, sensor_findings
    from icrtool.logs import read_log
    from icrtool.output import run_directory
    from icrtool.output.files import atomic, formats
    from icrtool.output.tables import calibration as tables

if TYPE_CHECKING:
    from icrtool.calibration.record import Calibration
    from icrtool.config import ConfigSources
    from icrtool.records.calibration_document import CalibrationFile
    from icrtool.records.run import Run

LARGEST_PLAN_BYTES = 50_000_000
"""Largest size of the table of a planned path [bytes]."""


@click.command("calibrate")
@click.argument("sources", metavar="[GROUND=]LOG|RUN|FOLDER...", nargs=-1, required=True)
@option("-o --output", "FILE|DIR", FILE, "Write the calibration file here.")
@option(
    "--x-icr",
    "METRES",
    float,
    "Forward position of the ICRs [m], if you know it: the position of the antenna follows from it. One log only.",
)
@option(
    "--plot", "FILE", NEW_PICTURE, "Draw the residuals before and after the calibration: png, svg, pdf. One log only."
)
@options.ALLOW_UNUSABLE
@options.CONFIGURATION
@options.INPUT_LIMITS
@options.printer_options(options.AS_JSON, options.QUIET, options.VERBOSE_OPTION)
def calibrate_command(
    sources: tuple[str, ...],
    output: Path | None,
    x_icr: float | None,
    plot: Path | None,
    allow_unusable: bool,
    settings: ConfigSources,
    printer: Printer,
) -> None:
    """Calibrate the motion model of a robot from one log or many, and test it on data that it was not fitted to.

    Several logs are fitted together, and each is left out in turn to test the model. With one log, each trial is
    predicted by a fit to the rest of the drive, and the position of the antenna, heading offset, delays and wheel
    scales are estimated as well. A RUN keeps the configuration that it was fitted with. A FOLDER stands for the runs in
    it, or for its logs if it has no runs. A log is left out if it is not usable, too short, a copy or a part of
    another log. With GROUND= before each argument, each ground is left out in turn too: a report with this
    calibration then states how far the robot gets on another ground. If the folder of a batch is the only argument,
    the groups of its manifest are the grounds.

    \b
    Example:
      icrtool calibrate field.mcap --robot husky-a200
      icrtool calibrate monday.mcap tuesday.mcap --robot warthog -o warthog.json
      icrtool calibrate icrtool-runs -o calibration.json
      icrtool calibrate grass=may/ gravel=june/ -o warthog.json
    """  # noqa: D301 - click reads the escape
    config = settings.load()
    places, grounds = grounds_of(sources)
    if len(places) > 1 and (plot is not None or x_icr is not None):
        raise click.UsageError("--plot and --x-icr are for one log")
    if output is not None:
        formats.calibration_file(output)
    if plot is not None and run_directory.is_run_directory(places[0]):
        # A stranger may have made the run, so no file or address that the run names is read.
        raise errors.RunError(places[0], "--plot draws the residuals of a log, not of a run", "name its log")
    if all(run_directory.is_run_directory(place) for place in places):
        check_run_config(config)
    runs = runs_named(places, config, printer)
    sensors = None
    if len(runs) == 1:
        printer.warn_about(runs[0])
        sensors = sensor_findings.calibrate_log(runs[0], x_icr_m=x_icr)
    result = None
    try:
        result = pooled.calibrate_runs(runs, allow_unusable=allow_unusable, grounds=grounds)
        printer.warn(map(str, result.left_out))
    except errors.IcrToolError as err:
        if sensors is None or not (runs[0].usable or allow_unusable):
            raise
        printer.warn([f"no motion model: {err}"])
    texts = []
    document: CalibrationFile | None = sensors
    if result is not None:
        document = result.calibration if sensors is None else sensor_findings.with_sensors(result.calibration, sensors)
    if output is not None and document is not None:
        texts.append(f"written to {formats.write_calibration(document, output)}")
    if plot is not None:
        _draw_residuals(places[0], runs[0], plot)
        texts.append(f"drawn to {plot}")
    printer.json("calibrate", {"calibration": document})
    printer.show(tables.calibration_blocks(result, sensors))
    for text in texts:
        printer.text(f"\n{text}" if printer.verbose else text)


def _draw_residuals(source: Path, run: Run, plot: Path) -> None:
    """Draw the residuals of the alignment of a log, which is read again, into the file `plot`."""
    log = read_log.read_log(source, run.config)
    measured = wheel_units.with_wheel_speeds(align.choose_reference(log, run.config), run.config)
    fit = corrections.align_streams(measured, run.config).fit
    if fit is not None:
        from icrtool.output.figures.calibrations import residuals_figure

        formats.save_picture(residuals_figure(run.name, estimator.residuals_by_estimate(fit)), plot)


@click.command("forecast")
@option("--calibration calibration_file", "CAL.json|RUN", PLACE, "File that icrtool calibrate -o wrote, or a run, "
        "which is calibrated.", required=True)  # fmt: skip
@option("--path", "PLAN.csv|RUN", PLACE, "Path to drive: a table with east_m, north_m[, speed_mps], or a run, "
        "whose path is driven again.", required=True)  # fmt: skip
@options.BUDGETS
@option("-o --output", "FILE.csv", NEW_FILE, "Write a row for each metre.")
@option("--plot", "FILE", NEW_PICTURE, "Draw the errors: png, svg, pdf.")
@options.printer_options(options.AS_JSON, options.QUIET_RESULTS)
def forecast_command(
    calibration_file: Path,
    path: Path,
    budgets_m: tuple[float, ...],
    output: Path | None,
    plot: Path | None,
    printer: Printer,
) -> None:
    """Forecast the error of driving a path without GNSS, with a calibrated motion model.

    The expected and the 95 % error are given after each metre of the path: for wheels alone and, if the calibration has
    a gyro, with the gyro. They follow from the covariance of the calibration and from its error growth, which was
    measured on held-out distance. With a negative speed_mps the robot drives in reverse.

    \b
    Example:
      icrtool calibrate monday.mcap tuesday.mcap --robot warthog -o warthog.json
      icrtool forecast --calibration warthog.json --path plan.csv --budget 0.5
      icrtool forecast --calibration warthog.json --path icrtool-runs/field -o errors.csv --plot errors.png
    """  # noqa: D301 - click reads the escape
    _, calibration = read_calibration(calibration_file)
    run = run_directory.open_run(path) if run_directory.is_run_directory(path) else None
    forecast, gyro = _forecasts(calibration, path, run)
    if output is not None:
        atomic.write_file(output, tables.forecast_csv(forecast, gyro))
    if plot is not None:
        from icrtool.output.figures.calibrations import forecast_figure

        measured_m = tables.measured_to_m(calibration)
        document = None if run is None else run.document
        figure = forecast_figure(forecast, path.name, budgets_m, measured_m, gyro, document=document)
        formats.save_picture(figure, plot)
    printer.json("forecast", tables.forecast_document(forecast, calibration, budgets_m, gyro))
    printer.show(tables.forecast_blocks(forecast, calibration, budgets_m, gyro))


def _forecasts(
    calibration: Calibration, path: Path, run: Run | None
) -> tuple[error_growth.Forecast, error_growth.Forecast | None]:
    """Return the forecasts along the path of a run, else of the table `path`: by wheels alone, and with a gyro.

    The second forecast is None if the calibration or the run has no gyro.
    """
    with_gyro = calibration.gyro is not None and calibration.gyro.error_sources is not None
    if run is not None:
        recording = pooled.turning_recording_of(run)
        with_gyro = with_gyro and recording.track.gyro is not None
        forecast = partial(error_growth.forecast_drive, calibration, recording)
    else:
        plan = formats.read_numbers(path, ("east_m", "north_m"), ("speed_mps",), most_bytes=LARGEST_PLAN_BYTES)
        points = plan["east_m"], plan["north_m"], plan.get("speed_mps")
        forecast = partial(error_growth.forecast_plan, calibration, *points)
    return forecast(), forecast(with_gyro=True) if with_gyro else None
