"""``icrtool study``."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from icrtool.cli import options
from icrtool.cli.inputs import RUNS
from icrtool.cli.options import FILE, POSITIVE, choice, numbers, option
from icrtool.cli.printing import Printer
from icrtool.cli.simulate import check_changes, default_icrs, degrees, drive_options, encoder_counts, given_fields

if TYPE_CHECKING:
    from icrtool.config import Config, ConfigSources
    from icrtool.simulation.drives import Sensors
    from icrtool.simulation.study_records import StudyName, StudyRequest

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
@option("--runs", "N", click.IntRange(min=1), "Runs for each value (in study initial: for each start).")
@options.SEED
@option("--values", "V,V,...", values_text, "Values of the quantity that the study varies, in its unit.")
@choice("--preset", ("paper", "field"), "Study this preset alone; default: both; initial: paper; convergence: paper, "
        "or field with --robot.")  # fmt: skip
@drive_options()
@choice("--wheels", ("ideal", "encoder"), "Wheel speeds without error, or counted travel.")
@option("--rate", "HZ", click.FloatRange(min=1, max=200), "Wheel and heading samples per second.")
@option("--heading-std heading_std_rad", "DEG", degrees(POSITIVE), "White noise of the heading.")
@options.PLOTS
@options.CONFIGURATION
@options.printing(options.QUIET, options.VERBOSE)
def command(
    name: StudyName,
    output: Path | None,
    seed: int,
    plots: tuple[str, ...],
    settings: ConfigSources,
    printer: Printer,
    **given: Any,
) -> None:
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
    from icrtool.output.study_directory import check_study_target, write_study

    request = replace(_request(name, settings.load(), given), seed=seed)
    directory = output if output is not None else RUNS / f"study-{name}"
    check_study_target(directory)
    from icrtool.output.tables.study import format_study
    from icrtool.simulation.studies import run_study

    with printer.progress(f"study {name}") as progress:
        result = run_study(request, progress)
    write_study(result, directory, plots=plots)
    printer.text(format_study(result))
    printer.text(f"\nwritten to {directory}")
    printer.detail(f"settings: {request.settings()}")


def _request(name: StudyName, config: Config, given: dict[str, Any]) -> StudyRequest:
    """Return the study's defaults, changed by the options."""
    from icrtool.simulation.drives import DrivePlan
    from icrtool.simulation.paths import PathPlan
    from icrtool.simulation.studies import STUDIES, default_request
    from icrtool.simulation.study_records import StudyRequest

    study = STUDIES[name]
    if given.get(study.varied) is not None:
        option = next(one.opts[0] for one in command.params if one.name == study.varied)
        raise click.UsageError(f"{option} is what study {name} varies; --values V,V,... sets where")
    if given["values"] is not None and not study.varies:
        raise click.UsageError(f"study {name} varies no number; it takes no --values")
    request = default_request(name, config)
    path = replace(request.path, **given_fields(PathPlan, given))
    plan = replace(request.plan, **given_fields(DrivePlan, given), path=path)
    if given["icrs_m"] is None and config.robot.track_width_m is not None:
        plan = replace(plan, icrs_m=default_icrs(config))
    check_changes(plan.changes, plan.duration_s)
    changed: dict[str, Any] = {"plan": plan, "sensors": _sensors(request.sensors, config, given)}
    if given["kind"] is not None and request.paths:
        changed["paths"] = (given["kind"],)
    preset = given["preset"]
    if preset is None and "filter.preset" in config.given:
        preset = config.filter.preset
    if preset is None and name == "convergence" and config.robot.track_width_m is not None:
        preset = "field"
    if preset is not None:
        changed["presets"] = (preset,)
    return replace(request, **changed, **given_fields(StudyRequest, given))


def _sensors(sensors: Sensors, config: Config, given: dict[str, Any]) -> Sensors:
    radius, rate = config.robot.wheel_radius_m, given["rate"]
    changed = given_fields(type(sensors), given)
    if rate is not None:
        changed |= {"wheel_rate_hz": rate, "heading_rate_hz": rate}
    if radius is not None:
        changed["metres_per_count"] = 2 * math.pi * radius / encoder_counts(config, given)
    return replace(sensors, **changed)
