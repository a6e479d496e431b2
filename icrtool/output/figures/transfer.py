"""Compared groups as a picture: the transfer matrix, and what a calibration of another group costs."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from icrtool.output.figures.style import HALF_WIDTH, ICR, drawable, new_figure, styled
from icrtool.records.calibration_document import GroupComparison
from icrtool.records.dropout import CHOICE_HORIZON_M

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LONGEST_NAME = 14


@styled
def transfer(found: GroupComparison) -> Figure:
    """Return the figure: p95 after 10 m, calibrated on row and tested on column; costs with 95 % intervals."""
    names, rows = list(found.groups), [one for one in found.costs if one.p95_m is not None]
    subtitle = f"{' · '.join(names)}: on the diagonal each trial is predicted by a fit that does not contain it"
    figure = new_figure(
        _answer(found), subtitle, width_in=9.6, height_in=2.95 + 0.45 * len(names) + 0.12 * len(rows),
        margins_in=(1.3, 0.2, 1.35, 0.75), wspace=1.15,
    )  # fmt: skip
    matrix, costs = figure.subplots(1, 2, width_ratios=(1.0, 1.2))
    _draw_matrix(matrix, found, names)
    labels = []
    for y, one in enumerate(rows):
        calibrated, tested = (drawable(name, LONGEST_NAME) for name in (one.calibrated_on, one.tested_on))
        labels.append(f"{calibrated} on {tested}, {one.horizon_m:g} m")
        if one.p95_low_m is not None and one.p95_high_m is not None:
            costs.plot([one.p95_low_m, one.p95_high_m], [y, y], **ICR.keywords() | {"linestyle": "-"})
        costs.plot([one.p95_m], [y], "o", color=ICR.color, markersize=4)
    costs.axvline(0.0, **HALF_WIDTH.keywords())
    costs.set_yticks(range(len(rows)), labels, fontsize=7.5, parse_math=False)
    costs.invert_yaxis()
    costs.set_xlabel("95 % error more than with its own calibration [m]")
    return figure


def _answer(found: GroupComparison) -> str:
    """Return the errors with a calibration of another group, and with its own."""
    cells = [one for one in found.transfer if one.horizon_m == CHOICE_HORIZON_M]
    own = [one.p95_m for one in cells if one.p95_m is not None and one.calibrated_on == one.tested_on]
    other = [one.p95_m for one in cells if one.p95_m is not None and one.calibrated_on != one.tested_on]
    if not (own and other):
        return f"No group has a trial of {CHOICE_HORIZON_M:g} m"
    spans = [" to ".join(dict.fromkeys((f"{min(errors):.2f}", f"{max(errors):.2f}"))) for errors in (other, own)]
    return f"{spans[0]} m off after {CHOICE_HORIZON_M:g} m (95 %) with another's calibration, {spans[1]} m with its own"


def _draw_matrix(axes: Axes, found: GroupComparison, names: list[str]) -> None:
    values = np.full((len(names), len(names)), np.nan)
    for cell in found.transfer:
        if cell.horizon_m == CHOICE_HORIZON_M and cell.p95_m is not None:
            values[names.index(cell.calibrated_on), names.index(cell.tested_on)] = cell.p95_m
    most = float(np.nanmax(values)) if np.isfinite(values).any() else 1.0
    axes.imshow(values, cmap="Blues", vmin=0.0, vmax=1.6 * most)
    for row, column in np.ndindex(values.shape):
        text = f"{values[row, column]:.2f} m" if np.isfinite(values[row, column]) else "–"
        axes.text(column, row, text, ha="center", va="center", fontsize=8.5)
    short = [drawable(name, LONGEST_NAME) for name in names]
    axes.xaxis.tick_top()
    axes.set_xticks(range(len(names)), short, fontsize=8, parse_math=False, rotation=30, ha="left")
    axes.set_yticks(range(len(names)), short, fontsize=8, parse_math=False)
    axes.set_xlabel(f"95 % error after {CHOICE_HORIZON_M:g} m:\ncalibrated on the row, tested on the column")
    axes.grid(visible=False)
