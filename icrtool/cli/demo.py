"""``icrtool demo``, which fits and reports on a sample log."""

from __future__ import annotations

import importlib
import shlex
from pathlib import Path

import click

SAMPLE_LOG, SAMPLE_ROBOT = "wheeled_lawnmower.mcap", "segway-rmp400"
"""Name of the sample log, a rigid-body simulation of 200 s and 122 m, and of its robot."""

DEMO_RUN = Path("icrtool-runs", "demo")
"""Run directory of the demonstration, relative to the current folder."""


def sample_log() -> Path:
    """Return the path of the sample log in the installed package, or in the checkout of the package."""
    package = Path(__file__).resolve().parents[1]
    folders = (package, package.parent)
    return next(
        (path for folder in folders if (path := folder / "sample_logs" / SAMPLE_LOG).is_file()), Path(SAMPLE_LOG)
    )


@click.command("demo")
def demo_command() -> None:
    """Fit a sample log that comes with icrtool, and report how far its robot drives without GNSS.

    The command prints and runs the two commands that a user would run. The result is the folder icrtool-runs/demo,
    with a page to open in a browser. The log is a rigid-body simulation of a wheeled robot.
    """
    fit = ["fit", str(sample_log()), "--robot", SAMPLE_ROBOT, "-o", str(DEMO_RUN)]
    report = ["dropout-report", str(DEMO_RUN)]
    for name, *words in (fit, report):
        click.secho(f"$ {shlex.join(['icrtool', name, *words])}", bold=True)
        module = importlib.import_module(f"icrtool.cli.{name.replace('-', '_')}")
        command: click.Command = getattr(module, f"{name.replace('-', '_')}_command")
        command.main(words, prog_name=f"icrtool {name}", standalone_mode=False)
        click.echo()
    click.echo("Next: icrtool info YOUR_LOG")
