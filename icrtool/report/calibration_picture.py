"""The picture of a calibration as a file that appears whole or not at all."""

from __future__ import annotations

import secrets
from pathlib import Path

from icrtool.analysis.calibrate_verdict import Calibration
from icrtool.errors import OutputError
from icrtool.report.run_directory import PLOT_FORMATS


def check_picture(file: Path) -> None:
    """Refuse a place or a format that cannot be written, before any work is done for it.

    Raises
    ------
    OutputError
        Another suffix than png, svg, pdf, or no such folder.
    """
    if file.suffix.removeprefix(".").lower() not in PLOT_FORMATS:
        raise OutputError(file, "its suffix is no format of a picture", f"end it in .{', .'.join(PLOT_FORMATS)}")
    if not file.absolute().parent.is_dir():
        raise OutputError(file, f"there is no folder {file.parent}", "make it, or name another place")
    if file.is_dir():
        raise OutputError(file, "is a folder", "name a file")


def write_picture(calibration: Calibration, file: Path) -> None:
    """Draw a calibration; the suffix says in which format.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    from icrtool.report.figure_calibration import draw_calibration
    from icrtool.report.figure_style import save, style

    partial = file.with_name(f".{file.stem}.{secrets.token_hex(4)}.partial")
    form = file.suffix.removeprefix(".").lower()
    drawn = partial.with_name(f"{partial.name}.{form}")
    try:
        with style():
            save(draw_calibration(calibration), partial, (form,))
        drawn.replace(file)
    except OSError as err:
        raise OutputError(file, "cannot be written", err.strerror or str(err)) from err
    finally:
        drawn.unlink(missing_ok=True)
