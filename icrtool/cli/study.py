"""``icrtool study``."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from icrtool.cli import options
from icrtool.cli.drive_options import CHANGE, PATHS, check_changes, gnss_text, icrs_text, numbers
from icrtool.cli.fit import RUNS, plot_formats
from icrtool.cli.options import NOT_NEGATIVE, POSITIVE
from icrtool.cli.simulate import default_icrs, encoder_counts
from icrtool.cli.terminal import show

if TYPE_CHECKING:
    from icrtool.config import Config
    from icrtool.simulation.drives import Sensors
    from icrtool.simulation.studies import StudyName, StudyRequest

STUDIES = (
    "convergence", "initial", "icr-change", "turn-radius", "input-noise", "input-bias", "input-source", "gnss", "rate",
    "consistency",
)  # fmt: skip

VARIES = {
    "input-noise": "input_noise",
    "input-bias": "input_bias",
    "gnss": "gnss",
    "rate": "rate",
    "turn-radius": "radius",
}
"""The option that a study varies itself; --values sets its values."""


def values_text(text: str) -> tuple[float, ...]:
    """Read ``V,V,...``."""
    return numbers(text, "V,V,...")


@click.command("study")
@click.argument("name", metavar="NAME", type=click.Choice(STUDIES))
@click.option(
    "-o",
    "--output",
    metavar="DIR",
    type=click.Path(path_type=Path),
    help="Study directory; default icrtool-runs/study-NAME.",
)
@click.option(
    "--runs",
    metavar="N",
    type=click.IntRange(min=1),
    help="Runs of every setting (from every start, in study initial).",
)
@click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed; the same seed, the same numbers."
)
@click.option("--values", metavar="V,V,...", type=values_text, help="Settings of what the study varies, in its unit.")
@click.option(
    "--preset",
    type=click.Choice(["paper", "field"]),
    help="Study this preset alone; default both; initial: paper; convergence: paper, field with a robot.",
)
@click.option(
    "--icrs",
    metavar="YR,YL,X",
    type=icrs_text,
    help="True ICRs [m]; default the paper's 0.5,-0.75,-0.25, or by the robot's width.",
)
@CHANGE
@click.option("--path", "kind", type=click.Choice(PATHS), help="What is driven; in study convergence, this alone.")
@click.option("--duration", metavar="S", type=POSITIVE, help="Length of a run [s].")
@click.option("--speed", metavar="MPS", type=POSITIVE, help="Speed of the body; of the faster track on the spot.")
@click.option("--radius", metavar="M", type=NOT_NEGATIVE, help="Radius of circles and of the tightest bends.")
@click.option("--leg", metavar="M", type=POSITIVE, help="Length of a lawnmower's legs.")
@click.option(
    "--wheels", type=click.Choice(["ideal", "encoder"]), help="Wheel speeds without error, or counted travel."
)
@click.option(
    "--encoder-counts", metavar="N", type=POSITIVE, help="Counts of a wheel revolution; default the robot's, or 8192."
)
@click.option("--input-noise", metavar="MPS", type=NOT_NEGATIVE, help="White noise of the track speeds, a sample.")
@click.option("--input-bias", metavar="MPS", type=float, help="Bias of both track speeds.")
@click.option("--rate", metavar="HZ", type=click.FloatRange(min=1, max=200), help="Wheel and heading samples a second.")
@click.option(
    "--gnss", metavar="rtk|waas|METRES", type=gnss_text, help="Noise of north and east: 0.01, 0.30 or so many metres."
)
@click.option("--gnss-rate", metavar="HZ", type=POSITIVE, help="Fixes a second.")
@click.option("--heading-std", metavar="DEG", type=POSITIVE, help="White noise of the heading.")
@click.option("--plots", default="png", show_default=True, metavar="png,svg,pdf|none", help="Formats of the picture.")
@options.configuration
@options.verbosity
def command(
    name: StudyName, output: Path | None, seed: int, plots: str,
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

    Everything left out is the paper's (Pentzer 2014, Section 5); --robot and the options put your own in. DIR holds
    study.json, every run in NAME.csv, and the picture.

    \b
    Example:
      icrtool study convergence --robot husky-a200 --wheels encoder --gnss waas
    """  # noqa: D301 - click reads the escape
    from icrtool.output.study_directory import check_study_target, write_study

    formats = plot_formats(plots)
    request = replace(_request(name, options.load(config_file, robot, sets), given), seed=seed)
    directory = output if output is not None else RUNS / f"study-{name}"
    check_study_target(directory)
    from icrtool.output.tables.study import format_study
    from icrtool.simulation.studies import run_study

    with options.progress_bar(f"study {name}", quiet=quiet) as progress:
        result = run_study(request, progress)
    write_study(result, directory, plots=formats)
    if not quiet:
        show(format_study(result))
        click.echo(f"\nwritten to {directory}")
    if verbose:
        click.echo(f"settings: {request.settings()}", err=True)


def _request(name: StudyName, config: Config, given: dict[str, Any]) -> StudyRequest:
    """Return the study's defaults, changed by the options."""
    from icrtool.simulation.studies import KINDS, default_request

    own = VARIES.get(name)
    if own is not None and given[own] is not None:
        raise click.UsageError(f"--{own.replace('_', '-')} is what study {name} varies; --values V,V,... sets where")
    if given["values"] is not None and not KINDS[name].varies:
        raise click.UsageError(f"study {name} varies no number; it takes no --values")
    request = default_request(name, config)
    plan, path = request.plan, request.plan.path
    values = {
        "kind": given["kind"],
        "speed_mps": given["speed"],
        "radius_m": given["radius"],
        "leg_m": given["leg"],
    }
    plan = replace(plan, path=replace(path, **_given(values)))
    if given["icrs"] is not None or config.robot.track_width_m is not None:
        plan = replace(plan, icrs_m=given["icrs"] or default_icrs(config))
    plan = replace(plan, **_given({"duration_s": given["duration"], "changes": given["changes"] or None}))
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
    return replace(request, **changed, **_given({"runs": given["runs"], "values": given["values"]}))


def _sensors(sensors: Sensors, config: Config, given: dict[str, Any]) -> Sensors:
    radius = config.robot.wheel_radius_m
    counts = encoder_counts(config, given)
    metres = 2 * math.pi * radius / counts if radius is not None else sensors.metres_per_count
    heading_std = math.radians(given["heading_std"]) if given["heading_std"] is not None else None
    values = {
        "wheels": given["wheels"],
        "wheel_rate_hz": given["rate"],
        "heading_rate_hz": given["rate"],
        "metres_per_count": metres,
        "input_noise_mps": given["input_noise"],
        "input_bias_mps": given["input_bias"],
        "gnss_std_m": given["gnss"],
        "gnss_rate_hz": given["gnss_rate"],
        "heading_std_rad": heading_std,
    }
    return replace(sensors, **_given(values))


def _given(values: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in values.items() if value is not None}
