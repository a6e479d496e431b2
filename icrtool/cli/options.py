"""Options that several commands share, and what reads their values."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Sequence
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

import click

from icrtool.records.text import escaped
from icrtool.records.urls import UrlPath, place_of

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

    from icrtool.config import Config
    from icrtool.output.files.baseline_file import Baseline
    from icrtool.records.dropout import Verdict
    from icrtool.records.fleet_document import FleetVerdict
    from icrtool.records.run import FigureSet

Command = TypeVar("Command", bound=Callable[..., Any])

POSITIVE = click.FloatRange(min=0, min_open=True)
NOT_NEGATIVE = click.FloatRange(min=0)


class _Place(click.Path):
    """A log, or a place of results, as a path or an address.

    Not checked by click: the reader reports an unreadable log with its own message and exit status 1.
    """

    def __init__(self) -> None:
        super().__init__(path_type=Path, readable=False)

    def convert(
        self, value: str | os.PathLike[str], param: click.Parameter | None, ctx: click.Context | None
    ) -> Path:  # fmt: skip
        """Return the path."""
        place = place_of(os.fspath(value))
        # click's own would lose a slash, and what stands behind a question mark.
        return place if isinstance(place, UrlPath) else cast("Path", super().convert(value, param, ctx))


LOG = PLACE = _Place()
LOGS = click.argument("logs", metavar="LOG...", nargs=-1, required=True, type=LOG)


class _File(click.Path):
    """A file or directory on disk."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(
        self, value: str | os.PathLike[str], param: click.Parameter | None, ctx: click.Context | None
    ) -> Path:  # fmt: skip
        """Return the path; refuse an address."""
        if isinstance(address := place_of(os.fspath(value)), UrlPath):
            self.fail(f"{escaped(str(address))}: an address is not taken here; name a place on disk", param, ctx)
        return cast("Path", super().convert(value, param, ctx))


FILE = _File()


class _NewFile(_File):
    """A file that the command writes: a place that cannot be written is refused before any work is done."""

    def __init__(self, *, picture: bool = False) -> None:
        super().__init__()
        self._picture = picture

    def convert(
        self, value: str | os.PathLike[str], param: click.Parameter | None, ctx: click.Context | None
    ) -> Path:  # fmt: skip
        """Return the path."""
        path = super().convert(value, param, ctx)
        if self._picture:
            from icrtool.output.files.formats import check_picture

            check_picture(path)
        else:
            from icrtool.output.files.own_files import check_place

            check_place(path)
        return path


NEW_FILE, NEW_PICTURE = _NewFile(), _NewFile(picture=True)


def configuration(command: Command) -> Command:
    """Add --config, --robot and --set."""
    options = (
        click.option("--config", "config_file", metavar="FILE.toml", type=FILE, help="Configuration file."),
        click.option("--robot", metavar="NAME", shell_complete=_robots,
                     help="Built-in robot, for example husky-a200; icrtool robots lists them."),
        click.option("--set", "sets", metavar="SECTION.KEY=VALUE", multiple=True, shell_complete=_settings,
                     help="Set a configuration key; icrtool config lists them; repeatable."),
    )  # fmt: skip
    return add_options(command, *options)


def add_options(command: Command, *options: Callable[[Command], Command]) -> Command:
    """Add options to a command, in this order."""
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
    return add_options(
        command,
        click.option("-o", "--output", metavar="DIR", type=PLACE,
                     help="Run directory of the log; with several logs: the folder of their run directories."),
        click.option("--into", metavar="DIR", type=PLACE, help="Folder of the run directories, also for one log."),
        click.option("--overwrite", is_flag=True, help="Also replace the run of another recording."),
    )  # fmt: skip


def numbers(text: str, form: str, count: int | None = None) -> tuple[float, ...]:
    """Read numbers separated by commas; `form` is what they shall look like."""
    try:
        found = tuple(float(part) for part in text.split(","))
    except ValueError:
        found = ()
    if len(found) != (count or len(found)) or not found or not all(map(math.isfinite, found)):
        raise click.BadParameter(f"{text!r} is not of the form {form}")
    return found


def seed(command: Command) -> Command:
    """Add --seed, by default 0."""
    text = "Seed of all noise; the same seed, the same numbers."
    return click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help=text)(command)


def plot_formats(text: str) -> tuple[str, ...]:
    """Read ``png,svg,pdf`` or ``none``."""
    formats = tuple(part.strip().lower() for part in text.split(",") if part.strip())
    if formats == ("none",):
        return ()
    from icrtool.output.files.formats import PLOT_FORMATS

    unknown = [part for part in formats if part not in PLOT_FORMATS]
    if unknown or not formats:
        raise click.BadParameter(f"{', '.join(unknown) or text!r} is not one of {', '.join(PLOT_FORMATS)}, none")
    return formats


def plots(command: Command) -> Command:
    """Add --plots, as a tuple of formats."""
    return click.option("--plots", default="png", show_default=True, metavar="png,svg,pdf|none", type=plot_formats,
                        help="Formats of the pictures.")(command)  # fmt: skip


def figures(command: Command) -> Command:
    """Add --figures, as a `FigureSet`."""
    return click.option("--figures", type=click.Choice(["default", "all"]), default="default", show_default=True,
                        help="all: also those of the paper, such as a histogram a distance.")(command)  # fmt: skip


def budgets(command: Command) -> Command:
    """Add --budget, as `budgets`."""
    return click.option("--budget", "budgets", metavar="METRES", type=POSITIVE, multiple=True, default=(0.5,),
                        show_default=True, help="Report how far 95 % of the errors stay within this; repeatable.",
                        )(command)  # fmt: skip


def report(command: Command) -> Command:
    """Add the options of a dropout report that are the same for one log and for many.

    The command gets them as `asked`, a `ReportOptions`; and `baseline`, `junit` and `markdown`.
    """

    @wraps(command)
    def with_options(
        *, plots: tuple[str, ...], gates: tuple[str, ...], budgets: tuple[float, ...], ladder: bool, strict: bool,
        page: bool, allow_unusable: bool, figures: FigureSet, junit: Path | None, markdown: Path | None,
        **others: object,
    ) -> object:  # fmt: skip
        from icrtool.fleet.one_log import ReportOptions

        # one that is all blank stays, and is refused as no limit
        limits = tuple(line for gate in gates for line in [one for one in gate.splitlines() if one.strip()] or [gate])
        asked = ReportOptions(plots, limits, budgets, ladder, strict, page, allow_unusable, figures)
        return command(asked=asked, junit=junit, markdown=markdown, **others)

    return add_options(
        cast("Command", with_options),
        budgets,
        click.option("--gate", "gates", metavar="LIMIT", multiple=True,
                     help="Acceptance limit, or several, one a line: exit status 3 if one is not met; repeatable."),
        click.option("--baseline", metavar="REPORT.json|DIR", type=FILE,
                     help="Earlier report, run or batch to compare with; a limit may then read "
                     "\"icr.p95@10m <= 1.1 * baseline\"."),
        click.option("--strict-gates", "strict", is_flag=True,
                     help="Compare limits relative to the baseline by their number alone, without the "
                     "confidence interval of the difference."),
        click.option("--ladder/--no-ladder", default=True, show_default=True,
                     help="Also test the motion model and the controller numbers, with a gyro too, on distance "
                     "that they were not fitted to."),
        click.option("--junit", metavar="FILE", type=NEW_FILE, help="Write the verdicts on the limits as JUnit XML."),
        click.option("--markdown", metavar="FILE", type=NEW_FILE, help="Write a summary for a pull request."),
        allow_unusable,
        plots,
        figures,
        click.option("--page/--no-page", default=True, show_default=True,
                     help="Also write report.html: pictures, tables and an interactive map in one file."),
    )  # fmt: skip


def allow_unusable(command: Command) -> Command:
    """Add --allow-unusable."""
    return click.option("--allow-unusable", is_flag=True,
                        help="Give distances and numbers of runs that are not usable, too.")(command)  # fmt: skip


def baseline_of(place: Path | None, gates: Sequence[str]) -> Baseline | None:
    """Find the reports of --baseline; refuse gates that cannot be read, or need one where there is none."""
    from icrtool.dropout_analysis.acceptance_limits import parse_gate
    from icrtool.errors import ConfigError

    relative = [gate.text for gate in map(parse_gate, gates) if gate.baseline_factor]
    if place is not None:
        from icrtool.output.files.baseline_file import open_baseline

        return open_baseline(place)
    if relative:
        raise ConfigError(f"gate {relative[0]!r}", "needs an earlier report", "name it with --baseline REPORT.json|DIR")
    return None


def check_compared(verdicts: Iterable[Verdict | FleetVerdict]) -> None:
    """Refuse a baseline that has none of the logs: a gate that is never checked would always pass."""
    from icrtool.errors import ConfigError

    relative = [bool(one.not_checked) for one in verdicts if one.relative]
    if relative and all(relative):
        raise ConfigError("--baseline", "none of these logs is in it", "logs are matched by content, else by name")


def cut(command: Command) -> Command:
    """Add --from and --to, as `start` and `end`."""
    what = "seconds since the log's first message, or a time in ISO 8601 (UTC without a zone)"
    return add_options(
        command,
        click.option("--from", "start", metavar="TIME", help=f"Read the log from here: {what}."),
        click.option("--to", "end", metavar="TIME", help="Read the log up to here."),
    )


def as_json(command: Command) -> Command:
    """Add --json, as `as_json`."""
    text = "Print one JSON document on standard output, and nothing else there."
    return click.option("--json", "as_json", is_flag=True, help=text)(command)


def quiet(command: Command) -> Command:
    """Add -q alone."""
    return click.option("-q", "--quiet", is_flag=True, help="Print no results.")(command)


def verbosity(command: Command) -> Command:
    """Add -q and -v."""
    return add_options(
        command,
        click.option("-q", "--quiet", is_flag=True, help="Print no results and no warnings."),
        click.option("-v", "--verbose", is_flag=True, help="Print more details."),
    )


def load(config_file: Path | None, robot: str | None, sets: tuple[str, ...]) -> Config:
    """Load the configuration the options describe."""
    from icrtool.config import load_config

    return load_config(config_file, robot, sets)


def given(
    config_file: Path | None, robot: str | None, sets: tuple[str, ...], start: str | None, end: str | None
) -> list[str]:
    """Return the options of a call that the next command takes too."""
    pairs = [("--config", config_file), ("--robot", robot), *(("--set", one) for one in sets)]
    pairs += [("--from", start), ("--to", end)]
    return [escaped(str(part)) for name, value in pairs if value is not None for part in (name, value)]
