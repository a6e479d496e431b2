"""The pictures of a page: PNG files of a run directory, with a caption that states what to see."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable, Iterable, Mapping
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from icrtool.output.figures.quiet_matplotlib import quiet_matplotlib

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Picture(NamedTuple):
    """One picture of a page.

    Attributes
    ----------
    name : of its file, without suffix
    title, caption : one line; what it shows and what to see
    source : data URL
    """

    name: str
    title: str
    caption: str
    source: str


CAPTIONS = {
    "trajectory": (
        "The drive from above",
        "Filter and position reference should coincide. Odometry leaves them by what wheel speeds alone lose.",
    ),
    "icr_estimates": ("ICR estimates over time", "Good: the lines settle soon and stay within their bands."),
    "icr_clusters": (
        "Where the ICRs lay",
        "Good: three narrow peaks. A wide one is ground that changed, or an ICR that the drive hardly shows.",
    ),
    "gnss_difference": (
        "Filter and position reference",
        "Good: noise about a constant mean. Steps and long deviations are trouble of the receiver or of the clocks.",
    ),
    "summary": (
        "Error over distance",
        "The lower a curve, the better the model. Where it crosses the budget line, the budget is used up.",
    ),
    "histogram": (
        "Errors after {} m",
        "A panel a model. Good: most trials at the left, and a short tail. 5 % of the trials lie beyond the 95 % line.",
    ),
    "examples": (
        "Two trials of {} m",
        "One of half a turn, and the straightest. The closer a coloured end is to the black one, the better its model.",
    ),
    "worst": ("The worst trials", "What they share (a turn, a slope, a place) is where the model fails."),
    "outages": ("Outages", "The path without GNSS, forced or real, and where the estimate was when fixes returned."),
    "icrs": (
        "Final ICRs of every log",
        "One robot on one ground should lie on one level; a step is other ground or wear.",
    ),
    "errors": ("Errors by robot and group", "Each point is a log: how much the logs of a group differ."),
    "failures": ("Why logs failed", "The commonest reason first."),
    "transfer": (
        "The cost of a foreign calibration",
        "Left: the darker, the larger the error. Right: an interval (95 %) that crosses zero may be chance.",
    ),
    "ladder": (
        "Model comparison",
        "Each model on distance it was not fitted to. Take the simplest of those that are about as good as the best.",
    ),
}
"""By the first word of the file's name: title, with the distance behind that word, and caption."""

WITH_PLACE = ("trajectory", "examples", "worst", "outages")
"""Pictures whose axes may be coordinates of a map grid."""


def drawn_pictures(figures: Mapping[str, Callable[[], Figure]]) -> dict[str, Picture]:
    """Draw figures, into memory."""
    from icrtool.output.figures.style import style

    found = []
    with quiet_matplotlib():
        for name, draw in figures.items():
            with style():
                image = BytesIO()
                draw().savefig(image, format="png")
                found.append((name, image.getvalue()))
    return pictures_of(found)


def pictures_in(directory: Path) -> dict[str, Picture]:
    """Return the PNG pictures of a folder that this module knows, by name; none where the folder is not there."""
    return pictures_of((file.stem, file.read_bytes()) for file in sorted(directory.glob("*.png")))


def pictures_of(found: Iterable[tuple[str, bytes]]) -> dict[str, Picture]:
    """Return pictures given as name and PNG file."""
    pictures = {}
    for name, content in found:
        word, _, rest = name.partition("_")
        if (known := CAPTIONS.get(name) or CAPTIONS.get(word)) is not None:
            title = known[0].format(rest.removesuffix("m").lstrip("0"))
            source = f"data:image/png;base64,{b64encode(content).decode('ascii')}"
            pictures[name] = Picture(name, title, known[1], source)
    return pictures
