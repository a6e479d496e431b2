"""The page of a run: what it holds, and what no text of a log can do to it."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pandas as pd
import pytest

from icrtool.dropout_analysis.dropout_report import dropout_report
from icrtool.dropout_analysis.report import DropoutReport
from icrtool.output.figures.filter_estimates import gnss_difference
from icrtool.output.page.drive_data import drive_data, pack_column, packed_levels, packed_sums
from icrtool.output.page.pages import draw_pictures, run_page, write_page
from icrtool.output.page.render import pictures_of
from icrtool.output.page.sketch import drive_sketch
from icrtool.output.tables.dropout import reach_rows, report_blocks
from icrtool.output.text_blocks import format_blocks
from icrtool.pipeline import fit
from icrtool.records.measurements import ReferenceJump
from icrtool.records.plain_data import plain_value
from icrtool.records.run import Run, track_of
from icrtool.records.run_document import EventDocument
from icrtool.records.tables import RobotLog
from support.barn import TRACK_WIDTH_M, configured, simulate
from support.documents import with_summary

HOSTILE_PART = "window.hostile=1"
VENDOR = Path(__file__).resolve().parents[4] / "icrtool" / "output" / "page" / "static" / "vendor"


class Elements(HTMLParser):
    """Collects elements, and the text outside of scripts and styles."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []
        self._inside = ""
        self.feed(page)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attributes)))
        self._inside = tag if tag in {"script", "style"} else ""

    def handle_endtag(self, tag: str) -> None:
        self._inside = ""

    def handle_data(self, data: str) -> None:
        if not self._inside:
            self.text.append(data)

    def named(self, name: str) -> list[dict[str, str | None]]:
        return [attributes for tag, attributes in self.tags if tag == name]


def data_of(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    return json.loads(found.group(1))


def numbers(column: dict[str, Any]) -> np.ndarray:
    raw = base64.b64decode(column["data"])
    if column["type"] == "sums":
        steps = np.frombuffer(raw, "<i2").astype(int)
        return column["first"] + np.concatenate([[0.0], np.cumsum(steps) * column["unit"]])
    if column["type"] == "levels":
        return np.frombuffer(raw, "<i2") * column["unit"]
    assert column["type"] == "f32"
    return np.frombuffer(raw, "<f4")


@pytest.fixture(scope="module")
def page(run: Run, report: DropoutReport) -> str:
    return run_page(run, report.document, pictures_of([("worst", b"\x89PNG")]))


def test_the_answer_is_that_of_the_report(page: str, run: Run, report: DropoutReport) -> None:
    text = " ".join("".join(Elements(page).text).split())
    reached = next(one for one in report.document.budgets if one.model == "recommended")
    assert f"{reached.distance_m:.1f} m" in text or f"more than {reached.distance_m:g} m" in text
    assert report.calibration is not None
    assert f"{report.calibration.controller.multiplier:.3f}" in text
    assert "No: an acceptance limit" in text.replace("May I trust it?No:", "No: ")
    assert f"{report.document.worst[0].errors_m['recommended']:.3f} m" in text


def test_page_and_terminal_state_the_same_distances(run: Run, report: DropoutReport) -> None:
    quiet = {"without_events_m": 20.0, "beyond_without_events": True}
    budgets = tuple(msgspec.structs.replace(one, **quiet) for one in report.document.budgets)
    event = EventDocument("skid", 1.0, 2.0, 10**9, 2 * 10**9, 0.0, 0.0, 0.1, 0.5, 1.0)
    document = msgspec.structs.replace(run.document, events=(event, event))
    stated = msgspec.structs.replace(report.document, budgets=budgets)
    brief = format_blocks(report_blocks(document, stated), verbose=False)
    text = "".join("".join(Elements(run_page(replace(run, document=document), stated, {})).text).split())
    rows, _ = reach_rows(stated, report.document.budgets[0].budget_m, 2)
    assert rows[-1][:2] == ("without its 2 slip events", "more than 20 m")
    lines = brief[brief.index("How far") :].splitlines()[2 : 2 + len(rows)]
    assert [[word for word in row if word] for row in rows] == [
        [word for word in re.split("  +", line.strip()) if word] for line in lines
    ]
    text = text.replace("\N{NON-BREAKING HYPHEN}", "-")
    assert all("".join(f"{label}{distance}{following}".split()) in text for label, distance, following, _ in rows)
    assert "without its" not in format_blocks(report_blocks(run.document, report.document), verbose=False)


def test_every_warning_stands_on_the_page(run: Run, report: DropoutReport) -> None:
    warned = with_summary(run, warnings=["the left wheel sings", "so does the right one"])
    text = "".join(Elements(run_page(warned, report.document, {})).text)
    assert "the left wheel sings" in text
    assert "2 warnings" in text


def test_a_worst_trial_in_which_the_reference_jumped_is_marked(run: Run, report: DropoutReport) -> None:
    at = report.document.worst[0].stamp_ns + 10**9
    jump = ReferenceJump("position", at, at + 10**8, 0.0, 0.0, 7.25, 0.0, 7.25, 0.0, "", undecided=True)
    jumping = with_summary(run, reference_jumps=[msgspec.structs.asdict(jump) | {"begin_s": 0.0, "end_s": 0.1}])
    found = [run_page(one, report.document, {}) for one in (run, jumping)]
    texts = [" ".join("".join(Elements(page).text).split()) for page in found]
    assert ["steps by 7.25 m" in text for text in texts] == [False, True]


def test_a_run_that_is_not_usable_begins_with_that(hostile_run: Run, report: DropoutReport) -> None:
    page = run_page(hostile_run, report.document, {})
    assert page.index("Do not use") < page.index("How far without GNSS")


def test_a_run_that_is_not_usable_does_not_say_that_it_learned(
    run: Run, hostile_run: Run, report: DropoutReport
) -> None:
    def header(one: Run) -> str:
        return run_page(one, report.document, {}).partition("<main")[0]

    assert "learned how the robot slips" in header(run)
    assert "could not be learned" in header(hostile_run)
    assert "icrtool learned" not in header(hostile_run)


def test_the_drawing_of_the_drive_marks_the_worst_trial(run: Run, report: DropoutReport) -> None:
    sketch = drive_sketch(run, report.document)
    worst = report.document.worst[0]
    rows = [int(np.argmin(np.abs(run.table.t_s - worst.t_s)))]
    rows.append(int(np.argmin(np.abs(run.table.distance_m - run.table.distance_m[rows[0]] - worst.horizon_m))))
    points = [np.array([text.split() for text in one[1:].split("L")], float) for one in (sketch.path, sketch.worst)]
    assert all(np.all(one >= 0.0) and np.all(one <= [sketch.width, sketch.height]) for one in points)
    # The length of the scale bar stands for its metres, also in the distance between the ends of the trial.
    metres = np.hypot(*(column[rows[1]] - column[rows[0]] for column in (run.table.north_m, run.table.east_m)))
    apart = np.hypot(*(points[1][-1] - points[1][0]))
    assert apart / sketch.bar * sketch.bar_m == pytest.approx(metres, abs=2.0 * sketch.bar_m / sketch.bar)
    assert sketch.bar_m in {0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0}


def test_a_run_with_too_few_turns_states_what_to_drive(run: Run, report: DropoutReport) -> None:
    excitation = run.summary["excitation"] | {"turned_right_deg": 0.0, "turned_left_deg": 9.0}
    straight = with_summary(run, usable=False, unusable_because="it turns too little", excitation=excitation)
    page = run_page(straight, report.document, {})
    assert "hardly any turns" in page[page.index("Do not use") : page.index("How far without GNSS")]


def test_a_spike_of_an_icr_does_not_flatten_the_others(run: Run, report: DropoutReport) -> None:
    x_icr_m = run.table.x_icr_m.copy()
    x_icr_m[len(x_icr_m) // 2] = 50.0
    spiked = replace(run, table=replace(run.table, x_icr_m=x_icr_m))
    scales = [data_of(run_page(one, report.document, {}))["icr_scale_m"] for one in (run, spiked)]
    assert scales[0] == scales[1]
    half_m = TRACK_WIDTH_M / 2
    assert scales[0][0] < -half_m < half_m < scales[0][1]


def test_the_numbers_of_the_drawings_are_those_of_the_run(page: str, run: Run) -> None:
    data, table = data_of(page), run.table
    step = numbers(data["series"]["step"]).astype(int)
    # 16 bits: a 32,000th of the longest step between two moments, and of the greatest speed.
    np.testing.assert_allclose(numbers(data["series"]["t"]), table.t_s[step], atol=1e-4)
    np.testing.assert_allclose(numbers(data["series"]["v_left"]), table.v_left_mps[step], atol=1e-4)
    np.testing.assert_allclose(numbers(data["series"]["y_right"]), table.y_icr_right_m[step], rtol=1e-6)
    north = numbers(data["steps"]["north"]) + data["origin"][0]
    np.testing.assert_allclose(north, table.north_m, atol=1e-5)
    # Over a gap, and until the reference is found again behind one, nothing is held.
    held = np.where(track_of(run).held[:-1] > 0.0, np.diff(table.t_s), 0.0)
    assert not held[run.in_gap[:-1]].any()
    driven = np.concatenate([[0.0], np.cumsum(held * table.v_left_mps[:-1])])
    # Half a unit of a 16-bit step, wherever on the drive.
    np.testing.assert_allclose(numbers(data["steps"]["left"]), driven, atol=1e-5)


def test_page_and_picture_of_the_fixes_have_one_scale_and_one_kind_of_breaks(page: str, run: Run) -> None:
    fixes = data_of(page)["fixes"]
    axes = gnss_difference(run).axes[0]
    assert fixes["top_m"] == pytest.approx(axes.get_ylim()[1])
    line = next(one for one in axes.lines if str(one.get_label()).startswith("used"))
    assert len(fixes["used"]["breaks_s"]) == np.count_nonzero(np.isnan(np.asarray(line.get_xdata(), float)))


def test_a_report_on_the_smoothed_trajectory_is_drawn_along_it() -> None:
    smoothed = fit(simulate(), configured(), smooth=True)
    assert smoothed.smoothed is not None
    found = dropout_report(smoothed, reference="smoothed", ladder=False)
    data = data_of(run_page(smoothed, found.document, {}))
    north = numbers(data["steps"]["north"]) + data["origin"][0]
    np.testing.assert_allclose(north, smoothed.smoothed.north_m, atol=1e-5)


def test_running_sums_do_not_gather_errors() -> None:
    rng = np.random.default_rng(16)
    column = np.cumsum(rng.normal(0.02, 0.01, 200_000))
    packed_column = plain_value(packed_sums(column))
    found, unit = numbers(packed_column), packed_column["unit"]
    assert np.abs(found - column).max() <= 0.5001 * unit
    assert unit < 3e-6


def test_columns_survive_their_packing() -> None:
    column = np.random.default_rng(16).normal(size=100)
    np.testing.assert_allclose(numbers(plain_value(pack_column(column))), column, rtol=1e-7)
    # Half of a 32,000th of the greatest.
    np.testing.assert_allclose(
        numbers(plain_value(packed_levels(column))), column, atol=0.51 / 32_000 * np.abs(column).max()
    )
    np.testing.assert_array_equal(numbers(plain_value(packed_sums(np.array([3, 4, 9]), unit=1))), [3, 4, 9])


def test_the_page_may_load_nothing_and_run_only_its_own_scripts(page: str) -> None:
    elements = Elements(page)
    policy = next(one["content"] for one in elements.named("meta") if one.get("http-equiv"))
    assert policy is not None
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    for tag, allowed in (("script", "script-src"), ("style", "style-src")):
        directive = next(part for part in policy.split("; ") if part.startswith(allowed))
        for content in re.findall(rf"<{tag}>(.*?)</{tag}>", page, re.DOTALL):
            digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
            assert f"'sha256-{digest}'" in directive
    for tag, attributes in elements.tags:
        assert "style" not in attributes, tag
        assert not [name for name in attributes if name.startswith("on")], tag
        for name in ("src", "href"):
            assert (attributes.get(name) or "#").startswith(("#", "data:", "geo:")), (tag, attributes)


def test_text_of_a_log_stays_text(hostile_run: Run, report: DropoutReport) -> None:
    page = run_page(hostile_run, report.document, {})
    elements = Elements(page)
    assert HOSTILE_PART in "".join(elements.text)
    assert not [one for one in elements.named("img") if one.get("src") == "x"]
    assert "\u202e" not in page
    for content in re.findall(r"<script[^>]*>(.*?)</script>", page, re.DOTALL):
        assert HOSTILE_PART not in content


def test_json_in_a_page_cannot_end_its_element(page: str, run: Run, report: DropoutReport) -> None:
    made = report.document
    named = msgspec.structs.replace(made.models[0], name="calibration:</script><b>&")
    document = msgspec.structs.replace(made, models=(named, *made.models))
    found = run_page(run, document, {})
    assert data_of(found)["errors"]["models"][0]["label"] == "calibration:</script><b>&"
    assert "</script><b>" not in found


def test_without_coordinates_no_place_is_on_the_page(run: Run, report: DropoutReport) -> None:
    cause = "magnetic declination here is -87.65°"
    placed = with_summary(
        run,
        gnss={"datum": [40.123456, -77.654321, 312.5]},
        heading={"magnetic_declination_deg": -87.6543, "offset_name": cause},
        config={"frames": run.summary["config"]["frames"] | {"datum": [40.123456, -77.654321]}},
        warnings=[f"the heading is off: {cause}"],
    )
    table = replace(run.table, north_m=run.table.north_m + 4_440_123.0, east_m=run.table.east_m + 612_345.0)
    there = replace(placed, table=table)
    made = report.document
    worst = tuple(
        msgspec.structs.replace(one, north_m=one.north_m + 4_440_123.0, east_m=one.east_m + 612_345.0)
        for one in made.worst
    )
    document = msgspec.structs.replace(made, worst=worst)
    shown, hidden = (run_page(there, document, {}, coordinates=one) for one in (True, False))
    for trace in ("40.12345", "77.65432", "87.65", "4440123", "612345"):
        assert trace in shown, trace
        assert trace not in hidden, trace
    assert data_of(hidden)["origin"] is None
    steps = data_of(hidden)["steps"]
    assert max(abs(steps[axis]["first"]) for axis in ("north", "east")) < 1.0


def test_fixes_lie_by_the_smoothed_path_without_coordinates(run: Run, report: DropoutReport) -> None:
    table, fixes = run.table, run.sensors.fixes
    grid = replace(table, north_m=table.north_m + 4_440_123.0, east_m=table.east_m + 612_345.0)
    fixes = replace(fixes, north_m=fixes.north_m + 4_440_123.0, east_m=fixes.east_m + 612_345.0)
    there = replace(run, table=grid, smoothed=grid, sensors=replace(run.sensors, fixes=fixes))
    asked = msgspec.structs.replace(report.document.request, reference="smoothed")
    document = msgspec.structs.replace(report.document, request=asked)
    data = data_of(run_page(there, document, {}, coordinates=False))
    for axis in ("north", "east"):
        assert np.abs(numbers(data["fixes"]["used"][axis])).max() < 1000.0


def test_a_picture_whose_axes_show_a_map_grid_is_left_out_without_coordinates(run: Run, report: DropoutReport) -> None:
    metric = with_summary(run, gnss={"datum": None})
    pictures = pictures_of([("worst", b"place"), ("summary", b"models")])
    page = run_page(metric, report.document, pictures, coordinates=False)
    assert base64.b64encode(b"models").decode() in page
    assert base64.b64encode(b"place").decode() not in page


def test_a_run_without_track_width_and_a_short_one_have_pages(make_run: Any) -> None:
    narrow = make_run(track_width_m=None)
    page = run_page(narrow, dropout_report(narrow).document, {})
    assert "robot.track_width_m is not known" in unescape(page)


@pytest.mark.parametrize("samples", [2, 3])
def test_a_run_of_one_state_or_two_is_drawn(samples: int, report: DropoutReport) -> None:
    t_s = 0.1 * np.arange(samples)
    wheels = pd.DataFrame({"t_s": t_s, "v_left_mps": 3.0, "v_right_mps": 2.4})
    fixes = pd.DataFrame({"t_s": [0.0, 1.0], "north_m": [0.0, 2.7], "east_m": [0.0, 0.01]})
    headings = pd.DataFrame({"t_s": [0.01, 1.01], "heading_rad": [0.0, 0.05]})
    run = fit(RobotLog.from_frames(wheels, fixes, headings), configured())
    data = plain_value(drive_data(run, report.document, coordinates=True))
    assert len(numbers(data["steps"]["left"])) == samples - 1
    assert [len(numbers(path["north"])) for path in data["paths"].values()] == [samples - 1] * len(data["paths"])
    assert "icr_final" in data["paths"]


def test_drawn_pictures_are_those_of_the_run_directory(run: Run, report: DropoutReport, tmp_path: Path) -> None:
    run.write(tmp_path / "run")
    write_page(run, report, tmp_path / "page.html", plots=tmp_path / "run")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    for name in draw_pictures(run):
        content = (tmp_path / "run" / "plots" / f"{name}.png").read_bytes()
        assert base64.b64encode(content).decode() in page


def test_the_bundled_libraries_are_those_that_are_listed() -> None:
    listed = (VENDOR / "SOURCES.md").read_text(encoding="utf-8")
    for file in VENDOR.glob("*.min.*"):
        assert f"`{file.name}`" in listed
        assert hashlib.sha256(file.read_bytes()).hexdigest() in listed


def test_the_subset_of_d3_holds_the_functions_that_the_scripts_call_and_no_others() -> None:
    root = VENDOR.parents[4]
    called = {
        name for file in VENDOR.parent.glob("*.js") for name in re.findall(r"\bd3\.(\w+)", file.read_text("utf-8"))
    }
    entry = re.findall(r"^export \{ (.*) \} from", (root / "scripts" / "d3_subset.sh").read_text("utf-8"), re.MULTILINE)
    assert called == {name for names in entry for name in names.split(", ")}
    bundle = (VENDOR / "d3-subset.min.js").read_text("utf-8")
    assert all(re.search(rf"\b{name}:\(\)=>", bundle) for name in called)
