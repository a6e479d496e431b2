"""Pictures of ICR estimates over time, many runs at once: convergence (Figs. 4, 5) and changes (Figs. 8, 9)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.lines import Line2D

from icrtool.kernels.arrays import Floats
from icrtool.output.figures.style import ICR_LOOKS, new_figure
from icrtool.output.tables.study import capital, runs_text, study_title
from icrtool.simulation.studies import KINDS, StudyResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MARKS = 9
"""Marks on a line, so that the three are distinguished without colours."""
PATH_COLORS = ("#2166ac", "#e08214", "#1b7837", "#b2182b", "0.3", "#762a83")
PATH_DASHES = ("-", (0, (6, 2)), (0, (2, 1.5)), (0, (6, 1.5, 1.2, 1.5)), (0, (1, 1)), (0, (8, 3)))
LEAST_VIEW_M = 0.6


def draw_convergence(result: StudyResult) -> Figure:
    """Draw a path, the estimates' first seconds over all runs, and the distribution of convergence times by path."""
    request, curves = result.request, result.curves
    about = f"{capital(KINDS['convergence'].about)}; {runs_text(request)}, start of preset"
    figure = new_figure(
        study_title(result), f"{about} {' and '.join(request.presets)}", height_in=6.4,
        margins_in=(0.75, 0.2, 0.85, 0.95), wspace=0.3, hspace=0.42,
    )  # fmt: skip
    grid = figure.add_gridspec(2, 2, width_ratios=(1, 1.6))
    shown = result.levels[int(curves["shown"][0])]
    left, right, below = (figure.add_subplot(grid[place]) for place in ((0, 0), (0, 1), (1, slice(None))))
    left.plot(curves["path"][:, 1], curves["path"][:, 0], color="black", linewidth=1.1)
    left.plot(*curves["path"][0, ::-1], marker="o", color="black", markerfacecolor="white")
    left.set_aspect("equal", adjustable="datalim")
    left.set(xlabel="East [m]", ylabel="North [m]")
    left.set_title(f"{shown['value']} path", loc="left")
    draw_bands(right, curves["trace"], curves["true_icrs"][:1], np.empty(0))
    right.set_title(f"{shown['value']} path, preset {shown['series']}: 5 to 95 % of the runs", loc="left")
    right.set(xlabel="Time [s]", ylabel="ICR estimate [m]")
    for place, level in enumerate(result.levels):
        chosen = np.array(result.columns["series"]) == level["series"]
        chosen &= np.array(result.columns["value"]) == level["value"]
        times = np.sort(np.asarray(result.columns["settle_s"])[chosen])
        share = 100 * np.arange(1, len(times) + 1) / len(times)
        settled = np.isfinite(times)
        start = np.zeros(min(settled.sum(), 1))
        below.step(
            np.maximum([*times[settled][: len(start)], *times[settled]], 0.01),
            [*start, *share[settled]],
            where="post",
            color=PATH_COLORS[place % 6],
            linestyle=PATH_DASHES[place % 6],
            label=level["value"] if len(request.presets) == 1 else f"{level['value']}, {level['series']}",
        )
    below.axvspan(5.0, 15.0, color="0.92", zorder=0)
    below.set(xscale="log", ylim=(0, 103), ylabel="Runs [%]")
    below.set_xlabel("All three ICRs within 10 % of the truth after [s]   (grey: 5-15 s, the paper's driven robots)")
    right.legend(handles=icr_keys("-"), loc="upper right", ncols=3, columnspacing=1.2)
    keys = below.get_legend_handles_labels()[0]
    figure.legend(handles=keys, ncols=min(len(keys), 6), columnspacing=1.2)
    return figure


def draw_icr_change(result: StudyResult) -> Figure:
    """Draw the estimates over the changes, and the seconds around the first one."""
    curves = result.curves
    names = [f"{level['series']} {level['value']}" for level in result.levels]
    request = result.request
    figure = new_figure(
        study_title(result),
        f"{runs_text(request)}; lines: median, bands: 5 to 95 %; dashed: the truth; left all, right the first change",
        height_in=1.4 + 1.75 * len(names), margins_in=(0.75, 0.2, 0.8, 0.85), wspace=0.18, hspace=0.34,
    )  # fmt: skip
    panels = figure.subplots(len(names), 2, squeeze=False, sharex="col", gridspec_kw={"width_ratios": (2, 1)})
    for row, name in zip(panels, names, strict=True):
        draw_bands(row[0], curves[f"trace {name}"], curves["true_icrs"], curves["changes"])
        zoom = curves[f"zoom {name}"]
        draw_bands(row[1], zoom, curves["true_icrs"][:2], np.zeros(1))
        preset, what = name.split(" ", 1)
        row[0].set_title(
            f"preset {preset}, {'covariance inflated' if what == 'inflated' else 'filter not informed'}", loc="left"
        )
        row[0].set_ylabel("ICRs [m]")
    panels[-1][0].set_xlabel("Time [s]")
    panels[-1][1].set_xlabel("Time since the change [s]")
    figure.legend(handles=icr_keys("-"), ncols=3)
    return figure


def icr_keys(linestyle: str | None = None) -> list[Line2D]:
    """Return a key for each of the three ICRs; `linestyle` replaces their own."""
    with_dash = {} if linestyle is None else {"linestyle": linestyle}
    return [Line2D([], [], **look | with_dash) for look in ICR_LOOKS.values()]


def draw_bands(axes: Axes, traces: Floats, true_icrs: Floats, changes: Floats) -> None:
    """Draw medians and 5 to 95 % bands of traces (runs, k, 4), and the truth (c, 3) between `changes` (c - 1,) [s]."""
    t = traces[0, :, 0]
    edges = np.concatenate([[t[0]], changes, [t[-1]]])
    for place, look in enumerate(ICR_LOOKS.values()):
        color = look["color"]
        low, middle, high = np.nanpercentile(traces[:, :, 1 + place], [5, 50, 95], axis=0)
        axes.fill_between(t, low, high, color=color, alpha=0.18, linewidth=0)
        every = (place * len(t) // (3 * MARKS), max(1, len(t) // MARKS))
        axes.plot(t, middle, linewidth=1.2, markevery=every, **look | {"linestyle": "-"})
        for number, value in enumerate(true_icrs[:, place]):
            axes.plot(edges[number : number + 2], [value, value], color=color, linewidth=0.9, linestyle=(0, (4, 2)))
    for change in changes:
        axes.axvline(change, color="0.4", linewidth=0.7)
    reach = max(LEAST_VIEW_M, float(np.ptp(true_icrs)))
    axes.set_ylim(true_icrs.min() - 0.8 * reach, true_icrs.max() + 0.8 * reach)
    axes.set_xlim(t[0], t[-1])
