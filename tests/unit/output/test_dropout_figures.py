"""The pictures of a dropout report: what they show."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import msgspec
import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.text import Text

from icrtool.calibration.run_models import models_of
from icrtool.dropout_analysis.dropout_report import dropout
from icrtool.dropout_analysis.report import DropoutReport, budget_distances
from icrtool.dropout_analysis.shown_paths import (
    errors_by_start,
    example_trials,
    force_outages,
    plan_outages,
    real_outages,
    worst_trials,
)
from icrtool.output.figure_catalogue import draw_figures
from icrtool.output.figures import style as figure_style
from icrtool.output.figures.dropout_errors import dropout_histogram, dropout_histograms, dropout_summary
from icrtool.output.figures.dropout_paths import dropout_examples, dropout_map, dropout_outages, dropout_worst
from icrtool.output.figures.style import style
from icrtool.output.text_format import error_text
from icrtool.records.dropout_document import ModelResult, Outage
from icrtool.records.run import Run
from support.reports import with_content, with_models, with_numbers, with_outages

HORIZONS_M = [1.0, 2.0, 5.0, 10.0]


@pytest.fixture(scope="module")
def report(run: Run) -> DropoutReport:
    return dropout(run, HORIZONS_M)


@pytest.fixture(scope="module")
def outages(run: Run) -> tuple[Outage, ...]:
    return (*force_outages(run, plan_outages(run, 2.0)), *real_outages(run))


@pytest.fixture(scope="module")
def drawn_once(run: Run, report: DropoutReport, outages: tuple[Outage, ...]) -> Callable[[str], Figure]:
    """Draw a figure by its name, each once; no test changes it."""
    known = figures(run, report, outages)
    return functools.cache(lambda name: drawn(known[name]))


def figures(run: Run, report: DropoutReport, outages: tuple[Outage, ...]) -> dict[str, Callable[[], Figure]]:
    whole = replace(report, outages=outages, examples=example_trials(run, 5.0), worst=worst_trials(run, horizon_m=2.0))
    mapped = replace(whole, path_errors=errors_by_start(run, horizon_m=2.0).on_path)
    return {
        "summary": lambda: dropout_summary(whole),
        "histogram": lambda: dropout_histograms(with_rows(whole), 2.0, 5.0, 10.0),
        "histogram of all": lambda: dropout_histogram(with_rows(whole), 5.0),
        "summary of all": lambda: dropout_summary(with_rows(whole)),
        "examples": lambda: dropout_examples(whole),
        "worst": lambda: dropout_worst(whole),
        "outages": lambda: dropout_outages(whole),
        "map": lambda: dropout_map(mapped),
    }


NAMES = ["summary", "summary of all", "histogram", "histogram of all", "examples", "worst", "outages", "map"]


def drawn(draw: Callable[[], Figure]) -> Figure:
    with style():
        figure = draw()
        figure.draw_without_rendering()
    return figure


def texts_of(figure: Figure) -> list[str]:
    legends = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    return legends + [axes.get_title(loc) for axes in figure.axes for loc in ("left", "center", "right")]


@pytest.mark.parametrize("name", NAMES)
def test_axes_have_units_and_no_text_lies_on_another(name: str, drawn_once: Callable[[str], Figure]) -> None:
    figure = drawn_once(name)
    labels = [axes.get_xlabel() for axes in figure.axes] + [axes.get_ylabel() for axes in figure.axes]
    labels += [text.get_text() for text in figure.texts]
    # The cells of the worst trials have a bar of a length in place of ticks.
    labels += [f"[{axes.texts[-1].get_text().split()[-1]}]" for axes in figure.axes if name == "worst" and axes.axison]
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
    (axes,) = drawn(lambda: dropout_summary(with_outages(report, outages))).axes
    found = {str(line.get_label()): line.get_xydata().T for line in axes.lines}
    for name in ("icr", "no_slip"):
        result = report.result(name)
        assert result is not None
        for metric, values in (("95 %", result.column("p95_m")), ("mean", result.column("expected_error_m"))):
            if (name, metric) != ("no_slip", "mean"):
                assert np.allclose(np.interp(HORIZONS_M, *found[f"{name}, {metric}"]), values, rtol=0.02)
    assert found["real outage"][1].tolist() == [outages[-1].document.end_error_m]
    low, high = axes.get_ylim()
    assert low < min(outages[-1].document.end_error_m, float(report.results[0].column("expected_error_m")[0]))
    assert high > float(np.nanmax(report.results[1].column("p95_m")))


def test_a_small_outage_is_shown_on_a_part_of_the_path(report: DropoutReport, outages: tuple[Outage, ...]) -> None:
    path = report.reference_north_m, report.reference_east_m
    span_m = max(float(np.ptp(one)) for one in path)
    one = outages[0]
    assert max(float(np.ptp(one.north_m)), float(np.ptp(one.east_m))) < 0.3 * span_m
    for shown, small in (((one,), True), (outages, False)):
        figure = drawn(lambda shown=shown: dropout_outages(replace(report, outages=shown)))
        (axes,) = figure.axes
        view_m = [float(np.ptp(limits)) for limits in (axes.get_ylim(), axes.get_xlim())]
        for column, (low, high) in ((one.north_m, axes.get_ylim()), (one.east_m, axes.get_xlim())):
            assert low < float(column.min()) < float(column.max()) < high
        assert ("a part of the path" in figure.texts[1].get_text()) is small
        assert (max(view_m) < 0.9 * span_m) is small


def named(one: ModelResult, name: str, factor: float) -> ModelResult:
    keys = (
        "expected_error_m",
        "p50_m",
        "p95_m",
        "max_m",
        "expected_low_m",
        "expected_high_m",
        "p95_low_m",
        "p95_high_m",
    )
    return with_numbers(one, name, **{key: factor * one.column(key) for key in keys})


def with_rows(report: DropoutReport) -> DropoutReport:
    """Return the report with the rows of a comparison, and how far each of them stays within 0.1 m."""
    icr = report.results[0]
    rows = {"recommended": 0.6, "controller": 0.9, "recommended_gyro": 0.3, "calibration:season": 0.7}
    further = [named(icr, name, factor) for name, factor in rows.items()]
    whole = with_models(report, *report.results, *further)
    return with_content(whole, budgets=budget_distances(whole, 0.1))


def test_the_summary_marks_the_distances_that_the_report_states(report: DropoutReport) -> None:
    whole = with_rows(report)
    reaches = {one.model: one for one in whole.document.budgets}
    figure = drawn(lambda: dropout_summary(whole))
    written = [text.get_text() for text in figure.axes[0].texts]
    shown = ("recommended", "controller", "calibration:season")
    assert sorted(written) == sorted(f"{reaches[name].distance_m:.1f} m" for name in shown)
    first = reaches["calibration:season"]
    # the name of the row stands in the subtitle, as it does not fit into the title
    stated = f"Within 0.1 m (95 %) for {first.short_text}; next drive {first.next_text}"
    assert figure.texts[0].get_text() == stated
    marks = [line.get_xydata()[0].tolist() for line in figure.axes[0].lines if line.get_marker() == "o"]
    assert sorted(marks) == sorted([reaches[name].distance_m, 0.1] for name in shown)


def test_the_summary_has_a_handful_of_entries_and_none_of_the_tables_alone(
    report: DropoutReport, outages: tuple[Outage, ...]
) -> None:
    entries = texts_of(drawn(lambda: dropout_summary(with_outages(with_rows(report), outages))))
    entries = [text for text in entries if text]
    assert len(entries) <= 10
    assert not any(text.startswith(("icr", "recommended_gyro", "icr_final")) for text in entries)


def test_a_run_that_is_not_usable_is_named_so_in_the_title(report: DropoutReport) -> None:
    title = dropout_summary(with_content(replace(report, usable=False), budgets=())).texts[0].get_text()
    assert re.fullmatch(r"Do not use: [\d.]+ m off \(95 %\) after \d+ m", title)


def test_a_distance_beyond_all_trials_is_not_marked(report: DropoutReport) -> None:
    far = with_content(report, budgets=budget_distances(report, 1000.0))
    figure = drawn(lambda: dropout_summary(far))
    assert [text.get_text() for text in figure.axes[0].texts] == []
    assert "more than 10 m" in figure.texts[0].get_text()


def test_the_histogram_shows_the_first_row_at_three_distances_with_the_budget(report: DropoutReport) -> None:
    whole = with_rows(report)
    model = whole.result("calibration:season")
    assert model is not None
    figure = drawn(lambda: dropout_histograms(whole, 2.0, 5.0, 10.0))
    assert len(figure.axes) == 3
    for axes, h in zip(figure.axes, (1, 2, 3), strict=True):
        places = {float(line.get_xdata()[0]) for line in axes.lines}
        assert places == {float(model.column("p95_m")[h]), float(model.column("expected_error_m")[h]), 0.1}


def test_a_histogram_marks_expected_value_and_95_percent_in_lines_and_words(report: DropoutReport) -> None:
    figure = drawn(lambda: dropout_histogram(report, 5.0))
    for axes, name in zip(figure.axes, ("icr", "no_slip"), strict=True):
        result = report.result(name)
        assert result is not None
        places = {float(line.get_xdata()[0]) for line in axes.lines}
        assert places == {float(result.column("p95_m")[2]), float(result.column("expected_error_m")[2])}
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
        assert "no_slip" not in " ".join(texts_of(drawn(draw)))


def test_a_report_draws_what_it_holds(
    run: Run, report: DropoutReport, outages: tuple[Outage, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    examples = example_trials(run, 15.0)
    report = replace(report, path_errors=errors_by_start(run, horizon_m=2.0).on_path)
    whole = with_content(report, examples=tuple(one.document for one in examples))
    whole = with_outages(replace(whole, examples=examples, worst=worst_trials(run)), outages)
    draw_figures("report", whole, tmp_path, ("png", "svg"))
    names = {path.stem for path in tmp_path.iterdir()}
    assert names == {"summary", "histogram", "worst", "outages", "error_map"}
    assert len(list(tmp_path.iterdir())) == 2 * len(names)
    monkeypatch.setattr(figure_style, "picture_bytes", lambda figure, form: form.encode())  # the names alone
    draw_figures("report", whole, tmp_path, ("png",), "all")
    further = {path.stem for path in tmp_path.iterdir()} - names
    assert further == {"histogram_05m", "histogram_10m", "examples_15m"}


def test_a_picture_that_cannot_be_written_is_named(report: DropoutReport, tmp_path: Path) -> None:
    (tmp_path / "histogram.png").mkdir()
    with pytest.raises(OSError, match="histogram"):
        draw_figures("report", report, tmp_path, ("png",))


def test_an_outage_within_a_worst_trial_is_marked_there(
    run: Run, report: DropoutReport, outages: tuple[Outage, ...]
) -> None:
    worst = worst_trials(run, horizon_m=2.0)
    (real,) = (one for one in outages if one.document.kind == "real")
    t_s = worst[0].document.t_s
    meanwhile, before = (
        replace(real, document=msgspec.structs.replace(real.document, begin_s=begin, end_s=end))
        for begin, end in ((t_s, t_s + 0.1), (-2.0, -1.0))
    )
    for outage, marked in ((meanwhile, True), (before, False)):
        figure = drawn(lambda shown=outage: dropout_worst(replace(with_outages(report, (shown,)), worst=worst)))
        assert ("real outage" in {line.get_label() for line in figure.axes[1].lines}) is marked


def test_the_map_colours_each_place_by_the_error_of_the_trial_that_starts_there(
    run: Run, report: DropoutReport
) -> None:
    found, worst = errors_by_start(run, horizon_m=2.0), worst_trials(run, horizon_m=2.0)
    axes = drawn(lambda: dropout_map(replace(report, path_errors=found.on_path, worst=worst))).axes[0]
    (lines,) = (one for one in axes.collections if isinstance(one, LineCollection))
    states = np.column_stack([run.table.east_m, run.table.north_m])
    for segment, error in zip(lines.get_segments(), lines.get_array(), strict=True):
        apart_m = np.hypot(*(states - segment.mean(axis=0)).T)
        assert error in found.error_m[apart_m < 0.1]
    assert lines.get_array().max() == pytest.approx(worst[0].document.errors_m["icr"], rel=1e-9)
    (scale,) = axes.child_axes
    assert scale.get_ylabel() == "Error after 2 m from there [m]"
    grey = np.array([lines.cmap(step)[:3] for step in range(lines.cmap.N)]) @ (0.299, 0.587, 0.114)
    assert (np.diff(grey) < -0.03).all()
    assert f"1: {error_text(worst[0].document.errors_m['icr'])}" in [text.get_text() for text in axes.texts]


def test_only_one_row_has_bands_and_the_others_have_bars(report: DropoutReport) -> None:
    whole = with_rows(report)
    (axes,) = drawn(lambda: dropout_summary(whole)).axes
    first = whole.result("calibration:season")
    assert first is not None
    bands = {str(one.get_label()): one for one in axes.collections if one.get_label()[0] != "_"}
    colours = {tuple(np.round(one.get_facecolor()[0][:3], 6)) for one in bands.values()}
    assert set(bands) == {"its 95 % interval", "next drive, 9 of 10"}
    assert len(colours) == 1
    top = bands["its 95 % interval"].get_paths()[0].vertices
    for horizon_m, high in zip(HORIZONS_M, first.column("p95_high_m"), strict=True):
        if np.isfinite(high):
            assert top[np.isclose(top[:, 0], horizon_m)][:, 1].max() == pytest.approx(high)
    assert "other 95 % intervals" in texts_of(drawn(lambda: dropout_summary(whole)))


def test_lines_are_straight_between_the_horizons_of_the_scale(report: DropoutReport) -> None:
    whole = with_content(report, budgets=())
    (axes,) = drawn(lambda: dropout_summary(whole)).axes
    line = next(one for one in axes.lines if one.get_label() == "icr, 95 %")
    assert line.get_xdata().tolist() == HORIZONS_M


def test_a_band_that_ends_says_why(report: DropoutReport) -> None:
    def ended(column: str, at: int) -> str:
        numbers = {name: report.results[0].column(name).copy() for name in (column, "p95_low_m", "p95_high_m")}
        for one in numbers.values():
            one[at:] = np.nan
        short = with_models(report, with_numbers(report.results[0], "icr", **numbers), *report.results[1:])
        (axes,) = drawn(lambda: dropout_summary(with_content(short, budgets=()))).axes
        return " ".join(text.get_text().replace("\n", " ").replace("\xa0", " ") for text in axes.texts)

    assert ended("p95_high_m", 3) == "bands end at 5 m: too little path behind it for an interval"
    assert ended("p95_m", 3).startswith("no trials beyond 5 m: ")


@pytest.mark.parametrize("name", NAMES)
def test_no_title_is_cut(name: str, drawn_once: Callable[[str], Figure]) -> None:
    assert [text.get_text() for text in drawn_once(name).texts if "…" in text.get_text()] == []
