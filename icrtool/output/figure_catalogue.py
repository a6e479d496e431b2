"""All figures of directories and pages: name, title, caption, the function that draws each, and when it is drawn.

matplotlib is imported when the first figure is drawn, because a page of finished pictures needs only captions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from icrtool.output.text_blocks import Chart
from icrtool.records.choices import FigureSet
from icrtool.records.stages import Watch, unwatched

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from icrtool.dropout_analysis.report import DropoutReport

Subject = Literal["run", "report", "fleet", "comparison"]
"""Kind of the subject of a figure."""

Parts = Mapping[str, tuple[float, ...]]
"""Further arguments of a figure's function, by suffix of the file name."""

HISTOGRAM_HORIZONS_M = (5.0, 10.0, 20.0)
"""Distances of the histograms [m], as in Figs. 28 to 30 of Pentzer 2014."""


ONCE: Parts = {"": ()}
"""Parts of a figure that is drawn once."""


def _histograms(report: DropoutReport, *, together: bool) -> Parts:
    """Return the parts of histograms: one figure of all horizons with trials, or one figure for each horizon."""
    trials = {row.horizon_m: row.trials for row in report.document.trials}
    horizons_m = tuple(horizon_m for horizon_m in HISTOGRAM_HORIZONS_M if trials.get(horizon_m))
    if together:
        return {"": horizons_m} if horizons_m else {}
    return {f"{horizon_m:02.0f}m": (horizon_m,) for horizon_m in horizons_m}


class Entry(NamedTuple):
    """A figure of the catalogue.

    Attributes
    ----------
    subject : kind of the subject of the figure
    title, caption : one line each: content of the figure, and what to look for; ``{}`` is the distance in the name
    place : module and name of the function that draws the figure, in ``icrtool.output.figures``
    parts : suffixes of the names of files, each with further arguments of the function; empty: no figure
    with_place : the axes may be coordinates of a map grid
    further : a figure of the paper, drawn only if all figures are requested
    """

    subject: Subject
    title: str
    caption: str
    place: str
    parts: Callable[[Any], Parts] = lambda _: ONCE
    with_place: bool = False
    further: bool = False

    @property
    def draw(self) -> Callable[..., Figure]:
        """The function that draws the figure."""
        module, _, name = self.place.partition(".")
        function: Callable[..., Figure] = getattr(import_module(f"icrtool.output.figures.{module}"), name)
        return function


FIGURES = {
    "trajectory": Entry(
        "run", "The drive from above",
        "Filter and position reference should coincide; the odometry shows what error wheel speeds alone make.",
        "trajectory.trajectory", with_place=True,
    ),
    "icr_estimates": Entry(
        "run", "ICR estimates over time",
        "Good: the lines settle soon and the bands become narrow. A later step: the ground changed, or a sensor fails.",
        "filter_estimates.icr_estimates",
    ),
    "icr_clusters": Entry(
        "run", "Where the ICRs lay",
        "Good: three narrow peaks. A wide peak: the ground changed, or the drive hardly shows this ICR.",
        "filter_estimates.icr_clusters", further=True,
    ),
    "gnss_difference": Entry(
        "run", "Filter and position reference",
        "Good: noise about a constant mean. Steps and long deviations come from the receiver or from the clocks.",
        "filter_estimates.gnss_difference",
    ),
    "examples_": Entry(
        "report", "Two trials of {} m",
        "One of half a turn, and the straightest. The closer a coloured end is to the black one, the better its model.",
        "dropout_paths.dropout_examples",
        lambda report: {f"{example.horizon_m:02.0f}m": () for example in report.document.examples[:1]},
        with_place=True, further=True,
    ),
    "worst": Entry(
        "report", "The worst trials", "What they share (a turn, a slope, a place) shows where the model fails.",
        "dropout_paths.dropout_worst", lambda report: ONCE if report.worst else {}, with_place=True,
    ),
    "error_map": Entry(
        "report", "Where the errors arise",
        "Dark parts of the path: from there on the error is large. What do they share?",
        "dropout_paths.dropout_map", lambda report: ONCE if report.path_errors is not None else {}, with_place=True,
    ),
    "outages": Entry(
        "report", "Outages",
        "The path without GNSS, forced or real, and where the estimate was when fixes returned.",
        "dropout_paths.dropout_outages", lambda report: ONCE if report.outages else {}, with_place=True,
    ),
    "histogram": Entry(
        "report", "How the errors scatter",
        "Good: most trials at the left, and a short tail. 5 % of the trials lie beyond the 95 % line.",
        "dropout_errors.dropout_histograms", partial(_histograms, together=True),
    ),
    "histogram_": Entry(
        "report", "Errors after {} m, by model",
        "Good: most trials at the left, and a short tail. 5 % of the trials lie beyond the 95 % line.",
        "dropout_errors.dropout_histogram", partial(_histograms, together=False), further=True,
    ),
    "summary": Entry(
        "report", "Error over distance",
        "The lower a curve, the better the model. Where it crosses the budget line, the budget is used up.",
        "dropout_errors.dropout_summary",
        lambda report: ONCE if any(row.trials for row in report.document.trials) else {},
    ),
    "icrs": Entry(
        "fleet", "Final ICRs of every log",
        "The ICRs of a robot on one ground should lie on one level; a step comes from other ground or from wear.",
        "calibrations.fleet_icrs", lambda fleet: ONCE if fleet.points else {},
    ),
    "errors": Entry(
        "fleet", "Error of every log", "Which logs are worse than the others of their group?",
        "calibrations.fleet_errors", lambda fleet: ONCE if fleet.errors_m else {},
    ),
    "transfer": Entry(
        "comparison", "Differences between the groups",
        "Above: the errors of each group, by calibration. Below: an interval (95 %) that holds zero may be chance.",
        "calibrations.transfer",
    ),
}  # fmt: skip
"""All figures by the names of their files. A distance is added to a name that ends with ``_``."""


def drive_charts(position_word: str) -> tuple[Chart, ...]:
    """Return the drawings of a drive on a run's page, its map first; their captions extend the pictures' captions."""
    icrs, differences = FIGURES["icr_estimates"], FIGURES["gnss_difference"]
    return (
        Chart(
            "map",
            "Map",
            "Point at the drive to mark the same moment in the charts. Click on it to see the path that each model "
            "drives from there, by wheel speeds alone for 20 m; the black line is the filter, which had the "
            f"{position_word}. The closer a coloured end lies to the black one, the better the model.",
        ),
        Chart("speeds", "Wheel speeds", "The robot turns where left and right differ: slip shows there."),
        Chart(
            "icrs",
            icrs.title,
            f"{icrs.caption} Bands: ±σ. The dotted lines show half the track width: the ICRs without slip.",
        ),
        Chart(
            "differences",
            f"Distance from filter to {position_word}",
            f"{differences.caption} Crosses are rejected fixes; those at the upper edge lie beyond it.",
        ),
        Chart(
            "headings",
            "Heading: measured minus filter",
            "Good: noise about zero. A long deviation comes from a disturbed compass, or from a clock that lags.",
        ),
    )


def figures_of(
    subject_type: Subject, subject: object, figures: FigureSet = "default", watch: Watch = unwatched
) -> Iterator[tuple[str, Figure]]:
    """Draw each figure for which a subject has numbers; yield it with the name of its file.

    `watch` is called with the name of each picture before it is drawn.
    """
    for name, entry in FIGURES.items():
        if entry.subject == subject_type and (figures == "all" or not entry.further):
            for part, arguments in entry.parts(subject).items():
                watch(f"picture {name}{part}")
                yield f"{name}{part}", entry.draw(subject, *arguments)


def draw_figures(
    subject_type: Subject, subject: object, directory: Path, formats: tuple[str, ...], figures: FigureSet = "default",
    watch: Watch = unwatched,
) -> None:  # fmt: skip
    """Write the figures of a run or a report into a directory.

    Parameters
    ----------
    directory : directory of the figures, made if it does not exist
    formats : of ``png``, ``svg`` and ``pdf``
    watch : called with the name of each picture before it is drawn

    Raises
    ------
    OSError
        A file cannot be written.
    """
    directory.mkdir(exist_ok=True)
    from icrtool.output.figures.style import save_figure

    for name, figure in figures_of(subject_type, subject, figures, watch):
        save_figure(figure, directory / name, formats)


def entry_of(file: str) -> tuple[Entry, str] | None:
    """Return the entry of a picture by the name of its file, and the distance in that name; None for any other file."""
    word, _, rest = file.rpartition("_")
    entry = FIGURES.get(file) or FIGURES.get(f"{word}_")
    return None if entry is None else (entry, rest.removesuffix("m").lstrip("0"))
