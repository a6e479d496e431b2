"""The place of a picture: a figure of its own, or axes of the caller."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import wraps
from typing import TYPE_CHECKING, Any, Concatenate, Literal, Protocol, TypeVar, cast, overload

import numpy as np
from matplotlib.collections import Collection
from matplotlib.colors import to_rgb, to_rgba, to_rgba_array
from matplotlib.lines import Line2D
from matplotlib.transforms import ScaledTranslation
from numpy.typing import NDArray

from icrtool.kernels.arrays import Floats
from icrtool.output.figures import style

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.typing import ColorType

Subject_contra = TypeVar("Subject_contra", contravariant=True)

Share = bool | Literal["all", "row", "col"]
"""The panels that have a common scale, as in ``matplotlib.figure.Figure.subplots``."""

Grid = NDArray[Any]
"""Axes (rows, columns)."""

LABEL_BELOW_IN, LABEL_LEFT_IN = 0.33, 0.56
"""Distance of the names of axes below and left of them [in]. Fixed distances save matplotlib two layouts of all
ticks."""

INSIDE_GAP = 0.12
"""Gap between panels in the place of a caller's axes, as a share of its width and height."""

INSIDE_KEY: style.Look = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.12), "ncols": 3, "fontsize": "small"}
"""Legend below the panels in the place of a caller's axes."""


MID_GREY = 0.5
"""Mean of red, green and blue below which a colour is dark."""


class Drawing(Protocol[Subject_contra]):
    """A function that draws a subject: into a new figure, or into axes of the caller."""

    @overload
    def __call__(self, subject: Subject_contra, /, *more: Any, ax: Axes, **named: Any) -> Axes: ...
    @overload
    def __call__(self, subject: Subject_contra, /, *more: Any, ax: None = None, **named: Any) -> Figure: ...


def styled(draw: Callable[Concatenate[Subject_contra, ...], Figure | Axes]) -> Drawing[Subject_contra]:
    """Return a function that draws a new figure in our style, and axes of the caller in the caller's style.

    The returned function has the keyword ``ax`` of `draw`. The settings of matplotlib are the same before and after a
    call.
    """

    @wraps(draw)
    def drawn(subject: Subject_contra, *more: Any, ax: Axes | None = None, **named: Any) -> Figure | Axes:
        if ax is not None:
            return draw(subject, *more, ax=ax, **named)
        with style.style():
            return draw(subject, *more, **named)

    return cast(Drawing[Subject_contra], drawn)


@dataclass(frozen=True, slots=True)
class Sheet:
    """The place of a picture: a figure of its own, or axes of the caller.

    Attributes
    ----------
    figure : holds the axes
    ax : axes of the caller; None: `figure` has been made for this picture
    panels : the axes that were drawn into
    callers_artists : artists that `ax` held before
    """

    figure: Figure
    ax: Axes | None = None
    panels: list[Axes] = field(default_factory=list)
    callers_artists: tuple[Artist, ...] = ()

    def subplots(
        self, rows: int = 1, columns: int = 1, *, sharex: Share = False, sharey: Share = False,
        width_ratios: Sequence[float] = (), height_ratios: Sequence[float] = (),
    ) -> Grid:  # fmt: skip
        """Return panels (rows, columns) in the figure, or in the place of the caller's axes."""
        widths, heights = (
            np.array(ratios or [1.0] * count, np.float64)
            for ratios, count in ((width_ratios, columns), (height_ratios, rows))
        )
        if self.ax is None:
            panels = self.figure.subplots(
                rows, columns, squeeze=False, sharex=sharex, sharey=sharey,
                gridspec_kw={"width_ratios": widths.tolist(), "height_ratios": heights.tolist()},
            )  # fmt: skip
        elif (rows, columns) == (1, 1):
            panels = np.array([[self.ax]], object)
        else:
            panels = self._inside(heights, widths, sharex=bool(sharex), sharey=bool(sharey))
        self.panels.extend(panels.ravel())
        return panels

    def _inside(self, heights: Floats, widths: Floats, *, sharex: bool, sharey: bool) -> Grid:
        """Return panels within the place of the caller's axes, which then show their title alone."""
        ax = cast("Axes", self.ax)
        ax.set_axis_off()
        (left, width), (top, height) = _places(widths), _places(heights)
        panels = np.empty((len(heights), len(widths)), object)
        for row, column in np.ndindex(*panels.shape):
            shared = {"sharex": panels[0, column]} if sharex and row else {}
            shared |= {"sharey": panels[row, 0]} if sharey and column else {}
            place = left[column], 1.0 - top[row] - height[row], width[column], height[row]
            panel = panels[row, column] = ax.inset_axes(place, **shared)
            if sharex and row + 1 < len(heights):
                panel.tick_params(labelbottom=False)
        return panels

    def legend(self, **layout: Any) -> None:
        """Add a legend with each label once: below all axes, or within the caller's axes."""
        entries: dict[str, Artist] = {}
        for axes in self.panels:
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
                entries.setdefault(str(label), handle)
        if not entries:
            return
        if self.ax is None:
            legend = self.figure.legend(entries.values(), entries.keys(), **{"ncols": len(entries)} | layout)
        elif self.panels == [self.ax]:
            legend = self.ax.legend(list(entries.values()), list(entries), loc="best", fontsize="small")
        else:
            legend = self.ax.legend(list(entries.values()), list(entries), **INSIDE_KEY)
        for text in legend.get_texts():
            text.set_parse_math(False)

    def finish(self) -> Figure | Axes:
        """Return the caller's axes, or the figure with the names of its axes at fixed places."""
        if self.ax is not None:
            self._fit_to_dark(self.ax)
            return self.ax
        below = ScaledTranslation(0.0, -LABEL_BELOW_IN, self.figure.dpi_scale_trans)
        to_the_left = ScaledTranslation(-LABEL_LEFT_IN, 0.0, self.figure.dpi_scale_trans)
        for axes in self.panels:
            axes.xaxis.set_label_coords(0.5, 0.0, axes.transAxes + below)
            axes.yaxis.set_label_coords(0.0, 0.5, axes.transAxes + to_the_left)
        return self.figure

    def _fit_to_dark(self, ax: Axes) -> None:
        """Replace black, greys and white in a picture on dark axes of the caller by the colours of these axes.

        Black becomes the colour of the axes' names, white becomes their background, and greys lie between both.
        """
        fore, back = (np.array(to_rgb(color)) for color in (ax.xaxis.label.get_color(), _background(ax)))
        if not (back.mean() < MID_GREY < fore.mean()):
            return

        def adapted(color: ColorType | Sequence[ColorType]) -> Floats | tuple[float, ...]:
            """Return a colour, or colours, with black, greys and white replaced."""
            rgba = np.atleast_2d(to_rgba_array(color)).copy()
            grey = (np.ptp(rgba[:, :3], axis=1) == 0.0) & (rgba[:, 3] > 0.0)
            share = rgba[grey, :1]
            rgba[grey, :3] = (1.0 - share) * fore + share * back
            return rgba if len(rgba) != 1 else tuple(rgba[0].tolist())

        for panel in self.panels:
            key = panel.get_legend()
            keys = [] if key is None or key in self.callers_artists else key.legend_handles
            for artist in (*panel.lines, *panel.collections, *panel.patches, *keys):
                if artist is None or artist in self.callers_artists:
                    continue
                if isinstance(artist, Collection) and artist.get_array() is not None:
                    # The colours of a scale stay.
                    continue
                line_colors = ("color", "markerfacecolor", "markeredgecolor")
                names = line_colors if isinstance(artist, Line2D) else ("facecolor", "edgecolor")
                properties = {name: getattr(artist, f"get_{name}")() for name in names}
                artist.set(**{name: adapted(color) for name, color in properties.items() if len(to_rgba_array(color))})
            for text in panel.texts:
                # Light words have the caller's colour already.
                if text not in self.callers_artists and np.mean(to_rgb(text.get_color())) < MID_GREY:
                    text.set(color=adapted(text.get_color()))


def _background(ax: Axes) -> ColorType:
    """Return the colour behind axes: the colour of their figure where they are transparent."""
    color = ax.get_facecolor()
    return color if to_rgba(color)[3] > 0.0 else cast("Figure", ax.get_figure(root=True)).get_facecolor()


def _places(sizes: Floats) -> tuple[list[float], list[float]]:
    """Return begins and lengths, as shares of a whole, of panels (n,) of relative sizes with gaps between them."""
    lengths = sizes / sizes.sum() * (1.0 - INSIDE_GAP * (len(sizes) - 1))
    begins = np.concatenate([[0.0], np.cumsum(lengths + INSIDE_GAP)[:-1]])
    return begins.tolist(), lengths.tolist()


def new_sheet(
    title: str, subtitle: str, ax: Axes | None = None, *, height_in: float, width_in: float = style.WIDTH_IN,
    margins_in: tuple[float, float, float, float] = style.MARGINS_IN, wspace: float = 0.2, hspace: float = 0.2,
) -> Sheet:  # fmt: skip
    """Return the place of a picture: `ax`, with its title, or a new figure.

    Parameters
    ----------
    title, subtitle : as in `icrtool.output.figures.style.new_figure`; `ax` gets the title alone
    ax : axes of the caller; None: a new figure, for which the following parameters hold
    height_in, width_in, margins_in, wspace, hspace : as in `new_figure`
    """
    if ax is None:
        layout = {"height_in": height_in, "width_in": width_in, "wspace": wspace, "hspace": hspace}
        return Sheet(style.new_figure(title, subtitle, margins_in=margins_in, **layout))
    ax.set_title(style.drawable_text(title), loc="left", parse_math=False, wrap=True)
    return Sheet(cast("Figure", ax.get_figure(root=True)), ax, callers_artists=tuple(ax.get_children()))
