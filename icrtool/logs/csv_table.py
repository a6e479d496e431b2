"""Reader of CSV files: a data frame with the columns that a log can use, read in parts of limited size."""

from __future__ import annotations

import csv
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, NamedTuple

from icrtool.records.tables import TABLE_COLUMNS

if TYPE_CHECKING:
    import pandas as pd

LONGEST_HEAD_BYTES, MOST_COLUMNS = 1 << 18, 4096
"""Largest size of the line with the names of columns [bytes], and largest number of columns. pandas takes 1 min for a
million columns."""

CELLS_AT_ONCE = 1 << 20
"""Number of cells that are read at a time. A cell takes up to 100 bytes of memory."""

MOST_EMPTY, LEAST_CELLS = 4, 1_000_000
"""Largest number of cells for each byte of a file, and number of cells that every file may have. pandas makes a cell
for each column of each row, so that rows of two bytes under thousands of names would fill the memory."""

_COUNTED_BYTES = 1 << 20
"""Number of bytes whose line ends are counted at a time."""

MORE_VALUES = "its rows have more values than its first line has names"
"""Reason why a table with values that belong to no column is refused."""


class TableForm(NamedTuple):
    """Separator of the columns of a table, its decimal sign, and the number of its columns."""

    separator: str
    decimal: str
    columns: int

    @property
    def text(self) -> str:
        """Text about the form for messages; empty for columns that are separated by commas."""
        signs = {";": "semicolons", "\t": "tabs"}
        comma = ", decimal comma" if self.decimal == "," else ""
        return f"{signs[self.separator]} between columns{comma}" if self.separator in signs else ""


def table_form(head: bytes, row: bytes) -> TableForm:
    """Return the form of a table, given its first line (names) and its first row of values.

    If semicolons or tabs separate the columns, as in countries with a decimal comma, a comma in the row is the decimal
    sign.
    """
    counts = {sign: head.count(sign.encode()) for sign in (",", ";", "\t")}
    separator = max(counts, key=lambda sign: counts[sign])
    return TableForm(separator, "," if separator != "," and b"," in row else ".", counts[separator] + 1)


def csv_frame(path: Path) -> pd.DataFrame:
    """Return the columns of a CSV file that a log can use, by the names in its first line.

    The `attrs` of the data frame hold the form of the table (``form``) and the names of all columns (``names``).

    Raises
    ------
    OSError
        The file cannot be read.
    ValueError
        The file is no table: it is not UTF-8, names too many columns, or has rows with more values than columns or with
        far fewer.
    """
    import pandas as pd

    with path.open("rb") as stream:
        head = _next_line(stream)
        if len(head) == LONGEST_HEAD_BYTES or head.count(b",") >= MOST_COLUMNS:
            most = min(head.count(b","), MOST_COLUMNS)
            raise ValueError(f"its first line has more than {most} columns")
        first = _next_line(stream)
        form = table_form(head, first)
        if form.columns > MOST_COLUMNS:
            raise ValueError(f"its first line has more than {MOST_COLUMNS} columns")
        if _count(first, form) > _count(head, form):
            raise ValueError(MORE_VALUES)
        _check_cells(stream, form)
    parts, names = [], list[object]()
    with warnings.catch_warnings():
        # In rows with more values than names, pandas drops the further values and only warns.
        warnings.simplefilter("error", pd.errors.ParserWarning)
        try:
            with pd.read_csv(
                path, skipinitialspace=form.separator != "\t", sep=form.separator, decimal=form.decimal,
                encoding="utf-8-sig", index_col=False, compression=None, chunksize=CELLS_AT_ONCE // form.columns,
            ) as reader:  # fmt: skip
                for part in reader:
                    names = names or list(part.columns)
                    parts.append(part[[column for column in part.columns if column in TABLE_COLUMNS]])
        except pd.errors.ParserWarning:
            raise ValueError(MORE_VALUES) from None
    table = pd.concat(parts, ignore_index=True) if len(parts) > 1 else parts[0] if parts else pd.DataFrame()
    table.attrs.update(form=form.text, names=names)
    return table


def _next_line(stream: BinaryIO) -> bytes:
    """Return the next line that is not blank, at most `LONGEST_HEAD_BYTES` of it; empty at the end of the stream."""
    while (line := stream.readline(LONGEST_HEAD_BYTES)) and not line.strip():
        pass
    return line


def _count(line: bytes, form: TableForm) -> int:
    """Return the number of values in a line."""
    text = line.decode("utf-8", "replace").strip("\r\n")
    try:
        return len(next(csv.reader([text], delimiter=form.separator, skipinitialspace=form.separator != "\t"), []))
    except csv.Error:
        return form.columns


def _check_cells(stream: BinaryIO, form: TableForm) -> None:
    """Refuse a table with far more cells than values.

    Raises
    ------
    ValueError
        The first line has many names, and the rows have values in few of these columns.
    """
    stream.seek(0)
    size = rows = 0
    while piece := stream.read(_COUNTED_BYTES):
        size += len(piece)
        rows += piece.count(b"\n") - piece.count(b"\n\n") - piece.count(b"\n\r\n")
    if rows * form.columns > MOST_EMPTY * size + LEAST_CELLS:
        raise ValueError(f"its first line names {form.columns} columns, and its rows have values in few of them")
