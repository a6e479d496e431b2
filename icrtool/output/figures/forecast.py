"""A forecast as a picture: error over distance, and the path with circles that hold 95 % of the errors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.patches import Circle

from icrtool.calibration.forecast import Forecast
from icrtool.kernels.error_statistics import within_budget
from icrtool.output.figures.style import CHANGE, FILTER, HALF_WIDTH, ICR, MEAN, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CIRCLES = 20


@styled
def forecast_figure(
    forecast: Forecast, title: str, budgets_m: tuple[float, ...], measured_m: float, gyro: Forecast | None = None
) -> Figure:
    """Return the figure of a forecast; a dashed line for each budget, and where the calibration's errors end."""
    reached = within_budget(forecast.distance_m, forecast.p95_m, budgets_m[0]) if budgets_m else None
    answer = f"{forecast.p95_m[-1]:.2f} m off (95 %) at the end of {forecast.distance_m[-1]:.0f} m"
    if reached is not None:
        answer = f"Within {budgets_m[0]:g} m (95 %) for {reached[0]:.1f} m, {answer}"
    by = "wheels alone" if gyro is None else "wheels alone, and with gyro"
    subtitle = f"{title}: forecast error without GNSS from the start: {by}, by the calibration"
    figure = new_figure(
        answer, subtitle, width_in=9.0, height_in=4.2, margins_in=(0.7, 0.25, 0.75, 0.95), wspace=0.28
    )  # fmt: skip
    grown, path = figure.subplots(1, 2)
    for one, words, dash in ((forecast, "", {}), (gyro, ", with gyro", {"linestyle": ":"})):
        if one is not None:
            grown.plot(one.distance_m, one.p95_m, label=f"95 %{words}", **ICR.keywords() | dash)
            grown.plot(one.distance_m, one.expected_m, label=f"expected{words}", **FILTER.keywords() | dash)
    for budget in budgets_m:
        grown.axhline(budget, label=f"budget {budget:g} m", **CHANGE.keywords())
    if forecast.distance_m[-1] > measured_m:
        grown.axvline(measured_m, label="measured up to here", **MEAN.keywords())
    grown.set(xlabel="Distance without GNSS [m]", ylabel="Error [m]", xlim=(0.0, None), ylim=(0.0, None))
    path.plot(forecast.east_m, forecast.north_m, label="path", **HALF_WIDTH.keywords() | {"linestyle": "-"})
    # Where the forecast is extrapolated its circles would bury the path.
    measured = np.flatnonzero(forecast.distance_m <= measured_m)
    rows = measured[:: max(len(measured) // CIRCLES, 1)]
    for east, north, radius in zip(forecast.east_m[rows], forecast.north_m[rows], forecast.p95_m[rows], strict=True):
        path.add_patch(
            Circle((float(east), float(north)), float(radius), fill=False, edgecolor=ICR.color, linewidth=0.8)
        )
    path.plot([], [], label=f"95 % of the errors, up to {measured_m:g} m", color=ICR.color, linewidth=0.8)
    path.autoscale_view()
    path.set_aspect("equal", adjustable="datalim")
    path.set(xlabel="East [m]", ylabel="North [m]")
    figure.legend(ncols=4)
    return figure
