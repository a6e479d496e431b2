"""Every single trial as Parquet, written while they are computed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from icrtool.dropout_analysis.trials import ErrorSink
from icrtool.kernels.arrays import Floats, Ints

ROWS_A_GROUP = 1 << 18
"""Rows written at a time: 6 MB."""


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
