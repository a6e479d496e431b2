"""``RUN/dropout/``: the files of `icrtool dropout-report`, written whole or not at all, and the content of report.json.

The module also opens a baseline for a later report: a report.json, or the reports of runs or of a batch.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from icrtool.dropout_analysis.report import BaselineReport, DropoutReport, pooled_baseline
from icrtool.dropout_analysis.trials import ErrorSink
from icrtool.errors import ConfigError
from icrtool.kernels.arrays import Floats, Ints
from icrtool.output import figure_catalogue
from icrtool.output.files.atomic import DirectoryKind, atomic_directory
from icrtool.output.files.formats import csv_bytes, json_bytes, logs_of_fleet, read_document, relist_files, schema_of
from icrtool.output.run_directory import REPORT_FILES, is_run_directory
from icrtool.records.choices import FigureSet
from icrtool.records.dropout_document import DropoutDocument, SummaryRow
from icrtool.records.fleet_document import FLEET_FILE
from icrtool.records.places import (
    NOT_REGULAR,
    SAVE_IT,
    Below,
    Place,
    below,
    is_regular,
    is_special,
    path_of,
    read_regular,
)
from icrtool.records.rows import IN_CSV
from icrtool.records.run_document import known_content
from icrtool.records.stages import Watch, unwatched
from icrtool.records.text import counted, escaped

REPORT_FILE = "report.json"
"""Name of the file with all results of a report."""

TRIALS_FILE = "trials.parquet"
"""Name of the file with every trial."""

DROPOUT_DIRECTORY = "dropout"
"""Name of a report's directory in its run directory."""
DROPOUT_FAMILY = "icrtool/dropout/"
"""First part of the schema of a report, without its version."""


def write_report(
    analyse: Callable[[ErrorSink | None], DropoutReport],
    directory: Place,
    *,
    plots: tuple[str, ...] = ("png",),
    figures: FigureSet = "default",
    stamp_ns: Ints | None = None,
    watch: Watch = unwatched,
) -> DropoutReport:
    """Write a report, whole or not at all, in place of an old one; its files are added to the list of its run.

    Parameters
    ----------
    analyse : returns the report. It is called with the sink for single trials, None if trials are not written
    plots : formats of the figures, of ``png``, ``svg`` and ``pdf``; none: no figures
    figures : ``all``: the paper's figures too
    stamp_ns : stamps (n,) of the starts, for trials.parquet with every single trial; None: trials are not written
    watch : called with the name of each picture before it is drawn

    Raises
    ------
    OutputError
        A file or directory that is not from a dropout report is in the place of the report, or writing fails.
    """
    run_folder, name = path_of(directory).parent, path_of(directory).name
    with atomic_directory(directory, REPORT) as partial:
        with trials_file(partial / TRIALS_FILE, stamp_ns) if stamp_ns is not None else nullcontext() as sink:
            report = analyse(sink)
        if plots:
            figure_catalogue.draw_figures("report", report, partial / "plots", plots, figures, watch)
        write_tables(report, partial)
        names = [path.relative_to(partial).as_posix() for path in sorted(partial.rglob("*")) if path.is_file()]
        if in_run := is_run_directory(run_folder):
            relist_files(run_folder, name)
    if in_run:
        relist_files(run_folder, name, names)
    return report


def is_dropout_directory(directory: Path) -> bool:
    """Return whether a directory is a dropout report that icrtool wrote."""
    return schema_of(Below(directory, REPORT_FILE)).startswith(DROPOUT_FAMILY)


REPORT = DirectoryKind(
    "dropout report",
    # In a run, a report with a damaged report.json may be replaced.
    lambda place: is_dropout_directory(place) or is_run_directory(place.parent),
    re.compile(REPORT_FILES),
)
"""The directory of a dropout report."""


def write_tables(report: DropoutReport, directory: Path) -> None:
    """Write summary.csv, histogram.csv, worst.csv and report.json into a directory.

    Raises
    ------
    OSError
        A file cannot be written.
    """
    document = report.document
    summary = ((model.name, *msgspec.structs.astuple(row)) for model in document.models for row in model.by_horizon)
    (directory / "summary.csv").write_bytes(csv_bytes(("model", *SummaryRow.__struct_fields__), summary))
    histogram: list[tuple[Any, ...]] = []
    for result in report.results:
        for horizon, bins in zip(report.horizons_m, result.histograms, strict=True):
            histogram += [(result.name, horizon, *row) for row in zip(*bins, strict=True)]
    (directory / "histogram.csv").write_bytes(csv_bytes(HISTOGRAM_COLUMNS, histogram))
    worst: list[tuple[Any, ...]] = []
    for rank, trial in enumerate(document.worst, start=1):
        *columns, errors = msgspec.structs.astuple(trial)
        worst.append((rank, *columns, *(errors.get(model) for model in IN_CSV)))
    (directory / "worst.csv").write_bytes(csv_bytes(WORST_CSV_COLUMNS, worst))
    (directory / REPORT_FILE).write_bytes(json_bytes(document))


HISTOGRAM_COLUMNS = ("model", "horizon_m", "bin_left_m", "bin_right_m", "percent")
"""Columns of histogram.csv."""

WORST_CSV_COLUMNS = (
    "rank", "model", "stamp_ns", "t_s", "north_m", "east_m", "horizon_m", "heading_change_deg", "speed_mean_mps",
    *(f"{model}_error_m" for model in IN_CSV),
)  # fmt: skip
"""Columns of worst.csv."""


ROWS_A_GROUP = 1 << 18
"""Number of trials that are written at a time. They take 6 MB of memory."""


@contextmanager
def trials_file(path: Path, stamp_ns: Ints) -> Iterator[ErrorSink]:
    """Yield a sink that appends trials to a new Parquet file; starts without a trial are left out.

    Parameters
    ----------
    path : path of the new file
    stamp_ns : stamps (n,) of the starts

    Raises
    ------
    OSError
        The file cannot be written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    names = pa.dictionary(pa.int8(), pa.string())
    schema = pa.schema({"model": names, "stamp_ns": pa.int64(), "horizon_m": pa.float64(), "error_m": pa.float64()})
    with pq.ParquetWriter(path, schema, compression="zstd") as writer:

        def append(model: str, horizons_m: Floats, errors_m: Floats) -> None:
            """Append the trials of a model, whose errors are (n, h) [m]."""
            for h, horizon in enumerate(horizons_m):
                for lo in range(0, len(stamp_ns), ROWS_A_GROUP):
                    error = errors_m[lo : lo + ROWS_A_GROUP, h]
                    tried = ~np.isnan(error)
                    rows = int(np.count_nonzero(tried))
                    model_column = pa.DictionaryArray.from_arrays(pa.array(np.zeros(rows, np.int8)), [model])
                    columns = [
                        model_column,
                        pa.array(stamp_ns[lo : lo + ROWS_A_GROUP][tried]),
                        pa.array(np.full(rows, float(horizon))),
                        pa.array(error[tried]),
                    ]
                    writer.write_table(pa.table(columns, schema=schema))

        yield append


BASELINE_ADVICE = "name a report.json, a run with a dropout report, or the folder of a batch"
"""Advice in errors about a baseline that cannot be used."""


@dataclass(frozen=True, slots=True)
class Baseline:
    """The reports of a baseline, read when they are needed.

    Attributes
    ----------
    path : path of the baseline as the user named it
    reports : path of report.json by name of the log
    sha256 : SHA-256 of the files of each log
    kinds : robot and group of each log with a usable run; both may be empty
    sources : files that list the reports: fleet.json of a batch, else the reports
    """

    path: Path
    reports: Mapping[str, Path]
    sha256: Mapping[str, tuple[str, ...]]
    kinds: Mapping[str, tuple[str, str]]
    sources: tuple[Path, ...]

    @property
    def folder(self) -> Path | None:
        """The directory that the user named; None for a single report."""
        return None if self.path.is_file() else self.path

    @property
    def digest(self) -> str:
        """Text that identifies the content of the baseline."""
        return sha256(b"".join(read_regular(below(self.folder, file)) for file in self.sources)).hexdigest()

    def missing(self, logs: Iterable[str]) -> list[str]:
        """Return the names of the logs of the baseline that are not among the given logs."""
        return sorted(set(self.reports) - set(logs))

    def find(self, name: str, content: Collection[str], robot: str = "", group: str = "") -> BaselineReport | None:
        """Return the report of the log with the same content, else with the same name, else the robot's drives pooled.

        A baseline of one report file is compared with any log. None if the baseline has no report for the log.

        Parameters
        ----------
        content : SHA-256 of each file of the log
        robot, group : robot and group of the log; an empty group is not known, and means all groups

        Raises
        ------
        ConfigError
            The report cannot be read.
        """
        if (own_log := self.own_report(name, content)) is not None:
            return read_baseline(below(self.folder, self.reports[own_log]), own_log)
        if not (drives := self.drives_of(robot, group)):
            return None
        pooled = [read_baseline(below(self.folder, self.reports[log]), log).document for log in drives]
        return pooled_baseline(pooled, f"{counted(len(drives), 'drive')} of {escaped(robot)}", str(self.path))

    def own_report(self, name: str, content: Collection[str]) -> str | None:
        """Return the name of the log whose report is the report of a log; None if all reports are of other logs."""
        same_log = next((log for log, files in self.sha256.items() if content and set(content) <= set(files)), None)
        if same_log is None and self.path.is_file():
            same_log = next(iter(self.reports))
        return same_log if same_log is not None else name if name in self.reports else None

    def drives_of(self, robot: str, group: str = "") -> list[str]:
        """Return the usable drives of a robot, in its group if groups are known; empty for a robot without a name."""
        return [
            log
            for log, (its_robot, its_group) in self.kinds.items()
            if robot and its_robot == robot and (its_group == group or not (its_group and group))
        ]

    def check_compares(self, logs: Iterable[tuple[str, Collection[str], str, str]]) -> None:
        """Refuse a baseline without a report for any of the logs, because a limit on it would never be checked.

        Parameters
        ----------
        logs : name, content, robot and group of each log, as in `find`

        Raises
        ------
        ConfigError
            Neither a log nor its robot is in the baseline.
        """
        robots = []
        for name, content, robot, group in logs:
            if self.own_report(name, content) is not None or self.drives_of(robot, group):
                return
            robots.append(robot)
        theirs = ", ".join(sorted({escaped(robot) for robot, _ in self.kinds.values() if robot})) or "none with a name"
        given = ", ".join(sorted({escaped(robot) for robot in robots if robot})) or "no robot named (--robot)"
        why = f"holds neither these logs nor their robot (robots in it: {theirs}; robots of the logs: {given})"
        raise ConfigError(f"--baseline {self.path}", why, "logs are matched by content, else by name, else by robot")


def open_baseline(path: Path) -> Baseline:
    """Return the reports of a baseline.

    Raises
    ------
    ConfigError
        The baseline has no report, or a report cannot be read.
    RunError
        The fleet.json of a batch cannot be read.
    """
    name = f"{DROPOUT_DIRECTORY}/{REPORT_FILE}"
    if not path.is_file() and (path / FLEET_FILE).is_file():
        logs = {log.log: (Below(path, f"{log.run}/{name}"), log) for log in logs_of_fleet(path)}
        present = {log: (report.path, fleet_log) for log, (report, fleet_log) in logs.items() if is_regular(report)}
        reports = {log: report for log, (report, _) in present.items()}
        kinds = {log: (fleet_log.robot, fleet_log.group) for log, (_, fleet_log) in present.items() if fleet_log.usable}
        files = {
            log: known_content(file.sha256 for file in fleet_log.inputs) for log, (_, fleet_log) in present.items()
        }
        sources: tuple[Path, ...] = (path / FLEET_FILE,)
    else:
        reports, files, kinds = {}, {}, {}
        if not (path.is_file() or path.is_dir()):
            if is_special(path):
                raise ConfigError(f"--baseline {path}", NOT_REGULAR, SAVE_IT)
            raise ConfigError(f"--baseline {path}", "no such file or directory", BASELINE_ADVICE)
        one_file = path if path.is_file() else path / REPORT_FILE
        for file in [one_file] if one_file.is_file() else sorted(path.glob(f"**/{name}")):
            report = read_baseline(file if file == path else below(path, file))
            if report.log in reports:
                why = f"two reports of logs named {report.log}"
                raise ConfigError(f"--baseline {path}", why, f"{reports[report.log]} and {file}")
            reports[report.log], files[report.log] = file, report.sha256
            if report.document.usable:
                kinds[report.log] = (report.document.run.config.robot.name or "", "")
        sources = tuple(reports.values())
    if not reports:
        raise ConfigError(f"--baseline {path}", "no dropout report in it", BASELINE_ADVICE)
    return Baseline(path, reports, files, kinds, sources)


def read_baseline(file: Place, log: str = "") -> BaselineReport:
    """Return the report in a report.json as a baseline.

    Parameters
    ----------
    log : name of the log in a batch; default: the name in the report

    Raises
    ------
    ConfigError
        The file is not a dropout report.
    """
    path = path_of(file)
    try:
        document = read_document(file, DropoutDocument, escape=False)
        if not document.schema.startswith(DROPOUT_FAMILY):
            raise ValueError(document.schema)
        return BaselineReport(escaped(log or document.run.log), str(path), document)
    except OSError as err:
        raise ConfigError(f"--baseline {path}", "cannot be read", err.strerror or str(err)) from err
    except (ValueError, RecursionError) as err:
        raise ConfigError(f"--baseline {path}", "not a complete dropout report", BASELINE_ADVICE) from err
