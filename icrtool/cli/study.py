"""``icrtool study``."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from icrtool.cli import options
from icrtool.cli.inputs import RUNS
from icrtool.cli.options import POSITIVE, numbers
from icrtool.cli.printing import progress_bar, show
from icrtool.cli.simulate import check_changes, default_icrs, degrees, drive_options, encoder_counts, given_fields

if TYPE_CHECKING:
    from icrtool.config import Config
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
@click.option("-o", "--output", metavar="DIR", type=options.FILE,
              help="Study directory; default icrtool-runs/study-NAME.")  # fmt: skip
@click.option("--runs", metavar="N", type=click.IntRange(min=1),
              help="Runs for each value (in study initial: for each start).")  # fmt: skip
@options.seed
@click.option("--values", metavar="V,V,...", type=values_text,
              help="Values of the quantity that the study varies, in its unit.")  # fmt: skip
@click.option("--preset", type=click.Choice(["paper", "field"]),
              help="Study this preset alone; default: both; initial: paper; convergence: paper, or field with --robot.",
              )  # fmt: skip
@drive_options()
@click.option("--wheels", type=click.Choice(["ideal", "encoder"]),
              help="Wheel speeds without error, or counted travel.")  # fmt: skip
@click.option(
    "--rate", metavar="HZ", type=click.FloatRange(min=1, max=200), help="Wheel and heading samples per second."
)
@click.option("--heading-std", "heading_std_rad", metavar="DEG", type=degrees(POSITIVE),
              help="White noise of the heading.")  # fmt: skip
@options.plots
@options.configuration
@options.verbosity
def command(
    name: StudyName, output: Path | None, seed: int, plots: tuple[str, ...],
    config_file: Path | None, robot: str | None, sets: tuple[str, ...], quiet: bool, verbose: bool, **given: Any,
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
    from icrtool.output.study_directory import check_study_target, write_study

    request = replace(_request(name, options.load(config_file, robot, sets), given), seed=seed)
    directory = output if output is not None else RUNS / f"study-{name}"
    check_study_target(directory)
    from icrtool.output.tables.study import format_study
    from icrtool.simulation.studies import run_study

    with progress_bar(f"study {name}", quiet=quiet) as progress:
        result = run_study(request, progress)
    write_study(result, directory, plots=plots)
    if not quiet:
        show(format_study(result))
        click.echo(f"\nwritten to {directory}")
    if verbose:
        click.echo(f"settings: {request.settings()}", err=True)


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
