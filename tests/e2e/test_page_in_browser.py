"""Pages in a real browser: headless Chromium draws them, points, clicks and presses keys."""

from __future__ import annotations

import base64
import json
import re
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from icrtool.calibration.pooled import calibrate, predictor, recording_of, turning_recording_of
from icrtool.calibration.run_models import compare_models
from icrtool.dropout_analysis.dropout_report import dropout_report
from icrtool.dropout_analysis.report import DropoutReport
from icrtool.estimation.odometry import measured_headings
from icrtool.kernels.open_loop import open_loop_path
from icrtool.kernels.track import trial_ends
from icrtool.motion.models import MODELS, controller_model
from icrtool.motion.recording import Trials, cut_windows, predicted_path
from icrtool.motion.window_fit import own_constants
from icrtool.output.files.formats import json_bytes
from icrtool.output.page import drive_data
from icrtool.output.page.pages import comparison_page, fleet_page, run_page
from icrtool.output.page.render import pictures_of
from icrtool.pipeline import fit
from icrtool.records.calibration_document import GroupComparison
from icrtool.records.dropout_document import DropoutDocument
from icrtool.records.fleet_document import FleetDocument
from icrtool.records.run import Run, track_of
from icrtool.records.samples import GyroSamples
from icrtool.records.text import LogText
from support.barn import TRACK_WIDTH_M, configured, simulate
from support.browser import Browser, Page, browser, chromium
from support.documents import with_summary
from support.open_loop_vector import HELD_S, ICRS_M, PATH, V_LEFT_MPS, V_RIGHT_MPS
from support.recordings import table_errors

HOSTILE = "</script><script>window.hostile=1</script><img src=x onerror='window.hostile=1'>\"'"
DRAWN_AT_FIRST = ["recommended", "no_slip", "controller"]
LENGTHS_M = (5.0, 10.0, 20.0)
AXE = Path(sys.prefix) / "axe-core" / "axe.min.js"

pytestmark = pytest.mark.skipif(chromium() is None, reason="no Chromium on this machine (Debian: apt install chromium)")


@pytest.fixture(scope="module")
def run() -> Run:
    return fit(simulate(), configured())


@pytest.fixture(scope="module")
def report(run: Run) -> DropoutReport:
    return dropout_report(run)


@pytest.fixture(scope="module")
def file(run: Run, report: DropoutReport, tmp_path_factory: pytest.TempPathFactory) -> Path:
    # The smallest PNG: a pixel.
    pixel = base64.b64decode(
        "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
    )
    page = run_page(run, report.document, pictures_of([("trajectory", pixel), ("ladder", pixel)]))
    file = tmp_path_factory.mktemp("page") / "report.html"
    file.write_text(page, encoding="utf-8")
    return file


@pytest.fixture(scope="module")
def local_file(run: Run, report: DropoutReport, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of the same run, its position in a frame without datum."""
    file = tmp_path_factory.mktemp("local") / "report.html"
    file.write_text(run_page(with_summary(run, gnss={"datum": None}), report.document, {}), encoding="utf-8")
    return file


@pytest.fixture(scope="module")
def chrome(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


@pytest.fixture(scope="module")
def page(chrome: Browser, file: Path) -> Page:
    opened = chrome.page()
    opened.open(file)
    return opened


def centre(page: Page, selector: str) -> tuple[float, float]:
    """Bring an element into view, and return its middle."""
    page.front()
    page.evaluate(f"document.querySelector({selector!r}).scrollIntoView({{block: 'center', behavior: 'instant'}})")
    return tuple(
        page.evaluate(
            f"(b => [b.left + b.width / 2, b.top + b.height / 2])"
            f"(document.querySelector({selector!r}).getBoundingClientRect())"
        )
    )


def test_a_page_loads_without_complaint_and_asks_for_nothing(page: Page) -> None:
    assert page.complaints() == []
    assert page.requests() == []
    assert page.evaluate("document.querySelectorAll('.chart canvas').length") == 5
    assert page.evaluate("document.querySelectorAll('#map path').length") > 5


def test_nothing_is_wider_than_a_phone(chrome: Browser, file: Path) -> None:
    page = chrome.page(width=360, height=780)
    page.open(file)
    page.evaluate("document.getElementById('go').click()")
    assert page.evaluate("document.documentElement.scrollWidth") <= 360


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (390, 844)])
def test_the_first_screen_has_a_picture_and_no_cut_number(chrome: Browser, file: Path, width: int, height: int) -> None:
    page = chrome.page(width=width, height=height)
    page.open(file)
    visible = "[...document.querySelectorAll('.sketch svg')].filter((one) => one.getClientRects().length)"
    assert page.evaluate(f"{visible}[0].getBoundingClientRect().bottom") < height
    if width == 1280:
        assert page.evaluate("document.querySelector('.card.trust .big').getBoundingClientRect().bottom") < height
    table = "document.querySelector('.card.reach .scroll')"
    assert page.evaluate(f"{table}.scrollWidth - {table}.clientWidth") <= 0
    empty = (
        "[...document.querySelectorAll('.card')].filter((one) => !one.querySelector('p, ul, dl, table, svg')).length"
    )
    assert page.evaluate(empty) == 0


def test_a_button_copies_the_configuration(chrome: Browser, file: Path) -> None:
    page = chrome.page()
    page.open(file)
    shown = page.evaluate("document.querySelector('#controller pre').textContent")
    assert "wheel_separation_multiplier:" in shown
    # The clipboard of a headless browser is not the system's: what the page hands over is kept.
    page.evaluate("navigator.clipboard.writeText = (text) => { window.copied = text; return Promise.resolve(); }; null")
    page.click(*centre(page, "#controller button.copy"))
    assert page.evaluate("window.copied") == shown
    assert page.evaluate("document.querySelector('#controller button.copy').textContent") == "Copied"
    page.evaluate("navigator.clipboard.writeText = () => Promise.reject(new Error('forbidden')); null")
    page.evaluate("document.addEventListener('copy', () => { window.selected = String(getSelection()); }); null")
    page.click(*centre(page, "#controller button.copy"))
    assert page.evaluate("window.selected").strip() == shown.strip()


def test_the_configuration_is_not_cut(chrome: Browser, file: Path) -> None:
    for width in (1280, 390):
        page = chrome.page(width=width, height=800)
        page.open(file)
        assert (
            page.evaluate("(one => one.scrollWidth - one.clientWidth)(document.querySelector('#controller pre'))") <= 0
        )


def test_show_zooms_to_the_trial(chrome: Browser, file: Path) -> None:
    page = chrome.page()
    page.open(file)
    length = (
        "(p => Math.hypot(p[0][0] - p[1][0], p[0][1] - p[1][1]))([0, 50].map((row) => icrtoolPage.map().pixelsOf(row)))"
    )
    before = page.evaluate(length)
    page.evaluate("document.querySelector('.at-moment').click()")
    assert page.evaluate(length) > 1.2 * before


def test_the_policy_stops_what_a_page_would_load(chrome: Browser, file: Path) -> None:
    page = chrome.page()
    page.open(file)
    blocked = page.evaluate("fetch('data:,x').then(() => 'loaded', () => 'blocked')")
    assert blocked == "blocked"
    inject = (
        "document.body.append(Object.assign(document.createElement('script'), {textContent: 'window.injected = 1'}))"
    )
    page.evaluate(f"{inject}, null")
    assert page.evaluate("window.injected") is None


def test_pointing_at_a_chart_marks_the_moment_on_the_map(page: Page) -> None:
    x, y = centre(page, "#icrs .u-over")
    page.mouse("mouseMoved", x, y)
    moment = page.evaluate("icrtoolPage.data.series.t[icrtoolPage.moment()]")
    duration = page.evaluate("icrtoolPage.data.duration_s")
    assert moment == pytest.approx(duration / 2, abs=0.02 * duration)
    at = page.evaluate("document.getElementById('here').getAttribute('transform').match(/[\\d.]+/g).map(Number)")
    assert at == pytest.approx(page.evaluate("icrtoolPage.map().pixelsOf(icrtoolPage.moment())"), abs=0.5)
    left = page.evaluate("icrtoolPage.charts().charts.map((chart) => chart.posToVal(chart.cursor.left, 'x'))")
    assert left == pytest.approx([moment] * len(left), abs=0.02 * duration)


def test_pointing_at_the_map_marks_the_moment_in_the_charts(page: Page) -> None:
    row = page.evaluate("icrtoolPage.rowAt(0.7 * icrtoolPage.data.duration_s)")
    centre(page, "#map")
    x, y = page.evaluate(
        f"((p, b) => [p[0] + b.left, p[1] + b.top])(icrtoolPage.map().pixelsOf({row}), "
        "document.getElementById('map').getBoundingClientRect())"
    )
    page.mouse("mouseMoved", x, y)
    moment = page.evaluate("icrtoolPage.data.series.t[icrtoolPage.moment()]")
    left = page.evaluate("icrtoolPage.charts().charts.map((chart) => chart.posToVal(chart.cursor.left, 'x'))")
    assert left == pytest.approx([moment] * len(left), abs=0.5)
    # The nearest point of the drive, whichever time the robot passed there.
    place = page.evaluate("icrtoolPage.map().pixelsOf(icrtoolPage.moment())")
    assert place == pytest.approx(page.evaluate(f"icrtoolPage.map().pixelsOf({row})"), abs=3.0)


def test_a_click_on_the_map_draws_three_paths_and_lists_all_errors(chrome: Browser, file: Path) -> None:
    page = chrome.page()
    page.open(file)
    centre(page, "#map")
    x, y = page.evaluate(
        "((p, b) => [p[0] + b.left, p[1] + b.top])(icrtoolPage.map().pixelsOf(icrtoolPage.rowAt(20)), "
        "document.getElementById('map').getBoundingClientRect())"
    )
    page.click(x, y)
    rows = page.evaluate("[...document.querySelectorAll('#loop tbody tr')].map((row) => row.textContent)")
    assert len(rows) == page.evaluate("icrtoolPage.data.models.length") > 4
    assert all(re.search(r"\d m", row) for row in rows)
    boxes = "[...document.querySelectorAll('#loop tbody tr')].filter((row) => row.querySelector('input').checked)"
    drawn = page.evaluate(f"{boxes}.map((row) => row.textContent.trim().split(/ ?[\\d]/)[0])")
    turned = [name for name in drawn if name in ("recommended_gyro", "recommended_heading")]
    assert drawn == ["controller", "recommended", *turned, "no_slip"]
    assert page.complaints() == []


def test_the_paths_of_a_page_end_where_those_of_the_library_do(page: Page, run: Run, report: DropoutReport) -> None:
    drive, table, b = track_of(run), run.table, TRACK_WIDTH_M
    ends = trial_ends(drive, np.array(LENGTHS_M))
    starts = np.flatnonzero((ends >= 0).all(axis=1))
    starts = starts[:: len(starts) // 8]
    assert report.calibration is not None
    trials = Trials(starts, ends[starts])
    along = {"recommended": predictor(report.calibration, recording_of(run))(trials).position}
    compared = compare_models(run, measured_headings(run))
    assert compared.heading == "heading"
    turned = turning_recording_of(run, "heading")
    for row, of in (
        ("controller", "five"), ("controller_heading", "five_gyro"), ("recommended_heading", "recommended_gyro"),
    ):  # fmt: skip
        fitted = compared.table.fits[of].fitted
        own = own_constants(cut_windows(turned), fitted, turned.width_m)
        if of.startswith("five"):
            fitted = controller_model(fitted, turned.lever, turned.width_m)
        along[row] = table_errors(turned, trials, predicted_path(turned, fitted, own))
    final = (table.y_icr_right_m[-1], table.y_icr_left_m[-1], table.x_icr_m[-1])
    # Every state of so short a drive is a row of the series.
    assert page.evaluate("icrtoolPage.data.series.step.length") == len(table)
    for number, start in enumerate(starts.tolist()):
        found = page.evaluate(f"icrtoolPage.openLoop({start}).models.map(({{name, errors}}) => [name, errors])")
        errors = dict(found)
        momentary = (table.y_icr_right_m[start], table.y_icr_left_m[start], table.x_icr_m[start])
        for name, icrs in (("icr", momentary), ("no_slip", (b / 2, -b / 2, 0.0)), ("icr_final", final)):
            for h, end in enumerate(ends[start].tolist()):
                path = open_loop_path(drive, *icrs, start, end)
                error = np.hypot(path.north[-1] - drive.north[end], path.east[-1] - drive.east[end])
                # Micrometres of rounding in each column, seven digits in the first heading; the heading of an odometry
                # turns within a gap, so that its 16 bits are 2e-5 rad: 0.2 mm over 20 m.
                assert errors[name][h] == pytest.approx(error, abs=1e-4 if name == "icr" else 3e-4), (name, start, h)
        for name, of_model in along.items():
            assert errors[name] == pytest.approx(of_model[number].tolist(), abs=1e-4), (name, start)


def test_the_script_of_a_page_drives_the_shared_vector_to_its_end(page: Page) -> None:
    left, right = (np.append(0.0, np.cumsum(HELD_S * speed)[:-1]).tolist() for speed in (V_LEFT_MPS, V_RIGHT_MPS))
    nowhere = [0.0] * len(PATH)
    steps = {"left": left, "right": right, "joined": 1, "distance": list(range(len(PATH))), "gaps": [],
             "north": nowhere, "east": nowhere, "without_reference": []}  # fmt: skip
    series = {"step": [0], "heading": [PATH[0, 2]], "y_right": [ICRS_M[0]], "y_left": [ICRS_M[1]], "x": [ICRS_M[2]]}
    data = json.dumps({"steps": steps, "series": series, "models": [{"name": "icr"}], "paths": {}})
    lengths = list(range(1, len(PATH)))
    [model] = page.evaluate(f"icrtoolOpenLoop.drive({data}, 0, {lengths}).models")
    moved = PATH[1:, :2] - PATH[0, :2]
    assert model["errors"] == pytest.approx(np.hypot(*moved.T).tolist(), abs=1e-12)
    ends = page.evaluate(
        f"(({{north, east}}) => [...north].map((n, k) => [n, east[k]]))"
        f"(icrtoolOpenLoop.drive({data}, 0, {lengths}).models[0].path)"
    )
    assert np.array(ends) == pytest.approx(PATH[:, :2] - PATH[0, :2], abs=1e-12)


def test_paths_of_joined_samples_are_close_to_those_of_the_library(
    chrome: Browser, run: Run, report: DropoutReport, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drive_data, "MOST_PAGE_STEPS", 1000)
    file = tmp_path / "joined.html"
    file.write_text(run_page(run, report.document, {}), encoding="utf-8")
    page = chrome.page()
    page.open(file)
    joined = page.evaluate("icrtoolPage.data.steps.joined")
    assert joined == 3
    drive, table = track_of(run), run.table
    ends = trial_ends(drive, np.array(LENGTHS_M))
    for step in (50, 150, 300):
        start = step * joined
        found = page.evaluate(f"icrtoolPage.openLoop(icrtoolPage.data.series.step.indexOf({step})).models")
        errors = {one["name"]: one["errors"] for one in found}
        icrs = (table.y_icr_right_m[start], table.y_icr_left_m[start], table.x_icr_m[start])
        for h, end in enumerate(ends[start].tolist()):
            if end < 0:
                assert errors["icr"][h] is None
                continue
            path = open_loop_path(drive, *icrs, start, end)
            error = np.hypot(path.north[-1] - drive.north[end], path.east[-1] - drive.east[end])
            # The trial ends up to two samples later, some centimetres on.
            assert errors["icr"][h] == pytest.approx(error, abs=0.01 + 0.02 * error), (start, h)


def test_paths_of_calibrations_with_and_without_the_gyro_end_where_those_of_the_library_do(
    chrome: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = simulate()
    turned = np.append(np.diff(np.unwrap(log.heading.heading_rad)), 0.0)
    stamps = log.heading.stamp_ns
    smooth = np.convolve(turned / np.append(np.diff(stamps), 1e9) * 1e9, np.ones(25) / 25, "same")
    run = fit(replace(log, gyro=GyroSamples(LogText("/imu/data"), stamps, smooth)), configured())
    calibration = calibrate(run)
    # With the constants of this log: those that are held change from start to start, and a page draws one path.
    report = dropout_report(run, horizons_m=LENGTHS_M, calibrations=[calibration], refit_sensors=True)
    names = {"calibration": False, "calibration_gyro": True}
    assert {one.name: one.with_gyro for one in report.document.calibrations} == names
    # Read back from JSON, as `icrtool report` does; so many paths that each has one point of three.
    monkeypatch.setattr(drive_data, "PATH_POINTS", 15_000)
    document = msgspec.convert(json.loads(json_bytes(report.document)), DropoutDocument)
    file = tmp_path / "calibrations.html"
    file.write_text(run_page(run, document, {}), encoding="utf-8")
    page = chrome.page()
    page.open(file)
    assert set(page.evaluate("Object.values(icrtoolPage.data.paths).map((one) => one.every)")) == {2}
    assert report.document.ladder.models
    recording = turning_recording_of(run)
    drawn = set(page.evaluate("icrtoolPage.data.models.map((one) => one.name)"))
    assert {"recommended", "recommended_gyro", "controller", "controller_gyro", "no_slip", "icr"} <= drawn
    ends = trial_ends(track_of(run), np.array(LENGTHS_M))
    starts = np.flatnonzero((ends >= 0).all(axis=1))[::300]
    trials = Trials(starts, ends[starts])
    for name, with_gyro in names.items():
        expected = predictor(calibration, recording, with_gyro=with_gyro)(trials).position
        for start, errors in zip(starts.tolist(), expected.tolist(), strict=True):
            found = page.evaluate(f"icrtoolPage.openLoop({start}).models.find((one) => one.name === '{name}').errors")
            # Between its points a path is straight, and its heading at a start is known to some 0.0002 rad.
            assert found == pytest.approx(errors, abs=0.01), (name, start)
    assert page.complaints() == []


def test_the_chart_of_errors_draws_the_main_models_and_folds_the_others(chrome: Browser, file: Path) -> None:
    page = chrome.page()
    page.open(file)
    names = "[...document.querySelectorAll('#{} input:checked')].map((one) => one.closest('li').textContent.trim())"
    drawn = page.evaluate(names.format("error-keys"))
    turned = {f"{name}_{kind}" for name in ("adaptive", "recommended") for kind in ("gyro", "heading")}
    assert {*DRAWN_AT_FIRST, "adaptive"} <= {*drawn} <= {*DRAWN_AT_FIRST, "adaptive"} | turned
    assert page.evaluate(names.format("error-others")) == []
    assert drawn[0] == "controller"
    assert drawn[-1] == "no_slip"
    folded = page.evaluate("icrtoolPage.data.errors.models.filter((one) => !one.shown).map((one) => one.label)")
    others = "[...document.querySelectorAll('#error-others li')].map((one) => one.textContent.trim())"
    assert page.evaluate(others) == folded != []
    assert page.evaluate("document.getElementById('error-others').closest('details').open") is False
    page.evaluate("document.querySelector('#error-others input').click()")
    assert page.evaluate(names.format("error-others")) == folded[:1]
    assert page.complaints() == []


def test_one_row_has_its_interval_as_a_band_and_pointing_at_a_name_gives_another_its_own(
    chrome: Browser, file: Path, report: DropoutReport
) -> None:
    page = chrome.page()
    page.open(file)
    page.evaluate("window.made = icrtoolCharts.errorChart(icrtoolPage.data); null")
    assert report.document.best is not None
    assert page.evaluate("made.bands()") == [report.document.best.model]
    item = "[...document.querySelectorAll('#error-keys li')].find((one) => one.textContent.trim() === 'no_slip')"
    page.evaluate(f"{item}.dispatchEvent(new Event('pointerover', {{bubbles: true}}))")
    assert page.evaluate("made.bands()") == ["no_slip"]
    page.evaluate("window.compared = icrtoolCharts.errorChart({...icrtoolPage.data,"
                  " errors: {...icrtoolPage.data.errors, banded: undefined}}); null")  # fmt: skip
    assert len(page.evaluate("compared.bands()")) > 2
    assert page.complaints() == []


def test_the_map_of_a_local_frame_has_no_north(chrome: Browser, local_file: Path, file: Path) -> None:
    texts = "[...document.querySelectorAll('#map .name')].map((one) => one.textContent)"
    for path, names in ((file, ["east [m]", "north [m]"]), (local_file, ["x [m]", "y [m]"])):
        page = chrome.page()
        page.open(path)
        assert sorted(page.evaluate(texts)) == names


@pytest.mark.parametrize("scale", [0.0, 3.7e-4, 0.0954, 0.3, 1.0, 13.0, 950.0])
def test_the_chart_of_errors_takes_numbers_of_any_size(chrome: Browser, file: Path, scale: float) -> None:
    page = chrome.page()
    page.open(file)
    page.evaluate(
        f"icrtoolPage.data.errors.models.forEach((model) => ['p95', 'p95_low', 'p95_high'].forEach((key) => {{"
        f" model[key] = model[key].map((value) => value === null ? null : {scale} * value) }})), null"
    )
    page.evaluate("icrtoolCharts.errorChart(icrtoolPage.data), null")
    assert page.evaluate("new Promise((done) => setTimeout(() => done('drawn'), 50))") == "drawn"
    assert page.complaints() == []


def test_the_moment_follows_the_keyboard(page: Page) -> None:
    page.front()
    page.evaluate("document.getElementById('moment').focus()")
    page.key("End")
    assert page.evaluate("icrtoolPage.data.duration_s - icrtoolPage.data.series.t[icrtoolPage.moment()]") < 0.2
    page.evaluate("document.getElementById('moment').value = 10")
    page.evaluate("document.getElementById('moment').dispatchEvent(new Event('input')), null")
    page.key("ArrowRight")
    assert page.evaluate("icrtoolPage.data.series.t[icrtoolPage.moment()]") == pytest.approx(10.1, abs=0.06)
    page.evaluate("document.getElementById('go').focus()")
    page.key("Enter")
    assert page.evaluate("document.querySelector('#loop caption').textContent").startswith("Open loop from 0:10")


def test_hostile_names_stay_text(chrome: Browser, run: Run, report: DropoutReport, tmp_path: Path) -> None:
    streams = [{**one, "topic": HOSTILE, "why": HOSTILE} for one in run.summary["streams"]]
    hostile = with_summary(run, log=HOSTILE, warnings=[HOSTILE], streams=streams)
    made = report.document
    models = (*made.models, msgspec.structs.replace(made.models[0], name=f"calibration:{HOSTILE}", words=HOSTILE))
    document = msgspec.structs.replace(made, models=models)
    file = tmp_path / "hostile.html"
    file.write_text(run_page(hostile, document, {}), encoding="utf-8")
    page = chrome.page()
    page.open(file)
    page.evaluate("icrtoolPage.openLoop(100)")
    assert page.evaluate("window.hostile") is None
    assert page.evaluate("document.querySelector('h1').textContent").startswith(HOSTILE)
    assert page.evaluate("document.querySelector('#warnings li').textContent") == HOSTILE
    assert page.evaluate("document.querySelectorAll('img[src=x]').length") == 0
    assert page.complaints() == []


def test_without_scripts_pictures_and_tables_are_there(chrome: Browser, file: Path) -> None:
    page = chrome.page(scripts=False)
    page.open(file)
    visible = "[...document.querySelectorAll({})].map((one) => one.getClientRects().length > 0)"
    assert page.evaluate(visible.format("'.picture img'")) == [True]
    assert set(page.evaluate(visible.format("'.needs-js'"))) == {False}
    assert all(page.evaluate(visible.format("'#errors table, #worst table'")))


def test_print_shows_pictures_in_place_of_what_is_interactive(chrome: Browser, file: Path) -> None:
    page = chrome.page()
    page.open(file)
    page.send("Emulation.setEmulatedMedia", media="print")
    assert page.evaluate("document.querySelector('.twin').getClientRects().length") > 0
    assert page.evaluate("document.querySelector('.workbench').getClientRects().length") == 0


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.skipif(not AXE.is_file(), reason="axe-core is not there: make axe")
def test_a_checker_of_accessibility_finds_no_error(chrome: Browser, file: Path, tmp_path: Path, *, dark: bool) -> None:
    fleet, comparison = tmp_path / "fleet.html", tmp_path / "comparison.html"
    fleet.write_text(page_of_fleet(FLEET, tmp_path), encoding="utf-8")
    comparison.write_text(comparison_page(msgspec.convert(COMPARISON, GroupComparison), "c"), encoding="utf-8")
    # What is dark differs in its colours alone.
    rules = "{runOnly: ['color-contrast']}" if dark else "{}"
    for one in (file, fleet, comparison):
        page = chrome.page(dark=dark)
        page.open(one)
        page.evaluate("document.querySelectorAll('details').forEach((one) => { one.open = true })")
        page.evaluate("document.getElementById('go')?.click()")
        page.evaluate(AXE.read_text(encoding="utf-8") + "; null")
        what = "[one.id, one.nodes[0].html.slice(0, 200), one.nodes[0].failureSummary]"
        violations = page.evaluate(f"axe.run({rules}).then((found) => found.violations.map((one) => {what}))")
        assert violations == []


LOG = {
    "log": "b.bag", "run": "runs/b", "status": "done", "reason": "", "robot": "jackal", "group": "grass",
    "tags": ["dry"], "start_utc": "2024-05-01T10:00:00Z", "duration_s": 60.0, "distance_m": 90.0,
    "icr": {"y_icr_right_m": 0.4, "std_y_icr_right_m": 0.01}, "multiplier": 1.5, "multiplier_std": 0.1,
    "errors": {"icr_p95_10m_m": 0.9, "recommended_within_0.5m_m": 8.0}, "events": None, "warnings": 1, "verdicts": [],
}  # fmt: skip
FLEET = {
    "schema": "icrtool/fleet/1",
    "counts": {"done": 2, "failed": 1, "skipped": 0},
    "gates_failed": 0,
    "tool_version": "1",
    "logs": [
        LOG,
        {**LOG, "log": "a10.bag", "run": "runs/a10", "multiplier": 1.2, "group": "tarmac"},
        {**LOG, "log": HOSTILE, "run": "../../etc", "status": "failed", "reason": "no heading", "multiplier": None},
    ],
}


def page_of_fleet(document: dict[str, object], folder: Path) -> str:
    """The page of what a fleet.json holds."""
    return fleet_page(msgspec.convert(document, FleetDocument), folder)


CHANGE = {"p95_m": 0.1, "p95_low_m": None, "p95_high_m": None, "expected_m": 0.05, "expected_low_m": -0.1,
          "expected_high_m": 0.2}  # fmt: skip
NAMES = ("grass", HOSTILE)
LOGGED = {"path": "", "sha256": "", "distance_m": 90.0, "heading_offset_deg": 0.0, "wheels_delay_s": 0.0}
COMPARISON = {
    "schema": "icrtool/compare/1",
    "tool_version": "0",
    "groups": {name: {"model": "icr", "logs": [LOGGED | {"name": name}], "geometry": {}} for name in NAMES},
    "pairs": [
        {"first": "grass", "second": HOSTILE, "verdict": f"They differ: {HOSTILE}",
         "errors": [CHANGE | {"horizon_m": 10.0, "paired": False}],
         "parameters": [{"quantity": "y_icr_right_m", "first": 0.8, "second": -0.9, "difference": -1.7, "std": 0.1,
                         "significant": True}]}
    ],
    "transfer": [
        CHANGE | {"calibrated_on": one, "tested_on": other, "horizon_m": h, "p95_m": h / 20, "p95_low_m": h / 30,
                  "p95_high_m": h / 10, "trials": 9}
        for one in NAMES for other in NAMES for h in (5.0, 10.0, 20.0)
    ],
    "costs": [CHANGE | {"calibrated_on": "grass", "tested_on": HOSTILE, "horizon_m": 10.0}],
}  # fmt: skip


def test_the_chart_of_a_comparison_follows_the_group_and_the_measure(chrome: Browser, tmp_path: Path) -> None:
    file = tmp_path / "comparison.html"
    file.write_text(comparison_page(msgspec.convert(COMPARISON, GroupComparison), "c"), encoding="utf-8")
    page = chrome.page(width=360, height=780)
    page.open(file)
    labels = "[...document.querySelectorAll('#error-keys label')].map((one) => one.textContent.trim())"
    # the calibration of grass costs in the runs of the second group
    assert page.evaluate(labels) == ["calibration of grass", f"calibration of {HOSTILE} (held out)"]
    page.evaluate("document.getElementById('group').value = '0'")
    page.evaluate("document.getElementById('group').dispatchEvent(new Event('change')), null")
    assert page.evaluate(labels) == ["calibration of grass (held out)", f"calibration of {HOSTILE}"]
    page.evaluate("document.querySelector('input[value=expected]').click()")
    assert page.evaluate("document.querySelectorAll('#error-chart canvas').length") == 1
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    assert page.evaluate("window.hostile") is None
    assert page.complaints() == []
    bare = chrome.page(scripts=False)
    bare.open(file)
    assert bare.evaluate("document.querySelector('.picture img').getClientRects().length") == 1


def test_a_failed_log_is_a_line_on_a_phone(chrome: Browser, tmp_path: Path) -> None:
    file, reason = tmp_path / "report.html", "not a log; a log is an .mcap file, a ROS 1 .bag or a ROS 2 bag directory"
    failed = {**FLEET["logs"][2], "log": "c.bag", "reason": reason}
    file.write_text(page_of_fleet({**FLEET, "logs": [*FLEET["logs"][:2], failed]}, tmp_path), encoding="utf-8")
    page = chrome.page(width=390, height=844)
    page.open(file)
    good, bad = page.evaluate(
        "['tr:not(.bad)', 'tr.bad'].map((one) => document.querySelector(`#table tbody ${one}`).offsetHeight)"
    )
    assert bad <= 1.2 * good
    assert page.evaluate("document.querySelector('#table .reason').getBoundingClientRect().left") < 390
    assert page.evaluate("document.documentElement.scrollWidth") <= 390


def test_a_phone_shows_multiplier_and_distance_of_the_robot_without_scrolling(chrome: Browser, tmp_path: Path) -> None:
    file = tmp_path / "report.html"
    robot = {
        "robot": "husky-a200", "group": "", "logs": ["a", "b"], "left_out": [], "reason": "", "multiplier": 1.6691,
        "multiplier_std": 0.0108, "icrs_m": [0.8, -0.9, 0.0], "within_m": 14.2, "within_beyond": False,
    }  # fmt: skip
    # 0.3 m after 20 m, and 0.5 m before that at 8 m, and nowhere
    errors = LOG["errors"] | {"recommended_p95_20m_m": 0.3}
    name = "recommended_within_0.5m_m"
    far = {**LOG, "errors": errors | {name: 20.0}, "bounds": [name]}
    logs = [{**LOG, "usable": False, "status": "done"}, {**LOG, "errors": errors}, far]
    file.write_text(page_of_fleet({**FLEET, "logs": logs, "calibrations": [robot]}, tmp_path), encoding="utf-8")
    page = chrome.page(width=390, height=844)
    page.open(file)
    for text in ("1.669", "14.2"):
        right = "[...document.querySelectorAll('#robots td')].find((one) => one.textContent.includes('{}'))"
        assert page.evaluate(f"{right.format(text)}.getBoundingClientRect().right") <= 390
    cells = page.evaluate("[...document.querySelectorAll('#table td')].map((one) => one.textContent)")
    assert {"not usable", "8.0\u00a0m", ">\u00a020.0\u00a0m"} <= {one.replace("> ", ">\u00a0") for one in cells}
    assert "1 cannot" in page.evaluate("document.querySelector('header').textContent")


def test_the_table_of_the_robot_fills_its_row_and_names_model_and_file(chrome: Browser, tmp_path: Path) -> None:
    file = tmp_path / "report.html"
    robot = {
        "robot": "husky-a200", "group": "", "logs": ["a", "b"], "file": "calibrations/husky-a200.json",
        "recommended": "five", "multiplier": 1.6691, "multiplier_std": 0.0108, "icrs_m": [0.8, -0.9, 0.0],
        "within_m": 14.2,
    }  # fmt: skip
    alone = {"robot": "", "group": "", "logs": ["c"], "reason": "one log alone"}
    file.write_text(page_of_fleet({**FLEET, "calibrations": [robot, alone]}, tmp_path), encoding="utf-8")
    page = chrome.page(width=1280, height=800)
    page.open(file)
    share = "document.querySelector('#robots table').clientWidth / document.querySelector('#robots').clientWidth"
    assert page.evaluate(share) > 0.95
    assert page.evaluate("(one => one.scrollWidth - one.clientWidth)(document.querySelector('#robots .scroll'))") <= 0
    rows = page.evaluate(
        "[...document.querySelectorAll('#robots tr')].map((row) => [...row.cells].map((one) => one.textContent))"
    )
    assert rows[0][-2:] == ["motion model", "calibration file"]
    assert rows[1][-2:] == [MODELS["five"].label, "calibrations/husky-a200.json"]
    assert (rows[2][1], rows[2][-1]) == ("one log alone", "")


def test_the_table_of_a_fleet_has_date_duration_and_distance_without_scrolling(chrome: Browser, tmp_path: Path) -> None:
    file = tmp_path / "report.html"
    errors = {
        f"{row}_p95_10m_m": 10.25 for row in ("controller", "recommended", "adaptive", "icr", "vendor", "no_slip")
    }
    long = {**LOG, "log": "season/2024-05-01/field_north_of_the_barn.mcap", "errors": LOG["errors"] | errors}
    file.write_text(
        page_of_fleet({**FLEET, "logs": [long, {**long, "robot": "husky-a200"}]}, tmp_path), encoding="utf-8"
    )
    page = chrome.page(width=1280, height=800)
    page.open(file)
    visible = "[...document.querySelectorAll('#table thead th')].filter((one) => one.getClientRects().length)"
    heads = f"{visible}.map((one) => one.textContent)"
    shown = page.evaluate(heads)
    assert {"start", "duration", "distance", "error, recommended", "multiplier"} <= set(shown)
    assert "error, icr" not in shown
    assert page.evaluate(f"Math.max(...{visible}.map((one) => one.getBoundingClientRect().right))") <= 1280
    page.evaluate("document.getElementById('all-columns').click()")
    assert "error, icr" in page.evaluate(heads)


def test_a_log_of_a_fleet_is_a_block_on_a_phone_with_interval_and_next_drive(chrome: Browser, tmp_path: Path) -> None:
    file = tmp_path / "report.html"
    errors = {
        "recommended_p95_10m_m": 0.5, "recommended_p95_low_10m_m": 0.4, "recommended_p95_high_10m_m": 0.7,
        "recommended_within_0.5m_m": 10.0, "recommended_next_low_0.5m_m": 4.5,
    }  # fmt: skip
    logs = [{**LOG, "errors": errors}, {**LOG, "log": "c.bag", "errors": errors}]
    file.write_text(page_of_fleet({**FLEET, "logs": logs}, tmp_path), encoding="utf-8")
    for width, one_line in ((1280, True), (390, False)):
        page = chrome.page(width=width, height=844)
        page.open(file)
        box = "[...document.querySelectorAll('#table tbody td')].find((one) => one.textContent.startsWith('{}'))"
        texts = [page.evaluate(f"{box.format(text)}.textContent") for text in ("0.500", "≥")]
        assert [one.replace("\u2011", "-").replace("\xa0", " ") for one in texts] == ["0.500 m0.400-0.700 m", "≥ 4.5 m"]
        assert page.evaluate(f"{box.format('0.500')}.getBoundingClientRect().right") <= width
        tops = [page.evaluate(f"{box.format(text)}.getBoundingClientRect().top") for text in ("done", "0.500")]
        assert (tops[0] == tops[1]) is one_line
        assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_the_first_screen_of_a_comparison_has_errors_with_intervals_as_numbers_and_drawn(
    chrome: Browser, tmp_path: Path
) -> None:
    file = tmp_path / "comparison.html"
    file.write_text(comparison_page(msgspec.convert(COMPARISON, GroupComparison), "c"), encoding="utf-8")
    for width, height in ((1280, 800), (390, 844)):
        page = chrome.page(width=width, height=height)
        page.open(file)
        rows = "[...document.querySelectorAll('.card.reach tbody tr')].map((row) => row.textContent)"
        assert next(one.replace("\xa0", " ") for one in page.evaluate(rows)) == "grass0.50 m0.33 to 1.00 m"
        assert page.evaluate("document.querySelector('.of-groups').getBoundingClientRect().bottom") < height
        # 10 m: 0.333 to 1 m about 0.5 m, from zero on one scale
        low, x, high = page.evaluate(
            "(one => [one.querySelector('.worst').getBBox().x, +one.querySelector('circle').getAttribute('cx'),"
            " one.querySelector('.worst').getBBox().x + one.querySelector('.worst').getBBox().width])"
            "(document.querySelector('.of-groups'))"
        )
        assert ((x - low) / (high - x)) == pytest.approx((0.5 - 1 / 3) / 0.5, abs=0.01)


def test_the_table_of_a_fleet_sorts_and_filters(chrome: Browser, tmp_path: Path) -> None:
    (tmp_path / "runs" / "b").mkdir(parents=True)
    (tmp_path / "runs" / "b" / "report.html").touch()
    file = tmp_path / "report.html"
    file.write_text(page_of_fleet(FLEET, tmp_path), encoding="utf-8")
    page = chrome.page()
    page.open(file)
    names = "[...document.querySelectorAll('#table tbody tr:not([hidden]) th')].map((one) => one.textContent)"
    sort = "[...document.querySelectorAll('thead button')].find((one) => one.textContent === '{}').click()"
    page.evaluate(sort.format("multiplier"))
    assert page.evaluate(names) == ["a10.bag", "b.bag", HOSTILE]
    page.evaluate(sort.format("multiplier"))
    assert page.evaluate(names) == ["b.bag", "a10.bag", HOSTILE]
    page.evaluate("document.getElementById('words').value = 'TARMAC'")
    page.evaluate("document.getElementById('words').dispatchEvent(new Event('input')), null")
    assert page.evaluate(names) == ["a10.bag"]
    assert page.evaluate("document.getElementById('count').textContent") == "1 of 3 logs"
    links = page.evaluate("[...document.querySelectorAll('tbody a')].map((one) => one.getAttribute('href'))")
    assert links == ["./runs/b/report.html"]
    assert page.evaluate("window.hostile") is None
    assert page.complaints() == []
