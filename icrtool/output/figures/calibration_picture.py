"""The picture of a calibration as an atomic file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from icrtool.alignment.estimator import WindowResiduals
from icrtool.errors import OutputError
from icrtool.output.atomic_file import atomic_file, check_place
from icrtool.output.figures.quiet_matplotlib import quiet_matplotlib
from icrtool.output.run_directory import PLOT_FORMATS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from icrtool.calibration.forecast import Forecast


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

    def draw() -> Figure:
        from icrtool.output.figures.calibration import draw_calibration

        return draw_calibration(name, residuals)

    save_picture(draw, file)


def write_forecast_picture(
    forecast: Forecast, title: str, budgets_m: tuple[float, ...], measured_m: float, file: Path,
    gyro: Forecast | None = None,
) -> None:  # fmt: skip
    """Draw a forecast, as `write_picture`."""

    def draw() -> Figure:
        from icrtool.output.figures.forecast import draw_forecast

        return draw_forecast(forecast, title, budgets_m, measured_m, gyro)

    save_picture(draw, file)


def write_transfer_picture(document: Mapping[str, Any], file: Path) -> None:
    """Draw compared groups, as `write_picture`."""

    def draw() -> Figure:
        from icrtool.output.figures.transfer import draw_transfer

        return draw_transfer(document)

    save_picture(draw, file)


def save_picture(draw: Callable[[], Figure], file: Path) -> None:
    """Write the figure that `draw` makes, in our style; the suffix gives the format.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    form = file.suffix.removeprefix(".").lower()
    with atomic_file(file) as partial, quiet_matplotlib():
        from icrtool.output.figures.style import save, style

        with style():
            save(draw(), partial.with_suffix(""), (form,))
