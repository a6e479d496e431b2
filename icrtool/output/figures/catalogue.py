"""Every figure as one function that takes a run or a report and returns a matplotlib Figure: ``icrtool.figures``."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from icrtool.dropout_analysis.report import DropoutReport
from icrtool.errors import DataError
from icrtool.estimation.odometry import odometry
from icrtool.output.figures.dropout_errors import draw_histogram, draw_summary
from icrtool.output.figures.dropout_paths import draw_examples, draw_outages, draw_worst
from icrtool.output.figures.gnss_difference import draw_gnss_difference
from icrtool.output.figures.icrs import draw_icr_clusters, draw_icr_estimates
from icrtool.output.figures.model_comparison import draw_comparison
from icrtool.output.figures.style import style
from icrtool.output.figures.trajectory import draw_trajectory
from icrtool.output.text_format import run_title
from icrtool.records.run import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def trajectory(run: Run) -> Figure:
    """Return fixes, filter and wheels-only odometry over east and north."""
    return _drawn(lambda: draw_trajectory(run, odometry(run)))


def icr_estimates(run: Run) -> Figure:
    """Return the three ICR estimates over time with ±2σ."""
    return _drawn(lambda: draw_icr_estimates(run))


def icr_clusters(run: Run) -> Figure:
    """Return how much of the time each ICR estimate had which value, after convergence."""
    return _drawn(lambda: draw_icr_clusters(run))


def gnss_difference(run: Run) -> Figure:
    """Return the distance between filter and fixes over percent of the mission."""
    return _drawn(lambda: draw_gnss_difference(run))


def dropout_summary(report: DropoutReport) -> Figure:
    """Return 95 % and expected error over distance without GNSS, by model."""
    return _drawn(lambda: draw_summary(run_title(report.run_summary), report))


def dropout_histogram(report: DropoutReport, horizon_m: float) -> Figure:
    """Return the share of trials by error at one of the report's horizons [m]."""
    if horizon_m not in report.horizons_m:
        raise ValueError(f"horizon_m: {horizon_m:g} m is not among the report's horizons")
    return _drawn(lambda: draw_histogram(run_title(report.run_summary), report, horizon_m))


def dropout_examples(report: DropoutReport) -> Figure:
    """Return a cornering and a straight trial; `report` is of `icrtool.dropout_report`."""
    _check(report, report.examples, "example trials")
    return _drawn(lambda: draw_examples(run_title(report.run_summary), report.examples))


def dropout_worst(report: DropoutReport) -> Figure:
    """Return the worst trials; `report` is of `icrtool.dropout_report`."""
    _check(report, report.worst, "worst trials")
    path = report.reference_north_m, report.reference_east_m
    return _drawn(lambda: draw_worst(run_title(report.run_summary), report.worst, *path))


def dropout_outages(report: DropoutReport) -> Figure:
    """Return the path with forced and real outages; `report` is of `icrtool.dropout_report`."""
    _check(report, report.outages, "outages")
    path = report.reference_north_m, report.reference_east_m
    return _drawn(lambda: draw_outages(run_title(report.run_summary), *path, report.outages))


def model_comparison(report: DropoutReport) -> Figure:
    """Return the errors of all models on distance they were not fitted to; `report` is of `icrtool.dropout_report`."""
    table = report.comparison
    if table is None:
        raise DataError(report.name, "the report holds no model comparison", report.no_comparison)
    return _drawn(lambda: draw_comparison(run_title(report.run_summary), table.scores, table.horizons_m))


def _check(report: DropoutReport, content: tuple[object, ...], what: str) -> None:
    if not content:
        raise DataError(report.name, f"the report holds no {what}", "icrtool.dropout_report finds what there is")


def _drawn(draw: Callable[[], Figure]) -> Figure:
    with style():
        return draw()
