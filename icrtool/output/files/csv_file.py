"""CSV files of ours, and tables of numbers that somebody else wrote."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from icrtool.errors import DataError
from icrtool.kernels.arrays import Floats
from icrtool.records.regular_file import open_regular
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


def read_numbers(
    path: Path, needed: Sequence[str], optional: Sequence[str] = (), *, most_bytes: int | None = None
) -> dict[str, Floats]:
    """Read columns of numbers (n,) by name; an empty cell is NaN, other columns are passed over.

    Raises
    ------
    DataError
        The file cannot be read, is larger than `most_bytes`, lacks a column that is needed, or has fewer than two rows.
    """
    try:
        with io.TextIOWrapper(open_regular(path), encoding="utf-8-sig", newline="") as file:
            if most_bytes is not None and path.stat().st_size > most_bytes:
                raise DataError(path, f"larger than {most_bytes / 1e6:g} MB", "leave out some of its rows")
            reader = csv.DictReader(file, skipinitialspace=True)
            found = tuple(reader.fieldnames or ())
            if missing := [name for name in needed if name not in found]:
                raise DataError(path, f"no column {missing[0]}", f"it holds {', '.join(found) or 'nothing'}")
            names = [*needed, *(name for name in optional if name in found)]
            rows = [[float(row[name] or "nan") for name in names] for row in reader]
    except OSError as err:
        raise DataError(path, "cannot be read", err.strerror or str(err)) from err
    except (UnicodeDecodeError, csv.Error, ValueError, TypeError) as err:
        raise DataError(path, "not a table of numbers", str(err)) from err
    if len(rows) < 2:
        raise DataError(path, f"{len(rows)} rows", "at least two are needed")
    return dict(zip(names, np.array(rows, np.float64).T.copy(), strict=True))
