"""Calibration files, written whole or not at all and read back, and the fleet.json of a batch."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from icrtool.errors import OutputError, RunError
from icrtool.output.files.atomic import write_file
from icrtool.output.files.formats import json_bytes, read_document, schema_of
from icrtool.records.calibration_document import CALIBRATION_SCHEMA, CalibrationFile
from icrtool.records.fleet_document import FLEET_FILE, FleetDocument, FleetLog
from icrtool.records.regular_file import check_folders

if TYPE_CHECKING:
    from icrtool.calibration.record import Calibration


FILE_NAME = "calibration.json"


def open_calibration(file: Path | str) -> Calibration:
    """Read a calibration file.

    Parameters
    ----------
    file : what ``icrtool calibrate -o`` or `Calibration.write` wrote

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


def write_calibration(document: CalibrationFile, place: Path, inside: Path | None = None) -> Path:
    """Write a calibration file: into `place` where that is a folder, else as `place`.

    Parameters
    ----------
    inside : as in `icrtool.output.files.atomic.atomic_file`

    Returns
    -------
    Path
        The file.

    Raises
    ------
    OutputError
        Something that is not a calibration is there, or it cannot be written.
    """
    file = calibration_file(place, inside)
    write_file(file, json_bytes(document), place if file != place else inside)
    return file


def calibration_file(place: Path, inside: Path | None = None) -> Path:
    """Return where a calibration asked for at `place` goes.

    Parameters
    ----------
    inside : as in `write_calibration`

    Raises
    ------
    OutputError
        Its folder does not exist, or something that is not a calibration is there.
    """
    file = place / FILE_NAME if place.is_dir() else place
    if not file.parent.is_dir():
        raise OutputError(file, f"there is no folder {file.parent}", "make it, or name another place")
    replaced = file.is_symlink() and (file != place or inside is not None)
    if file.exists() and not replaced and schema_of(file) != CALIBRATION_SCHEMA:
        raise OutputError(file, "a file that is not a calibration is there", "it is left alone; name another place")
    return file


def read_fleet(directory: Path) -> FleetDocument:
    """Return what the fleet.json of a batch holds.

    Raises
    ------
    OSError, ValueError, RecursionError
        It cannot be read, or is not of this version.
    """
    return read_document(directory / FLEET_FILE, FleetDocument, directory, escape=False)


def logs_of_fleet(directory: Path) -> list[FleetLog]:
    """Return the logs of a batch that could be used.

    Raises
    ------
    RunError
        The folder does not hold the result of a batch.
    """
    try:
        found = [one for one in read_fleet(directory).logs if one.status != "failed"]
        for one in found:
            check_folders(directory / one.run, directory)
    except (OSError, ValueError, RecursionError) as err:
        raise RunError(directory, f"its {FLEET_FILE} cannot be read ({err})", "name the folder of a batch") from err
    return found
