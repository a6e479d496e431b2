"""Compared groups as a picture: the transfer matrix, and what a calibration of another group costs."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from icrtool.calibration.transfer import HORIZONS_M, Transfer
from icrtool.output.figures.style import HALF_WIDTH, ICR, drawable, inches, new_figure
from icrtool.records.dropout import CHOICE_HORIZON_M

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LONGEST_NAME = 14


def draw_transfer(transfer: Transfer) -> Figure:
    """Return the figure: p95 after 10 m, calibrated on row and tested on column; costs with 95 % intervals."""
    names = list(transfer.calibrations)
    rows = [(one, one.cost) for one in transfer.cells if one.cost is not None and np.isfinite(one.cost.p95_m)]
    subtitle = "95 % error without GNSS; on the diagonal each trial is predicted by what was not fitted to it"
    figure = new_figure(" · ".join(names), subtitle, width_in=9.0, height_in=2.6 + 0.45 * len(names) + 0.12 * len(rows))
    matrix, costs = figure.subplots(1, 2, width_ratios=(1.0, 1.2))
    figure.subplots_adjust(wspace=0.75, **inches(figure, left=1.3, right=0.2, top=1.0, bottom=0.65))
    _draw_matrix(matrix, transfer, names)
    labels = []
    for y, (one, cost) in enumerate(rows):
        labels.append(f"{_short(one.calibrated_on)} on {_short(one.tested_on)}, {one.horizon_m:g} m")
        costs.plot([cost.p95_low_m, cost.p95_high_m], [y, y], **ICR.keywords() | {"linestyle": "-"})
        costs.plot([cost.p95_m], [y], "o", color=ICR.color, markersize=4)
    costs.axvline(0.0, **HALF_WIDTH.keywords())
    costs.set_yticks(range(len(rows)), labels, fontsize=7.5, parse_math=False)
    costs.invert_yaxis()
    costs.set_xlabel("95 % error more than with its own calibration [m]")
    return figure


def _draw_matrix(axes: Axes, transfer: Transfer, names: list[str]) -> None:
    horizon = CHOICE_HORIZON_M if CHOICE_HORIZON_M in HORIZONS_M else HORIZONS_M[-1]
    values = np.array([[transfer.cell(row, column, horizon).errors.p95_m for column in names] for row in names])
    axes.imshow(values, cmap="Blues", vmin=0.0, vmax=1.6 * float(np.nanmax(values)))
    for row, column in np.ndindex(values.shape):
        text = f"{values[row, column]:.2f} m" if np.isfinite(values[row, column]) else "–"
        axes.text(column, row, text, ha="center", va="center", fontsize=8.5)
    short = [_short(name) for name in names]
    axes.set_xticks(range(len(names)), short, fontsize=8, parse_math=False)
    axes.set_yticks(range(len(names)), short, fontsize=8, parse_math=False)
    axes.set_xlabel(f"tested on, after {horizon:g} m")
    axes.set_ylabel("calibrated on")
    axes.grid(visible=False)


def _short(name: str) -> str:
    text = drawable(name)
    return text if len(text) <= LONGEST_NAME else f"{text[: LONGEST_NAME - 1]}…"
