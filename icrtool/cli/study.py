"""``icrtool study``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from icrtool.cli import options
from icrtool.cli.inputs import RUNS
from icrtool.cli.options import FILE, POSITIVE, Change, changes, choice, numbers, option
from icrtool.cli.printing import Printer
from icrtool.cli.simulate import check_changes, default_icrs, degrees, drive_options, encoder_counts_of

if TYPE_CHECKING:
    from icrtool.config import ConfigSources
    from icrtool.simulation.drives import DrivePlan, PathPlan, Sensors
    from icrtool.simulation.study_records import Study, StudyName, StudyRequest

NAMES = (
    "convergence", "initial", "icr-change", "turn-radius", "input-noise", "input-bias", "input-source", "gnss", "rate",
    "consistency",
)  # fmt: skip


def values_text(text: str) -> tuple[float, ...]:
    """Read ``V,V,...``."""
    return numbers(text, "V,V,...")


@click.command("study")
@click.argument("name", metavar="NAME", type=click.Choice(NAMES))
@option("-o --output", "DIR", FILE, "Study directory; default icrtool-runs/study-NAME.")
@changes(
    "request",
    "icrtool.simulation.study_records:StudyRequest",
    option("--runs", "N", click.IntRange(min=1), "Runs for each value (in study initial: for each start)."),
    options.SEED,
    option("--values", "V,V,...", values_text, "Values of the quantity that the study varies, in its unit."),
)
@choice("--preset", ("paper", "field"), "Study this preset alone; default: both; initial: paper; convergence: paper, "
        "or field with --robot.")  # fmt: skip
@drive_options(
    choice("--wheels", ("ideal", "encoder"), "Wheel speeds without error, or counted travel."),
    option("--rate", "HZ", click.FloatRange(min=1, max=200), "Wheel and heading samples per second."),
    option("--heading-std heading_std_rad", "DEG", degrees(POSITIVE), "White noise of the heading."),
)
@options.PLOTS
@options.CONFIGURATION
@options.printing(options.QUIET, options.VERBOSE)
def command(
    name: StudyName, output: Path | None, request: Change[StudyRequest], preset: Literal["paper", "field"] | None,
    path: Change[PathPlan], plan: Change[DrivePlan], sensors: Change[Sensors], encoder_counts: float | None,
    rate: float | None, plots: tuple[str, ...], settings: ConfigSources, printer: Printer,
) -> None:  # fmt: skip
    """Simulate and filter many drives, and report accuracy, convergence time and consistency of the ICRs.

    \b
    NAME is one of
      convergence   Figs. 4, 5    convergence time of the ICRs, by kind of path
      initial       Figs. 6, 7    which initial ICRs converge, without and with the sign guard
      icr-change    Figs. 8, 9    following a change of the ICRs, with and without covariance inflation
      turn-radius   Fig. 10       convergence after a change, by radius of the turn
      input-source  Fig. 11       encoders against commanded speeds
      input-noise   Fig. 12       ICR error by noise of the track speeds
      input-bias    Fig. 13       ICR error by bias of the track speeds
      gnss          Figs. 35-37   ICR error and open-loop error by noise of the GNSS
      rate                        whether logs of any rate give the same ICRs
      consistency                 whether the filter's covariance is right

    Defaults are those of the paper (Pentzer 2014, Section 5); --robot and the options replace them. DIR holds
    study.json, every run in NAME.csv, and the picture.

    \b
    Example:
      icrtool study convergence --robot husky-a200 --wheels encoder --gnss waas
    """  # noqa: D301 - click reads the escape
    from icrtool.output.simulation_files import check_study_target, write_study
    from icrtool.simulation.studies import STUDIES, default_request, run_study

    config, given = settings.load(), click.get_current_context().params
    check_varied(STUDIES[name], name, given)
    asked = request(default_request(name, config))
    if config.robot.track_width_m is not None:
        asked = replace(asked, plan=replace(asked.plan, icrs_m=default_icrs(config)))
    asked = replace(asked, plan=plan(replace(asked.plan, path=path(asked.path))), sensors=sensors(asked.sensors))
    check_changes(asked.plan.changes, asked.plan.duration_s)
    if rate is not None:
        asked = replace(asked, sensors=replace(asked.sensors, wheel_rate_hz=rate, heading_rate_hz=rate))
    if (radius_m := config.robot.wheel_radius_m) is not None:
        metres = 2 * math.pi * radius_m / (encoder_counts or encoder_counts_of(config))
        asked = replace(asked, sensors=replace(asked.sensors, metres_per_count=metres))
    if given["kind"] is not None and asked.paths:
        asked = replace(asked, paths=(asked.path.kind,))
    if preset is None and "filter.preset" in config.given:
        preset = config.filter.preset
    if preset is None and name == "convergence" and config.robot.track_width_m is not None:
        preset = "field"
    if preset is not None:
        asked = replace(asked, presets=(preset,))
    directory = output if output is not None else RUNS / f"study-{name}"
    check_study_target(directory)
    from icrtool.output.tables.study import study_blocks

    with printer.progress(f"study {name}") as progress:
        result = run_study(asked, progress)
    write_study(result, directory, plots=plots)
    printer.show(study_blocks(result))
    printer.text(f"\nwritten to {directory}")
    printer.detail(f"settings: {asked.settings()}")


def check_varied(study: Study, name: str, given: Mapping[str, object]) -> None:
    """Refuse an option for what a study varies, and values where it varies no number; `given`: the options by name."""
    if given.get(study.varied) is not None:
        option = next(one.opts[0] for one in command.params if one.name == study.varied)
        raise click.UsageError(f"{option} is what study {name} varies; --values V,V,... sets where")
    if given["values"] is not None and not study.varies:
        raise click.UsageError(f"study {name} varies no number; it takes no --values")
