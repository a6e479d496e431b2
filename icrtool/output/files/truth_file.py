"""The truth beside a simulated log, and track speeds to simulate with."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from icrtool.errors import DataError, OutputError
from icrtool.output.files import disk
from icrtool.output.files.atomic import hidden_directory, put
from icrtool.output.files.formats import read_numbers
from icrtool.output.files.own_files import reported, restore
from icrtool.records.process_resources import remove
from icrtool.simulation.drives import TrackSpeeds
from icrtool.simulation.record import TruthTable

SPEED_COLUMNS = ("t_s", "v_left_mps", "v_right_mps")


def truth_path(log: Path) -> Path:
    """Return where the truth of a log stands: beside it, ``LOG.truth.csv``."""
    return log.with_name(f"{log.name}.truth.csv")


@contextmanager
def log_and_truth(log: Path, *, force: bool) -> Iterator[tuple[Path, Path]]:
    """Give places to write a log and its truth to; put both in place when the block ends well.

    Parameters
    ----------
    log : where the log shall appear; its truth appears beside it, see `truth_path`
    force : replace what is there, if it is a log (a file, or a bag directory)

    Raises
    ------
    OutputError
        Something is there, or the place cannot be written. It then stays as it was.
    """
    truth = truth_path(log)
    with reported(log):
        restore(log, _is_bag)
        for place in (log, truth):
            if place.exists() and not force:
                raise OutputError(place, "exists already", "--force replaces it")
            if place.is_dir() and (place == truth or not _is_bag(place)):
                raise OutputError(place, "is a directory and no bag", "it is left alone; choose another name")
        with hidden_directory(log.absolute()) as fresh:
            yield fresh / log.name, fresh / truth.name
            disk.sync_tree(fresh)
            # Killed from here on, it leaves a log without its truth, never with that of another log.
            remove(truth)
            if log.is_dir():
                put(fresh / log.name, log, fresh)
            else:
                (fresh / log.name).replace(log)
            (fresh / truth.name).replace(truth)
            disk.sync(log.absolute().parent)


def _is_bag(place: Path) -> bool:
    return (place / "metadata.yaml").is_file()


def write_truth(table: TruthTable, path: Path) -> None:
    """Write the truth; numbers in the shortest form that reads back the same."""
    import pyarrow as pa
    import pyarrow.csv as pc

    header = ",".join(table) + "\n"
    with path.open("xb") as file:
        file.write(header.encode())
        rows = pa.table({name: np.ascontiguousarray(values) for name, values in table.items()})
        pc.write_csv(rows, file, pc.WriteOptions(include_header=False, quoting_style="none"))


def read_speeds(path: Path) -> TrackSpeeds:
    """Read track speeds from a CSV with columns ``t_s, v_left_mps, v_right_mps``; others are passed over.

    Raises
    ------
    DataError
        A file that cannot be read, or without usable columns; times that do not increase.
    """
    t, left, right = read_numbers(path, SPEED_COLUMNS).values()
    if not np.isfinite([t, left, right]).all():
        row = int(np.argmin(np.isfinite([t, left, right]).all(axis=0)))
        raise DataError(path, f"row {row + 1} holds a value that is not a finite number")
    if not (np.diff(t) > 0).all():
        row = int(np.argmax(np.diff(t) <= 0)) + 1
        raise DataError(path, f"the times do not increase at row {row + 1}", f"t_s = {t[row]:g} after {t[row - 1]:g}")
    return TrackSpeeds(t - t[0], left, right)
