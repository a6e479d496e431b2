"""``headings.parquet`` of a run: what its own sensors told of the heading, by state, apart from the filter."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from icrtool.analysis.ladder_trials import MeasuredHeading
from icrtool.tables import Ints

HEADINGS_FILE = "headings.parquet"

COLUMNS = {"gyro": "gyro_turned_rad", "heading": "measured_heading_rad"}
"""By kind: the gyro's integrated turn since the first state, the attitude as the filter took it; clockwise."""


def write_headings(headings: tuple[MeasuredHeading, ...], stamp_ns: Ints, path: Path) -> None:
    """Write headings, a row per state.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = {"stamp_ns": pa.Array.from_buffers(pa.int64(), len(stamp_ns), [None, pa.py_buffer(stamp_ns)])}
    for heading in headings:
        angle = np.ascontiguousarray(heading.angle_rad)
        columns[COLUMNS[heading.kind]] = pa.Array.from_buffers(pa.float64(), len(angle), [None, pa.py_buffer(angle)])
    with path.open("xb") as file:
        pq.write_table(pa.table(columns), file, compression="zstd", use_dictionary=False)


def read_headings(path: Path, stamp_ns: Ints) -> tuple[MeasuredHeading, ...]:
    """Read what `write_headings` wrote.

    Raises
    ------
    ValueError
        The rows are not those of the states, or it is no such file.
    OSError
        The file cannot be read.
    """
    import pyarrow.parquet as pq

    stored = pq.read_table(path)
    if not np.array_equal(np.array(stored.column("stamp_ns")), stamp_ns):
        raise ValueError("its rows are not those of the states")
    found: list[MeasuredHeading] = []
    if COLUMNS["gyro"] in stored.column_names:
        found.append(MeasuredHeading("gyro", np.array(stored.column(COLUMNS["gyro"]))))
    if COLUMNS["heading"] in stored.column_names:
        found.append(MeasuredHeading("heading", np.array(stored.column(COLUMNS["heading"]))))
    return tuple(found)
