"""A picture as an atomic file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from icrtool.errors import OutputError
from icrtool.output.files.atomic import write_file
from icrtool.output.files.own_files import check_place
from icrtool.output.run_directory import PLOT_FORMATS

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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


def save_picture(figure: Figure, file: Path, inside: Path | None = None) -> None:
    """Write a figure; the suffix gives the format.

    Parameters
    ----------
    inside : as in `icrtool.output.files.atomic.atomic_file`

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    form = file.suffix.removeprefix(".").lower()
    from icrtool.output.figures.style import picture_bytes

    write_file(file, picture_bytes(figure, form), inside)
