"""The pictures of a page: PNG files of a run directory, with a caption that states what to see."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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


def pictures_in(directory: Path) -> dict[str, Picture]:
    """Return the PNG pictures of a folder that this module knows, by name; none where the folder is not there."""
    return pictures_of((file.stem, file.read_bytes()) for file in sorted(directory.glob("*.png")))


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
