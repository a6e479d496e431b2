"""The pictures of a page: PNG files of a run directory, with a caption that states what to see."""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Iterable, Mapping
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from icrtool.errors import RunError
from icrtool.records.regular_file import read_regular

if TYPE_CHECKING:
    from matplotlib.figure import Figure


SIGNATURE = b"\x89PNG\r\n\x1a\n"

LARGEST_PICTURE_BYTES = 1 << 24
"""Ours have less than 1 MB."""

PICTURE = re.compile(r"[a-z_]{1,40}(_\d{1,4}m)?")
"""The name of a picture of ours, without its suffix."""


class Picture(NamedTuple):
    """One picture of a page.

    Attributes
    ----------
    title, caption : one line; what it shows and what to see
    source : data URL
    with_place : its axes may be coordinates of a map grid
    """

    title: str
    caption: str
    source: str
    with_place: bool


def drawn_pictures(figures: Iterable[tuple[str, Figure]]) -> dict[str, Picture]:
    """Return figures as pictures, by name."""
    from icrtool.output.figures.style import picture_bytes

    return pictures_of((name, picture_bytes(figure, "png")) for name, figure in figures)


def pictures_in(directory: Path, inside: Path, sums: Mapping[str, str] | None = None) -> dict[str, Picture]:
    """Return the PNG pictures of a folder that this module knows, by name; none where the folder is not there.

    Parameters
    ----------
    inside : the directory that the user named; below it no link is followed
    sums : BLAKE2b sums (hex) of files by their path below it, where they are known

    Raises
    ------
    RunError
        One is not a picture that icrtool made: a link, another file, too large, or its sum is another.
    """
    from icrtool.output.figure_catalogue import entry_of

    files = (file for file in sorted(directory.glob("*.png")) if PICTURE.fullmatch(file.stem) and entry_of(file.stem))
    return pictures_of((file.stem, _png(file, inside, sums or {})) for file in files)


def _png(file: Path, inside: Path, sums: Mapping[str, str]) -> bytes:
    name = file.relative_to(inside).as_posix()
    try:
        content = read_regular(file, inside, LARGEST_PICTURE_BYTES)
    except OSError as err:
        raise RunError(inside, f"{name} cannot be read ({err.strerror})", "remove it") from err
    if not content.startswith(SIGNATURE):
        raise RunError(inside, f"{name} is not a PNG picture", "remove it")
    if sums.get(name, found := blake2b(content).hexdigest()) != found:
        raise RunError(inside, f"{name} was edited or cut short since the run", "remove it, or fit the log again")
    return content


def pictures_of(found: Iterable[tuple[str, bytes]]) -> dict[str, Picture]:
    """Return pictures given as name and PNG file."""
    from icrtool.output.figure_catalogue import entry_of

    pictures = {}
    for name, content in found:
        if (known := entry_of(name)) is not None:
            entry, metres = known
            source = f"data:image/png;base64,{b64encode(content).decode('ascii')}"
            pictures[name] = Picture(entry.title.format(metres), entry.caption, source, entry.with_place)
    return pictures
