"""A study as a picture: a column of panels for each preset or case.

A panel shows a quantity over the varied setting, values along time, a distribution over the runs, or shares over a
grid.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from icrtool.kernels.arrays import Floats
from icrtool.output.figures import style
from icrtool.output.figures.sheet import new_sheet, styled
from icrtool.output.series import BLUE, GREEN, ORANGE, RED
from icrtool.output.tables.study import finding_text, runs_text
from icrtool.output.text_format import signed_text
from icrtool.records.presets import PRESETS
from icrtool.simulation.studies import shown_path
from icrtool.simulation.study_records import Level, StudyResult, chi2_band, consistency_of
from icrtool.simulation.study_runs import FATES, STUDY_STATES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def study_title(result: StudyResult) -> str:
    """Return the answer of a study with its number, by series."""
    study = result.study
    answer = ", ".join(f"{finding_text(number)} ({number.what})" for number in result.answer)
    value = study.answer.values_among(result.levels)[0]
    return study.title.format(answer=answer, value=value)


def study_subtitle(result: StudyResult) -> str:
    """Return a study's name, with the robot's where it has one, the true ICRs, the path and the runs."""
    request, robot = result.request, result.request.config.robot.name
    icrs = ", ".join(signed_text(icr, 2) for icr in request.plan.icrs_m)
    return (
        f"{request.name}{f', {robot}' if robot else ''}: ICRs {icrs} m, {request.path.kind} path, "
        f"{request.path.speed_mps:g} m/s, {runs_text(request)}"
    )


PANEL_IN = 2.1
"""Height of a panel [in]."""

MARKS_A_LINE = 9
"""Number of marks on a line. Marks distinguish lines without colours."""

LEAST_RANGE_M, LEAST_VIEW_M = 0.02, 0.6
"""Smallest range of a panel of errors, and of a panel of ICRs [m]."""

BEYOND = 1.6
"""Ratio of the range of a panel of starts to the largest start."""

FATE_COLORS = np.array([(0.57, 0.77, 0.93), (0.50, 0.0, 0.10), (0.90, 0.90, 0.90)])
"""Red, green and blue of each of `FATES`; they are mixed by the shares of the runs."""

STUDY_LOOKS: tuple[style.Look, ...] = (
    *({key: value for key, value in look.items() if key != "label"} for look in style.ICR_LOOKS.values()),
    {"color": GREEN, "linestyle": "-", "marker": "D", "markersize": 3.5},
)
"""Looks of lines that show no ICRs, in turn."""

OPEN_LOOP = {"label": "open loop, final ICRs", **STUDY_LOOKS[3]}
"""Look of the open-loop error with the final ICRs."""

OPEN_LOOP_NO_SLIP = {"label": "open loop, no slip", **style.NO_SLIP_LINE}
"""Look of the open-loop error without slip."""

PATH_COLORS = (BLUE, ORANGE, GREEN, RED)
"""Colours of kinds of paths, in turn."""

WIDE: style.Look = {"linewidth": 1.5}
"""Width of the line of an estimate."""

TRUTH: style.Look = {"linewidth": 0.9, "linestyle": (0, (4, 2))}
"""Line of the truth."""

Draw = Callable[["Axes", StudyResult, list[Level]], None]
"""Type of a function that draws the levels of one series."""


@styled
def study_figure(result: StudyResult, *, ax: Axes | None = None) -> Figure | Axes:
    """Return the picture of a study; `ax`: axes to draw into, which are returned."""
    rows = STUDY_PICTURES[result.request.name]
    names = dict.fromkeys(level.setting.series for level in result.levels)
    levels_by_series = [[level for level in result.levels if level.setting.series == name] for name in names]
    columns = [list(result.levels)] if result.request.name in TOGETHER else levels_by_series
    title, subtitle, height_in = study_title(result), study_subtitle(result), 1.7 + PANEL_IN * len(rows)
    margins_in = (0.85, 0.2, 0.75, 1.2)
    sheet = new_sheet(title, subtitle, ax, height_in=height_in, margins_in=margins_in, wspace=0.12, hspace=0.5)
    panels = sheet.subplots(len(rows), len(columns), sharey="row")
    for column, levels in enumerate(columns):
        name = levels[0].setting.series
        if len(columns) > 1:
            panels[0][column].set_title(f"preset {name}" if name in PRESETS else name, loc="left")
        for row, (label, draw) in enumerate(rows):
            draw(panels[row][column], result, levels)
            panels[row][0].set_ylabel(label)
    sheet.legend(title=NOTES.get(result.request.name, NOTE), ncols=5)
    return sheet.finish()


def _varied(result: StudyResult) -> str:
    """Return the name of the setting that a study varies, with a capital."""
    return f"{result.study.varies[:1].upper()}{result.study.varies[1:]}"


def draw_columns(
    axes: Axes, result: StudyResult, levels: Sequence[Level], columns: dict[str, style.Look], *, log: str = ""
) -> None:
    """Draw columns over the varied setting: medians, and bars from the 5th to the 95th percentile.

    Parameters
    ----------
    columns : look of each column, by name
    log : names of the logarithmic axes
    """
    values = [level.setting.value for level in levels]
    for place, (column, look) in enumerate(columns.items()):
        numbers = [level.metrics()[column] for level in levels]
        _draw_points(
            axes,
            values,
            [(statistics["p5"], statistics["p50"], statistics["p95"]) for statistics in numbers],
            look,
            0.15 * (place - 1),
        )
    axes.set_xlabel(_varied(result))
    if "x" in log:
        axes.set_xscale("log")
        axes.set_xticks(values, [f"{value:g}" for value in values], fontsize=7.5)
        axes.minorticks_off()
    # On a drive without a turn errors are zero, and zero has no logarithm.
    if "y" in log and all((np.asarray(line.get_ydata()) > 0).any() for line in axes.lines):
        axes.set_yscale("log")


def _draw_points(axes: Axes, values: Sequence[Any], numbers: Sequence[Any], look: style.Look, shift: float) -> None:
    """Draw (low, middle, high) over numbers, or over names at equal steps."""
    x: Any = values
    if isinstance(values[0], str):
        axes.set_xticks(range(len(values)), [str(value).replace("_", " ") for value in values])
        x, look = np.arange(len(values)) + shift, look | {"linestyle": "none"}
    low, middle, high = np.array(numbers).T
    axes.errorbar(x, middle, [middle - low, high - middle], elinewidth=0.8, capsize=2.0, **WIDE | look)


def draw_errors(axes: Axes, result: StudyResult, levels: Sequence[Level], *, log: str = "") -> None:
    """Draw the ICR errors over the varied setting; bars of settings with a diverged run are cut at the frame."""
    columns = _looks_by_icr("error_{icr}_m")
    draw_columns(axes, result, levels, columns, log=log)
    medians = [level.metrics()[column]["p50"] for level in result.levels for column in columns]
    finite = [value for value in (*medians, 0.0) if np.isfinite(value)]
    reach = 0.3 * max(LEAST_RANGE_M, float(np.ptp(finite)))
    axes.axhline(0.0, color="0.6", linewidth=0.8)
    axes.set_ylim(min(finite) - reach, max(finite) + reach)


def _looks_by_icr(column: str) -> dict[str, style.Look]:
    """Return the look of each ICR by the name of its column; {icr} stands for the ICR in the pattern `column`."""
    return {column.format(icr=icr): look for icr, look in style.ICR_LOOKS.items()}


def draw_inversions(axes: Axes, result: StudyResult, levels: Sequence[Level]) -> None:
    """Draw the share of the runs that end inverted, over the varied setting."""
    shares = [100 * level.metrics()["inverted"]["mean"] for level in levels]
    axes.plot([level.setting.value for level in levels], shares, color="black", marker="o", markersize=3.5)
    axes.set(ylim=(-4, 104), xlabel=_varied(result))


def draw_percentiles(axes: Axes, t: Floats, values: Floats, look: style.Look) -> None:
    """Draw median and 5 to 95 % of values (runs, k) along time t (k,) [s]."""
    low, middle, high = np.nanpercentile(values, [5, 50, 95], axis=0)
    if len(values) > 1:
        axes.fill_between(t, low, high, color=look["color"], alpha=0.18, linewidth=0)
    axes.plot(t, middle, linewidth=1.2, markevery=max(1, len(t) // MARKS_A_LINE), **look)
    axes.set_xlabel("Time [s]")
    if len(t) > 1:
        axes.set_xlim(t[0], t[-1])


def draw_estimates(
    axes: Axes, _result: StudyResult, levels: Sequence[Level], value: str = "", name: str = "trace"
) -> None:
    """Draw the ICR estimates of one level along time, and the truth."""
    value = value or str(shown_path([level.setting.value for level in levels])[0])
    level = next(level for level in levels if level.setting.value == value)
    traces, plan = level.found[name], level.setting.scenario.plan
    t = traces[0, :, 0]
    truth = np.array([plan.icrs_m, *(icrs for _, icrs in plan.changes)])
    edges = [t[0], *(time for time, _ in plan.changes), max(t[-1], plan.duration_s)]
    for place, look in enumerate(style.ICR_LOOKS.values()):
        draw_percentiles(axes, t, traces[..., 1 + place], look | {"linestyle": "-"})
        axes.step(edges, [*truth[:, place], truth[-1, place]], where="post", color=look["color"], **TRUTH)
    reach = 0.8 * max(LEAST_VIEW_M, float(np.ptp(truth)))
    axes.set_ylim(truth.min() - reach, truth.max() + reach)


def draw_starts(axes: Axes, result: StudyResult, levels: Sequence[Level]) -> None:
    """Draw y_icr_right of one run along time, from each start whose y_icr_left is nearest to the truth."""
    right, left, _ = result.request.plan.icrs_m
    nearest = min(sorted(result.request.values), key=lambda value: abs(value - left))
    for level in levels:
        if level.names["start_y_icr_left_m"] == nearest:
            trace = level.found["trace"][:1]
            draw_percentiles(axes, trace[0, :, 0], trace[..., 1], {"color": "0.35"})
    axes.axhline(right, color=STUDY_LOOKS[0]["color"], **TRUTH)
    reach = BEYOND * max(LEAST_VIEW_M, *map(abs, result.request.values))
    axes.set_ylim(-reach, reach)
    axes.set_title(f"start y left {nearest:g} m", loc="left")


def draw_fates(axes: Axes, result: StudyResult, levels: Sequence[Level]) -> None:
    """Draw the outcome of every start over both initial y ICRs; the dashed line is where they are equal."""
    values = sorted(set(result.request.values))
    picture = np.zeros((len(values), len(values), 3))
    for level in levels:
        starts_m = [level.names[f"start_{name}_m"] for name in ("y_icr_right", "y_icr_left")]
        row, column = np.searchsorted(values, np.array(starts_m, np.float64))
        picture[row, column] = np.array([level.found[fate].mean() for fate in FATES]) @ FATE_COLORS
    half = (values[-1] - values[0]) / max(2 * (len(values) - 1), 1) or 0.5
    span = (values[0] - half, values[-1] + half)
    axes.imshow(picture, origin="lower", extent=(*span, *span), aspect="auto")
    axes.plot(span, span, color="black", **TRUTH)
    axes.grid(visible=False)
    axes.set_xlabel("Initial y left [m]")
    for fate, color in zip(FATES, FATE_COLORS, strict=True):
        axes.fill_between([], [], color=color, label=fate)


def draw_speeds(axes: Axes, _result: StudyResult, levels: Sequence[Level]) -> None:
    """Draw the left track speed of one run along time, as the filter gets it."""
    for level, look in zip(levels, STUDY_LOOKS, strict=False):
        trace = level.found["trace"][:1]
        draw_percentiles(axes, trace[0, :, 0], trace[..., 4], look | {"label": level.setting.value, "marker": ""})


def draw_shares(axes: Axes, _result: StudyResult, levels: Sequence[Level]) -> None:
    """Draw the share of the runs that have settled, over time."""
    for number, level in enumerate(levels):
        times = np.sort(level.found["settle_s"])
        settled = np.maximum(times[np.isfinite(times)], 0.01)
        look: style.Look = {"color": PATH_COLORS[number % 4], "linestyle": ("-", "--", ":", "-.")[number % 4]}
        share = 100 * np.arange(len(settled) + 1) / len(times)
        axes.step([*settled[:1], *settled], share[: 2 * len(settled)], where="post", label=level.setting.value, **look)
    axes.axvspan(5.0, 15.0, color="0.92", zorder=0, label="the paper's driven robots")
    axes.set(xscale="log", ylim=(0, 103), xlabel="All three ICRs within 10 % of the truth after [s]")


def draw_nees(axes: Axes, _result: StudyResult, levels: Sequence[Level]) -> None:
    """Draw the mean NEES along time, and its 95 % band."""
    runs = len(levels[0].found["nees"])
    axes.axhspan(*chi2_band(6 * runs, runs), color="#d9ead3", zorder=0.5, label="95 % band")
    for level, look in zip(levels, STUDY_LOOKS, strict=False):
        mean = level.found["all nees"].mean(axis=0, keepdims=True)
        draw_percentiles(axes, level.found["stops_s"][0], mean, look | {"label": level.setting.series})
    axes.set_yscale("log")


def draw_coverage(axes: Axes, _result: StudyResult, levels: Sequence[Level]) -> None:
    """Draw the share of the time in which the truth is within 2 sigma, by state."""
    for series_index, (level, look) in enumerate(zip(levels, STUDY_LOOKS, strict=False)):
        coverage_pct = consistency_of(level.found)["coverage_pct"]
        _draw_points(
            axes, STUDY_STATES, [(share, share, share) for share in coverage_pct], look, 0.15 * (series_index - 1)
        )
    axes.axhline(95.4, color="black", **TRUTH)


SETTLING_LINES: Draw = partial(draw_columns, columns=_looks_by_icr("settle_{icr}_s"))
"""Draws the settling time of each ICR."""

MEANS, SCATTER = (
    partial(draw_columns, columns=_looks_by_icr(f"{statistic}_{{icr}}_m")) for statistic in ("mean", "scatter")
)
"""Draw mean and scatter of each ICR."""

RMS: Draw = partial(draw_columns, columns=_looks_by_icr("rms_{icr}_m"), log="xy")
"""Draws the rms error of each ICR."""

WITHOUT_GNSS: Draw = partial(
    draw_columns, columns={"blind_icr_10m_p95_m": OPEN_LOOP, "blind_no_slip_10m_p95_m": OPEN_LOOP_NO_SLIP}, log="xy"
)
"""Draws the errors after 10 m without GNSS."""

NOT_INFLATED, INFLATED = (partial(draw_estimates, value=value) for value in ("not inflated", "inflated"))
"""Draw the estimates without and with inflation."""

STUDY_PICTURES: dict[str, tuple[tuple[str, Draw], ...]] = {
    "convergence": (("ICR estimate [m]", draw_estimates), ("Runs [%]", draw_shares)),
    "initial": (("Initial y right [m]", draw_fates), ("y right [m]", draw_starts)),
    "icr-change": (
        ("ICRs, not inflated [m]", NOT_INFLATED), ("ICRs, inflated [m]", INFLATED),
        ("… first change [m]", partial(INFLATED, name="zoom")),
    ),
    "turn-radius": (("Within 10 % after [s]", SETTLING_LINES), ("Ends inverted [%]", draw_inversions)),
    "input-noise": (("ICR error [m]", draw_errors),),
    "input-bias": (("ICR error [m]", draw_errors),),
    "input-source": (("Left track speed [m/s]", draw_speeds), ("ICR error [m]", draw_errors)),
    "gnss": (("ICR error, rms [m]", RMS), ("10 m without GNSS, p95 [m]", WITHOUT_GNSS)),
    "rate": (("ICR error [m]", partial(draw_errors, log="x")),),
    "speed": (("ICR, mean [m]", MEANS), ("ICR, std [m]", SCATTER)),
    "consistency": (("NEES, mean (6 expected)", draw_nees), ("Within 2 sigma [%]", draw_coverage)),
}  # fmt: skip
"""Rows of panels of each picture: name of the y axis, and the function that draws."""

TOGETHER: frozenset[str] = frozenset({"consistency"})
"""Pictures whose series share a panel."""

NOTE = "lines: median; bars and bands: 5 to 95 % of the runs"
"""Sentence above the legend of every study."""

NOTES: dict[str, str] = {
    "initial": "colours: share of the runs; above the dashed line the start is proper",
    "consistency": "model: truth drawn from Q and R; paper and field: exact kinematics, preset's start",
}
"""Sentences above the legend, by study."""
