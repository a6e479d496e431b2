"""Files of a batch: tables, figures, results of acceptance limits for CI, and calibrations.

There is one calibration for each robot and group. It is tested by leaving out each log in turn.
"""

from __future__ import annotations

import math
import textwrap
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from hashlib import sha256
from pathlib import Path

import msgspec
import numpy as np
from msgspec.structs import replace

from icrtool import __version__
from icrtool.errors import IcrToolError, OutputError
from icrtool.fleet.recordings import as_text, unique_name
from icrtool.output.figure_catalogue import FIGURES, figures_of
from icrtool.output.files import formats
from icrtool.output.files.atomic import atomic_file, check_place, make_folders, write_file
from icrtool.output.run_directory import PAGE_FILE, is_page, open_run
from icrtool.output.text_blocks import Block, Items, Section, Table, Title
from icrtool.records import fleet_document as documents
from icrtool.records.fleet_document import FLEET_FILE, ROWS, RUNS, FleetCalibration, FleetDocument, FleetFile, FleetLog
from icrtool.records.places import Below, is_regular
from icrtool.records.process_resources import remove_path
from icrtool.records.rows import FALLBACK_ROW, MAIN_ROW
from icrtool.records.run import ICR_COLUMNS, Run
from icrtool.records.text import LogText, counted, escaped

BEFORE_ICRS = ("log", "status", "this_time", "reason", "robot", "group", "start_utc", "duration_s", "distance_m")
AFTER_ERRORS = ("events", "outages", "warnings", "tool_version", "run")
"""Columns of fleet.csv that are fields of a log's row, before and after the columns of ICRs and errors."""

WITHIN, IS_BOUND = "_within_", "_is_bound"
"""Parts of the names of two columns: the distance within a budget [m], and 1 if this distance is a lower bound, else
0."""

FAILURES = ("log", "reason", "details", "robot", "group", "run", "took_s")
"""Columns of failures.csv."""

PLOTS = "plots"
"""Folder of the figures, below the folder of the batch."""

CALIBRATIONS = "calibrations"
"""Folder of the calibration files, below the folder of the batch."""

MOST_POOLED_S = 86_400.0
"""Longest total time of the logs of a robot and group that are calibrated together [s]. Logs of a longer total time are
sampled evenly. The calibration of logs of this time needs about 1 GB of memory."""

FOLDERS = (RUNS, ROWS, CALIBRATIONS, PLOTS)
"""Names of the folders that a batch writes."""

TABLES = ("fleet.csv", "failures.csv", "fleet.parquet", FLEET_FILE)
"""Names of the tables of a batch."""

SHOWN_ERRORS = {MAIN_ROW: documents.SHOWN_ERROR, FALLBACK_ROW: documents.SHOWN_FALLBACK}
"""Columns of errors that the figure can show, by row. It shows the first one that a log has."""


def check_tables(folder: Path, *, page: bool) -> None:
    """Refuse a folder in which a file that icrtool did not write has the name of a result.

    Parameters
    ----------
    folder : folder of the fleet
    page : whether the batch writes a page

    Raises
    ------
    OutputError
        The folder contains such a file.
    """
    if page and folder.is_dir():
        check_place(Below(folder, PAGE_FILE), is_page)
    schema = formats.schema_of(Below(folder, FLEET_FILE))
    if schema.startswith(documents.FLEET_FAMILY) or (folder / ROWS).is_dir():
        return
    for file in (*(folder / name for name in TABLES), *pictures_of_batch(folder)):
        if file.exists() and not file.is_symlink():
            raise OutputError(file, "exists and was not written by a batch", "it is not replaced; name another folder")


def pictures_of_batch(folder: Path) -> list[Path]:
    """Return the paths of the pictures of a batch, below its folder, in every format."""
    names = [name for name, entry in FIGURES.items() if entry.subject == "fleet"]
    return [folder / PLOTS / f"{name}.{form}" for name in names for form in formats.PLOT_FORMATS]


def fleet_document(rows: Sequence[FleetLog], calibrations: Sequence[FleetCalibration] = ()) -> FleetDocument:
    """Return the content of fleet.json: numbers of logs that were done and failed, rows of the logs, calibrations."""
    counts = Counter(row.status for row in rows) + Counter(row.this_time for row in rows)
    return FleetDocument(
        schema=documents.FLEET_SCHEMA,
        tool_version=__version__,
        counts=documents.FleetCounts(counts["done"], counts["failed"], counts["skipped"]),
        gates_failed=sum(row.gates_failed for row in rows),
        calibrations=tuple(calibrations),
        logs=tuple(rows),
    )


def fleet_rows(rows: Sequence[FleetLog]) -> list[dict[str, object]]:
    """Return the rows of fleet.csv by the names of its columns; errors in the order of models and horizons."""
    errors = list(dict.fromkeys(name for row in rows for name in row.errors))
    table = []
    for row in rows:
        cells: dict[str, object] = {name: getattr(row, name) for name in BEFORE_ICRS}
        cells |= {name: row.icr.get(name) for name in (*ICR_COLUMNS, *(f"std_{column}" for column in ICR_COLUMNS))}
        cells |= {"multiplier": row.multiplier, "multiplier_std": row.multiplier_std}
        for name in errors:
            cells[name] = row.errors.get(name)
            if WITHIN in name:
                is_bound = None if cells[name] is None else int(name in row.bounds)
                cells[f"{name.removesuffix('_m')}{IS_BOUND}"] = is_bound
        cells |= {name: getattr(row, name) for name in AFTER_ERRORS}
        limits = row.gates_failed if row.status != "failed" else None
        listed = {"tags": ";".join(row.tags), "notes": ";".join(row.codes)}
        table.append(cells | listed | {"gates_failed": limits, "took_s": row.took_s})
    return table


def write_fleet(
    rows: Sequence[FleetLog],
    directory: Path,
    calibrations: Sequence[FleetCalibration] = (),
    plots: Sequence[str] = (),
    *,
    page: bool = False,
) -> FleetDocument:
    """Write the tables, figures and page of a batch, and return its document; files of an earlier batch are replaced.

    Parameters
    ----------
    rows : rows of the logs
    directory : folder of the batch
    calibrations : calibrations of the groups
    plots : formats of the figures
    page : whether to write report.html

    Raises
    ------
    OutputError
        A file cannot be written.
    """
    cells = fleet_rows(rows)
    write_file(Below(directory, "fleet.csv"), formats.csv_bytes(cells[0], (row.values() for row in cells)))
    failures = [[getattr(row, name) for name in FAILURES] for row in rows if row.status == "failed"]
    write_file(Below(directory, "failures.csv"), formats.csv_bytes(FAILURES, failures))
    with atomic_file(Below(directory, "fleet.parquet")) as file:
        _write_parquet(cells, file)
    if plots:
        write_figures(rows, directory, plots)
    document = fleet_document(rows, calibrations)
    # fleet.json is written after the tables, so that existing tables are of the same batch as fleet.json.
    write_file(Below(directory, FLEET_FILE), formats.json_bytes(document))
    if page:
        from icrtool.output.page.pages import fleet_page

        write_file(Below(directory, PAGE_FILE), fleet_page(document, directory), is_page)
    return document


def calibrations_text(calibrations: Sequence[FleetCalibration]) -> str:
    """Return a text with one paragraph for each calibration."""
    parts = []
    for calibration in calibrations:
        name = ", ".join(str(LogText(part)) for part in (calibration.robot, calibration.group) if part) or "all logs"
        head = f"{name}: {counted(len(calibration.logs), 'log')}"
        if calibration.left_out:
            head += f", {len(calibration.left_out)} not used"
        if calibration.reason:
            head += f": no calibration: {escaped(calibration.reason)}"
        else:
            head += f": multiplier {calibration.multiplier:.4f} ± {calibration.multiplier_std:.4f}"
            head += f"{calibration.within_text}, in {calibration.file}"
        lines = textwrap.wrap(head, 80, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)
        parts.append("\n".join(lines))
    return "\n".join(parts) + "\n"


def write_figures(rows: Sequence[FleetLog], folder: Path, picture_formats: Sequence[str]) -> None:
    """Draw the ICRs by robot and date, and the error of each log; older figures are removed.

    Parameters
    ----------
    rows : rows of the logs
    folder : folder of the batch
    picture_formats : formats of the files
    """
    from icrtool.output.figures.calibrations import FleetNumbers

    points: list[FleetLog] = []
    errors: dict[str, dict[str, float]] = {}
    names = {name for row in rows for name in row.errors}
    model, error_name = next(
        ((model, column) for model, column in SHOWN_ERRORS.items() if column in names), ("", documents.SHOWN_FALLBACK)
    )
    for row in sorted(rows, key=lambda row: row.start_utc):
        shown = all(row.icr.get(name) is not None for name in ("y_icr_right_m", "y_icr_left_m"))
        if shown and row.start_utc:
            points.append(row)
        if (error := row.errors.get(error_name)) is not None:
            name = ", ".join(part for part in (row.robot, row.group) if part) or "robot not named"
            errors.setdefault(name, {})[row.log] = error
    make_folders(Below(folder, PLOTS))
    intervals: dict[str, tuple[float, float]] = {}
    for row in rows:
        low, high = (row.errors.get(error_name.replace("_p95_", f"_p95_{end}_")) for end in ("low", "high"))
        if low is not None and high is not None:
            intervals[row.log] = low, high
    dates = {row.log: row.start_utc for row in rows}
    numbers = FleetNumbers(f"{len(rows)} logs", points, errors, model, dates, intervals)
    old = set(pictures_of_batch(folder))
    for name, figure in figures_of("fleet", numbers):
        for file in (Below(folder, f"{PLOTS}/{name}.{form}") for form in picture_formats):
            formats.save_picture(figure, file)
            old.discard(file.path)
    for abandoned in old:
        remove_path(abandoned)


def _write_parquet(rows: Sequence[Mapping[str, object]], file: Path) -> None:
    """Write the rows of fleet.csv as a Parquet file, with a type for each column."""
    import pyarrow as pa
    import pyarrow.json as pj
    import pyarrow.parquet as pq

    texts = {"log", "status", "this_time", "reason", "robot", "group", "start_utc", "tool_version", "run", "tags"}
    texts.add("notes")
    counts = {"events", "outages", "warnings", "gates_failed", *(name for name in rows[0] if name.endswith(IS_BOUND))}
    kinds = {name: pa.string() if name in texts else pa.int64() if name in counts else pa.float64() for name in rows[0]}
    # Names of files need not be valid text. Lists are written as JSON, because pyarrow would load pandas for lists.
    cells = ({name: as_text(cell) if name in texts else cell for name, cell in row.items()} for row in rows)
    lines = b"\n".join(map(msgspec.json.encode, cells))
    table = pj.read_json(
        pa.BufferReader(lines), pj.ReadOptions(block_size=len(lines) + 1), pj.ParseOptions(pa.schema(kinds))
    )
    pq.write_table(table, file)


def counts_text(rows: Sequence[FleetLog]) -> str:
    """Return a text with the numbers of logs that were done, that failed, and that an earlier batch processed."""
    counts = Counter(row.status for row in rows)
    text = ", ".join(f"{counts[status]} {status}" for status in ("done", "failed") if counts[status])
    skipped = sum(row.this_time == "skipped" for row in rows)
    return f"{text} ({skipped} of them before, skipped this time)" if skipped else text


def fleet_blocks(rows: Sequence[FleetLog], missing: Sequence[str] = ()) -> list[Block]:
    """Return the summary of a batch as blocks: counts, acceptance limits, comparison with the baseline, changes.

    Parameters
    ----------
    rows : rows of the logs
    missing : logs of the baseline that the batch does not have
    """
    # The import is inside the function, because a process that fits logs does not need these modules.
    from icrtool.output.exports.acceptance import limit_section

    errors, changes = [], changes_of(rows, missing)
    for row in rows:
        if row.status == "failed":
            errors.append([row.log, f"could not be used: {row.reason}", "", ""])
            continue
        now, before = row.shown_error(), row.shown_error(baseline=True)
        both = ["-" if error_m is None else f"{error_m:.3f} m" for error_m in (now, before)]
        difference = f"{now - before:+z.3f} m" if now is not None and before is not None else "-"
        errors.append([row.log, *both, difference])
    return [
        Title(counted(len(rows), "log"), counts_text(rows)),
        limit_section([verdict for row in rows for verdict in row.verdicts]),
        Table("lr", errors, ("log", "95 % after 10 m", "baseline", "difference")),
        Section("Since the baseline", [Items(changes)]),
    ]


def changes_of(rows: Sequence[FleetLog], missing: Sequence[str]) -> list[str]:
    """Return a sentence for each difference of logs, configuration and version from the baseline.

    Parameters
    ----------
    missing : logs of the baseline that the batch does not have
    """
    lines = [f"not in this batch, but in the baseline: {', '.join(missing)}"] if missing else []
    new = [row.log for row in rows if row.status != "failed" and not row.baseline]
    if new and len(new) < len(rows):
        lines.append(f"not in the baseline: {', '.join(new)}")
    by_change: dict[str, list[str]] = {}
    for row in rows:
        for change in row.changes:
            by_change.setdefault(change, []).append(row.log)
    lines += [
        f"{', '.join(logs) if len(logs) < len(rows) or len(rows) == 1 else 'all logs'}: {change}"
        for change, logs in by_change.items()
    ]
    return lines


def pooled_calibrations(
    rows: Sequence[FleetLog], directory: Path, place: Path | None = None, *, allow_unusable: bool = False
) -> Iterator[FleetCalibration]:
    """Yield the calibration of each robot in each group; a calibration of unchanged logs is not fitted again.

    Parameters
    ----------
    rows : rows of the logs
    directory : folder of the batch on disk, to which the calibration files are written
    place : folder or address of the runs; None: `directory`
    allow_unusable : whether unusable runs are calibrated too
    """
    try:
        stored = {calibration.key: calibration for calibration in formats.read_fleet(directory).calibrations}
    except (OSError, ValueError, RecursionError):
        stored = {}
    groups: dict[tuple[str, str], list[FleetLog]] = {}
    for row in rows:
        if row.status != "failed":
            groups.setdefault((row.robot, row.group), []).append(row)
    names: set[str] = set()
    for (robot, group), members in sorted(groups.items()):
        key = sha256(
            msgspec.json.encode([__version__, allow_unusable, [(row.log, row.key, row.inputs) for row in members]])
        ).hexdigest()
        text = "-".join(part for part in (robot, group) if part)
        name = "".join(letter if letter.isalnum() or letter in "-_." else "_" for letter in text)[:100].strip(".")
        name = unique_name(name or "all", names)
        unchanged = stored.get(key)
        if unchanged is not None and (not unchanged.file or is_regular(Below(directory, unchanged.file))):
            yield unchanged
        else:
            empty = FleetCalibration(robot, group, tuple(row.log for row in members), key=key)
            yield _pool_calibration(empty, members, directory, place or directory, name, allow_unusable=allow_unusable)


def runs_of_fleet(directory: Path) -> dict[str, list[Path]]:
    """Return the directories of the usable runs of a batch by group: the group of the manifest, else the robot.

    Different robots in one group of the manifest form different groups. Of copies of a log in a group, only the first
    is returned.

    Raises
    ------
    RunError
        The folder does not hold the result of a batch.
    """
    logs = [row for row in formats.logs_of_fleet(directory) if row.usable]
    robots = {row.robot for row in logs}
    by_group: dict[str, dict[tuple[str, ...], Path]] = {}
    for row in logs:
        name = row.group if row.group and len(robots) == 1 else f"{row.robot} {row.group}".strip() or directory.name
        by_group.setdefault(name, {}).setdefault(_content(row.inputs), directory / row.run)
    return {name: list(runs.values()) for name, runs in by_group.items()}


def is_fleet(directory: Path) -> bool:
    """Return whether a folder is the folder of a batch."""
    return is_regular(Below(directory, FLEET_FILE))


def _pool_calibration(
    empty: FleetCalibration,
    members: Sequence[FleetLog],
    directory: Path,
    place: Path,
    name: str,
    *,
    allow_unusable: bool,
) -> FleetCalibration:
    """Return the calibration of the logs of one robot and group, and write its file.

    Parameters
    ----------
    empty : calibration without numbers, with robot, group and logs
    members : rows of the logs
    directory, place : as for `pooled_calibrations`
    name : name of the file without suffix
    """
    from icrtool.calibration.pooled import calibrate_runs
    from icrtool.output.tables.calibration import held_out_blocks
    from icrtool.output.text_blocks import format_blocks

    # Copies are left out, because a copy would be tested with parameters that were fitted to the same log.
    distinct = {_content(row.inputs): row for row in reversed(members)}
    ordered = sorted(distinct.values(), key=lambda row: (row.start_utc, row.log))
    total_s = sum(row.duration_s or 0.0 for row in ordered)
    count = math.ceil(len(ordered) * min(1.0, MOST_POOLED_S / max(total_s, 1.0)))
    spaced = {ordered[i].log for i in np.linspace(0, len(ordered) - 1, count).round().astype(int)}
    file = f"{CALIBRATIONS}/{name}.json"
    chosen = [row for row in members if row.log in spaced and (row.usable or allow_unusable)]
    if not chosen:
        reason = "none of its runs is usable; --allow-unusable also takes unusable runs"
        return replace(empty, left_out=empty.logs, reason=reason)
    opened: dict[str, str] = {}

    def open_runs() -> Iterator[Run]:
        for row in chosen:
            run = open_run(place / row.run)
            opened[row.log] = run.name
            yield run

    try:
        result = calibrate_runs(open_runs(), allow_unusable=allow_unusable)
        make_folders(Below(directory, CALIBRATIONS))
        formats.write_calibration(result.calibration, Below(directory, file))
    except IcrToolError as err:
        left_out = tuple(log for log in empty.logs if log not in opened)
        return replace(empty, left_out=left_out, reason=str(err))
    numbers = result.calibration.controller
    table = format_blocks(held_out_blocks(result.table))
    reached = result.table.score("recommended").within(result.table.horizons_m, documents.BUDGET_M)
    short = {name for name, _ in result.left_out}
    used = tuple(log for log, run_name in opened.items() if run_name not in short)
    return replace(
        empty, logs=used, left_out=tuple(log for log in empty.logs if log not in used), file=file,
        recommended=result.calibration.recommended, multiplier=float(numbers.multiplier),
        multiplier_std=float(numbers.multiplier_std), table=table,
        icrs_m=tuple(result.calibration.geometry[name] for name in ICR_COLUMNS),
        within_m=None if reached is None else float(reached.distance_m),
        within_beyond=reached is not None and reached.beyond,
        within_between_m=None if reached is None else reached.between_m,
    )  # fmt: skip


def _content(inputs: Sequence[FleetFile]) -> tuple[str, ...]:
    """Return a key for the content of a log: the SHA-256 of each file, else its path, size and version."""
    return tuple(sorted(file.sha256 or f"at {file.path} {file.bytes} {file.version} {file.address}" for file in inputs))
