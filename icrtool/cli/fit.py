"""``icrtool fit``."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from icrtool.cli import options
from icrtool.cli.inputs import ResultPlace, logs_of, run_directories
from icrtool.cli.options import PLACE, choice, flag, option
from icrtool.cli.printing import Inputs, Printer
from icrtool.records.text import LogText, escaped

if TYPE_CHECKING:
    from icrtool.config import Config, ConfigSources
    from icrtool.fleet.one_log import FitOptions
    from icrtool.records.run import Run


def seconds(text: str) -> float:
    """Read a time of ``--terrain-change`` [s]."""
    return options.numbers(text, "T, finite seconds", 1)[0]


ASKED = options.together(
    "asked",
    "icrtool.fleet.one_log:FitOptions",
    options.PLACES,
    choice("--states", ("csv", "parquet"), "Format of the states; default: csv, parquet for over a million states."),
    options.PLOTS,
    options.FIGURES,
    option("--warm-start", "RUN|CAL.json", PLACE, "Start from another run's final ICRs and covariance, or from those "
           "of a calibration."),
    option("--terrain-change changes_s", "T", seconds, "The ground changes after T seconds: inflate the ICR "
           "covariance there; repeatable.", multiple=True),
    flag("--smooth", "Also write the RTS smoother's states (smoothed.csv)."),
    options.CUT,
)  # fmt: skip


@click.command("fit")
@options.LOGS
@ASKED
@options.CONFIGURATION
@options.printing(options.AS_JSON, options.QUIET, options.VERBOSE)
def command(
    logs: tuple[Path, ...], place: ResultPlace, asked: FitOptions, settings: ConfigSources, printer: Printer
) -> None:
    """Learn the track ICRs of a robot from its logs, and write a run directory per log.

    Without options the topics are found by type and content. --robot or --set robot.track_width_m=… and
    robot.wheel_radius_m=… give what the messages do not hold.

    \b
    Example:
      icrtool fit field.mcap --robot husky-a200
      icrtool fit log.bag --set topics.gnss=/rtk/fix -o runs/today
    """  # noqa: D301 - click reads the escape
    from icrtool.output.tables.run import next_blocks, run_blocks

    config = settings.load()
    logs = logs_of(logs, printer)
    inputs = Inputs("log")
    for log, (directory, inside) in zip(logs, run_directories(logs, place), strict=True):
        with inputs.each(log) as document:
            with fitted_log(log, directory, config, asked, printer, inside) as (run, _):
                pass
            where = escaped(str(directory))
            document |= {"directory": where, "run": run.summary}
            # The command that names what is wrong in the log.
            examine = shlex.join(["icrtool", "info", escaped(str(log)), "-v", *options.given(settings, asked.span)])
            printer.show([*run_blocks(run.document), *next_blocks(run.document, where, examine)])
    printer.json("fit", {"logs": inputs.documents})
    inputs.leave("logs")


@contextmanager
def fitted_log(
    log: Path, directory: Path, config: Config, asked: FitOptions, printer: Printer, inside: Path | None
) -> Iterator[tuple[Run, Path]]:
    """Fit a log, and give as `icrtool.fleet.one_log.fitted` does; print warnings and chosen streams on stderr."""
    from icrtool.fleet.one_log import fitted
    from icrtool.output.text_format import jump_lines

    notes: list[str] = []
    with (
        printer.stages(LogText(log.name)) as stages,
        fitted(
            log, directory, config, asked, stages.begin, share=stages.share, note=notes.append, inside=inside
        ) as found,
    ):
        yield found
    printer.warn_of(found[0], *notes)
    for line in jump_lines(found[0].document.reference_jumps):
        printer.detail(line)
