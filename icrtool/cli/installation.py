"""``icrtool robots``, ``config``, ``cache`` and ``completion``: built-in robots, keys, compiled code, completion."""

from __future__ import annotations

import importlib
import pkgutil
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click
from click.shell_completion import BashComplete, CompletionItem, add_completion_class, get_completion_class

from icrtool.cli import lazy_imports, options
from icrtool.cli.options import flag, option
from icrtool.cli.printing import Printer, write_or_print
from icrtool.output.text_blocks import Line, Table

with lazy_imports():
    from icrtool import config
    from icrtool.output.tables import configuration

if TYPE_CHECKING:
    from icrtool.config import ConfigSources


@click.command("robots")
@options.printer_options(options.AS_JSON)
def robots_command(printer: Printer) -> None:
    """List the built-in robots for --robot, with their numbers and sources.

    For another robot, give --set robot.track_width_m=… and --set robot.wheel_radius_m=…, or a configuration file, which
    icrtool config prints.
    """
    robots = config.builtin_robots()
    keys = ("track_width_m", "wheel_radius_m", "encoder_counts_per_rev", "skid_factor", "source")
    listed = [{"name": name} | {key: robot.get(key) for key in keys} for name, robot in robots.items()]
    printer.json("robots", {"robots": listed})
    rows = [
        (
            name, f"{robot['track_width_m']:.3f} m", f"{robot['wheel_radius_m']:.4f} m",
            f"{robot['encoder_counts_per_rev']:,}" if "encoder_counts_per_rev" in robot else "-",
            f"{robot['skid_factor']:g}" if "skid_factor" in robot else "-",
        )
        for name, robot in robots.items()
    ]  # fmt: skip
    head = ("robot", "track width", "wheel radius", "counts per turn", "skid factor")
    sources = Table("l", [(f"  {name}", robot["source"]) for name, robot in robots.items()])
    printer.show([Table("lr", rows, head), "", Line("Sources", "title"), sources])


@click.command("config")
@options.CONFIGURATION
@option("-o --output", "FILE", options.NEW_FILE, "File to write; default: standard output.")
def config_command(settings: ConfigSources, output: Path | None) -> None:
    """Print all configuration keys as a TOML file, with meaning, type, bounds and value.

    Without options the values are the defaults; --robot, --config and --set change them. Keys without a default are
    comments with an example. Edit the file, and use it with --config.

    \b
    Example:
      icrtool config --robot husky-a200 -o my-husky.toml
      icrtool fit field.mcap --config my-husky.toml
    """  # noqa: D301 - click reads the escape
    write_or_print(configuration.format_configuration(settings.load()), output)


@click.group("cache")
def cache_command() -> None:
    """Manage the machine code of the kernels, which the first commands on a computer otherwise compile."""


@cache_command.command("warm")
@flag("-q --quiet", "Print no result.")
def compile_all(*, quiet: bool) -> None:
    """Compile all kernels and modules now, so that no later command has to: for an image or a CI cache.

    The machine code is kept in NUMBA_CACHE_DIR, else in the installed package, else in the user's cache. Later commands
    also use it from a NUMBA_CACHE_DIR that they cannot write. If NUMBA_CPU_NAME=generic is set here and in later
    commands, the code runs on any processor of this architecture.

    \b
    Example:
      export NUMBA_CACHE_DIR=$HOME/kernels NUMBA_CPU_NAME=generic
      icrtool cache warm
    """  # noqa: D301 - click reads the escape
    import icrtool
    from icrtool.errors import OutputError
    from icrtool.kernels.compiled import all_kernels, cache_directories, processor, writable_directory

    begin = time.perf_counter()
    for module in pkgutil.walk_packages(icrtool.__path__, "icrtool."):
        # Python keeps the compiled code of an imported module.
        importlib.import_module(module.name)
    place = writable_directory()
    if place is None:
        raise OutputError(
            cache_directories()[0], "cannot be written", "set NUMBA_CACHE_DIR to a directory that can be written"
        )
    call_all_kernels()
    if not quiet:
        compiled = [bool(kernel.compiled) for kernel in all_kernels()]
        click.echo(
            f"{sum(compiled)} of {len(compiled)} kernels compiled for {processor()[0]}, "
            f"in {time.perf_counter() - begin:.1f} s; kept in {place}"
        )


def call_all_kernels() -> None:
    """Call each kernel with the types of arguments of the commands: simulate, fit, smooth, report and study a robot."""
    import numpy as np

    import icrtool
    from icrtool.estimation.run_filter import smooth_run
    from icrtool.kernels.open_loop import open_loop_errors_direct
    from icrtool.kernels.track import FrozenIcrs, trial_ends
    from icrtool.logs.write_log import WriteOptions, write_log
    from icrtool.records.process_resources import unfinished
    from icrtool.records.run import track_of
    from icrtool.simulation.drives import DrivePlan, Sensors, simulate
    from icrtool.simulation.friction import FrictionRobot
    from icrtool.simulation.studies import default_request, run_study

    config = icrtool.load_config(robot="husky-a200")
    columns, _ = simulate(DrivePlan(motor_lag_s=0.1), Sensors(), 0)
    simulate(DrivePlan(robot=FrictionRobot(), duration_s=1.0), Sensors(), 0)
    robot = config.robot
    assert robot.wheel_radius_m is not None  # noqa: S101 - for the type checker
    assert robot.track_width_m is not None  # noqa: S101 - as above
    writing = WriteOptions(wheel_radius_m=robot.wheel_radius_m, track_width_m=robot.track_width_m)
    with tempfile.TemporaryDirectory() as folder, unfinished(Path(folder)):
        log = icrtool.read_log(write_log(Path(folder) / "drive.mcap", columns, writing), config)
    run = icrtool.fit(log, config)
    icrtool.dropout(run)
    smooth_run(run)
    track = track_of(run)
    open_loop_errors_direct(track, FrozenIcrs.constant(0.4, -0.4, 0.0), trial_ends(track, np.array([1.0])))
    request = default_request("consistency", config)
    run_study(replace(request, runs=1, plan=replace(request.plan, duration_s=10.0)))


NO_BLANK_AFTER_EQUALS = """\
    [[ ${#COMPREPLY[@]} == 1 && ${COMPREPLY[0]} == *= ]] && compopt -o nospace
    return 0
"""


class BashWithEquals(BashComplete):
    """Completion of ``--set key=value`` in bash, which splits words at ``=`` and replaces only the text after it."""

    source_template = BashComplete.source_template.replace("    return 0\n", NO_BLANK_AFTER_EQUALS, 1)

    def get_completion_args(self) -> tuple[list[str], str]:
        """Return the complete words and the incomplete word; words that bash split at ``=`` are joined."""
        args, incomplete = super().get_completion_args()
        rest, words = [*args, incomplete], [""]
        while rest:
            word = rest.pop(0)
            if word != "=":
                words.append(word)
            elif words[-1].startswith("-"):
                words.append(rest.pop(0) if rest else "")
            else:
                words[-1] += f"={rest.pop(0) if rest else ''}"
        return words[1:-1], words[-1]

    def format_completion(self, item: CompletionItem) -> str:
        """Return a completion without the text before its ``=``."""
        key, equals, value = item.value.partition("=")
        after = value if equals and value else f"{key}{equals}"
        return f"{item.type},{after}"


def register_completion() -> None:
    """Register `BashWithEquals` in click, before click answers a shell that asks for completions."""
    add_completion_class(BashWithEquals, "bash")


@click.command("completion")
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion_command(shell: str) -> None:
    """Print what a shell needs to complete commands, options, robots, configuration keys and topics of a log.

    \b
    One line in the shell's start-up file:
      eval "$(icrtool completion bash)"        # in ~/.bashrc
      eval "$(icrtool completion zsh)"         # in ~/.zshrc, after compinit
      icrtool completion fish | source         # in ~/.config/fish/config.fish
    """  # noqa: D301 - click reads the escape
    from icrtool.cli.commands import icrtool

    register_completion()
    completion_class = get_completion_class(shell)
    if completion_class is None:
        raise click.UsageError(f"click has no completion for {shell}")
    click.echo(completion_class(icrtool, {}, "icrtool", "_ICRTOOL_COMPLETE").source())
