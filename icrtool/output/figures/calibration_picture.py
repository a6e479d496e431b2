"""The picture of a calibration as an atomic file."""

from __future__ import annotations

from pathlib import Path

from icrtool.alignment.estimator import WindowResiduals
from icrtool.errors import OutputError
from icrtool.output.atomic_file import atomic_file, check_place
from icrtool.output.figures.drawing_process import matplotlib_unsaid
from icrtool.output.run_directory import PLOT_FORMATS


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


def write_picture(name: str, residuals: WindowResiduals, file: Path) -> None:
    """Draw the residuals of a calibration; the suffix gives the format.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    form = file.suffix.removeprefix(".").lower()
    with atomic_file(file) as partial, matplotlib_unsaid():
        from icrtool.output.figures.calibration import draw_calibration
        from icrtool.output.figures.style import save, style

        with style():
            save(draw_calibration(name, residuals), partial.with_suffix(""), (form,))
