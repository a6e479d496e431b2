"""Formats of icrtool's files: JSON, CSV, pictures, and the list of their checksums, which shows an edited file.

The module also reads and writes calibrations, and reads the fleet.json of a batch.
"""

from __future__ import annotations

import csv
import errno
import hashlib
import io
import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec
import numpy as np

from icrtool.errors import DataError, OutputError, RunError
from icrtool.kernels.arrays import Floats
from icrtool.output.files.atomic import check_place, write_file
from icrtool.records.calibration_document import CALIBRATION_SCHEMA, CalibrationFile
from icrtool.records.fleet_document import FLEET_FILE, FleetDocument, FleetLog
from icrtool.records.places import Below, Place, open_regular, path_of, read_regular
from icrtool.records.plain_data import plain_value
from icrtool.records.text import LogText, escaped_texts, table_cell

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from icrtool.calibration.record import Calibration


def schema_of(file: Place) -> str:
    """Return the schema that a JSON file states, for example ``icrtool/run/1``; empty if the file states none."""
    try:
        schema = json.loads(read_regular(file))["schema"]
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return ""
    return schema if isinstance(schema, str) else ""


def parse_json(raw: bytes) -> Any:  # noqa: ANN401 - whatever JSON holds
    """Return the content of a JSON file that icrtool wrote.

    Raises
    ------
    ValueError, RecursionError
        The bytes are not JSON, or hold a number that is not finite, which `json_bytes` never writes.
    """
    return json.loads(raw, parse_constant=_finite, parse_float=_finite)


def _finite(text: str) -> float:
    """Return the number in a text; refuse infinity and NaN."""
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is not a finite number")
    return value


Document = TypeVar("Document", bound=msgspec.Struct)


def read_document(file: Place, record_type: type[Document], *, escape: bool = True) -> Document:
    """Return the content of a JSON file as a record. Types and limits are checked; keys without a field are ignored.

    Parameters
    ----------
    file : place of the file
    record_type : type of the record
    escape : escape the texts, because they are printed later; names of files are not escaped

    Raises
    ------
    OSError, ValueError, RecursionError
        The file cannot be read, or its content does not fit the record.
    """
    stored = parse_json(read_regular(file))
    return msgspec.convert(escaped_texts(stored) if escape else stored, record_type)


def json_bytes(document: msgspec.Struct | Mapping[str, object]) -> bytes:
    """Return a document as JSON: indented, in UTF-8, with null for a number that is not finite."""
    text = json.dumps(_as_in_the_log(plain_value(document)), indent=2, ensure_ascii=False, allow_nan=False)
    # A file name with lone surrogates, which UTF-8 cannot hold, is written with JSON escapes.
    return (text + "\n").encode("utf-8", errors="backslashreplace")


def _as_in_the_log(value: Any) -> Any:  # noqa: ANN401 - whatever JSON holds
    """Return plain data with the texts of a log unescaped, because JSON has escapes of its own."""
    if isinstance(value, dict):
        return {key: _as_in_the_log(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_as_in_the_log(item) for item in value]
    return value.raw if isinstance(value, LogText) else value


def csv_bytes(columns: Iterable[str], rows: Iterable[Iterable[object]]) -> bytes:
    """Return a table as CSV: numbers in their shortest exact form, empty cells for None, infinity and NaN."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([_cell(value) for value in row] for row in rows)
    return text.getvalue().encode("utf-8", errors="backslashreplace")


def _cell(value: object) -> object:
    """Return the content of a cell of CSV."""
    if isinstance(value, str):
        return table_cell(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


def read_numbers(
    path: Path, needed: Sequence[str], optional: Sequence[str] = (), *, most_bytes: int | None = None
) -> dict[str, Floats]:
    """Return columns (n,) of a CSV file by name; an empty cell is NaN.

    Parameters
    ----------
    path : path of the file
    needed, optional : names of the columns to read; all others are ignored
    most_bytes : largest size of the file [bytes]; None: any

    Raises
    ------
    DataError
        The file cannot be read, is larger than `most_bytes`, lacks a column of `needed`, or has fewer than two rows.
    """
    try:
        with io.TextIOWrapper(open_regular(path), encoding="utf-8-sig", newline="") as file:
            if most_bytes is not None and path.stat().st_size > most_bytes:
                raise DataError(path, f"larger than {most_bytes / 1e6:g} MB", "leave out some of its rows")
            reader = csv.DictReader(file, skipinitialspace=True)
            header = tuple(reader.fieldnames or ())
            if missing := [name for name in needed if name not in header]:
                raise DataError(path, f"no column {missing[0]}", f"it holds {', '.join(header) or 'nothing'}")
            names = [*needed, *(name for name in optional if name in header)]
            rows = [[float(row[name] or "nan") for name in names] for row in reader]
    except OSError as err:
        raise DataError(path, "cannot be read", err.strerror or str(err)) from err
    except (UnicodeDecodeError, csv.Error, ValueError, TypeError) as err:
        raise DataError(path, "not a table of numbers", str(err)) from err
    if len(rows) < 2:
        raise DataError(path, f"{len(rows)} rows", "at least two are needed")
    return dict(zip(names, np.array(rows, np.float64).T.copy(), strict=True))


PLOT_FORMATS = ("png", "svg", "pdf")
"""Formats of pictures, which are also the suffixes of their files."""


def check_picture(file: Path) -> None:
    """Refuse a picture whose place or format cannot be written, before any work is done for it.

    Raises
    ------
    OutputError
        The suffix is none of `PLOT_FORMATS`, or `check_place` refuses the place.
    """
    if file.suffix.removeprefix(".").lower() not in PLOT_FORMATS:
        raise OutputError(
            file, "its suffix is not the suffix of a picture", f"end the name in .{', .'.join(PLOT_FORMATS)}"
        )
    check_place(file)


def save_picture(figure: Figure, file: Place) -> None:
    """Write a figure in the format of the suffix of the file.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    picture_format = path_of(file).suffix.removeprefix(".").lower()
    from icrtool.output.figures.style import picture_bytes

    write_file(file, picture_bytes(figure, picture_format))


CHECKSUM_FILE = "B2SUMS"
"""Name of the file in a run with the checksums of the run's files, in the form that ``b2sum --check`` reads.

The file lists every file of the run and of its dropout report, but not the page. It is correct at every moment: while a
report is replaced, it does not name the files of the report.
"""

LARGEST_SUMS_BYTES = 1 << 20
"""Largest size of the list of checksums of a run [bytes]. Such a list has some 40 lines of 160 bytes."""

SOURCES_FILE = ".icrtool-files"
"""Name of the file in a run with the absolute paths of its input files. run.json holds the paths as the user gave
them."""

LARGEST_RUN_FILE_BYTES = 1 << 33
"""Largest size of a file of a run [bytes]: 70 h at 100 Hz. A sparse file may state a far larger size and take hours to
read."""


def file_b2sum(place: Place) -> str:
    """Return the BLAKE2b checksum (hex) of a file. BLAKE2b is as safe as SHA-256, and twice as fast on most machines.

    Raises
    ------
    OSError
        The file cannot be read, or is larger than `LARGEST_RUN_FILE_BYTES`.
    """
    with open_regular(place) as file:
        if os.fstat(file.fileno()).st_size > LARGEST_RUN_FILE_BYTES:
            raise OSError(errno.EFBIG, f"larger than {LARGEST_RUN_FILE_BYTES} bytes", str(path_of(place)))
        return hashlib.file_digest(file, hashlib.blake2b).hexdigest()


def read_sums(directory: Path) -> dict[str, str]:
    """Return the BLAKE2b checksums (hex) of the files of a run, by the path of each file below the run.

    Raises
    ------
    RunError
        The list of checksums cannot be read.
    """
    try:
        lines = read_regular(Below(directory, CHECKSUM_FILE), LARGEST_SUMS_BYTES).decode().splitlines()
    except (OSError, UnicodeDecodeError) as err:
        raise RunError(directory, f"no readable {CHECKSUM_FILE}", "fit the log again") from err
    return {name: sum_ for sum_, _, name in (line.partition("  ") for line in lines)}


def write_sums(directory: Path, sums: Mapping[str, str]) -> None:
    """Write the list of checksums of a run.

    Raises
    ------
    OutputError
        The list cannot be written.
    """
    lines = (f"{sum_}  {name}\n" for name, sum_ in sums.items())
    write_file(Below(directory, CHECKSUM_FILE), "".join(lines))


def relist_files(directory: Path, part: str, names: Iterable[str] = ()) -> None:
    """Replace the files of one directory of a run in the run's list of checksums; a run without a list gets none.

    Parameters
    ----------
    directory : the run
    part : name of the directory in the run; all its files are removed from the list
    names : files that are added to the list, relative to `part`; empty while the files are being replaced

    Raises
    ------
    OSError
        A file cannot be read.
    OutputError
        The list cannot be written.
    RunError
        The list cannot be read.
    """
    if not os.path.lexists(directory / CHECKSUM_FILE):
        return
    before = read_sums(directory)
    sums = {name: sum_ for name, sum_ in before.items() if not name.startswith(f"{part}/")}
    sums |= {f"{part}/{name}": file_b2sum(Below(directory, f"{part}/{name}")) for name in names}
    if sums != before:
        write_sums(directory, sums)


CALIBRATION_FILE = "calibration.json"
"""Name of a calibration file in a folder."""


def open_calibration(file: Path | str) -> Calibration:
    """Return the calibration in a file.

    Parameters
    ----------
    file : path of a file that ``icrtool calibrate -o`` or `Calibration.write` wrote

    Raises
    ------
    RunError
        The file cannot be read, or is not a calibration.
    """
    from icrtool.calibration.record import Calibration

    path = Path(file)
    try:
        return msgspec.structs.replace(read_document(path, Calibration), name=path.stem)
    except OSError as err:
        raise RunError(path, "cannot be read", err.strerror or str(err)) from err
    except (ValueError, LookupError, ArithmeticError, RecursionError) as err:
        why = "not a calibration with a motion model"
        raise RunError(path, why, "make one with icrtool calibrate -o") from err


def write_calibration(document: CalibrationFile, place: Place) -> Path:
    """Write a calibration file to a place, or into the place if it is a folder.

    Returns
    -------
    Path
        The path of the file.

    Raises
    ------
    OutputError
        `calibration_file` refuses the place, or the file cannot be written.
    """
    file = calibration_file(place)
    write_file(file, json_bytes(document))
    return path_of(file)


def calibration_file(place: Place) -> Place:
    """Return the place of a calibration file: `place` itself, or `CALIBRATION_FILE` in it if it is a folder.

    Raises
    ------
    OutputError
        The folder does not exist, or a file that is not a calibration is there.
    """
    target = Below(path_of(place), CALIBRATION_FILE) if path_of(place).is_dir() else place
    file = path_of(target)
    if not file.parent.is_dir():
        raise OutputError(file, f"there is no folder {file.parent}", "make it, or name another place")
    replaced = file.is_symlink() and isinstance(target, Below)
    if file.exists() and not replaced and schema_of(file) != CALIBRATION_SCHEMA:
        raise OutputError(file, "a file that is not a calibration is there", "it is left alone; name another place")
    return target


def read_fleet(directory: Path) -> FleetDocument:
    """Return the content of the fleet.json of a batch.

    Raises
    ------
    OSError, ValueError, RecursionError
        The file cannot be read, or another version wrote it.
    """
    return read_document(Below(directory, FLEET_FILE), FleetDocument, escape=False)


def logs_of_fleet(directory: Path) -> list[FleetLog]:
    """Return the logs of a batch that could be used.

    Raises
    ------
    RunError
        The folder has no readable fleet.json, or the run of a log is a link.
    """
    try:
        usable = [log for log in read_fleet(directory).logs if log.status != "failed"]
        for log in usable:
            Below(directory, log.run).check_links()
    except (OSError, ValueError, RecursionError) as err:
        raise RunError(directory, f"its {FLEET_FILE} cannot be read ({err})", "name the folder of a batch") from err
    return usable
