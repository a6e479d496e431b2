"""The recorded states as a file: CSV with every bit of every number, or Parquet."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from icrtool.tables import Floats, Ints, States

if TYPE_CHECKING:
    import pyarrow as pa

StatesFormat = Literal["csv", "parquet"]

COLUMNS = tuple(field.name for field in fields(States))
INTEGER_COLUMNS = frozenset({"stamp_ns"})

CHUNK_ROWS = 16_384
"""Rows formatted at a time: 4 MB of text, so that memory does not grow with the log."""

LARGEST_PLAIN_WHOLE = 1e15
"""Whole numbers below this are printed without an exponent."""


class StatesFileError(ValueError):
    """A file that does not hold the columns of the states. Only `read_run` sees it, and says it better."""


def write_states(table: States, path: Path, states: StatesFormat) -> str:
    """Write the states to a new file.

    Parameters
    ----------
    table : the recorded states
    path : the file to make
    states : its format

    Returns
    -------
    str
        SHA-256 (hex) of the file.

    Raises
    ------
    OSError
        The file cannot be written.

    Notes
    -----
    CSV numbers have the shortest form that reads back to the same double. A column of whole numbers keeps a
    ``.0``, so that pandas does not take it for integers.
    """
    if states == "parquet":
        import pyarrow.parquet as pq

        with path.open("xb") as file:
            pq.write_table(_arrow(table.columns()), file, compression="zstd")
        return file_sha256(path)
    digest = hashlib.sha256()
    with path.open("xb") as file:
        for chunk in _csv_chunks(table):
            digest.update(chunk)
            file.write(chunk)
    return digest.hexdigest()


def read_states(path: Path, states: StatesFormat) -> States:
    """Read what `write_states` wrote.

    Raises
    ------
    StatesFileError
        The columns are not those of the states.
    OSError
        The file cannot be read.
    """
    import pyarrow as pa

    types = {name: pa.int64() if name in INTEGER_COLUMNS else pa.float64() for name in COLUMNS}
    try:
        if states == "parquet":
            import pyarrow.parquet as pq

            stored = pq.read_table(path, columns=list(COLUMNS))
        else:
            import pyarrow.csv as pc

            options = pc.ConvertOptions(column_types=types, include_columns=list(COLUMNS))
            stored = pc.read_csv(path, convert_options=options)
        if dict(zip(stored.schema.names, stored.schema.types, strict=True)) != types:
            raise StatesFileError("its columns are not those of the states")
        return States(**{name: np.array(stored.column(name)) for name in COLUMNS})
    except (pa.ArrowInvalid, pa.ArrowKeyError) as err:
        raise StatesFileError(" ".join(str(err).split())) from err


def file_sha256(path: Path) -> str:
    """Return the SHA-256 (hex) of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _csv_chunks(table: States) -> Iterator[memoryview]:
    """Yield the file piece by piece, formatted ahead by as many threads as there are cores (pyarrow frees the GIL)."""
    import pyarrow as pa

    yield memoryview((",".join(COLUMNS) + "\n").encode())
    workers = pa.cpu_count()
    columns = table.columns()
    whole = frozenset(name for name, values in columns.items() if name not in INTEGER_COLUMNS and _is_whole(values))
    waiting: deque[Future[memoryview]] = deque()
    with ThreadPoolExecutor(workers) as pool:
        for begin in range(0, len(table), CHUNK_ROWS):
            rows = {name: values[begin : begin + CHUNK_ROWS] for name, values in columns.items()}
            waiting.append(pool.submit(_format_rows, rows, whole))
            if len(waiting) > 2 * workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def _is_whole(values: Floats | Ints) -> bool:
    """Say whether all of a column would be printed without a decimal point."""
    return bool(np.all((values == np.trunc(values)) & (np.abs(values) < LARGEST_PLAIN_WHOLE)))


def _format_rows(rows: dict[str, Floats | Ints], whole: frozenset[str]) -> memoryview:
    import pyarrow as pa
    import pyarrow.compute as pac
    import pyarrow.csv as pc

    block = _arrow(rows)
    for name in whole:
        texts = pac.binary_join_element_wise(pac.cast(block.column(name), pa.string()), ".0", "")
        block = block.set_column(block.schema.get_field_index(name), name, texts)
    sink = pa.BufferOutputStream()
    pc.write_csv(block, sink, pc.WriteOptions(include_header=False, quoting_style="none"))
    return memoryview(sink.getvalue())


def _arrow(columns: dict[str, Floats | Ints]) -> pa.Table:
    """Return columns as an Arrow table that shares their memory; to convert them pyarrow would import pandas."""
    import pyarrow as pa

    arrays = {
        name: pa.Array.from_buffers(
            pa.int64() if name in INTEGER_COLUMNS else pa.float64(),
            len(values),
            [None, pa.py_buffer(np.ascontiguousarray(values))],
        )
        for name, values in columns.items()
    }
    return pa.table(arrays)
