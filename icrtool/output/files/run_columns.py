"""The columns of a run as files: states, smoothed states, and measurements with their outcomes.

States are written as exact CSV or as Parquet. ``measurements.npz`` holds the measurements as the filter used them, and
the outcome of each. It holds only the wheel samples before the first recorded state, because the other wheel samples
are columns of the states.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from functools import partial
from io import BufferedReader
from pathlib import Path
from tokenize import TokenError
from typing import TYPE_CHECKING, Any
from zipfile import ZIP_STORED, BadZipFile, ZipFile

import msgspec
import numpy as np
import orjson
from numpy.typing import NDArray

from icrtool.errors import RunError
from icrtool.kernels.arrays import Floats, Ints
from icrtool.logs.containers.chunk import LARGEST_RATIO
from icrtool.records.choices import StatesFormat
from icrtool.records.measurements import Fixes, ReferenceJump, SensorData, SlipEvent
from icrtool.records.places import Below, Place, open_regular, path_of
from icrtool.records.run import STATE_COLUMNS, MeasurementOutcome, Run
from icrtool.records.run_document import RunDocument
from icrtool.records.samples import GyroSamples, HeadingSamples, WheelSamples, without_repeats
from icrtool.records.tables import LARGEST_STATE, States

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq


COLUMNS_OF_STATES = tuple(field.name for field in fields(States))
"""Names of the columns of states, in the order of the files."""

INTEGER_COLUMNS = frozenset({"stamp_ns"})
"""Names of the int64 columns of states; the others are float64."""

FLOAT_COLUMNS = tuple(name for name in COLUMNS_OF_STATES if name not in INTEGER_COLUMNS)
DEVIATIONS = frozenset(f"std_{name}" for name in STATE_COLUMNS)
"""Names of the columns with standard deviations."""

FORMATTED_ROWS = 1024
"""Number of rows that are formatted at a time. Their text fits into the processor's cache, and memory does not grow
with the log."""

PARQUET_ROWS = 1 << 17
"""Number of rows in a row group of a Parquet file. A group is held in memory until it is written."""

FREE_STATES_BYTES = 1 << 29
"""Memory that states from a file may have in any case [bytes], in addition to `LARGEST_RATIO` times the size of the
file. The states of a robot that is parked for hours compress by a large ratio."""


def write_states(states: States, path: Path, file_format: StatesFormat) -> None:
    """Write the states to a new file.

    Parameters
    ----------
    states : the recorded states
    path : path of the new file
    file_format : format of the file

    Raises
    ------
    OSError
        The file cannot be written.

    Notes
    -----
    CSV numbers have the shortest form that reads back to the same double; whole numbers keep a ``.0``, so that pandas
    does not take them for integers.
    """
    if file_format == "parquet":
        import pyarrow as pa
        import pyarrow.parquet as pq

        # Arrays that share the memory of the columns: pyarrow's own conversion would import pandas.
        arrays = {
            name: pa.Array.from_buffers(
                pa.int64() if name in INTEGER_COLUMNS else pa.float64(),
                len(values),
                [None, pa.py_buffer(np.ascontiguousarray(values))],
            )
            for name, values in states.columns().items()
        }
        with path.open("xb") as file:
            pq.write_table(
                pa.table(arrays), file, compression="zstd", row_group_size=PARQUET_ROWS,
                use_dictionary=False, use_byte_stream_split=list(FLOAT_COLUMNS),
            )  # fmt: skip
    else:
        with path.open("xb") as file:
            file.writelines(_csv_chunks(states))


def read_states(place: Place, file_format: StatesFormat, *, whole: bool = True) -> States:
    """Return the states in a file that `write_states` wrote.

    Parameters
    ----------
    place : place of the file
    file_format : format of the file
    whole : hold all columns in memory; otherwise the standard deviations in a Parquet file are read each time they are
        used

    Raises
    ------
    ValueError
        The columns are not the columns of states.
    OSError
        The file cannot be read.
    """
    import pyarrow as pa

    types = {name: pa.int64() if name in INTEGER_COLUMNS else pa.float64() for name in COLUMNS_OF_STATES}
    try:
        if file_format == "parquet":
            import pyarrow.parquet as pq

            with open_regular(place) as source, pq.ParquetFile(source) as file:
                numbers = file.metadata.num_rows * len(COLUMNS_OF_STATES)
                if 8 * numbers > FREE_STATES_BYTES + LARGEST_RATIO * os.fstat(source.fileno()).st_size:
                    raise ValueError(f"it claims {numbers} numbers, more than a file of its size can hold")
                _check_columns(file.schema_arrow, types)
                columns_in_memory = {
                    name: _parquet_column(file, name) for name in COLUMNS_OF_STATES if whole or name not in DEVIATIONS
                }
                read = partial(_read_again, place, _identity(source))
            pa.default_memory_pool().release_unused()
            return States(**columns_in_memory) if whole else StoredStates(read, **columns_in_memory)
        import pyarrow.csv as pc

        options = pc.ConvertOptions(column_types=types, include_columns=list(COLUMNS_OF_STATES), null_values=[])
        with open_regular(place) as source:
            stored = pc.read_csv(source, convert_options=options)
        _check_columns(stored.schema, types)
        columns = dict(zip(stored.schema.names, stored.columns, strict=True))
        del stored
        # The memory of each column is freed before the next column is copied.
        return States(**{name: _array(columns.pop(name)) for name in COLUMNS_OF_STATES})
    except pa.ArrowException as err:
        raise ValueError(" ".join(str(err).split())) from err


class StoredStates(States):
    """States whose standard deviations stay in the file and are read each time they are used.

    Parameters
    ----------
    read : returns the standard deviations (n,) of a column by its name
    held : the other columns (n,)
    """

    __slots__ = ("_held", "_read")
    _read: Callable[[str], Floats]
    _held: dict[str, Floats | Ints]

    def __init__(self, read: Callable[[str], Floats], **held: Floats | Ints) -> None:
        for name, column in held.items():
            object.__setattr__(self, name, column)
        object.__setattr__(self, "_read", read)
        object.__setattr__(self, "_held", held)

    def __getattr__(self, name: str) -> Floats:
        # Python calls this method only for columns that are not held in memory.
        if name not in DEVIATIONS:
            raise AttributeError(name)
        return self._read(name)

    def __reduce__(self) -> tuple[type, tuple[Floats | Ints, ...]]:
        return States, tuple(self.columns().values())

    def changed(self, **columns: Floats | Ints) -> States:
        """Return the states with the given columns in place of their own."""
        return StoredStates(self._read, **(self._held | columns))


def _identity(file: BufferedReader) -> tuple[int, ...]:
    """Return numbers of an open file that change if the file is replaced or written to."""
    status = os.fstat(file.fileno())
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


def _read_again(place: Place, identity: tuple[int, ...], name: str) -> Floats:
    """Return a column (n,) from a file of states that was opened before.

    Raises
    ------
    RunError
        The file was replaced, edited or removed since.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = path_of(place)
    try:
        with open_regular(place) as source:
            if _identity(source) != identity:
                raise RunError(path.parent, f"{path.name} was replaced or edited while it was in use", "start again")
            with pq.ParquetFile(source) as file:
                return _parquet_column(file, name)
    except (OSError, pa.ArrowException) as err:
        raise RunError(path.parent, f"{path.name} cannot be read any more ({err})", "start again") from err


def _parquet_column(file: pq.ParquetFile, name: str) -> NDArray[Any]:
    """Return a column (n,) without nulls; it is read group by group, which needs no further memory."""
    column = np.empty(file.metadata.num_rows, np.int64 if name in INTEGER_COLUMNS else np.float64)
    filled = 0
    for group in range(file.num_row_groups):
        part = _array(file.read_row_group(group, [name], use_threads=False).column(0))
        column[filled : filled + len(part)] = part
        filled += len(part)
    if filled < len(column):
        raise ValueError(f"it holds {filled} of {len(column)} rows")
    return column


def _check_columns(schema: pa.Schema, types: dict[str, pa.DataType]) -> None:
    """Refuse a file whose columns are not the columns of states."""
    columns = [
        (name, column_type) for name, column_type in zip(schema.names, schema.types, strict=True) if name in types
    ]
    if sorted(name for name, _ in columns) != sorted(types) or dict(columns) != types:
        raise ValueError("its columns are not the columns of states")


def _array(column: pa.ChunkedArray) -> NDArray[Any]:
    """Return a column without nulls as an array (n,); pyarrow's own conversion would import pandas."""
    if column.null_count:
        raise ValueError("a cell is empty")
    return np.concatenate([np.from_dlpack(chunk) for chunk in column.chunks])


def _csv_chunks(table: States) -> Iterator[bytes]:
    """Yield the bytes of a CSV file with the states, `FORMATTED_ROWS` rows at a time."""
    yield (",".join(COLUMNS_OF_STATES) + "\n").encode()
    columns = table.columns()
    for begin in range(0, len(table), FORMATTED_ROWS):
        rows = slice(begin, begin + FORMATTED_ROWS)
        stamps = np.ascontiguousarray(table.stamp_ns[rows])
        numbers = np.stack([columns[name][rows] for name in FLOAT_COLUMNS], 1, dtype=np.float64)
        if np.isfinite(numbers).all():
            # Rows are split at one byte, which is faster than at the three bytes between rows. Therefore the first two
            # bytes of each row are removed.
            texts = [row[2:] for row in orjson.dumps(numbers, option=orjson.OPT_SERIALIZE_NUMPY).split(b"]")[:-2]]
        else:
            # JSON cannot express a number that is not finite.
            texts = [",".join(map(repr, row)).encode() for row in numbers.tolist()]
        stamp_texts = orjson.dumps(stamps, option=orjson.OPT_SERIALIZE_NUMPY)[1:-1].split(b",")
        yield b"\n".join([*map(b",".join, zip(stamp_texts, texts, strict=True)), b""])


MEASUREMENTS_FILE = "measurements.npz"
"""Name of the file with the measurements of a run."""

OUTCOME_COLUMNS = ("nis", "code", "difference")
"""Columns of the outcome of fixes and headings (`MeasurementOutcome`)."""

COLUMN_TYPES = {
    "stamp_ns": np.int64,
    "fix_class": np.uint8,
    "misreported": np.bool_,
    "down_weighted": np.bool_,
    "code": np.uint8,
}
"""Types of the columns of measurements that are not float64, by name."""


WHEEL_COLUMNS = ("stamp_ns", "v_left_mps", "v_right_mps")
"""Columns of the wheel samples before the first state. The states hold the other wheel samples."""


def write_measurements(run: Run, path: Path) -> None:
    """Write the measurements of a run to a new file, as arrays that `numpy.load` reads.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    sensors, count_before = run.sensors, len(run.sensors.wheels.stamp_ns) - len(run.table)
    columns: dict[str, NDArray[Any]] = {}
    for name in WHEEL_COLUMNS:
        columns[f"wheels_{name}"] = getattr(sensors.wheels, name)[:count_before]
    for group, record in (("fixes", sensors.fixes), ("headings", sensors.headings)):
        columns |= {f"{group}_{name}": getattr(record, name) for name in _names(type(record))}
    for group, outcome in (("fixes", run.gnss), ("headings", run.heading)):
        columns |= {f"{group}_{name}": getattr(outcome, name) for name in OUTCOME_COLUMNS}
    if sensors.gyro is not None:
        columns["gyro_topic"] = np.frombuffer(sensors.gyro.topic.encode("utf-8", "surrogatepass"), np.uint8)
        columns |= {"gyro_stamp_ns": sensors.gyro.stamp_ns, "gyro_rate_radps": sensors.gyro.rate_radps}
    if sensors.attitude is not None:
        columns |= {f"attitude_{name}": getattr(sensors.attitude, name) for name in _names(HeadingSamples)}
    with path.open("xb") as file:
        np.savez(file, **columns)  # type: ignore[arg-type]  # The stub of numpy takes the columns for its own flag.


def read_measurements(
    directory: Path, table: States, document: RunDocument
) -> tuple[States, SensorData, MeasurementOutcome, MeasurementOutcome]:
    """Return the measurements of a run, from the file that `write_measurements` wrote.

    Parameters
    ----------
    directory : the run
    table : the states of the run
    document : content of run.json, which holds the facts that are not columns

    Returns
    -------
    states : the states of the run; their wheel columns share the memory of the wheel samples
    sensors : wheels, fixes, headings and gyro
    fixes, headings : outcome of each fix and of each heading in the filter

    Raises
    ------
    ValueError
        The file is not a file of measurements, or its columns do not belong together.
    OSError
        The file cannot be read.
    """
    try:
        with open_regular(Below(directory, MEASUREMENTS_FILE)) as file, ZipFile(file) as stored:
            if any(member.compress_type != ZIP_STORED for member in stored.infolist()):
                # The size of a compressed array has no bound.
                raise ValueError(f"{MEASUREMENTS_FILE} is compressed")
            columns = {}
            for member in stored.infolist():
                with stored.open(member) as array:
                    read: NDArray[Any] = np.lib.format.read_array(array, allow_pickle=False)
                    columns[member.filename.removesuffix(".npy")] = read
        before_states = _columns(columns, "wheels", WHEEL_COLUMNS)
        stamps, left, right = (np.concatenate([before_states[name], getattr(table, name)]) for name in WHEEL_COLUMNS)
        fixes = Fixes(**_columns(columns, "fixes", _names(Fixes)))
        headings = HeadingSamples(**_columns(columns, "headings", _names(HeadingSamples)))
        gyro = None
        if "gyro_topic" in columns:
            topic = columns["gyro_topic"].astype(np.uint8).tobytes().decode("utf-8", "surrogatepass")
            gyro = GyroSamples(topic, *(_checked(columns, f"gyro_{name}", name) for name in ("stamp_ns", "rate_radps")))
        sensors = SensorData(
            name=document.log,
            wheels=WheelSamples(stamps, left, right),
            fixes=fixes,
            headings=headings,
            gyro=gyro,
            facts=document.facts,
            losses_ns=spans_of(document.rtk_losses_ns),
            # The documents also have seconds; the records of the log have stamps alone.
            events=msgspec.convert(document.events, tuple[SlipEvent, ...], from_attributes=True),
            jumps=msgspec.convert(document.reference_jumps, tuple[ReferenceJump, ...], from_attributes=True),
            attitude=_attitude(columns, gyro),
        )
        outcomes = []
        for group, stamps_ns in (("fixes", fixes.stamp_ns), ("headings", headings.stamp_ns)):
            outcome = [_checked(columns, f"{group}_{name}", name) for name in OUTCOME_COLUMNS]
            if {len(column) for column in outcome} != {len(stamps_ns)}:
                raise ValueError(f"the {group} and their outcomes differ in number")
            outcomes.append(MeasurementOutcome(stamps_ns, int(table.stamp_ns[0]), *outcome))
    except (BadZipFile, KeyError, EOFError, RuntimeError, MemoryError, SyntaxError, TokenError) as err:
        raise ValueError(f"{MEASUREMENTS_FILE}: {err}") from err
    first = len(stamps) - len(table)
    states = table.changed(stamp_ns=stamps[first:], v_left_mps=left[first:], v_right_mps=right[first:])
    return states, sensors, outcomes[0], outcomes[1]


def _attitude(columns: dict[str, NDArray[Any]], gyro: GyroSamples | None) -> HeadingSamples | None:
    """Return the headings of an inertial unit; None for a run without them.

    Most units send attitude and turn rate in one message: equal stamps share the memory of the gyro's stamps.
    """
    if "attitude_stamp_ns" not in columns:
        return None
    attitude = HeadingSamples(**_columns(columns, "attitude", _names(HeadingSamples)))
    same = gyro is not None and np.array_equal(attitude.stamp_ns, gyro.stamp_ns)
    stamps_ns = gyro.stamp_ns if gyro is not None and same else attitude.stamp_ns
    return replace(attitude, stamp_ns=stamps_ns, var_rad2=without_repeats(attitude.var_rad2))


def spans_of(pairs: object) -> Ints:
    """Return the spans in a run.json as an array (k, 2) of starts and ends [ns]."""
    return np.array(pairs, np.int64).reshape(-1, 2)


def _names(record: type) -> tuple[str, ...]:
    """Return the names of the fields of a dataclass."""
    return tuple(field.name for field in fields(record))


def _columns(columns: dict[str, NDArray[Any]], group: str, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    """Return the columns (n,) of a group by name; refuse columns of other types or of different lengths."""
    by_name = {name: _checked(columns, f"{group}_{name}", name) for name in names}
    if len({len(column) for column in by_name.values()}) > 1:
        raise ValueError(f"the columns of the {group} differ in length")
    return by_name


def _checked(columns: dict[str, NDArray[Any]], key: str, name: str) -> NDArray[Any]:
    """Return a column (n,); refuse another type, another shape, or numbers beyond `LARGEST_STATE`."""
    column, column_type = columns[key], COLUMN_TYPES.get(name, np.float64)
    if column.ndim != 1 or column.dtype != column_type:
        raise ValueError(f"{key} is not a column of {np.dtype(column_type)}")
    if column_type is np.float64 and name not in OUTCOME_COLUMNS and (np.abs(column) > LARGEST_STATE).any():
        raise ValueError(f"{key} holds a number beyond {LARGEST_STATE:g}")
    return column
