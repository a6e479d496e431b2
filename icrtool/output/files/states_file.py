"""The recorded states as a file, CSV with every bit of every number or Parquet, and every single trial as Parquet."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import orjson
from numpy.typing import NDArray

from icrtool.kernels.arrays import Floats, Ints
from icrtool.logs.containers.chunk import LARGEST_RATIO
from icrtool.output.files.formats import file_b2sum
from icrtool.records.regular_file import open_regular
from icrtool.records.tables import States

if TYPE_CHECKING:
    import pyarrow as pa

    from icrtool.dropout_analysis.trials import ErrorSink

StatesFormat = Literal["csv", "parquet"]

COLUMNS = tuple(field.name for field in fields(States))
INTEGER_COLUMNS = frozenset({"stamp_ns"})

CHUNK_ROWS = 1024
"""Rows formatted at a time: their text stays in the processor's cache, and memory does not grow with the log."""

PARQUET_ROWS = 1 << 17
"""Rows of a row group: a group is held in memory until it is written."""

FREE_BYTES = 1 << 29
"""States take no more than this and `LARGEST_RATIO` times the size of their file: a robot that is parked for hours."""

ROWS_A_GROUP = 1 << 18
"""Trials written at a time: 6 MB."""


class StatesFileError(ValueError):
    """A file that does not hold the columns of the states. Only `read_run` sees it, and raises a clearer one."""


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
        Sum of the file, as `file_b2sum`.

    Raises
    ------
    OSError
        The file cannot be written.

    Notes
    -----
    CSV numbers have the shortest form that reads back to the same double; whole numbers keep a ``.0``, so that pandas
    does not take them for integers.
    """
    if states == "parquet":
        import pyarrow.parquet as pq

        floats = [name for name in COLUMNS if name not in INTEGER_COLUMNS]
        with path.open("xb") as file:
            pq.write_table(
                _arrow(table.columns()), file, compression="zstd", row_group_size=PARQUET_ROWS,
                use_dictionary=False, use_byte_stream_split=floats,
            )  # fmt: skip
        return file_b2sum(path)
    digest = hashlib.blake2b()
    # A chunk is summed and written while it is in the processor's cache: a thread for that takes longer.
    with path.open("xb") as file:
        for chunk in _csv_chunks(table):
            digest.update(chunk)
            file.write(chunk)
    return digest.hexdigest()


def read_states(path: Path, states: StatesFormat, inside: Path | None = None) -> States:
    """Read what `write_states` wrote.

    Parameters
    ----------
    inside : as in `open_regular`

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

            with open_regular(path, inside) as source, pq.ParquetFile(source) as file:
                numbers = file.metadata.num_rows * len(COLUMNS)
                if 8 * numbers > FREE_BYTES + LARGEST_RATIO * os.fstat(source.fileno()).st_size:
                    raise StatesFileError(f"it claims {numbers} numbers, too many for its size")
                _check_columns(file.schema_arrow, types)
                # One at a time: each one's memory is used again for the next.
                read = partial(file.read, use_threads=False)
                return States(**{name: _array(read([name]).column(0)) for name in COLUMNS})
        import pyarrow.csv as pc

        options = pc.ConvertOptions(column_types=types, include_columns=list(COLUMNS), null_values=[])
        with open_regular(path, inside) as source:
            stored = pc.read_csv(source, convert_options=options)
        _check_columns(stored.schema, types)
        columns = dict(zip(stored.schema.names, stored.columns, strict=True))
        del stored
        # Each column's memory goes back before the next is copied.
        return States(**{name: _array(columns.pop(name)) for name in COLUMNS})
    except pa.ArrowException as err:
        raise StatesFileError(" ".join(str(err).split())) from err


def _check_columns(schema: pa.Schema, types: dict[str, pa.DataType]) -> None:
    if {name: schema.field(name).type for name in schema.names if name in types} != types:
        raise StatesFileError("its columns are not those of the states")


def _array(column: pa.ChunkedArray) -> NDArray[Any]:
    """Return a column without nulls as an array; pyarrow's own conversion would import pandas."""
    if column.null_count:
        raise StatesFileError("a cell is empty")
    return np.concatenate([np.from_dlpack(chunk) for chunk in column.chunks])


@contextmanager
def trials_file(path: Path, stamp_ns: Ints) -> Iterator[ErrorSink]:
    """Give a sink that appends trials to a new Parquet file; starts without a trial are left out.

    Parameters
    ----------
    path : the file to make
    stamp_ns : (n,) of the starts

    Raises
    ------
    OSError
        The file cannot be written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    names = pa.dictionary(pa.int8(), pa.string())
    schema = pa.schema({"model": names, "stamp_ns": pa.int64(), "horizon_m": pa.float64(), "error_m": pa.float64()})
    with pq.ParquetWriter(path, schema, compression="zstd") as writer:

        def append(model: str, horizons_m: Floats, errors_m: Floats) -> None:
            for h, horizon in enumerate(horizons_m):
                for lo in range(0, len(stamp_ns), ROWS_A_GROUP):
                    error = errors_m[lo : lo + ROWS_A_GROUP, h]
                    tried = ~np.isnan(error)
                    rows = int(np.count_nonzero(tried))
                    model_column = pa.DictionaryArray.from_arrays(pa.array(np.zeros(rows, np.int8)), [model])
                    columns = [
                        model_column,
                        pa.array(stamp_ns[lo : lo + ROWS_A_GROUP][tried]),
                        pa.array(np.full(rows, float(horizon))),
                        pa.array(error[tried]),
                    ]
                    writer.write_table(pa.table(columns, schema=schema))

        yield append


def _csv_chunks(table: States) -> Iterator[bytes]:
    yield (",".join(COLUMNS) + "\n").encode()
    columns = table.columns()
    for begin in range(0, len(table), CHUNK_ROWS):
        rows = slice(begin, begin + CHUNK_ROWS)
        stamps = table.stamp_ns[rows]
        numbers = np.stack(
            [columns[name][rows] for name in COLUMNS if name not in INTEGER_COLUMNS], 1, dtype=np.float64
        )
        yield b"\n".join([*map(b",".join, zip(_texts(stamps), _number_rows(numbers), strict=True)), b""])


def _texts(stamps: Ints) -> list[bytes]:
    return orjson.dumps(np.ascontiguousarray(stamps), option=orjson.OPT_SERIALIZE_NUMPY)[1:-1].split(b",")


def _number_rows(numbers: Floats) -> list[bytes]:
    """Return rows of numbers as text, separated by commas."""
    if not np.isfinite(numbers).all():
        # JSON has no word for these.
        return [",".join(map(repr, row)).encode() for row in numbers.tolist()]
    return orjson.dumps(numbers, option=orjson.OPT_SERIALIZE_NUMPY)[2:-2].split(b"],[")


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
