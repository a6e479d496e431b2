"""CSV files of ours."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable

from icrtool.records.text import table_cell


def csv_bytes(columns: Iterable[str], rows: Iterable[Iterable[object]]) -> bytes:
    """Return a table as CSV: numbers in their shortest exact form, empty where there is none, text as `table_cell`."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([_cell(value) for value in row] for row in rows)
    return text.getvalue().encode("utf-8", errors="backslashreplace")


def _cell(value: object) -> object:
    if isinstance(value, str):
        return table_cell(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value
