"""``icrtool forecast``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from icrtool.cli import options
from icrtool.cli.inputs import read_calibration
from icrtool.cli.options import NEW_FILE, NEW_PICTURE, PLACE, option
from icrtool.cli.printing import Printer

LARGEST_PLAN_BYTES = 50_000_000

if TYPE_CHECKING:
    from icrtool.calibration.forecast import Forecast
    from icrtool.calibration.record import Calibration


@click.command("forecast")
@option("--calibration calibration_file", "CAL.json|RUN", PLACE, "File that icrtool calibrate -o wrote, or a run, "
        "which is calibrated.", required=True)  # fmt: skip
@option("--path", "PLAN.csv|RUN", PLACE, "Path to drive: a table with east_m, north_m[, speed_mps], or a run, driven "
        "again.", required=True)  # fmt: skip
@options.BUDGETS
@option("-o --output", "FILE.csv", NEW_FILE, "Write a row for each metre.")
@option("--plot", "FILE", NEW_PICTURE, "Draw the errors: png, svg, pdf.")
@options.printing(options.AS_JSON, options.QUIET_RESULTS)
def command(
    calibration_file: Path,
    path: Path,
    budgets_m: tuple[float, ...],
    output: Path | None,
    plot: Path | None,
    printer: Printer,
) -> None:
    """Forecast the error of driving a path without GNSS, with a calibrated motion model.

    The expected and the 95 % error are given after each metre of the path: for wheels alone and, where the calibration
    has a gyro, with it. They follow from the covariance of the calibration and from its error growth, which was
    measured on held-out distance. A negative speed_mps in a plan drives in reverse.

    \b
    Example:
      icrtool calibrate monday.mcap tuesday.mcap --robot warthog -o warthog.json
      icrtool forecast --calibration warthog.json --path plan.csv --budget 0.5
      icrtool forecast --calibration warthog.json --path icrtool-runs/field -o errors.csv --plot errors.png
    """  # noqa: D301 - click reads the escape
    from icrtool.output.files.atomic import write_file
    from icrtool.output.files.formats import save_picture
    from icrtool.output.tables.calibration import forecast_blocks, forecast_csv, forecast_document, measured_to_m

    _, calibration = read_calibration(calibration_file)
    forecast, gyro = _forecasts(calibration, path)
    if output is not None:
        write_file(output, forecast_csv(forecast, gyro))
    if plot is not None:
        from icrtool.output.figures.calibrations import forecast_figure

        measured_m = measured_to_m(calibration)
        save_picture(forecast_figure(forecast, path.name, budgets_m, measured_m, gyro), plot)
    printer.json("forecast", forecast_document(forecast, calibration, budgets_m, gyro))
    printer.show(forecast_blocks(forecast, calibration, budgets_m, gyro))


def _forecasts(calibration: Calibration, path: Path) -> tuple[Forecast, Forecast | None]:
    """Forecast along a run's path or the points of a table: wheels alone, and with a gyro where both have one."""
    from icrtool.calibration.forecast import forecast_drive, forecast_plan
    from icrtool.output.run_directory import is_run_directory

    with_gyro = calibration.gyro is not None and calibration.gyro.error_sources is not None
    if is_run_directory(path):
        from icrtool.calibration.run_recording import turning_recording_of
        from icrtool.output.run_directory import open_run

        recording = turning_recording_of(open_run(path))
        with_gyro = with_gyro and recording.track.gyro is not None
        forecast = partial(forecast_drive, calibration, recording)
    else:
        from icrtool.output.files.formats import read_numbers

        plan = read_numbers(path, ("east_m", "north_m"), ("speed_mps",), most_bytes=LARGEST_PLAN_BYTES)
        forecast = partial(forecast_plan, calibration, plan["east_m"], plan["north_m"], plan.get("speed_mps"))
    return forecast(), forecast(with_gyro=True) if with_gyro else None
