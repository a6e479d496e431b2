"""``headings.npz`` of a run: what its own sensors told of the heading, by state, apart from the filter."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal
from zipfile import BadZipFile

import numpy as np

from icrtool.estimation.measured_heading import MeasuredHeading
from icrtool.records.tables import Ints

HEADINGS_FILE = "headings.npz"

COLUMNS = {"gyro": "gyro_turned_rad", "heading": "measured_heading_rad"}
"""By kind: the gyro's integrated turn since the first state, the attitude as the filter took it; clockwise."""


def write_headings(headings: tuple[MeasuredHeading, ...], stamp_ns: Ints, path: Path) -> None:
    """Write headings, a row per state, as arrays that `numpy.load` reads.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    columns: dict[str, Any] = {COLUMNS[heading.kind]: heading.angle_rad for heading in headings}
    with path.open("xb") as file:
        np.savez(file, stamp_ns=stamp_ns, **columns)


def read_headings(path: Path, stamp_ns: Ints) -> tuple[MeasuredHeading, ...]:
    """Read what `write_headings` wrote.

    Raises
    ------
    ValueError
        The rows are not those of the states, or it is no such file.
    OSError
        The file cannot be read.
    """
    try:
        with np.load(path) as stored:
            if not np.array_equal(stored["stamp_ns"], stamp_ns):
                raise ValueError("its rows are not those of the states")
            kinds: tuple[Literal["gyro", "heading"], ...] = ("gyro", "heading")
            return tuple(MeasuredHeading(kind, stored[COLUMNS[kind]]) for kind in kinds if COLUMNS[kind] in stored)
    except (BadZipFile, KeyError) as err:
        raise ValueError(str(err)) from err
