"""Baselines on disk: a report.json, a run, a folder of runs, or the folder of a batch."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

from icrtool.dropout_analysis.report import BaselineReport
from icrtool.errors import ConfigError
from icrtool.output.dropout_directory import DROPOUT_DIRECTORY, REPORT_FILE, SCHEMA_FAMILY
from icrtool.output.files.formats import logs_of_fleet, read_document
from icrtool.records.dropout_document import EarlierReport
from icrtool.records.fleet_document import FLEET_FILE
from icrtool.records.regular_file import NOT_REGULAR, SAVE_IT, is_regular, is_special, read_regular
from icrtool.records.run_document import known_content
from icrtool.records.text import escaped

ADVICE = "name a report.json, a run with a dropout report, or the folder of a batch"


@dataclass(frozen=True, slots=True)
class Baseline:
    """The reports of a baseline, read when they are needed.

    Attributes
    ----------
    path : as it was named
    reports : report.json by name of the log
    sha256 : of each log's files
    sources : the files that name the reports: fleet.json of a batch, else the reports
    """

    path: Path
    reports: Mapping[str, Path]
    sha256: Mapping[str, tuple[str, ...]]
    sources: tuple[Path, ...]

    @property
    def folder(self) -> Path | None:
        """The directory that was named; None where it was one report."""
        return None if self.path.is_file() else self.path

    @property
    def digest(self) -> str:
        """A text that changes with the content."""
        return sha256(b"".join(read_regular(file, self.folder) for file in self.sources)).hexdigest()

    def missing(self, logs: Iterable[str]) -> list[str]:
        """Return the logs of the baseline that are not among some others, by name."""
        return sorted(set(self.reports) - set(logs))

    def find(self, name: str, content: Collection[str]) -> BaselineReport | None:
        """Return the report of a log: that of the same content, else of the same name; None where there is none.

        `content` is the SHA-256 of each of its files. A baseline that is one report file is that of any log.

        Raises
        ------
        ConfigError
            The report cannot be read.
        """
        found = next((log for log, files in self.sha256.items() if content and set(content) <= set(files)), None)
        if found is None and self.path.is_file():
            found = next(iter(self.reports))
        found = found if found is not None else name if name in self.reports else None
        return read_report(self.reports[found], found, self.folder) if found is not None else None


def open_baseline(path: Path) -> Baseline:
    """Find the reports of a baseline.

    Raises
    ------
    ConfigError
        There is none, or one cannot be read.
    RunError
        The fleet.json of a batch cannot be read.
    """
    if not path.is_file() and (path / FLEET_FILE).is_file():
        return _fleet_baseline(path)
    reports: dict[str, Path] = {}
    files: dict[str, tuple[str, ...]] = {}
    for file in [path] if path.is_file() else _report_files(path):
        one = read_report(file, inside=None if file == path else path)
        if one.log in reports:
            why = f"two reports of logs named {one.log}"
            raise ConfigError(f"--baseline {path}", why, f"{reports[one.log]} and {file}")
        reports[one.log], files[one.log] = file, one.sha256
    if not reports:
        raise ConfigError(f"--baseline {path}", "no dropout report in it", ADVICE)
    return Baseline(path, reports, files, tuple(reports.values()))


def read_report(path: Path, log: str = "", inside: Path | None = None) -> BaselineReport:
    """Read a report.json as a baseline.

    Parameters
    ----------
    log : its name in a batch; default: that in the report
    inside : as in `open_regular`

    Raises
    ------
    ConfigError
        It is not a dropout report.
    """
    try:
        document = read_document(path, EarlierReport, inside, escape=False)
        if not document.schema.startswith(SCHEMA_FAMILY):
            raise ValueError(document.schema)
        return BaselineReport(escaped(log or document.run.log), str(path), document)
    except OSError as err:
        raise ConfigError(f"--baseline {path}", "cannot be read", err.strerror or str(err)) from err
    except (ValueError, RecursionError) as err:
        raise ConfigError(f"--baseline {path}", "not a complete dropout report", ADVICE) from err


def _fleet_baseline(path: Path) -> Baseline:
    """Return the baseline of a batch: its fleet.json names logs, content and runs."""
    logs = {one.log: (path / one.run / DROPOUT_DIRECTORY / REPORT_FILE, one) for one in logs_of_fleet(path)}
    present = {log: found for log, found in logs.items() if is_regular(found[0], path)}
    if not present:
        raise ConfigError(f"--baseline {path}", "no dropout report in it", ADVICE)
    files = {log: known_content(file.sha256 for file in one.inputs) for log, (_, one) in present.items()}
    return Baseline(path, {log: file for log, (file, _) in present.items()}, files, (path / FLEET_FILE,))


def _report_files(path: Path) -> list[Path]:
    if not path.is_dir():
        if is_special(path):
            raise ConfigError(f"--baseline {path}", NOT_REGULAR, SAVE_IT)
        raise ConfigError(f"--baseline {path}", "no such file or directory", ADVICE)
    if (path / REPORT_FILE).is_file():
        return [path / REPORT_FILE]
    return sorted(path.glob(f"**/{DROPOUT_DIRECTORY}/{REPORT_FILE}"))
