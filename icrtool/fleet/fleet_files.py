"""The tables of a fleet: fleet.csv, fleet.parquet, fleet.json and failures.csv."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from icrtool import __version__
from icrtool.fleet.row import Row, columns_of
from icrtool.output.atomic_file import atomic_file
from icrtool.output.run_directory import json_bytes
from icrtool.records.text import table_cell

FLEET_SCHEMA = "icrtool/fleet/1"

FAILURES = ("log", "reason", "details", "robot", "group", "run", "took_s")


def fleet_document(rows: Sequence[Row]) -> dict[str, Any]:
    """Return what fleet.json holds: how many logs came to what, and all of each."""
    counts = Counter(row.status for row in rows)
    return {
        "schema": FLEET_SCHEMA,
        "tool_version": __version__,
        "counts": {status: counts[status] for status in ("done", "failed", "skipped")},
        "gates_failed": sum(row.gates_failed for row in rows),
        "logs": [msgspec.to_builtins(row) for row in rows],
    }


def write_fleet(rows: Sequence[Row], directory: Path) -> None:
    """Write the tables of a batch; those of an earlier one are replaced.

    Raises
    ------
    OutputError
        The disk does not take them.
    """
    columns = columns_of(rows)
    cells = [row.columns() for row in rows]
    _write(directory / "fleet.csv", _csv(columns, [[row.get(name) for name in columns] for row in cells]))
    failures = [msgspec.to_builtins(row) for row in rows if row.status == "failed"]
    _write(directory / "failures.csv", _csv(FAILURES, [[row[name] for name in FAILURES] for row in failures]))
    with atomic_file(directory / "fleet.parquet") as file:
        _write_parquet(columns, cells, file)
    # Last: where it is, the others are of the same batch.
    _write(directory / "fleet.json", json_bytes(fleet_document(rows)))


def _write(path: Path, content: bytes) -> None:
    with atomic_file(path) as file:
        file.write_bytes(content)


def _csv(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([[_cell(cell) for cell in row] for row in rows])
    return text.getvalue().encode("utf-8", errors="backslashreplace")


def _cell(value: Any) -> Any:  # noqa: ANN401 - text or a number
    if isinstance(value, str):
        return table_cell(value)
    return "" if value is None else value


def _write_parquet(columns: Sequence[str], rows: Sequence[dict[str, Any]], file: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    texts = {"log", "status", "reason", "robot", "group", "start_utc", "tool_version", "run", "tags"}
    counts = {"events", "outages", "warnings", "gates_failed"}
    arrays = {}
    for name in columns:
        kind = pa.string() if name in texts else pa.int64() if name in counts else pa.float64()
        values = [row.get(name) for row in rows]
        if name in texts:
            # Names of files need not be text.
            values = [str(value).encode("utf-8", errors="backslashreplace").decode() for value in values]
        arrays[name] = pa.array(values, kind)
    pq.write_table(pa.table(arrays), file)
