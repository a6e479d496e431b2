"""The pictures: what they show, and the process that draws them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from icrtool.dropout_analysis import trials as dropout_analysis
from icrtool.dropout_analysis.dropout_report import dropout_report
from icrtool.dropout_analysis.example_trials import example_trials, worst_trials
from icrtool.dropout_analysis.forced_outages import force_outages, plan_outages
from icrtool.dropout_analysis.real_outages import real_outages
from icrtool.dropout_analysis.report import DropoutReport
from icrtool.dropout_analysis.trials import dropout, models_of
from icrtool.output.figures import dropout_figures as pictures
from icrtool.output.figures.drawing_process import DrawingProcess
from icrtool.output.figures.dropout_errors import draw_histogram, draw_summary
from icrtool.output.figures.dropout_paths import draw_examples, draw_outages, draw_worst
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
    return {
        "summary": lambda: draw_summary("barn", replace(report, outages=outages)),
        "histogram": lambda: draw_histogram("barn", report, 5.0),
        "examples": lambda: draw_examples("barn", example_trials(run, 5.0)),
        "worst": lambda: draw_worst("barn", worst_trials(run, 2.0), run.table.north_m, run.table.east_m),
        "outages": lambda: draw_outages("barn", run.table.north_m, run.table.east_m, outages),
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
    figure = drawn(lambda: draw_summary("barn", replace(report, outages=outages)))
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
    assert [len(drawn(lambda one=one: draw_summary("barn", one)).axes) for one in (near, far)] == [1, 2]


def test_a_histogram_marks_expected_value_and_95_percent_in_lines_and_words(report: DropoutReport) -> None:
    figure = drawn(lambda: draw_histogram("barn", report, 5.0))
    for axes, name in zip(figure.axes, ("icr", "no_slip"), strict=True):
        result = report.result(name)
        assert result is not None
        places = {float(line.get_xdata()[0]) for line in axes.lines}
        assert places == {float(result.summary.p95[2]), float(result.summary.expected[2])}
        assert "95 % within" in axes.get_title("right")
        assert "expected" in axes.get_title("right")


def test_a_histogram_needs_no_other_models_than_it_says(run: Run) -> None:
    models = [model for model in models_of(run) if model.name in pictures.HISTOGRAM_MODELS]
    assert len(drawn(lambda: draw_histogram("barn", dropout(run, [5.0], models=models), 5.0)).axes) == 2


def test_pictures_stand_without_the_no_slip_model(make_run: Callable[..., Run]) -> None:
    run = make_run(track_width_m=None, troubles=False)
    report = dropout(run, HORIZONS_M)
    for draw in (
        lambda: draw_summary("barn", report),
        lambda: draw_histogram("barn", report, 5.0),
        lambda: draw_examples("barn", example_trials(run, 5.0)),
        lambda: draw_worst("barn", worst_trials(run, 5.0), run.table.north_m, run.table.east_m),
    ):
        assert "no slip" not in " ".join(texts_of(drawn(draw)))


@pytest.mark.parametrize("table_bytes", [1, 1 << 30])
def test_figures_are_drawn_once_and_as_soon_as_their_numbers_are_there(
    run: Run, monkeypatch: pytest.MonkeyPatch, table_bytes: int
) -> None:
    monkeypatch.setattr(dropout_analysis, "LARGEST_TABLE_BYTES", table_bytes)
    drawn: list[tuple[str, int]] = []
    models: list[int] = []

    def draw(_: object, name: str, *content: object) -> None:
        drawn.append((name, models[-1]))

    figures = pictures.ReportFigures(draw)

    def watch(report: DropoutReport) -> None:
        models.append(len(report.results))
        figures.draw_ready(report)

    figures.draw_rest(dropout_report(run, horizons_m=[5.0, 10.0], comparison=False, watch=watch))
    assert models == [0, 1, 2, 3]
    single = [("examples_15m", 0), ("worst", 0), ("outages", 0)]
    assert drawn == [*single, ("histogram_05m", 2), ("histogram_10m", 2), ("summary", 3)]


def test_drawing_needs_no_compiled_code() -> None:
    # What dropout-report loads before it starts the process that draws, and what that process loads.
    before = [
        "cli.dropout_report",
        "dropout_analysis.acceptance_limits",
        "output.stored_run",
        "output.atomic_file",
        "output.figures.drawing_process",
    ]
    loads = "; ".join(f"import icrtool.{module}" for module in before)
    code = (
        f"import sys, icrtool.output.figures.dropout_figures as d; {loads}; "
        "d.load_figures(); sys.exit('numba' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.skipif(sys.platform != "linux", reason="forks from a process with threads, as pytest's is, only there")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_the_second_process_draws_what_there_is(
    run: Run, report: DropoutReport, outages: tuple[Outage, ...], tmp_path: Path
) -> None:
    with DrawingProcess(("png", "svg")) as process, process.into(tmp_path / "plots") as draw:
        whole = replace(report, examples=example_trials(run, 15.0), worst=worst_trials(run), outages=outages)
        figures = pictures.ReportFigures(draw)
        figures.draw_ready(whole)
        figures.draw_rest(whole)
    names = {path.stem for path in (tmp_path / "plots").iterdir()}
    assert names == {"summary", "histogram_05m", "histogram_10m", "examples_15m", "worst", "outages"}
    assert len(list((tmp_path / "plots").iterdir())) == 2 * len(names)


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_what_goes_wrong_in_the_second_process_is_raised_here(report: DropoutReport, tmp_path: Path) -> None:
    (tmp_path / "plots" / "histogram_05m.png").mkdir(parents=True)

    def draw_all() -> None:
        with DrawingProcess(("png",)) as process, process.into(tmp_path / "plots") as draw:
            pictures.ReportFigures(draw).draw_ready(report)

    with pytest.raises(OSError, match="histogram_05m"):
        draw_all()


def test_without_formats_nothing_is_started_or_drawn(report: DropoutReport, tmp_path: Path) -> None:
    with DrawingProcess(()) as process, process.into(tmp_path / "plots") as draw:
        pictures.ReportFigures(draw).draw_ready(report)
    assert list(tmp_path.iterdir()) == []
