"""A log that is one CSV file (columns: `icrtool.records.frames`)."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from icrtool.errors import LogError
from icrtool.logs.containers.open_log import check_unchanged, plain_file, states_of
from icrtool.logs.containers.recording_files import PACKED, log_name
from icrtool.logs.cut import Moment, longest_part, moment, nanoseconds
from icrtool.records.tables import RobotLog
from icrtool.records.urls import UrlPath

if TYPE_CHECKING:
    import pandas as pd

_NAME = re.compile(rf"\.csv(?:{PACKED})?$", re.IGNORECASE)

LONGEST_HEAD_BYTES = 1 << 18
"""Of the line that names the columns: pandas takes a minute for a million of them."""


def is_table(path: Path) -> bool:
    """Return whether a path, or an address, names a table."""
    return _NAME.search(path.name) is not None and (path.is_file() or isinstance(path, UrlPath))


def csv_frame(path: Path) -> pd.DataFrame:
    """Return the columns of a CSV file whose first line names them.

    Raises
    ------
    OSError
        The file cannot be read.
    ValueError
        It is not a table: text that is not UTF-8, a line that names too many columns, or rows with more values.
    """
    import pandas as pd

    with path.open("rb") as stream:
        if len(head := stream.readline(LONGEST_HEAD_BYTES)) == LONGEST_HEAD_BYTES:
            raise ValueError(f"its first line has more than {head.count(b',')} columns")
    table = pd.read_csv(path, skipinitialspace=True)
    if not isinstance(table.index, pd.RangeIndex):
        raise ValueError("its rows have more values than its first line has names")  # noqa: TRY004 - of the file
    return table


def read_table(path: Path, start: Moment | None = None, end: Moment | None = None) -> RobotLog:
    """Read a CSV file, also compressed: a row for each stamp, with the columns that were measured then.

    Raises
    ------
    LogError
        The file is not a CSV table.
    DataError
        A column is missing or holds a value that is not a number.
    """
    import pandas as pd

    begin, stop = moment(start, "start"), moment(end, "end")
    before = states_of(path)
    try:
        with plain_file(path) as (file, read):
            table = csv_frame(file)
        check_unchanged(path, before, [read])
    except OSError as err:
        raise LogError(path, "cannot be read", err.strerror or str(err)) from err
    except ValueError as err:
        raise LogError(path, "not a CSV table", str(err)) from err
    table = table.rename(columns=str)
    if begin is not None or stop is not None:
        clock, unit = ("stamp_ns", 1) if "stamp_ns" in table else ("t_s", 1e9)
        if clock in table and len(table):
            stamps = pd.to_numeric(table[clock], errors="coerce") * unit
            inside = np.isfinite(stamps)
            first = int(stamps[inside].min()) if inside.any() else 0
            inside &= stamps >= nanoseconds(begin, first) if begin is not None else True
            inside &= stamps < nanoseconds(stop, first) if stop is not None else True
            table = table[inside]
    log = RobotLog.from_frames(table, table, table, table, log_name(path))
    return longest_part(replace(log, inputs=(read,)))
