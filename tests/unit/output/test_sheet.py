"""Pictures in the caller's axes: they are drawn into, returned, and leave the settings of matplotlib as they were."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib import style as styles
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from PIL import Image

import icrtool
from icrtool.dropout_analysis.dropout_report import dropout
from icrtool.dropout_analysis.report import DropoutReport
from icrtool.dropout_analysis.shown_paths import errors_by_start, example_trials, real_outages, worst_trials
from icrtool.output.figures.style import save_figure
from icrtool.records.run import Run

HORIZONS_M = [1.0, 2.0, 5.0]
OF_RUNS = ("trajectory", "icr_estimates", "icr_clusters", "gnss_difference")
OF_REPORTS = {
    "dropout_summary": (), "dropout_histogram": (2.0,), "dropout_histograms": (1.0, 2.0), "dropout_examples": (),
    "dropout_worst": (), "dropout_outages": (), "dropout_map": (),
}  # fmt: skip
SETTINGS = {"font.size": 13.0, "axes.facecolor": "0.95", "axes.grid": False, "lines.linewidth": 4.0}


@pytest.fixture(scope="module")
def report(run: Run) -> DropoutReport:
    return replace(
        dropout(run, HORIZONS_M), examples=example_trials(run, 5.0), worst=worst_trials(run, horizon_m=2.0),
        outages=real_outages(run), path_errors=errors_by_start(run, horizon_m=2.0).on_path,
    )  # fmt: skip


@pytest.fixture
def users_settings() -> Iterator[dict[str, object]]:
    with mpl.rc_context(SETTINGS):
        yield dict(mpl.rcParams)
        assert {key: mpl.rcParams[key] for key in SETTINGS} == SETTINGS


def drawings(run: Run, report: DropoutReport) -> dict[str, Callable[..., object]]:
    found: dict[str, Callable[..., object]] = {}
    for name in OF_RUNS:
        found[name] = lambda ax=None, name=name: getattr(icrtool.figures, name)(run, ax=ax)
    for name, more in OF_REPORTS.items():
        found[name] = lambda ax=None, name=name, more=more: getattr(icrtool.figures, name)(report, *more, ax=ax)
    return found


def all_axes(ax: Axes) -> list[Axes]:
    return [ax, *(inner for child in ax.child_axes for inner in all_axes(child))]


def test_every_public_figure_is_tested_here() -> None:
    assert sorted(icrtool.figures.__all__) == sorted([*OF_RUNS, *OF_REPORTS])


@pytest.mark.parametrize("name", [*OF_RUNS, *OF_REPORTS])
def test_a_figure_is_drawn_into_axes_and_returns_them(
    name: str, run: Run, report: DropoutReport, users_settings: dict[str, object]
) -> None:
    figure = Figure(figsize=(9.0, 4.0))
    ax, other = figure.subplots(1, 2)
    assert drawings(run, report)[name](ax=ax) is ax
    assert dict(mpl.rcParams) == users_settings
    assert ax.get_title(loc="left")
    assert any(one.lines or one.collections for one in all_axes(ax))
    assert not (other.lines)
    assert not (other.collections)
    assert not (other.texts)
    assert not (other.child_axes)
    assert figure.texts == []
    assert figure.legends == []
    assert figure.axes == [ax, other]
    figure.canvas.draw()


@pytest.mark.parametrize("name", [*OF_RUNS, *OF_REPORTS])
def test_a_new_figure_is_of_our_style_and_leaves_the_users_settings(
    name: str, run: Run, report: DropoutReport, users_settings: dict[str, object]
) -> None:
    figure = drawings(run, report)[name]()
    assert isinstance(figure, Figure)
    assert dict(mpl.rcParams) == users_settings
    assert figure.axes[0].get_facecolor() == (1.0, 1.0, 1.0, 1.0)


def test_axes_hold_the_lines_of_the_figure_in_the_callers_style(run: Run, users_settings: dict[str, object]) -> None:
    own = icrtool.figures.trajectory(run).axes[0]
    ax = icrtool.figures.trajectory(run, ax=Figure(figsize=(7.0, 6.0)).subplots())
    named, of_own = (
        {str(line.get_label()): line for line in axes.lines if not str(line.get_label()).startswith("_")}
        for axes in (ax, own)
    )
    assert list(named) == list(of_own)
    assert ax.xaxis.label.get_fontsize() == SETTINGS["font.size"]
    assert own.xaxis.label.get_fontsize() == 9.5
    assert np.allclose(named["filter"].get_xydata()[-1], of_own["filter"].get_xydata()[-1])


def drawn_colors(axes: Axes) -> list[tuple[float, float, float]]:
    """Colours of the lines, areas and words in axes that are seen."""
    found: list[object] = []
    for line in axes.lines:
        found += [line.get_color()] if line.get_linestyle() != "None" else []
        found += [line.get_markeredgecolor()] if line.get_marker() not in ("None", "") else []
    for one in axes.collections:
        found += [*one.get_edgecolor()] if one.get_array() is None else []
    found += [text.get_color() for text in axes.texts]
    return [to_rgba(one)[:3] for one in found if to_rgba(one)[3] > 0.0]


@pytest.mark.parametrize("name", [*OF_RUNS, *OF_REPORTS])
def test_nothing_is_black_on_the_dark_axes_of_a_caller(name: str, run: Run, report: DropoutReport) -> None:
    draw = drawings(run, report)[name]
    with styles.context("dark_background"):
        ax = Figure(figsize=(9.0, 6.0)).subplots()
        (own,) = ax.plot([0.0], [0.0], color="black")
        draw(ax=ax)
        ax.figure.canvas.draw()
    shown = [color for one in all_axes(ax) for color in drawn_colors(one)]
    assert own.get_color() == "black"
    assert shown.count((0.0, 0.0, 0.0)) == 1
    # on light axes of a caller the same pens are black
    light = draw(ax=Figure(figsize=(9.0, 6.0)).subplots())
    assert isinstance(light, Axes)
    pens = [color for one in all_axes(light) for color in drawn_colors(one)]
    assert (0.0, 0.0, 0.0) in pens or name in ("gnss_difference", "dropout_summary")
    greys = {round(1.0 - one[0], 9) for one in pens if len(set(one)) == 1}
    assert greys <= {round(one[0], 9) for one in shown}


def test_the_key_on_dark_axes_has_the_colours_of_the_lines(run: Run) -> None:
    with styles.context("dark_background"):
        ax = icrtool.figures.trajectory(run, ax=Figure(figsize=(7.0, 6.0)).subplots())
    key = ax.get_legend()
    assert key is not None
    handles = {text.get_text(): one for text, one in zip(key.get_texts(), key.legend_handles, strict=True)}
    lines = {str(line.get_label()): line for line in ax.lines}
    assert to_rgba(handles["filter"].get_color()) == to_rgba(lines["filter"].get_color()) == (1.0, 1.0, 1.0, 1.0)
    assert to_rgba(handles["start"].get_markerfacecolor()) == (0.0, 0.0, 0.0, 1.0)


def test_a_picture_is_opaque_and_white_in_the_corners(tmp_path, run: Run) -> None:
    with mpl.rc_context({"savefig.transparent": True, "figure.facecolor": "black", "savefig.facecolor": "black"}):
        save_figure(icrtool.figures.gnss_difference(run), tmp_path / "one", ("png",))
    with Image.open(tmp_path / "one.png") as picture:
        assert picture.convert("RGBA").getpixel((1, 1)) == (255, 255, 255, 255)
        assert picture.convert("RGBA").getextrema()[3] == (255, 255)
