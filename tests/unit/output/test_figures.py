from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import matplotlib as mpl
import msgspec
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.text import Text

from icrtool.alignment.estimator import ResidualsByEstimate
from icrtool.calibration.error_growth import Forecast
from icrtool.estimation.odometry import drive_wheels, odometry_icrs
from icrtool.kernels.filter_records import GATED
from icrtool.output.figure_catalogue import FIGURES
from icrtool.output.figures.calibrations import forecast_figure, residuals_figure, transfer
from icrtool.output.figures.filter_estimates import gnss_difference
from icrtool.output.figures.style import new_figure, save_figure, style
from icrtool.output.page.render import drawn_pictures
from icrtool.pipeline import fit
from icrtool.records.acceptance import CHOICE_HORIZON_M
from icrtool.records.calibration_document import (
    COMPARE_SCHEMA,
    ComparedGroup,
    ComparedPair,
    ErrorDifference,
    GroupComparison,
    TransferCell,
)
from icrtool.records.measurements import ReferenceJump
from icrtool.records.run import ICR_COLUMNS, Run
from support.barn import configured, simulate

BAD_FIXES = 4
NAMES = [name for name, entry in FIGURES.items() if entry.subject == "run"]
ESTIMATE_KEY = [
    "estimate", "its ±1σ", "10 %", "90 %: converged", "no slip (±b/2, 0)", "no usable GNSS", "whole drive ±1σ"
]  # fmt: skip
CELL = 1 / 700
"""Two points closer than this part of the view are one dot."""


DRAWN: dict[tuple[str, int], tuple[Figure, Run]] = {}


def drawn(name: str, run: Run) -> Figure:
    """Return a figure of a run with its texts laid out, drawn once; no test changes it."""
    if (name, id(run)) not in DRAWN:
        figure = FIGURES[name].draw(run)
        with style():
            figure.draw_without_rendering()
        DRAWN[name, id(run)] = figure, run  # a run that is kept keeps its id
    return DRAWN[name, id(run)][0]


def legend_texts(figure: Figure) -> list[str]:
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def line_labelled(axes: Axes, begin: str) -> np.ndarray:
    return next(np.column_stack(line.get_data()) for line in axes.lines if str(line.get_label()).startswith(begin))


@pytest.mark.parametrize("name", NAMES)
def test_every_axis_has_a_name_and_a_unit(name: str, run: Run) -> None:
    figure = drawn(name, run)
    lowest_row = [axes for axes in figure.axes if axes.get_subplotspec().is_last_row()]
    first_column = [axes for axes in figure.axes if axes.get_subplotspec().is_first_col()]
    for label in [axes.get_xlabel() for axes in lowest_row] + [axes.get_ylabel() for axes in first_column]:
        assert label.endswith(("[m]", "[s]", "[%]")), label
    assert figure.texts[1].get_text().startswith("barn  (segway-rmp400): ")


@pytest.mark.parametrize("name", NAMES)
def test_the_title_answers_with_the_number_of_the_summary(name: str, run: Run) -> None:
    icr, gnss = run.summary["icr"], run.summary["gnss"]
    ends = [end["end_error_m"] for end in run.summary["odometry"].values() if end is not None]
    numbers = {
        "trajectory": [f"{end:.1f} m" for end in ends],
        "icr_estimates": [f"{abs(value):.3f} m" for value in icr["final"].values()],
        "icr_clusters": [f"±{value:.3f} m" for value in icr["std"].values()],
        "gnss_difference": [f"{gnss['mean_difference_m']:.4f} m"],
    }[name]
    title = drawn(name, run).texts[0].get_text()
    assert len(numbers) > 0
    assert [number for number in numbers if number not in title] == []


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    "drive",
    [
        {},
        {"troubles": False, "track_width_m": None, "datum": False},
        {"speed_mps": 0.008, "turn_mps": 0.0, "duration_s": 20.0},
        {"duration_s": 1.0, "troubles": False},
        {"duration_s": 700.0},
    ],
    ids=["usual", "bare", "parked", "one second", "long"],
)
def test_no_text_leaves_the_picture_or_covers_another(
    name: str, drive: dict[str, object], make_run: Callable[..., Run]
) -> None:
    figure = drawn(name, make_run(**drive))
    boxes = [(text.get_text(), text.get_window_extent()) for text in texts_of(figure)]
    for text, box in boxes:
        assert figure.bbox.x0 <= box.x0, text
        assert figure.bbox.y0 <= box.y0, text
        assert box.x1 <= figure.bbox.x1, text
        assert box.y1 <= figure.bbox.y1, text
    for number, (text, box) in enumerate(boxes):
        for other, other_box in boxes[number + 1 :]:
            assert not box.padded(-1.0).overlaps(other_box.padded(-1.0)), f"{text!r} covers {other!r}"


def texts_of(figure: Figure) -> list[mpl.text.Text]:
    found = list(figure.texts)
    for legend in figure.legends:
        found += legend.get_texts()
    for axes in figure.axes:
        titles = [axes.title, axes._left_title, axes._right_title, axes.xaxis.label, axes.yaxis.label]
        low, high = sorted(axes.get_xlim()), sorted(axes.get_ylim())
        ticks = [tick.label1 for tick in axes.xaxis.get_major_ticks() if low[0] <= tick.get_loc() <= low[1]]
        ticks += [tick.label1 for tick in axes.yaxis.get_major_ticks() if high[0] <= tick.get_loc() <= high[1]]
        found += titles + [tick for tick in ticks if tick.get_visible()]
    return [text for text in found if text.get_text().strip()]


def test_trajectory_shows_fixes_filter_and_every_odometry_square(run: Run) -> None:
    figure = drawn("trajectory", run)
    (axes,) = figure.axes
    texts = legend_texts(figure)
    for begin in (
        "GNSS fixes",
        f"GNSS fixes, {BAD_FIXES} rejected",
        "filter",
        "ICR odometry, ends",
        "momentary-ICR odometry, ends",
        "no-slip odometry, ends",
        "start",
        "end",
    ):
        assert any(text.startswith(begin) for text in texts), begin
    assert axes.get_aspect() == 1.0
    view = max(np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim()))
    path = line_labelled(axes, "filter")
    assert np.allclose(path[[0, -1]], np.column_stack([run.table.east_m, run.table.north_m])[[0, -1]])
    path_end = drive_wheels(run.table, run.in_gap, odometry_icrs(run.table, None)["icr"])
    assert np.allclose(line_labelled(axes, "ICR odometry")[-1], [path_end.east_m[-1], path_end.north_m[-1]])
    for states, line in ((run.table.east_m, path[:, 0]), (run.table.north_m, path[:, 1])):
        assert abs(line.max() - states.max()) < CELL * view
        assert abs(line.min() - states.min()) < CELL * view
    assert len(line_labelled(axes, f"GNSS fixes, {BAD_FIXES} rejected")) > 0


def test_many_rejected_fixes_and_jumps_leave_the_path_in_sight(run: Run) -> None:
    jumps = tuple(
        ReferenceJump(
            kind="position", begin_ns=int(run.table.stamp_ns[row]), end_ns=int(run.table.stamp_ns[row]),
            north_m=float(run.table.north_m[row]), east_m=float(run.table.east_m[row]), size_m=0.01 * number,
            turn_deg=0.0, moved_north_m=0.0, moved_east_m=0.0, why="", undecided=False,
        )
        for number, row in enumerate(range(0, len(run.table), 10))
    )  # fmt: skip
    refused = np.full_like(run.gnss.code, GATED)
    outcome = replace(run.gnss, code=refused)
    (axes,) = drawn("trajectory", replace(run, gnss=outcome, sensors=replace(run.sensors, jumps=jumps))).axes
    assert len(line_labelled(axes, f"GNSS fixes, {len(refused)} rejected")) <= 60
    marked = line_labelled(axes, "jump, up to ")
    assert len(marked) == 5
    assert np.allclose(marked[0], [jumps[-1].east_m, jumps[-1].north_m])


def test_trajectory_without_width_has_no_no_slip_path(make_run: Callable[..., Run]) -> None:
    texts = legend_texts(drawn("trajectory", make_run(track_width_m=None, datum=False, troubles=False)))
    assert not any("no-slip" in text for text in texts)
    assert "position reference" in texts


def test_trajectory_far_from_the_origin_keeps_short_ticks(make_run: Callable[..., Run]) -> None:
    near = make_run(troubles=False, datum=False, duration_s=20.0)
    for column in (near.table.north_m, near.sensors.fixes.north_m):
        np.add(column, 5_412_300.0, out=column)
    (axes,) = drawn("trajectory", near).axes
    assert axes.get_ylabel() == "y [m]  + 5,412,000 m"
    assert axes.get_xlabel() == "x [m]"
    assert max(len(tick.get_text()) for tick in axes.get_yticklabels()) < 7


def test_odometry_that_leads_away_leaves_the_picture(make_run: Callable[..., Run]) -> None:
    run = make_run(duration_s=300.0, track_width_m=20.0, troubles=False)
    figure = drawn("trajectory", run)
    assert any(text.endswith("(out of view)") for text in legend_texts(figure))


def test_icr_estimates_show_bands_and_outage(run: Run) -> None:
    figure = drawn("icr_estimates", run)
    assert legend_texts(figure) == ESTIMATE_KEY
    rises = [axes.get_title(loc="left") for axes in figure.axes if axes.get_title(loc="left")]
    assert len(rises) == 3
    assert all(rise.startswith("10–90 % in ") for rise in rises)
    finals = [axes.get_title(loc="right") for axes in figure.axes if axes.get_title(loc="right")]
    assert finals[1].startswith("final −0.6")
    assert [axes.get_ylabel() for axes in figure.axes if axes.get_ylabel()] == [
        "ICR y right [m]", "ICR y left [m]", "ICR x [m]",
    ]  # fmt: skip


def test_icr_estimates_from_a_given_start_show_their_rises() -> None:
    config = configured()
    far = replace(
        config.filter, initial_y_icr_right_m=1.2, initial_y_icr_left_m=-1.2, initial_x_icr_m=0.5, initial_icr_std_m=1.0
    )
    run = fit(simulate(), replace(config, filter=far))
    figure = drawn("icr_estimates", run)
    assert legend_texts(figure) == ESTIMATE_KEY
    rises = [axes.get_title(loc="left") for axes in figure.axes if axes.get_title(loc="left")]
    convergence = run.summary["icr"]["convergence_s"]
    assert rises == [
        f"10–90 % in {convergence[column]:.1f} s" for column in ("y_icr_right_m", "y_icr_left_m", "x_icr_m")
    ]


def test_icr_clusters_add_up_to_all_of_the_time(run: Run) -> None:
    figure = drawn("icr_clusters", run)
    for axes in figure.axes:
        (filled,) = axes.collections
        x, y = filled.get_paths()[0].vertices.T
        widths = np.diff(np.unique(x))
        area = abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2.0
        assert 98.0 < area / widths.mean() < 100.0 + 1e-6
        assert axes.get_ylim()[0] == 0.0
    assert figure.axes[0].get_title().splitlines()[1] == "no slip: −0.300 m"


def test_gnss_difference_marks_rejected_fixes_and_breaks_at_the_outage(run: Run) -> None:
    figure = drawn("gnss_difference", run)
    (axes,) = figure.axes
    texts = legend_texts(figure)
    assert f"{BAD_FIXES} rejected, above" in texts
    assert any(text.startswith("mean ") for text in texts)
    assert "no usable GNSS" in texts
    line = line_labelled(axes, "used, max")
    assert np.isnan(line[:, 1]).sum() == 1
    assert np.nanmax(line[:, 1]) == run.summary["gnss"]["max_difference_m"]
    assert axes.get_ylim()[1] < 0.2
    assert axes.get_xlim() == (0.0, run.table.t_s[-1])
    assert axes.get_xlabel() == "Time [s]"


def test_line_styles_differ_in_grey() -> None:
    from icrtool.output.figures.style import FILTER, FIX_COLOR, ICR, NO_SLIP_LINE

    grey = [
        float(np.dot(mpl.colors.to_rgb(color), (0.299, 0.587, 0.114)))
        for color in (FILTER["color"], ICR["color"], NO_SLIP_LINE["color"], FIX_COLOR)
    ]
    assert min(np.diff(sorted(grey))) > 0.09
    assert len({str(pen["linestyle"]) for pen in (FILTER, ICR, NO_SLIP_LINE)}) == 3


def test_the_picture_of_a_comparison_shows_errors_and_differences_with_their_intervals() -> None:
    names = ["grass", "a very long name of a group", "asphalt"]
    cells = [
        TransferCell(CHOICE_HORIZON_M, 0.4 if row == column else 0.9, 0.1, 1.2, 0.3, 0.2, 0.4, calibrated_on=row,
                     tested_on=column, trials=3)
        for row in names for column in names
    ]  # fmt: skip
    differences = [(1.0, 0.05, -0.1, 0.2), (CHOICE_HORIZON_M, 0.31, 0.12, 0.5), (20.0, 0.7, None, None)]
    errors = tuple(
        ErrorDifference(h, p95, low, high, p95, low, high, paired=False) for h, p95, low, high in differences
    )
    found = GroupComparison(
        schema=COMPARE_SCHEMA, tool_version="", groups=dict.fromkeys(names, ComparedGroup("icr", (), {})),
        pairs=(ComparedPair("grass", "asphalt", (), errors, ""),), transfer=tuple(cells),
        costs=tuple(one for one in cells if one.p95_m == 0.9),
    )  # fmt: skip
    figure = transfer(found)
    figure.draw_without_rendering()
    assert figure.texts[0].get_text() == "asphalt: +0.31 m against grass at 10 m (+0.12 to +0.50)"
    own, more = figure.axes
    assert [text.get_text() for text in own.get_yticklabels()][:2] == [
        "grass, own calibration",
        "grass, by a ver… group's calibration",
    ]
    drawn_at = {text.get_text(): row for row, text in enumerate(more.get_yticklabels())}
    assert len(drawn_at) == len(differences) + 6
    for horizon_m, p95, low, high in differences:
        row = drawn_at[f"asphalt − grass, {horizon_m:g} m"]
        assert any(row in line.get_ydata() and p95 in line.get_xdata() for line in more.lines)
        bars = [path.vertices[:, 0].tolist() for bar in more.collections for path in bar.get_paths()
                if row in path.vertices[:, 1]]  # fmt: skip
        assert [np.round(bar, 9).tolist() for bar in bars] == ([] if low is None else [[low, high]])
    assert legend_texts(figure) == ["with 95 % interval", "no interval: too little path", "may be chance: holds 0"]
    written = [*figure.texts, *own.get_yticklabels(), *more.get_yticklabels()]
    boxes = [(one.get_text(), one.get_window_extent()) for one in written]
    for number, (text, box) in enumerate(boxes):
        assert figure.bbox.contains(*box.min), text
        for other, other_box in boxes[number + 1 :]:
            assert not box.overlaps(other_box), f"{text!r} covers {other!r}"
    same = found.pairs[0].errors[0]
    chance = transfer(
        msgspec.structs.replace(
            found,
            pairs=(ComparedPair("grass", "asphalt", (), (msgspec.structs.replace(same, horizon_m=10.0),), ""),),
        )
    )
    assert chance.texts[0].get_text() == "No difference shown at 10 m: +0.05 m (−0.10 to +0.20)"


def test_the_band_of_an_estimate_ends_at_the_sigma_of_the_text(run: Run) -> None:
    panels = [axes for axes in drawn("icr_estimates", run).axes if axes.get_title(loc="right")]
    for axes, column in zip(panels, ICR_COLUMNS, strict=True):
        (band,) = (one for one in axes.collections if one.get_label() == "its ±1σ")
        vertices = band.get_paths()[0].vertices
        end = vertices[vertices[:, 0] == run.table.t_s[-1]][:, 1]
        final, std = run.document.icr.final[column], run.document.icr.final_std[column]
        assert end.max() - final == pytest.approx(std, rel=1e-9)
        assert final - end.min() == pytest.approx(std, rel=1e-9)
        value, reach = run.document.icr_of_drive(column)
        (bar,) = (one for one in axes.containers if one.get_label() == "whole drive ±1σ")
        ends = bar.lines[2][0].get_segments()[0][:, 1]
        assert ends.tolist() == pytest.approx([value - reach, value + reach])


def test_a_local_frame_has_x_and_y_and_no_gnss(make_run: Callable[..., Run]) -> None:
    local = make_run(datum=False)
    (axes,) = drawn("trajectory", local).axes
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x [m]", "y [m]")
    shown = [text.get_text() for name in NAMES for text in texts_of(drawn(name, local))]
    assert "no usable position" in shown
    assert [text for text in shown if any(word in text for word in ("GNSS", "North", "East"))] == []


def test_the_path_has_no_boxes_behind_the_times_and_no_time_covers_it(run: Run) -> None:
    (axes,) = drawn("trajectory", run).axes
    times = [text for text in axes.texts if text.get_text().endswith(" s")]
    assert len(times) > 3
    path = axes.transData.transform(np.column_stack([run.table.east_m, run.table.north_m]))
    for text in times:
        assert text.get_bbox_patch() is None
        box = Text.get_window_extent(text)
        assert not ((path > box.min) & (path < box.max)).all(axis=1).any(), text


def test_a_drive_that_shows_no_icrs_says_so_in_the_title(make_run: Callable[..., Run]) -> None:
    parked = make_run(speed_mps=0.008, turn_mps=0.0, duration_s=20.0)
    assert drawn("icr_estimates", parked).texts[0].get_text().startswith("This drive does not show its ICRs: y right")


def test_a_users_settings_change_nothing(tmp_path, run: Run) -> None:
    save_figure(gnss_difference(run), tmp_path / "plain", ("png",))
    in_page = drawn_pictures([("gnss_difference", gnss_difference(run))])
    with mpl.rc_context({"font.size": 30.0, "axes.facecolor": "red", "savefig.dpi": 20, "text.usetex": True}):
        save_figure(gnss_difference(run), tmp_path / "set", ("png",))
        assert drawn_pictures([("gnss_difference", gnss_difference(run))]) == in_page
        assert mpl.rcParams["font.size"] == 30.0
    assert (tmp_path / "plain.png").read_bytes() == (tmp_path / "set.png").read_bytes()


def test_a_pdf_has_the_same_bytes_every_time(tmp_path, run: Run) -> None:
    for place in ("one", "two"):
        save_figure(gnss_difference(run), tmp_path / place, ("pdf",))
    assert (tmp_path / "one.pdf").read_bytes() == (tmp_path / "two.pdf").read_bytes()


def test_a_long_title_is_cut_in_its_middle() -> None:
    figure = new_figure("begin" + "x" * 200 + "end", "", width_in=7.2, height_in=3.0)
    title = figure.texts[0].get_text()
    assert title.startswith("begin")
    assert title.endswith("end")
    assert "…" in title
    assert figure.texts[0].get_window_extent().x1 < figure.bbox.x1


def test_the_circles_of_a_forecast_hold_its_95_percent_errors_at_round_distances() -> None:
    metres = np.arange(1.0, 61.0)
    forecast = Forecast(metres, metres, -metres, 0.01 * metres, 0.03 * metres, *np.tile(0.01 * metres, (3, 1)))
    grown, path = forecast_figure(forecast, "path", (0.5,), 50.0).axes
    filled = [one for one in path.patches if isinstance(one, Circle) and one.get_fill()]
    found = sorted((*map(float, one.center), float(one.radius)) for one in filled)
    assert found == [pytest.approx((metres, -metres, 0.03 * metres)) for metres in (10.0, 20.0, 30.0, 40.0, 50.0)]
    assert [text.get_text() for text in path.texts] == [
        "10 m: 0.300 m", "20 m: 0.600 m", "30 m: 0.900 m", "40 m: 1.20 m", "50 m: 1.50 m"
    ]  # fmt: skip
    # 0.5 m is reached at 0.5 / 0.03
    assert [text.get_text() for text in grown.texts] == ["16.7 m"]
    (beyond,) = grown.patches
    assert (beyond.get_x(), beyond.get_x() + beyond.get_width()) == (50.0, 60.0)


def test_residuals_are_drawn_as_shares_of_the_windows_and_by_heading_change() -> None:
    rng = np.random.default_rng(7)
    turn_rad = np.sort(rng.uniform(-1.0, 1.0, 80))
    before, after = rng.normal(0.0, 0.2, (2, 80)), rng.normal(0.0, 0.1, (2, 80))
    residuals = ResidualsByEstimate(before, after, 0.1 * turn_rad, 0.0 * turn_rad, turn_rad)
    place, heading, turn = residuals_figure("log", residuals).axes
    for line, part in zip(place.lines, (before, after), strict=True):
        sizes, shares = line.get_xdata(), line.get_ydata()
        assert np.interp(50.0, shares, sizes) == pytest.approx(np.median(np.hypot(*part)), rel=0.02)
    assert heading.lines[0].get_xdata()[-1] == pytest.approx(np.degrees(0.1 * np.abs(turn_rad).max()))
    slopes = [np.polyfit(line.get_xdata(), line.get_ydata(), 1)[0] for line in turn.lines[:2]]
    assert slopes == pytest.approx([0.1, 0.0], abs=1e-9)


def test_a_forecast_along_a_run_in_a_local_frame_has_x_and_y(make_run: Callable[..., Run]) -> None:
    metres = np.arange(1.0, 6.0)
    forecast = Forecast(metres, *np.tile(metres / 10.0, (7, 1)))
    for document, names in (
        (None, ("East [m]", "North [m]")),
        (make_run().document, ("East [m]", "North [m]")),
        (make_run(datum=False).document, ("x [m]", "y [m]")),
    ):
        path = forecast_figure(forecast, "path", (0.3,), 5.0, document=document).axes[1]
        assert (path.get_xlabel(), path.get_ylabel()) == names
