"""The figures of a run, and where each goes. They draw numbers; they make none."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from icrtool.estimation.odometry import odometry
from icrtool.output.figures.gnss_difference import draw_gnss_difference
from icrtool.output.figures.icrs import draw_icr_clusters, draw_icr_estimates
from icrtool.output.figures.style import save, style
from icrtool.output.figures.trajectory import draw_trajectory
from icrtool.records.run import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FIGURES: dict[str, Callable[[Run], Figure]] = {
    "trajectory": lambda run: draw_trajectory(run, odometry(run)),
    "icr_estimates": draw_icr_estimates,
    "icr_clusters": draw_icr_clusters,
    "gnss_difference": draw_gnss_difference,
}


def draw_figures(run: Run, directory: Path, formats: tuple[str, ...]) -> None:
    """Write every figure of a run into a directory.

    Parameters
    ----------
    run : just made or read back
    directory : an existing directory
    formats : of ``png``, ``svg`` and ``pdf``

    Raises
    ------
    OSError
        A file cannot be written.
    """
    for name, draw in FIGURES.items():
        with style():
            save(draw(run), directory / name, formats)
