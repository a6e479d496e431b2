"""``B2SUMS`` of a run: the sums of its files as ``b2sum --check`` reads them, so that an edited one is recognised.

It lists every file of the run and of its dropout report, but not the page. The list is true at every moment: while a
report is replaced it does not name its files.
"""

from __future__ import annotations

import errno
import hashlib
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from icrtool.errors import RunError
from icrtool.output.files.atomic import write_file
from icrtool.records.regular_file import open_regular, read_regular

CHECKSUM_FILE = "B2SUMS"

LARGEST_RUN_FILE_BYTES = 1 << 33
"""Of a file of a run: 70 h at 100 Hz. A file may be far larger than what is on the disk, and take hours to read."""


def file_b2sum(path: Path, inside: Path | None = None) -> str:
    """Return the BLAKE2b sum (hex) of a file: as safe as SHA-256, at twice its speed on most machines.

    Parameters
    ----------
    inside : as in `open_regular`

    Raises
    ------
    OSError
        The file cannot be read, or is larger than `LARGEST_RUN_FILE_BYTES`.
    """
    with open_regular(path, inside) as file:
        if os.fstat(file.fileno()).st_size > LARGEST_RUN_FILE_BYTES:
            raise OSError(errno.EFBIG, f"larger than {LARGEST_RUN_FILE_BYTES} bytes", str(path))
        return hashlib.file_digest(file, hashlib.blake2b).hexdigest()


def read_sums(directory: Path) -> dict[str, str]:
    """Return the BLAKE2b sums (hex) of the files of a run, by their path below it.

    Raises
    ------
    RunError
        Its list of them cannot be read.
    """
    try:
        lines = read_regular(directory / CHECKSUM_FILE, directory).decode().splitlines()
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
    write_file(directory / CHECKSUM_FILE, "".join(f"{sum_}  {name}\n" for name, sum_ in sums.items()), directory)


def list_anew(directory: Path, part: str, names: Iterable[str] = ()) -> None:
    """Have the list of a run name other files of a part of it; a directory without a list stays so.

    Parameters
    ----------
    part : a directory of the run; of what is listed below it nothing stays
    names : of its files, relative to it; none: while it is being replaced
    """
    if not os.path.lexists(directory / CHECKSUM_FILE):
        return
    before = read_sums(directory)
    sums = {name: sum_ for name, sum_ in before.items() if not name.startswith(f"{part}/")}
    sums |= {f"{part}/{name}": file_b2sum(directory / part / name, directory) for name in names}
    if sums != before:
        write_sums(directory, sums)
