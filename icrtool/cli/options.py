"""Options and messages that several commands share."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from icrtool.cli.stages import Stages, signal_word
from icrtool.records.text import LONGEST_NAME, escaped, shortened

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

    from icrtool.config import Config
    from icrtool.errors import IcrToolError
    from icrtool.output.baseline_file import Baseline

Command = TypeVar("Command", bound=Callable[..., Any])

POSITIVE = click.FloatRange(min=0, min_open=True)
NOT_NEGATIVE = click.FloatRange(min=0)

NAMES_SHOWN = 5

# Not checked by click: the reader reports an unreadable log with its own message and exit status 1.
LOG = click.Path(path_type=Path, readable=False)
LOGS = click.argument("logs", metavar="LOG...", nargs=-1, required=True, type=LOG)


def configuration(command: Command) -> Command:
    """Add --config, --robot and --set."""
    options = (
        click.option(
            "--config", "config_file", metavar="FILE.toml", type=click.Path(path_type=Path), help="Configuration file."
        ),
        click.option("--robot", metavar="NAME", shell_complete=_robots,
                     help="Built-in robot, for example husky-a200; icrtool robots lists them."),
        click.option("--set", "sets", metavar="SECTION.KEY=VALUE", multiple=True, shell_complete=_settings,
                     help="Set a configuration key; icrtool config lists them; repeatable."),
    )  # fmt: skip
    for option in reversed(options):
        command = option(command)
    return command


def _robots(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    from icrtool.cli.completion import complete_robot

    return complete_robot(ctx, param, incomplete)


def _settings(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    from icrtool.cli.completion import complete_setting

    return complete_setting(ctx, param, incomplete)


def place(command: Command) -> Command:
    """Add -o, --into and --overwrite, as `output`, `into` and `overwrite`."""
    command = click.option("--overwrite", is_flag=True, help="Also replace the run of another recording.")(command)
    command = click.option("--into", metavar="DIR", type=click.Path(path_type=Path),
                           help="Parent of the run directories, also of one log.")(command)  # fmt: skip
    return click.option("-o", "--output", metavar="DIR", type=click.Path(path_type=Path),
                        help="Run directory of a log; of several logs: its parent.")(command)  # fmt: skip


def baseline(command: Command) -> Command:
    """Add --baseline and --strict-gates, as `baseline` and `strict`."""
    command = click.option("--strict-gates", "strict", is_flag=True,
                           help="A gate on the baseline fails by its number alone, also where the interval of the "
                           "difference reaches the bound.")(command)  # fmt: skip
    return click.option("--baseline", metavar="REPORT.json|DIR", type=click.Path(path_type=Path),
                        help="Earlier report, run or batch to compare with; a gate may then read "
                        "\"icr.p95@10m <= 1.1 * baseline\".")(command)  # fmt: skip


def open_baseline(place: Path | None, gates: Sequence[str]) -> Baseline | None:
    """Find the reports of --baseline; refuse gates that need one where there is none."""
    from icrtool.dropout_analysis.acceptance_limits import parse_gate
    from icrtool.errors import ConfigError
    from icrtool.output.baseline_file import open_baseline

    relative = [gate.text for gate in map(parse_gate, gates) if gate.baseline_factor]
    if place is None and relative:
        raise ConfigError(f"gate {relative[0]!r}", "needs an earlier report", "name it with --baseline REPORT.json|DIR")
    return open_baseline(place) if place is not None else None


def check_compared(verdicts: Sequence[tuple[bool, bool]]) -> None:
    """Refuse a baseline that has none of the logs: a gate that is never checked would always pass.

    Parameters
    ----------
    verdicts : for each, whether its limit is relative to the baseline, and whether it was not checked
    """
    from icrtool.errors import ConfigError

    relative = [not_checked for is_relative, not_checked in verdicts if is_relative]
    if relative and all(relative):
        raise ConfigError("--baseline", "none of these logs is in it", "logs are matched by content, else by name")


def cut(command: Command) -> Command:
    """Add --from and --to, as `start` and `end`."""
    what = "seconds since the log's first message, or a time in ISO 8601 (UTC without a zone)"
    command = click.option("--to", "end", metavar="TIME", help="Read the log up to here.")(command)
    return click.option("--from", "start", metavar="TIME", help=f"Read the log from here: {what}.")(command)


def page(command: Command) -> Command:
    """Add --page."""
    what = "Also write report.html: pictures, tables and an interactive map in one file."
    return click.option("--page/--no-page", default=True, show_default=True, help=what)(command)


def verbosity(command: Command) -> Command:
    """Add -q and -v."""
    command = click.option("-v", "--verbose", is_flag=True, help="Print more details.")(command)
    return click.option("-q", "--quiet", is_flag=True, help="Print no results and no warnings.")(command)


def load(config_file: Path | None, robot: str | None, sets: tuple[str, ...]) -> Config:
    """Load the configuration the options describe."""
    from icrtool.config import load_config

    return load_config(config_file, robot, sets)


def warn(warnings: tuple[str, ...] | list[str], *, quiet: bool) -> None:
    """Print warnings on standard error."""
    if not quiet:
        for warning in warnings:
            click.echo(f"{signal_word('Warning:', 'yellow')} {warning}", err=True)


def error_line(err: IcrToolError, source: Path | str) -> str:
    """Return the line about an error, which names the log or run that it occurred in."""
    name = shortened(escaped(str(source)), LONGEST_NAME)
    named = any(part in str(err) for part in (name, escaped(Path(source).name), escaped(Path(source).stem)))
    word = signal_word("Error:", "red")
    return f"{word} {err}" if named else f"{word} {name}: {err}"


def report_error(err: IcrToolError, source: Path | str) -> None:
    """Print the line about an error on standard error."""
    click.echo(error_line(err, source), err=True)


def leave(failed: Sequence[object], of: int, what: str, *, gate_failed: bool = False) -> None:
    """Exit with the status of a command that had several inputs: 3 if a gate failed, else 1 if an input failed.

    Parameters
    ----------
    failed : inputs that could not be used; each was reported when it occurred
    of : number of inputs
    """
    if failed and of > 1:
        names = [shortened(escaped(str(source)), LONGEST_NAME) for source in failed]
        listed = ", ".join(names[:NAMES_SHOWN]) + (
            f" and {len(names) - NAMES_SHOWN} more" if names[NAMES_SHOWN:] else ""
        )
        word = signal_word("Error:", "red")
        click.echo(f"{word} {len(failed)} of {of} {what} could not be used: {listed}", err=True)
    if gate_failed or failed:
        raise SystemExit(3 if gate_failed else 1)


@contextmanager
def progress_bar(label: str, *, quiet: bool) -> Iterator[Callable[[float], None] | None]:
    """Give a function that shows the share done of work of one stage; None where there is no terminal."""
    with Stages(label, quiet=quiet) as stages:
        stages.begin("")
        yield stages.share if stages.on_terminal else None
