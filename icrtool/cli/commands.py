"""The command group. The module of a command is imported when the command is called, so that ``--help`` is instant."""

from __future__ import annotations

from importlib import import_module

import click

from icrtool import __version__
from icrtool.records.text import did_you_mean

_COMMANDS = {
    "demo": "Fit and report on a sample log that comes with icrtool, to see its results.",
    "info": "List what logs hold, which topics would be used, and the problems found.",
    "fit": "Learn the track ICRs of a robot from its logs.",
    "dropout-report": "Report the open-loop error without GNSS, over 1 to 20 m from every recorded state.",
    "report": "Answer the whole question of a log on one screen, or write the page of a result.",
    "calibrate": "Calibrate the motion model of a robot from one log or many.",
    "forecast": "Forecast the error of driving a path without GNSS, with a calibration.",
    "export": "Write a calibration for a controller, or a run for evo, Google Earth, QGIS or Foxglove.",
    "compare": "Compare groups of runs: ICRs, errors, and the errors of the calibration of one group in another.",
    "batch": "Fit and report on folders of logs, in several processes; a table with a row per log.",
    "robots": "List the built-in robots, with their numbers and sources.",
    "config": "Print all configuration keys with their meaning, bounds and defaults, as a TOML file.",
    "cache": "Compile the kernels ahead, for an image or a CI cache.",
    "completion": "Print what bash, zsh or fish needs to complete commands, robots, keys and topics.",
    "simulate": "Drive a robot of known ICRs and record its log, with the truth next to it.",
    "study": "Simulate and filter many drives: accuracy, convergence time and consistency of the ICRs.",
}
"""One line of help for each command, by its name."""

_GROUPS = {
    "Start here": ("info", "report", "demo"),
    "Commands": ("fit", "dropout-report", "calibrate", "forecast", "export", "compare", "batch"),
    "More": ("robots", "config", "cache", "completion", "simulate", "study"),
}
"""Titles of the groups in ``--help``, with the names of their commands."""

_COMMAND_MODULES = {
    "info": "fit",
    "forecast": "calibrate",
    "compare": "report",
    "study": "simulate",
    **dict.fromkeys(("robots", "config", "cache", "completion"), "installation"),
}
"""Names of the modules of commands whose module is not named after the command."""


class _Commands(click.Group):
    """Command group that finds each command as ``NAME_command`` in its module."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in _COMMANDS:
            return None
        name = cmd_name.replace("-", "_")
        command: click.Command = getattr(
            import_module(f"icrtool.cli.{_COMMAND_MODULES.get(name, name)}"), f"{name}_command"
        )
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError as err:
            if args[0] not in _COMMANDS and (meant := did_you_mean(args[0], _COMMANDS)):
                raise click.UsageError(f"No such command {args[0]!r}: {meant.strip()}", ctx) from err
            raise

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        widest = max(map(len, _COMMANDS))
        for title, names in _GROUPS.items():
            with formatter.section(title):
                formatter.write_dl([(f"{name:{widest}}", _COMMANDS[name]) for name in names])


@click.command(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="icrtool")
def icrtool() -> None:
    """Learn the track ICRs of a skid-steer robot from its field logs, and how far it can drive without GNSS.

    A log is an .mcap file, a ROS 1 .bag, a ROS 2 bag directory or a bare .db3. Results go to standard output,
    warnings and errors to standard error. Exit status: 0 done, 1 the log, configuration or request cannot be used,
    2 wrong usage, 3 an acceptance limit is not met.
    """
