"""The look of all figures, and their files: no display, no user settings, the same bytes every time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import matplotlib as mpl
import numpy as np
from matplotlib import font_manager
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from PIL import Image

from icrtool.kernels.arrays import Floats
from icrtool.output.series import BLUE, GREEN, ORANGE, PURPLE, RED
from icrtool.records.rows import Color, Dash, rows_of
from icrtool.records.text import LONGEST_MESSAGE, escaped, shortened

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis

PNG_DPI = 130
"""Resolution of PNG files [dots per inch]."""

WIDTH_IN = 7.2
"""Width of most figures [in]: the text width of a page."""

KEY_ROW_IN = 0.2
"""Height of a row of a legend [in]. Figures have space for two rows."""

TITLE_CHARACTERS_PER_INCH, SUBTITLE_CHARACTERS_PER_INCH = 9.75, 13.5
"""Characters of a title and of a subtitle in an inch of width."""

TITLE_PT, SUBTITLE_PT = 10.8, 9.0
"""Sizes of title and subtitle [points]."""

MARGINS_IN = (0.75, 0.2, 0.65, 1.05)
"""Left, right, top and bottom of the axes of most figures [in]."""

WEIGHTS = ("regular", "bold")
"""Weights of the titles' font."""

BACKGROUND = "white"
"""Background of every picture, also on a dark page: the PNG files are opaque."""

MISSING = "\u25a1"
"""Character that is drawn for a character that the font lacks."""

Look = dict[str, Any]
"""Keywords of a matplotlib artist: colour, line, marker."""

RC: dict[str, Any] = {
    "font.family": ["DejaVu Sans"],
    "font.size": 9.5,
    "axes.titlesize": 9.5,
    "axes.titley": 1.0,
    "axes.labelsize": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "grid.color": "0.88",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.3,
    "legend.fontsize": 9.0,
    "legend.frameon": False,
    "legend.handlelength": 2.4,
    "legend.columnspacing": 1.8,
    "legend.loc": "lower center",
    "xtick.labelsize": 9.0,
    "ytick.labelsize": 9.0,
    "agg.path.chunksize": 20000,
    "svg.hashsalt": "icrtool",
    "pdf.fonttype": 42,
}
"""Settings of matplotlib for all figures."""

SAVE: dict[str, dict[str, Any]] = {
    "svg": {"metadata": {"Date": None, "Creator": "icrtool"}},
    "pdf": {"metadata": {"CreationDate": None, "Creator": "icrtool", "Producer": "icrtool"}},
}
"""Metadata by format, without values that change from run to run."""

PNG_COLORS = 256
"""Number of colours of a PNG file. It needs half of the time and a third of the bytes of full colour and looks the
same."""
NEARLY_WHITE = 252
"""Value of a part of a colour, of 255, from which on it becomes white in a PNG file."""


def line_look(color: str, dash: str | tuple[float, tuple[float, ...]] = "-", width: float = 1.3) -> Look:
    """Return the look of a line: dash and luminance distinguish it on a grey print."""
    return {"color": color, "linestyle": dash, "linewidth": width}


FIX_COLOR = "0.70"
FLOAT_COLOR = PURPLE
BAD_FIX_COLOR = RED
"""Colours of fixed, float and rejected fixes."""

OUTAGE_COLOR = "0.90"
"""Colour of times without fixes."""

BAR_COLOR = "#5b8db8"
BAND_COLOR = "#a6c4e0"
"""Colours of the bars of a histogram and of bands of one standard deviation."""

FILTER = line_look("black", width=1.1)
ICR = line_look(BLUE, (0, (6, 2)), 1.5)
NO_SLIP_LINE = line_look(ORANGE, (0, (6, 1.5, 1.2, 1.5)), 1.5)
"""Lines of the filter, of ICRs and of a robot without slip."""

HALF_WIDTH = line_look("0.35", (0, (1.5, 2.0)), 1.1)
"""Line at half the track width: an ICR without slip."""

CHANGE_LINE = line_look(RED, (0, (3, 1.5)), 1.1)
"""Line at a change of the ground."""

MEAN = line_look("black", (0, (5, 2)), 1.1)
"""Line of a mean."""

BUDGET = line_look(RED, (0, (1.5, 2.0)), 1.2)
"""Line of an error budget."""

COLORS: dict[Color, str] = {
    "green": GREEN, "purple": PURPLE, "blue": BLUE, "orange": ORANGE, "grey": "#666666", "brown": "#8c510a",
    "pink": "#c51b7d", "teal": "#01665e", "olive": "#7a7a00", "slate": "#5c6f8a",
}  # fmt: skip
"""Colours of rows on paper, by name. On pages the colours of page.css are used."""

DASHES: dict[Dash, str | tuple[float, tuple[float, ...]]] = {
    "solid": "-", "dashed": (0, (6, 2)), "dotted": (0, (1.5, 1.5)), "dashdot": (0, (6, 1.5, 1.2, 1.5)),
}  # fmt: skip
"""Dashes of matplotlib by the names in `icrtool.records.rows`."""

ROW_WIDTH = 1.45
"""Width of the line of most rows [points]."""

ICR_LOOKS: dict[str, Look] = {
    "y_icr_right": {"label": "y right", "color": BLUE, "linestyle": "-", "marker": "o", "markersize": 3.5},
    "y_icr_left": {"label": "y left", "color": RED, "linestyle": (0, (6, 2)), "marker": "s", "markersize": 3.5},
    "x_icr": {"label": "x", "color": "0.25", "linestyle": (0, (1.5, 1.5)), "marker": "^", "markersize": 3.5},
}
"""Looks of the three ICRs in a common panel, by `icrtool.simulation.study_runs.ICR_NAMES`."""


@contextmanager
def style() -> Iterator[None]:
    """Set matplotlib to its defaults and `RC` in a block; a matplotlibrc has no effect there."""
    settings = cast(dict[str, Any], mpl.rcParams)
    defaults = cast(dict[str, Any], mpl.rcParamsDefault)
    with mpl.rc_context():
        settings.update({key: value for key, value in defaults.items() if key != "backend"})
        settings.update(RC)
        yield


def new_figure(
    title: str, subtitle: str, *, height_in: float, width_in: float = WIDTH_IN,
    margins_in: tuple[float, float, float, float] = MARGINS_IN, wspace: float = 0.2, hspace: float = 0.2,
) -> Figure:  # fmt: skip
    """Return an empty figure with two lines of title at its upper left.

    Parameters
    ----------
    title : the answer of the figure, with its number
    subtitle : the subject, and what is drawn
    margins_in : left, right, top and bottom of its axes [in]
    wspace, hspace : between axes, as a share of their width and height
    """
    figure = Figure(figsize=(width_in, height_in), dpi=PNG_DPI, facecolor=BACKGROUND)
    FigureCanvasAgg(figure)
    left, right, top, bottom = margins_in
    figure.subplots_adjust(
        left / width_in, bottom / height_in, 1 - right / width_in, 1 - top / height_in, wspace, hspace
    )
    edge = 0.09 / width_in
    most = int(TITLE_CHARACTERS_PER_INCH * width_in)
    at: Look = {"va": "top", "ha": "left", "parse_math": False}
    figure.text(edge, 1 - 0.09 / height_in, drawable_text(title, most), fontsize=TITLE_PT, fontweight="bold", **at)
    most = int(SUBTITLE_CHARACTERS_PER_INCH * width_in)
    figure.text(edge, 1 - 0.32 / height_in, drawable_text(subtitle, most), fontsize=SUBTITLE_PT, color="0.3", **at)
    return figure


def spot_look(fill: str, size: float = 5.5, marker: str = "o", color: str = "black") -> Look:
    """Return the look of a place: white where something begins, black where it ends."""
    return {"linestyle": "none", "marker": marker, "color": color, "markerfacecolor": fill, "markersize": size}


def write_near(
    axes: Axes, text: str, point: tuple[float, float], offset_pt: tuple[float, float] = (0.0, 0.0), **look: Any
) -> None:
    """Write a text at an offset [points] from a place, without a box: a box would hide the lines below it."""
    axes.annotate(text, point, xytext=offset_pt, textcoords="offset points", **look)


def drawable_text(text: str, longest: int = LONGEST_MESSAGE) -> str:
    """Return a text from a log, a path or a configuration with a box for every character that the font lacks.

    It is shortened to `longest` characters. Control characters and undecodable bytes become their Python escapes. Draw
    it with ``parse_math=False``: a ``$`` in a name begins no formula.
    """
    regular, bold = (font_manager.get_font(font_manager.findfont(f"DejaVu Sans:{weight}")) for weight in WEIGHTS)
    has = [c if regular.get_char_index(ord(c)) and bold.get_char_index(ord(c)) else MISSING for c in escaped(text)]
    return shortened("".join(has), longest)


def picture_bytes(figure: Figure, form: str) -> bytes:
    """Return a figure as a file of a format; the bytes depend on the figure alone."""
    memory = BytesIO()
    with style():
        if form == "png":
            canvas = cast(FigureCanvasAgg, figure.canvas)
            canvas.draw()  # type: ignore[no-untyped-call]
            pixels = canvas.buffer_rgba()  # type: ignore[no-untyped-call]
            picture = Image.frombuffer("RGBA", canvas.get_width_height(), pixels, "raw", "RGBA", 0, 1)
            few = picture.convert("RGB").quantize(PNG_COLORS, Image.Quantize.FASTOCTREE)
            # The palette's white is the mean of all nearly white colours.
            few.putpalette([255 if part >= NEARLY_WHITE else part for part in few.getpalette() or []])
            few.save(memory, "png", compress_level=1, dpi=(figure.dpi, figure.dpi))
        else:
            figure.savefig(memory, format=form, **SAVE[form])
    return memory.getvalue()


def save_figure(figure: Figure, stem: Path, formats: tuple[str, ...]) -> None:
    """Write a figure as ``stem.format`` in each of `formats`."""
    for form in formats:
        stem.with_name(f"{stem.name}.{form}").write_bytes(picture_bytes(figure, form))


def fill_bins(axes: Axes, edges: Floats, heights: Floats, **look: Any) -> None:
    """Fill the bins of a histogram from zero up; `Axes.stairs` measures every step of its outline and takes longer."""
    filled = axes.fill_between(edges, np.append(heights, heights[-1:]), step="post", linewidth=0, **look)
    filled.sticky_edges.y.append(0.0)


def row_pens(names: Iterable[str]) -> dict[str, Look]:
    """Return the looks of the rows of a report by name, in their order."""
    rows = rows_of(names).items()
    return {name: line_look(COLORS[row.color], DASHES[row.dash], ROW_WIDTH * row.width) for name, row in rows}


def logarithmic_errors(axes: Axes, direction: Literal["x", "y"] = "x") -> None:
    """Set one axis to a logarithmic scale of errors [m], with plain numbers; `direction` is the axis."""
    axes.set(**{f"{direction}scale": "log", f"{direction}label": "Error [m], logarithmic"})
    axis: Axis = getattr(axes, f"{direction}axis")
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=20))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())
