"""Formats of icrtool's files: JSON, CSV, pictures, and the list of their sums, which shows an edited file.

The module also reads and writes documents of one JSON file: calibrations, and the fleet.json of a batch.
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
    """Return the schema that a JSON file states, for example ``icrtool/run/1``; empty where it states none."""
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
        It is no JSON, or holds a number that is not finite, which `json_bytes` never writes.
    """
    return json.loads(raw, parse_constant=_finite, parse_float=_finite)


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is no number")
    return value


Document = TypeVar("Document", bound=msgspec.Struct)


def read_document(file: Place, kind: type[Document], *, escape: bool = True) -> Document:
    """Read a JSON file as a record: types and limits are checked, keys that it does not know are ignored.

    Parameters
    ----------
    escape : escape the texts, because they are printed later; names of files are not escaped

    Raises
    ------
    OSError, ValueError, RecursionError
        The file cannot be read, or does not agree with the record.
    """
    stored = parse_json(read_regular(file))
    return msgspec.convert(escaped_texts(stored) if escape else stored, kind)


def json_bytes(document: msgspec.Struct | Mapping[str, object]) -> bytes:
    """Return the JSON text of a file: indented, UTF-8, null for a number that is not finite."""
    text = json.dumps(_as_in_the_log(plain_value(document)), indent=2, ensure_ascii=False, allow_nan=False)
    # A file name with lone surrogates, which UTF-8 cannot hold, is written with JSON escapes.
    return (text + "\n").encode("utf-8", errors="backslashreplace")


def _as_in_the_log(value: Any) -> Any:  # noqa: ANN401 - whatever JSON holds
    """Return plain data with the texts of a log unescaped: JSON has escapes of its own."""
    if isinstance(value, dict):
        return {key: _as_in_the_log(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_as_in_the_log(item) for item in value]
    return value.raw if isinstance(value, LogText) else value


def csv_bytes(columns: Iterable[str], rows: Iterable[Iterable[object]]) -> bytes:
    """Return a table as CSV: numbers in their shortest exact form, an empty cell for None, text as `table_cell`."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([_cell(value) for value in row] for row in rows)
    return text.getvalue().encode("utf-8", errors="backslashreplace")


def _cell(value: object) -> object:
    if isinstance(value, str):
        return table_cell(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


def read_numbers(
    path: Path, needed: Sequence[str], optional: Sequence[str] = (), *, most_bytes: int | None = None
) -> dict[str, Floats]:
    """Read columns of numbers (n,) by name; an empty cell is NaN, other columns are ignored.

    Raises
    ------
    DataError
        The file cannot be read, is larger than `most_bytes`, lacks a column that is needed, or has fewer than two rows.
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


def check_picture(file: Path) -> None:
    """Refuse a place or a format that cannot be written, before any work is done for it.

    Raises
    ------
    OutputError
        Another suffix than png, svg, pdf, or no such folder.
    """
    if file.suffix.removeprefix(".").lower() not in PLOT_FORMATS:
        raise OutputError(file, "its suffix is no format of a picture", f"end it in .{', .'.join(PLOT_FORMATS)}")
    check_place(file)


def save_picture(figure: Figure, file: Place) -> None:
    """Write a figure; the suffix gives the format.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    form = path_of(file).suffix.removeprefix(".").lower()
    from icrtool.output.figures.style import picture_bytes

    write_file(file, picture_bytes(figure, form))


CHECKSUM_FILE = "B2SUMS"
"""File in a run with the sums of the run's files, in the form that ``b2sum --check`` reads.

It lists every file of the run and of its dropout report, but not the page. The list is correct at every moment: while a
report is replaced, the list does not name its files.
"""

LARGEST_SUMS_BYTES = 1 << 20
"""Largest size of the list of sums of a run [bytes]. The list of a run has some 40 lines of 160 bytes."""

SOURCES_FILE = ".icrtool-files"
"""File in a run with the absolute paths of the files that the run was made from. run.json holds the paths as given."""

LARGEST_RUN_FILE_BYTES = 1 << 33
"""Largest size of a file of a run [bytes]: 70 h at 100 Hz. A sparse file may state a far larger size, and would take
hours to read."""


def file_b2sum(place: Place) -> str:
    """Return the BLAKE2b sum (hex) of a file: as safe as SHA-256, at twice its speed on most machines.

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
    """Return the BLAKE2b sums (hex) of the files of a run, by their path below it.

    Raises
    ------
    RunError
        The list of sums cannot be read.
    """
    try:
        lines = read_regular(Below(directory, CHECKSUM_FILE), LARGEST_SUMS_BYTES).decode().splitlines()
    except (OSError, UnicodeDecodeError) as err:
        raise RunError(directory, f"no readable {CHECKSUM_FILE}", "fit the log again") from err
    return {name: sum_ for sum_, _, name in (line.partition("  ") for line in lines)}


def write_sums(directory: Path, sums: Mapping[str, str]) -> None:
    """Write the list of a run.

    Raises
    ------
    OutputError
        The disk does not take it.
    """
    lines = (f"{sum_}  {name}\n" for name, sum_ in sums.items())
    write_file(Below(directory, CHECKSUM_FILE), "".join(lines))


def relist_files(directory: Path, part: str, names: Iterable[str] = ()) -> None:
    """Replace the files of a part of a run in the run's list; a directory without a list gets none.

    Parameters
    ----------
    part : a directory of the run; all its entries in the list are removed
    names : its files, relative to it, which are added; none: while the part is being replaced
    """
    if not os.path.lexists(directory / CHECKSUM_FILE):
        return
    before = read_sums(directory)
    sums = {name: sum_ for name, sum_ in before.items() if not name.startswith(f"{part}/")}
    sums |= {f"{part}/{name}": file_b2sum(Below(directory, f"{part}/{name}")) for name in names}
    if sums != before:
        write_sums(directory, sums)


CALIBRATION_FILE = "calibration.json"


def open_calibration(file: Path | str) -> Calibration:
    """Read a calibration file.

    Parameters
    ----------
    file : a file that ``icrtool calibrate -o`` or `Calibration.write` wrote

    Raises
    ------
    RunError
        It cannot be read, or is not a calibration.
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
    """Write a calibration file: into `place` where that is a folder, else as `place`.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    OutputError
        Something that is not a calibration is there, or it cannot be written.
    """
    file = calibration_file(place)
    write_file(file, json_bytes(document))
    return path_of(file)


def calibration_file(place: Place) -> Place:
    """Return where the calibration file is written for `place`: in this folder, else `place` itself.

    Raises
    ------
    OutputError
        Its folder does not exist, or something that is not a calibration is there.
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
    """Return the content of a batch's fleet.json.

    Raises
    ------
    OSError, ValueError, RecursionError
        It cannot be read, or is not of this version.
    """
    return read_document(Below(directory, FLEET_FILE), FleetDocument, escape=False)


def logs_of_fleet(directory: Path) -> list[FleetLog]:
    """Return the logs of a batch that could be used.

    Raises
    ------
    RunError
        The folder does not hold the result of a batch.
    """
    try:
        usable = [log for log in read_fleet(directory).logs if log.status != "failed"]
        for log in usable:
            Below(directory, log.run).check_links()
    except (OSError, ValueError, RecursionError) as err:
        raise RunError(directory, f"its {FLEET_FILE} cannot be read ({err})", "name the folder of a batch") from err
    return usable
