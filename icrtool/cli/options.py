"""Options that several commands share, and the functions that read their values.

Each option is declared by `option`, `choice` or `flag`. Options that belong together reach the command as one argument
(`options_as_record`).
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import wraps
from inspect import signature
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, cast, get_args

import click
from click.shell_completion import CompletionItem

from icrtool.cli import lazy_imports
from icrtool.cli.inputs import ResultPlace
from icrtool.cli.printing import Printer
from icrtool.records.choices import FigureSet
from icrtool.records.places import UrlPath, place_of
from icrtool.records.text import did_you_mean, escaped

with lazy_imports():
    from icrtool import config, errors
    from icrtool.dropout_analysis import report
    from icrtool.logs.containers import open_log
    from icrtool.output import dropout_directory
    from icrtool.output.exports import acceptance
    from icrtool.output.files import atomic, formats
    from icrtool.records import input_limits, rows

if TYPE_CHECKING:
    from icrtool.calibration.record import Calibration
    from icrtool.config import ConfigSources
    from icrtool.records.acceptance import Verdict
    from icrtool.records.fleet_document import FleetVerdict
    from icrtool.records.requests import FitRequest, ReportRequest

Command = Callable[..., Any]
"""The function of a command."""

Option = Callable[[Command], Command]
"""A decorator that adds an option to a command."""

RecordT = TypeVar("RecordT")
RecordChange = Callable[[RecordT], RecordT]
"""A function that returns a changed record."""

REQUESTS_MODULE = "icrtool.records.requests"
"""Name of the module of the records that are made from options. It is imported when a command is called."""


class _Positive(click.FloatRange):
    """Type of a number above zero. It refuses a text with a unit; the error states the number to type."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:  # noqa: ANN401 - as click has it
        """Return the number in a text; the error for a text with a unit states the number to type."""
        with_unit = re.fullmatch(r"\s*(\d*\.?\d+)\s*([a-zA-Zµ]+)\s*", value) if isinstance(value, str) else None
        if with_unit is None or with_unit[2].lower() in ("inf", "nan", "e"):
            return super().convert(value, param, ctx)
        unit = param.metavar.lower() if param is not None and isinstance(param.metavar, str) else "units"
        scale = METRES_OF_UNIT.get(with_unit[2]) if unit == "metres" else None
        meant = f", here {float(with_unit[1]) * scale:g}" if scale is not None else ""
        raise click.BadParameter(f"{value!r} has a unit; give the number of {unit} alone{meant}", ctx, param)


METRES_OF_UNIT = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "km": 1e3}
"""Metres in each unit of length that a user may type."""

POSITIVE = _Positive(min=0, min_open=True)
"""Numbers above 0."""

NOT_NEGATIVE = click.FloatRange(min=0)
"""Numbers from 0 on."""


USUAL_OPTIONS = (
    "output", "robot", "config", "set", "topics", "path", "duration", "speed", "seed", "runs", "jobs", "budget",
    "calibration", "gate", "baseline", "outage", "plots", "overwrite", "strict", "json", "quiet", "verbose", "help",
)  # fmt: skip
"""Names of the options that most calls need, in the order in which the help lists them. Other options come after
them."""


class GroupedCommand(click.Command):
    """Command whose help lists `USUAL_OPTIONS` first, and the other options under ``More options``."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options into the help."""
        declared = [parameter for parameter in self.get_params(ctx) if isinstance(parameter, click.Option)]
        shown = [
            (shown_option, help_record)
            for shown_option in declared
            if (help_record := shown_option.get_help_record(ctx)) is not None
        ]
        ranks = {f"--{name}": rank for rank, name in enumerate(USUAL_OPTIONS)}

        def rank_of(parameter: click.Parameter) -> int | None:
            """Return the place of an option among the usual options; None for another option."""
            return next((ranks[name] for name in parameter.opts if name in ranks), None)

        usual = sorted((pair for pair in shown if rank_of(pair[0]) is not None), key=lambda pair: rank_of(pair[0]) or 0)
        rest = [pair for pair in shown if rank_of(pair[0]) is None]
        for title, pairs in (("Options", usual), ("More options", rest)):
            with formatter.section(title):
                formatter.write_dl([help_record for _, help_record in pairs])


def command(name: str, **further: Any) -> Callable[[Command], click.Command]:
    """Return a decorator that makes a `GroupedCommand` with this name."""
    return click.command(name, cls=GroupedCommand, **further)


def option(names: str, metavar: str | None, value_type: object, text: str, **further: Any) -> Option:
    """Return an option with a value; the help shows its default.

    Parameters
    ----------
    names : for example ``-o --output directory``; a last name without a dash is the name of the argument
    metavar : word for the value in the help; None: chosen by click
    value_type : type of the value, or a function that reads it
    text : text of the help
    further : further arguments of `click.option`
    """
    further = {"show_default": further.get("default") is not None} | further
    return click.option(*names.split(), metavar=metavar, type=value_type, help=text, **further)


def choice(names: str, words: Sequence[str], text: str, **further: Any) -> Option:
    """Return an option whose value is one of the given words."""
    return option(names, None, click.Choice(words), text, **further)


def flag(names: str, text: str, **further: Any) -> Option:
    """Return an option without a value."""
    return click.option(*names.split(), is_flag=True, help=text, **further)


def options_as_record(name: str, home: str | Callable[..., Any], *options: Option, change: bool = False) -> Option:
    """Return a decorator that adds options to a command, in this order, and passes a record of them as one argument.

    Parameters
    ----------
    name : name of the argument
    home : type of the record, or its place, for example ``icrtool.config:ConfigSources``, which is imported when the
        command is called. An option with the name of a field sets this field if the user gives the option. The command
        receives the options without a field
    options : the options to add
    change : the argument is not a record, but a function that returns a given dataclass with these fields changed
    """
    without_command = add_options(lambda: None, *options)
    declared = {parameter.name for parameter in without_command.__dict__.get("__click_params__", ())}.union(
        without_command.__dict__.get("made", ())
    )

    def add(command: Command) -> Command:
        @wraps(command)
        def call(**arguments: Any) -> object:
            record = resolve_name(home) if isinstance(home, str) else home
            fields = {
                field: arguments.pop(field) for field in declared.intersection(signature(record).parameters, arguments)
            }
            values = {field: value for field, value in fields.items() if value is not None}
            record_or_change = (lambda old: replace(old, **values)) if change else record(**values)
            return command(**{name: record_or_change}, **arguments)

        call.__dict__["made"] = {name, *command.__dict__.get("made", ())}
        return add_options(call, *options)

    return add


def add_options(command: Command, *options: Option) -> Command:
    """Add options to a command, in this order."""
    for add in reversed(options):
        command = add(command)
    return command


def option_group(*options: Option) -> Option:
    """Return a decorator that adds several options."""
    return lambda command: add_options(command, *options)


class _Path(click.Path):
    """Type of a path on disk or, with `addresses`, also of an address.

    Parameters
    ----------
    addresses : accept addresses. The reader of the log then checks that the path can be read, not click
    check : name of a function (``module:function``) that refuses a place that cannot be written; empty: no check
    """

    def __init__(self, *, addresses: bool = False, check: str = "") -> None:
        super().__init__(path_type=Path, readable=not addresses)
        self._addresses, self._check = addresses, check

    def convert(self, value: str | os.PathLike[str], param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Return the path or address in a text."""
        if not os.fspath(value):
            # An empty text would be the current directory.
            self.fail("the name is empty; check that the shell variable in it is set", param, ctx)
        address = place_of(os.fspath(value))
        if isinstance(address, UrlPath):
            if not self._addresses:
                self.fail(f"{escaped(str(address))}: is an address; name a place on disk", param, ctx)
            # click's own conversion would drop a slash, and the text after a question mark.
            return address
        path = cast("Path", super().convert(value, param, ctx))
        if self._check:
            resolve_name(self._check)(path)
        return path


LOG = PLACE = _Path(addresses=True)
"""Types of a log, and of a place of results: a path on disk or an address."""

LOGS = click.argument("logs", metavar="LOG...", nargs=-1, required=True, type=LOG)
FILE, NEW_FILE = _Path(), _Path(check="icrtool.output.files.atomic:check_place")
NEW_PICTURE = _Path(check="icrtool.output.files.formats:check_picture")
"""Types of a path on disk, of a file that the command writes, and of a picture that it writes."""


def numbers_reader(form: str, count: int | None = None) -> Callable[[str], tuple[float, ...]]:
    """Return a function that reads finite numbers separated by commas, `count` of them if given; errors show `form`."""

    def read(text: str) -> tuple[float, ...]:
        try:
            values = tuple(float(part) for part in text.split(","))
        except ValueError:
            values = ()
        if len(values) != (count or len(values)) or not values or not all(map(math.isfinite, values)):
            raise click.BadParameter(f"{text!r} is not of the form {form}")
        return values

    return read


def complete_robot(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Return the built-in robots whose name begins with `incomplete`."""
    return [
        CompletionItem(name, help=f"track width {robot['track_width_m']:g} m")
        for name, robot in config.builtin_robots().items()
        if name.startswith(incomplete)
    ]


def complete_setting(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Return the keys that begin with `incomplete`; after ``KEY=`` the words of the key, or the topics of the log."""
    key, equals, begun = incomplete.partition("=")
    section, _, name = key.partition(".")
    if not equals:
        texts = config.key_texts()
        keys = [
            (f"{section}.{two}", texts[section][two]["text"]) for section in config.SECTIONS for two in texts[section]
        ]
        return [CompletionItem(f"{name}=", help=text) for name, text in keys if name.startswith(incomplete)]
    if section == "topics":
        # click leaves the words before an incomplete --set in `args`.
        values = topics_of(ctx.params.get("logs") or ctx.params.get("sources") or ctx.args)
    else:
        values = config.words_of_key(section, name)
    return [CompletionItem(f"{key}={value}") for value in values if value.startswith(begun)]


def topics_of(logs: object) -> tuple[str, ...]:
    """Return the topics of the logs on the command line whose names are valid in ROS.

    Bash inserts a completion without quotes, so any other text of a log could run as a command. Logs that cannot be
    read are left out.
    """
    topics: set[str] = set()
    for log in logs if isinstance(logs, tuple | list) else ():
        if log == "-":
            continue  # A completion must not wait for standard input.
        try:
            container = open_log.open_log(Path(log))
        except errors.IcrToolError:
            continue
        topics |= {
            str(channel.topic) for channel in container.channels if re.fullmatch(r"[\w/~.-]+", channel.topic, re.ASCII)
        }
        container.close()
    return tuple(sorted(topics))


def _limit(variable: str, read: str) -> Callable[[click.Context, click.Parameter, str | None], None]:
    """Return a callback that sets an input limit while the command runs.

    Parameters
    ----------
    variable, read : name of the limit, and of the function that reads its value, in `icrtool.records.input_limits`
    """

    def set_limit(context: click.Context, _option: click.Parameter, text: str | None) -> None:
        if text is None:
            return
        try:
            value = getattr(input_limits, read)(text)
        except ValueError as err:
            raise click.BadParameter(str(err)) from None
        context.with_resource(input_limits.set_limit(getattr(input_limits, variable), value))

    return set_limit


INPUT_LIMITS = option_group(
    option("--most-bytes", "N", None, "Largest part of standard input, or of a file at an address, that is saved: for "
           "example 800000, 500M or 2GB; default: half of the free space of the temporary folder.",
           expose_value=False, callback=_limit("MOST_BYTES", "bytes_in")),
    option("--server-timeout", "SECONDS", None, "Give up a server that sends nothing for this time, or then less "
           "than 10 kB/s; default: 15.",
           expose_value=False, callback=_limit("SERVER_TIMEOUT_S", "seconds_in")),
)  # fmt: skip
"""--most-bytes and --server-timeout. They hold while the command runs, also in the processes that it starts."""

CONFIGURATION = options_as_record(
    "settings",
    "icrtool.config:ConfigSources",
    option("--config file", "FILE.toml", FILE, "Configuration file."),
    option("--robot", "NAME", None, "Built-in robot, for example husky-a200; icrtool robots lists them.",
           shell_complete=complete_robot),
    option("--set sets", "SECTION.KEY=VALUE", None, "Set a configuration key; icrtool config lists them; repeatable.",
           multiple=True, shell_complete=complete_setting),
)  # fmt: skip
"""--config, --robot and --set, as `settings`."""


PLACES = options_as_record(
    "place",
    ResultPlace,
    option("-o --output", "DIR", PLACE, "Run directory of the log; for several logs, the folder of their run "
           "directories."),
    option("--into", "DIR", PLACE, "Folder of the run directories, also for one log."),
    flag("--overwrite", "Also replace the run of another recording, or a run that was made with other settings."),
)  # fmt: skip
"""-o and --into as `place`, and --overwrite."""


CUT = option_group(
    option("--from start", "TIME", None, "Read the log from this time on: seconds since its first message, or a time "
           "in ISO 8601 (UTC if it has no zone)."),
    option("--to end", "TIME", None, "Read the log up to this time."),
)  # fmt: skip
"""--from and --to, as `start` and `end`."""

AS_JSON = flag("--json as_json", "Print one JSON document on standard output, and nothing else there.")
"""Option of commands that print JSON."""

QUIET_RESULTS = flag("-q --quiet", "Print no results.")
"""Option of commands without warnings."""

QUIET = flag("-q --quiet", "Print no results and no warnings.")
"""Option of commands with warnings."""

VERBOSE_OPTION = flag("-v --verbose", "Print more details.")
"""Option for details."""


def printer_options(*options: Option) -> Option:
    """Return a decorator that adds some of the options -q, -v and --json, as the argument `printer`."""
    return options_as_record("printer", Printer, *options)


SEED = option(
    "--seed", None, click.IntRange(min=0), "Seed of all noise; the same seed gives the same numbers.", default=0
)
"""Option for the seed of all random numbers."""


def plot_formats(text: str) -> tuple[str, ...]:
    """Return the formats in the value of ``--plots``: ``png,svg,pdf`` or ``none``."""
    chosen = tuple(part.strip().lower() for part in text.split(",") if part.strip())
    if chosen == ("none",):
        return ()
    formats_known = formats.PLOT_FORMATS
    unknown = [part for part in chosen if part not in formats_known]
    if unknown or not chosen:
        raise click.BadParameter(f"{', '.join(unknown) or text!r} is not one of {', '.join(formats_known)}, none")
    return chosen


PLOTS_OPTION = option("--plots", "png,svg,pdf|none", plot_formats, "Formats of the pictures.", default="png")
FIGURES_OPTION = choice(
    "--figures",
    get_args(FigureSet),
    "all: also the figures of the paper, for example a histogram for each distance.",
    default="default",
)
BUDGETS = option(
    "--budget budgets_m", "METRES", POSITIVE, "Report the distance over which 95 % of the errors stay within this "
    "error; repeatable.",
    multiple=True, default=(0.5,),
)  # fmt: skip
CALIBRATION_OPTIONS = option_group(
    option("--calibration calibrations", "CAL.json", FILE, "Also predict with a calibration that icrtool calibrate "
           "wrote; repeatable.", multiple=True),
    flag("--refit-sensors", "Refit heading offset, delays and gyro bias in this log; the constants of the calibrations "
         "are not used."),
)  # fmt: skip
"""--calibration as `calibrations`, and --refit-sensors; `calibrations_of` reads the files."""
ALLOW_UNUSABLE = flag("--allow-unusable", "Also give the distances and numbers of runs that are not usable.")
"""Option for runs that are not usable."""


def _split_gates(_context: click.Context, _option: click.Parameter, gates: tuple[str, ...]) -> tuple[str, ...]:
    """Return the limits in the lines of each text; refuse an invalid limit, also a blank text."""
    lines = tuple(line for gate in gates for line in [line for line in gate.splitlines() if line.strip()] or [gate])
    for line in lines:
        try:
            model = report.parse_gate(line).model
        except errors.IcrToolError as err:
            raise click.BadParameter(str(err)) from err
        if rows.kind_of(model) not in rows.REPORT_ROWS:
            names = [f"{row}{suffix}" for row in rows.REPORT_ROWS for suffix in ("", "_gyro")]
            meant = did_you_mean(model, names)
            raise click.BadParameter(f"gate {line!r}: no model {model}; {meant}one of {', '.join(rows.REPORT_ROWS)}")
    return lines


class Exports(NamedTuple):
    """Paths of the files for CI: JUnit XML (--junit), and a summary for a pull request (--markdown)."""

    junit: Path | None = None
    markdown: Path | None = None

    def write(self, command: str, suites: Callable[[], Sequence[acceptance.Suite]], text: Callable[[], str]) -> None:
        """Write the requested files; `suites` and `text` compute their content only if a file is requested."""
        if self.junit is not None:
            acceptance.write_junit(self.junit, suites(), command)
        if self.markdown is not None:
            atomic.write_file(self.markdown, text())


def report_options(*further: Option) -> Option:
    """Return a decorator that adds the options of a report, and further options.

    The command receives them as `report`, `files`, `exports` and `baseline`.
    """
    report_only = options_as_record(
        "report",
        f"{REQUESTS_MODULE}:ReportRequest",
        *further,
        CALIBRATION_OPTIONS,
        BUDGETS,
        option("--gate gates", "LIMIT", None, "Acceptance limit, or several, one on each line; exit status 3 if a "
               "limit is not met; repeatable.", multiple=True, callback=_split_gates),
        option("--baseline", "REPORT.json|DIR", FILE, "Earlier report, run or batch to compare with; a limit may then "
               "be \"icr.p95@10m <= 1.1 * baseline\"."),
        flag("--strict-gates", "Check limits relative to the baseline by the number alone, without the confidence "
             "interval of the difference."),
        flag("--ladder/--no-ladder", "Also test the rows recommended and controller, without and with a gyro, "
             "on distance that they were not fitted to.", default=True, show_default=True),
        option("--junit", "FILE", NEW_FILE, "Write the verdicts on the limits as JUnit XML."),
        option("--markdown", "FILE", NEW_FILE, "Write a summary for a pull request."),
        ALLOW_UNUSABLE,
        PLOTS_OPTION,
        FIGURES_OPTION,
        flag("--page/--no-page", "Also write report.html: pictures, tables and an interactive map in one file.",
             default=True, show_default=True),
    )  # fmt: skip
    files = options_as_record("files", f"{REQUESTS_MODULE}:ResultFiles", report_only)
    return options_as_record("exports", Exports, files)


def baseline_of(place: Path | None, gates: Sequence[str]) -> dropout_directory.Baseline | None:
    """Return the reports of --baseline, None without it; refuse limits that need a missing baseline."""
    relative = [gate for gate in gates if names_baseline(gate)]
    if place is not None:
        return dropout_directory.open_baseline(place)
    if relative:
        advice = "name it with --baseline REPORT.json|DIR"
        raise errors.ConfigError(f"gate {relative[0]!r}", "needs an earlier report", advice)
    return None


def calibrations_of(files: Sequence[Path], request: ReportRequest) -> tuple[Calibration, ...]:
    """Return the calibrations in the files of --calibration; refuse --refit-sensors without a calibration."""
    if request.refit_sensors and not files:
        raise click.UsageError("--refit-sensors refits the sensors of a calibration: name one with --calibration")
    return tuple(map(formats.open_calibration, files))


def names_baseline(gate: str) -> bool:
    """Return whether a limit is relative to the baseline."""
    return report.parse_gate(gate).relative


def check_compared(verdicts: Iterable[Verdict | FleetVerdict]) -> None:
    """Refuse a baseline that has none of the logs, because a limit that is never checked would always be met."""
    relative = [bool(verdict.not_checked) for verdict in verdicts if verdict.relative]
    if relative and all(relative):
        advice = "logs are matched by content, else by name"
        raise errors.ConfigError("--baseline", "has none of these logs", advice)


def options_to_repeat(settings: ConfigSources, request: FitRequest) -> list[str]:
    """Return the options of this call that the next command needs too."""
    pairs = [
        ("--config", settings.file),
        ("--robot", settings.robot),
        *(("--set", setting) for setting in settings.sets),
    ]
    pairs += [("--from", request.start), ("--to", request.end)]
    return [escaped(str(part)) for name, value in pairs if value is not None for part in (name, value)]
