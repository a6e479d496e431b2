"""The pictures of a dropout report: what they show."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from icrtool.dropout_analysis.example_trials import example_trials, worst_trials
from icrtool.dropout_analysis.forced_outages import force_outages, plan_outages
from icrtool.dropout_analysis.real_outages import real_outages
from icrtool.dropout_analysis.report import DropoutReport
from icrtool.dropout_analysis.trials import dropout, models_of
from icrtool.output.figure_catalogue import draw_figures
from icrtool.output.figures.dropout_errors import dropout_histogram, dropout_summary
from icrtool.output.figures.dropout_paths import dropout_examples, dropout_outages, dropout_worst
from icrtool.output.figures.style import style
from icrtool.records.dropout import Outage
from icrtool.records.run import Run

HORIZONS_M = [1.0, 2.0, 5.0, 10.0]


@pytest.fixture(scope="module")
def report(run: Run) -> DropoutReport:
    return dropout(run, HORIZONS_M)


@pytest.fixture(scope="module")
def outages(run: Run) -> tuple[Outage, ...]:
    return (*force_outages(run, plan_outages(run, 2.0)), *real_outages(run))


def figures(run: Run, report: DropoutReport, outages: tuple[Outage, ...]) -> dict[str, Callable[[], Figure]]:
    whole = replace(report, outages=outages, examples=example_trials(run, 5.0), worst=worst_trials(run, horizon_m=2.0))
    return {
        "summary": lambda: dropout_summary(whole),
        "histogram": lambda: dropout_histogram(whole, 5.0),
        "examples": lambda: dropout_examples(whole),
        "worst": lambda: dropout_worst(whole),
        "outages": lambda: dropout_outages(whole),
    }


NAMES = ["summary", "histogram", "examples", "worst", "outages"]


def drawn(draw: Callable[[], Figure]) -> Figure:
    with style():
        figure = draw()
        figure.canvas.draw()
    return figure


def texts_of(figure: Figure) -> list[str]:
    legends = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    return legends + [axes.get_title(loc) for axes in figure.axes for loc in ("left", "center", "right")]


@pytest.mark.parametrize("name", NAMES)
def test_axes_have_units_and_no_text_lies_on_another(
    name: str, run: Run, report: DropoutReport, outages: tuple[Outage, ...]
) -> None:
    figure = drawn(figures(run, report, outages)[name])
    labels = [axes.get_xlabel() for axes in figure.axes] + [axes.get_ylabel() for axes in figure.axes]
    labels += [text.get_text() for text in figure.texts]
    assert sum("[m]" in label for label in labels) >= 1
    assert sum("[" in label for label in labels) >= 2
    written = [text for text in figure.texts if text.get_text()]
    for axes in figure.axes:
        shown = [axes.title, axes._left_title, axes._right_title, axes.xaxis.label, axes.yaxis.label]
        written += [text for text in (*shown, *axes.texts) if axes.axison and text.get_text()]
    written += [text for legend in figure.legends for text in legend.get_texts()]
    # Text's own extent: that of an annotation holds the line to its point too.
    boxes = [(text.get_text(), Text.get_window_extent(text)) for text in written]
    for (one, box), (other, another) in combinations(boxes, 2):
        assert not box.overlaps(another), (one, other)
    width, height = figure.canvas.get_width_height()
    for text, box in boxes:
        assert box.x0 >= 0, text
        assert box.x1 <= width, text
        assert box.y0 >= 0, text
        assert box.y1 <= height, text


def test_the_summary_draws_the_numbers_of_both_models(report: DropoutReport, outages: tuple[Outage, ...]) -> None:
    figure = drawn(lambda: dropout_summary(replace(report, outages=outages)))
    lines = [line.get_ydata() for line in figure.axes[0].lines]
    for name in ("icr", "no_slip", "icr_final"):
        result = report.result(name)
        assert result is not None
        for values in (result.summary.p95, result.summary.expected):
            assert any(len(line) == len(values) and np.array_equal(line, values) for line in lines)
    assert any(len(line) == 1 and line[0] == outages[-1].end_error_m for line in lines)
    assert {"ICR, 95 %", "ICR, expected", "no slip, 95 %", "no slip, expected", "real outage"} <= set(texts_of(figure))


def test_a_flattened_icr_curve_gets_a_panel_of_its_own(report: DropoutReport) -> None:
    icr, no_slip = report.results[0], report.results[1]
    near = replace(report, results=(icr, no_slip._replace(summary=icr.summary)))
    far = replace(report, results=(icr, no_slip._replace(summary=icr.summary._replace(p95=10 * icr.summary.p95))))
    assert [len(drawn(lambda one=one: dropout_summary(one)).axes) for one in (near, far)] == [1, 2]


def test_a_histogram_marks_expected_value_and_95_percent_in_lines_and_words(report: DropoutReport) -> None:
    figure = drawn(lambda: dropout_histogram(report, 5.0))
    for axes, name in zip(figure.axes, ("icr", "no_slip"), strict=True):
        result = report.result(name)
        assert result is not None
        places = {float(line.get_xdata()[0]) for line in axes.lines}
        assert places == {float(result.summary.p95[2]), float(result.summary.expected[2])}
        assert "95 % within" in axes.get_title("right")
        assert "expected" in axes.get_title("right")


def test_a_histogram_needs_no_other_models_than_it_says(run: Run) -> None:
    models = [model for model in models_of(run) if model.name in ("icr", "no_slip")]
    assert len(drawn(lambda: dropout_histogram(dropout(run, [5.0], models=models), 5.0)).axes) == 2


def test_pictures_stand_without_the_no_slip_model(make_run: Callable[..., Run]) -> None:
    run = make_run(track_width_m=None, troubles=False)
    without = figures(run, dropout(run, HORIZONS_M), ())
    for name in ("summary", "histogram", "examples", "worst"):
        draw = without[name]
        assert "no slip" not in " ".join(texts_of(drawn(draw)))


def test_a_report_draws_what_it_holds(
    run: Run, report: DropoutReport, outages: tuple[Outage, ...], tmp_path: Path
) -> None:
    whole = replace(report, examples=example_trials(run, 15.0), worst=worst_trials(run), outages=outages)
    draw_figures("report", whole, tmp_path, ("png", "svg"))
    names = {path.stem for path in tmp_path.iterdir()}
    assert names == {"summary", "histogram_05m", "histogram_10m", "examples_15m", "worst", "outages"}
    assert len(list(tmp_path.iterdir())) == 2 * len(names)


def test_a_picture_that_cannot_be_written_is_named(report: DropoutReport, tmp_path: Path) -> None:
    (tmp_path / "histogram_05m.png").mkdir()
    with pytest.raises(OSError, match="histogram_05m"):
        draw_figures("report", report, tmp_path, ("png",))
