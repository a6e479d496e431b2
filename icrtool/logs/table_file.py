"""A log that is one CSV file (columns: `icrtool.records.frames`)."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

from icrtool.errors import LogError
from icrtool.logs.cut import Moment, moment, nanoseconds
from icrtool.records.tables import InputFile, RobotLog

SUFFIX = ".csv"


def is_table(path: Path) -> bool:
    """Return whether a path names a table."""
    return path.suffix.lower() == SUFFIX and path.is_file()


def read_table(path: Path, start: Moment | None = None, end: Moment | None = None) -> RobotLog:
    """Read a CSV file: a row for each stamp, with the columns that were measured then; others are empty.

    Raises
    ------
    LogError
        The file is not a CSV table.
    DataError
        A column is missing or holds a value that is not a number.
    """
    import pandas as pd

    begin, stop = moment(start, "start"), moment(end, "end")
    try:
        with path.open("rb") as stream:
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
        table = pd.read_csv(path, skipinitialspace=True)
    except OSError as err:
        raise LogError(path, "cannot be read", err.strerror or str(err)) from err
    except ValueError as err:
        raise LogError(path, "not a CSV table", str(err)) from err
    table = table.rename(columns=str)
    if begin is not None or stop is not None:
        clock, unit = ("stamp_ns", 1) if "stamp_ns" in table else ("t_s", 1e9)
        if clock in table and len(table):
            stamps = pd.to_numeric(table[clock], errors="coerce") * unit
            first = int(stamps.min()) if stamps.notna().any() else 0
            inside = stamps.notna()
            inside &= stamps >= nanoseconds(begin, first) if begin is not None else True
            inside &= stamps < nanoseconds(stop, first) if stop is not None else True
            table = table[inside]
    log = RobotLog.from_frames(table, table, table, table, path.stem)
    return replace(log, inputs=(InputFile(str(path), path.stat().st_size, digest),))
