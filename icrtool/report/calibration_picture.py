"""The picture of a calibration as a file that appears whole or not at all."""

from __future__ import annotations

from pathlib import Path

from icrtool.analysis.calibrate_verdict import Calibration
from icrtool.errors import OutputError
from icrtool.report.drawing_process import matplotlib_unsaid
from icrtool.report.run_directory import PLOT_FORMATS
from icrtool.report.whole_file import check_place, whole_file


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


def write_picture(calibration: Calibration, file: Path) -> None:
    """Draw a calibration; the suffix says in which format.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    form = file.suffix.removeprefix(".").lower()
    with whole_file(file) as partial, matplotlib_unsaid():
        from icrtool.report.figure_calibration import draw_calibration
        from icrtool.report.figure_style import save, style

        with style():
            save(draw_calibration(calibration), partial.with_suffix(""), (form,))
