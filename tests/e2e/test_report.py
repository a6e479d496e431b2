"""``icrtool report``: pages of runs, fleets and comparisons, and what cannot be one."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from icrtool.output.tables.calibration import change_sentence, comparison_title
from icrtool.pipeline import fit
from icrtool.records.calibration_document import (
    CalibrationLog,
    ComparedGroup,
    ComparedPair,
    ErrorDifference,
    GroupComparison,
)
from support.barn import configured, simulate

ROBOT = ("--robot", "husky-a200")

Command = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("runs") / "barn"
    fit(simulate(), configured()).write(directory, plots=())
    return directory


@pytest.fixture
def run_directory(made: Path, run_place: Path) -> Path:
    """A copy, since a page is written into it."""
    directory = run_place / "icrtool-runs" / "barn"
    shutil.copytree(made, directory)
    return directory


@pytest.fixture
def field(short_logs: Path) -> Path:
    return short_logs / "field.mcap"


def spaced(page: str) -> str:
    """Return a page with plain spaces between values and units."""
    return page.replace("\xa0", " ").replace("&nbsp;", " ")


@pytest.mark.usefixtures("without_drawing")
def test_the_page_of_the_newest_run_is_in_its_directory(icrtool: Command, run_directory: Path) -> None:
    status, output, errors = icrtool("report")
    assert (status, errors) == (0, "")
    assert str(Path("icrtool-runs", "barn", "report.html")) in output
    page = spaced((run_directory / "report.html").read_text(encoding="utf-8"))
    # Neither a dropout report nor pictures were there: both were made for the page, and only for it.
    assert "within 0.5 m (95 %), by wheel speeds alone" in page
    assert "data:image/png;base64," in page
    assert not (run_directory / "dropout").exists()


@pytest.mark.usefixtures("without_drawing")
def test_a_dropout_report_writes_the_page_unless_it_is_not_wanted(icrtool: Command, run_directory: Path) -> None:
    lean = ("dropout-report", run_directory, "--plots", "none", "--no-ladder")
    assert icrtool(*lean, "--no-page")[0] == 0
    assert not (run_directory / "report.html").exists()
    assert icrtool(*lean, "--budget", "0.123")[0] == 0
    written = (run_directory / "report.html").read_bytes()
    assert "within 0.123 m" in spaced(written.decode())
    # The page that is made from the files is the same; it draws the pictures that are missing.
    assert icrtool("report", run_directory, "-o", "again.html", "-q") == (0, "", "")
    again = Path("again.html").read_bytes()
    assert "within 0.123 m" in spaced(again.decode())
    assert again.count(b"data:image/png") == written.count(b"data:image/png") + 3


@pytest.mark.usefixtures("without_drawing")
def test_figures_all_adds_those_of_the_paper(icrtool: Command, run_directory: Path) -> None:
    drawn = {}
    for figures in ("default", "all"):
        lean = ("--no-page", "--no-ladder", "-q")
        assert icrtool("dropout-report", run_directory, "--plots", "svg", "--figures", figures, *lean) == (0, "", "")
        drawn[figures] = {file.stem for file in (run_directory / "dropout" / "plots").iterdir()}
    assert {"summary", "histogram", "worst"} <= drawn["default"]
    assert drawn["all"] - drawn["default"] == {"histogram_05m", "histogram_10m", "histogram_20m", "examples_15m"}


def test_a_report_that_was_edited_is_refused_in_one_line(icrtool: Command, run_directory: Path) -> None:
    icrtool("dropout-report", run_directory, "--plots", "none", "--no-page", "--no-ladder", "-q")
    file = run_directory / "dropout" / "report.json"
    for change in ({"worst": [{"t_s": "soon"}]}, {"schema": "icrtool/dropout/99"}, {"models": None}):
        document = json.loads(file.read_bytes())
        kept = file.read_bytes()
        file.write_text(json.dumps(document | change), encoding="utf-8")
        status, _, errors = icrtool("report", run_directory)
        assert status == 1
        assert errors.startswith("Error: ")
        assert len(errors.splitlines()) == 1
        assert not (run_directory / "report.html").exists()
        file.write_bytes(kept)


@pytest.mark.parametrize(("place", "why"), [("nothing-here", "no such file"), (".", "holds no run")])
def test_what_is_no_result_has_no_page(icrtool: Command, place: str, why: str) -> None:
    status, _, errors = icrtool("report", place)
    assert status == 1
    assert errors.startswith(f"Error: {place}: {why}")


@pytest.mark.usefixtures("without_drawing")
def test_report_of_a_log_answers_the_whole_question_and_fits_it_once(
    icrtool: Command, run_place: Path, field: Path
) -> None:
    status, first, errors = icrtool("report", field, *ROBOT)
    assert (status, errors) == (0, "")
    labels = [line.partition(" ")[0] for line in first.splitlines()]
    for label in ("controller", "Trust?", "Worst", "page"):
        assert label in labels
    assert "How far without GNSS?" in first
    assert "wheel_separation_multiplier" in first
    run = run_place / "icrtool-runs" / field.stem
    assert str(run.relative_to(run_place) / "report.html") in first
    fitted, made = (run / "run.json").stat(), (run / "report.html").stat()
    # The run is there: only the test is made again, with the same answer.
    assert icrtool("report", field, *ROBOT) == (0, first, "")
    assert (run / "run.json").stat().st_mtime_ns == fitted.st_mtime_ns
    assert (run / "report.html").stat().st_mtime_ns > made.st_mtime_ns
    # Of the run, named itself, the same answer and the same page.
    assert icrtool("report", run.relative_to(run_place)) == (0, first, "")
    status, second, _ = icrtool("report", field, *ROBOT, "-o", "mine.html", "--no-coordinates")
    assert status == 0
    assert "page        mine.html" in second
    assert second.count("How far without GNSS?") == 1
    assert "left out" in Path("mine.html").read_text(encoding="utf-8")


def test_a_run_of_other_settings_is_lost_only_with_overwrite(icrtool: Command, run_place: Path, field: Path) -> None:
    assert icrtool("fit", field, *ROBOT, "--plots", "none", "-q")[0] == 0
    file = run_place / "icrtool-runs" / field.stem / "run.json"
    kept = file.read_bytes()
    for command in (("fit", field), ("report", field), ("dropout-report", field),
                    ("fit", field, *ROBOT, "--from", "20")):  # fmt: skip
        status, _, errors = icrtool(*command)
        assert status == 1
        assert "--overwrite" in errors
        assert ("robot.name was husky-a200, now not given" in errors) == ("--from" not in command)
        assert ("--from was not given, now 20" in errors) == ("--from" in command)
        assert file.read_bytes() == kept
    # The same settings again, in other words, and what is no setting of a fit.
    words = ("--set", "dropout.horizons_m=[1, 2]", "--smooth", "--plots", "none", "-q")
    assert icrtool("fit", field, *ROBOT, *words)[0] == 0
    assert icrtool("fit", field, "--overwrite", "--plots", "none", "-q")[0] == 0
    assert json.loads(file.read_bytes())["config"]["robot"]["name"] is None


@pytest.fixture
def other(icrtool: Command, run_place: Path, short_logs: Path) -> Path:
    """A calibration of another log than the one that is reported on."""
    assert icrtool("fit", short_logs / "third", *ROBOT, "-o", "other", "--plots", "none", "-q")[0] == 0
    assert icrtool("calibrate", "other", "-o", "other.json", "-q")[0] == 0
    return run_place / "other.json"


def calibration_rows(run: Path) -> list[dict[str, object]]:
    """Return the rows of calibrations in a run's report, and how their sensors were found."""
    document = json.loads((run / "dropout" / "report.json").read_text(encoding="utf-8"))
    rows = [one for one in document["models"] if one["name"].startswith("calibration")]
    return [*rows, *document["calibrations"]]


@pytest.mark.usefixtures("without_drawing")
@pytest.mark.parametrize("further", [(), ("--refit-sensors",)])
def test_report_and_batch_have_the_row_of_a_calibration_that_a_dropout_report_has(
    icrtool: Command, run_place: Path, field: Path, other: Path, further: tuple[str, ...]
) -> None:
    asked = (field, *ROBOT, "--calibration", other.name, *further)
    lean = ("--plots", "none", "--no-page")
    assert icrtool("dropout-report", *asked, *lean, "-o", "expected", "-q")[0] == 0
    expected = calibration_rows(run_place / "expected")
    assert [one["name"] for one in expected if "by_horizon" in one][:1] == ["calibration"]
    assert ("(--refit-sensors)" in str(expected)) == bool(further)

    status, shown, errors = icrtool("report", *asked)
    assert (status, errors) == (0, "")
    run = run_place / "icrtool-runs" / field.stem
    assert calibration_rows(run) == expected
    assert "calibration" in [line.split()[0] for line in shown.splitlines() if line.strip()]
    assert "not fitted to this log" in spaced((run / "report.html").read_text(encoding="utf-8"))

    status, shown, errors = icrtool("batch", *asked, *lean, "-o", "results", "-j", "1")
    assert (status, errors) == (0, "")
    assert calibration_rows(run_place / "results" / "runs" / field.stem) == expected
    assert "calibration_p95_10m_m" in (run_place / "results" / "fleet.csv").read_text(encoding="utf-8")

    if further:
        return
    # the report of a finished run is made again, from the run
    (run / "dropout" / "report.json").unlink()
    status, shown, errors = icrtool("report", run, *asked[1 + len(ROBOT) :])
    assert (status, errors) == (0, "")
    assert calibration_rows(run) == expected
    status, _, errors = icrtool("report", other.name, *asked[1 + len(ROBOT) :])
    assert status == 1
    assert "is neither a log nor a run" in errors


@pytest.mark.parametrize("command", [("dropout-report",), ("report",), ("batch", "-o", "results")])
@pytest.mark.parametrize(
    ("content", "why"), [(None, "cannot be read"), ("{", "not a calibration"), ('{"schema": 1}', "not a calibration")]
)
def test_a_calibration_that_cannot_be_used_is_refused_before_any_log_is_read(
    icrtool: Command, run_place: Path, field: Path, command: tuple[str, ...], content: str | None, why: str
) -> None:
    if content is not None:
        (run_place / "cal.json").write_text(content, encoding="utf-8")
    before = sorted(run_place.iterdir())
    status, shown, errors = icrtool(*command, field, *ROBOT, "--calibration", "cal.json")
    assert (status, shown) == (1, "")
    assert errors.startswith("Error: cal.json: ")
    assert why in errors
    assert sorted(run_place.iterdir()) == before


@pytest.mark.parametrize("command", [("report",), ("batch", "-o", "results")])
def test_sensors_are_refitted_only_for_a_calibration(
    icrtool: Command, run_place: Path, field: Path, command: tuple[str, ...]
) -> None:
    status, _, errors = icrtool(*command, field, "--refit-sensors")
    assert status == 2
    assert "name one with --calibration" in errors
    assert list(run_place.iterdir()) == []


def test_a_calibration_of_another_width_is_refused_for_the_page_of_a_finished_run(
    icrtool: Command, run_directory: Path, other: Path
) -> None:
    status, _, errors = icrtool("report", run_directory, "--calibration", other)
    assert status == 1
    assert "robot.track_width_m: is 0.6 m, and 0.555 m in the calibration" in errors
    assert not (run_directory / "report.html").exists()


def test_a_calibration_has_a_page(icrtool: Command, run_directory: Path) -> None:
    status, printed, _ = icrtool("calibrate", run_directory, "-o", "season.json")
    assert status == 0
    document = json.loads(Path("season.json").read_bytes())
    status, output, errors = icrtool("report", "season.json")
    assert (status, errors) == (0, "")
    assert "season.html" in output
    page = spaced(Path("season.html").read_text(encoding="utf-8"))
    controller = document["controller"]
    assert f"{controller['multiplier']:.3f} ± {controller['multiplier_std']:.3f}" in page
    held_out = next(one for one in document["held_out_pooled"] if (one["model"], one["horizon_m"]) == ("no_slip", 10))
    assert f"{held_out['p95_m']:.2f} / {held_out['expected_m']:.2f}" in page
    assert all(name in page for name in document["terms"])
    # The distances that calibrate prints are those of the page.
    lines = printed.partition("How far")[2].splitlines()[1:]
    distances = [
        re.split("  +", line.strip()) for line in lines[: next(k for k, one in enumerate(lines) if one[0] != " ")]
    ]
    assert len(distances) >= 3
    card = page.partition("card fact reach")[2].partition("</article>")[0]
    rows = [[re.sub("<[^>]*>", "", cell) for cell in re.findall("<t[hd].*?</t[hd]>", row)]
            for row in re.findall("<tr.*?</tr>", card, re.DOTALL)]  # fmt: skip
    assert [[cell for cell in row if cell] for row in rows[1:]] == distances
    assert "diff_drive_controller" in page
    assert document["logs"][0]["name"] in page
    Path("season.json").write_text(json.dumps(document | {"parameters": {}}), encoding="utf-8")
    status, _, errors = icrtool("report", "season.json", "-o", "other.html")
    assert status == 1
    assert errors.startswith("Error: season.json: ")
    assert not Path("other.html").exists()


def test_compare_begins_with_a_sentence_and_expands_patterns(icrtool: Command, run_place: Path) -> None:
    robot = ("--robot", "segway-rmp400")
    rates = ("--wheel-rate", "20", "--heading-rate", "20", "--gnss-rate", "5")
    for name, seed in (("a1", 1), ("a2", 2), ("b1", 3)):
        drive = ("--path", "curved", "--duration", "200", "--seed", seed, "-q", *rates)
        assert icrtool("simulate", "-o", f"{name}.mcap", *drive, *robot)[0] == 0
    status, output, errors = icrtool(
        "compare", "before=a*.mcap", f"after={run_place}/b*.mcap", *robot, "-o", "both.json"
    )
    assert status == 0, errors
    first = output.splitlines()[0]
    assert first.startswith("after against before: no difference of the error found; with these 3 drives a change")
    document = json.loads(Path("both.json").read_bytes())
    assert [one["name"] for one in document["groups"]["before"]["logs"]] == ["a1", "a2"]
    status, _, errors = icrtool("compare", "before=no*.mcap", "after=b1.mcap", *robot)
    assert status == 1
    assert "no*.mcap" in errors


@pytest.mark.parametrize(("low", "high", "words"), [
    (-0.4, 1.0, "no difference of the error found; with these 2 drives a change below 1.00 m (95 % at 10 m)"),
    (0.2, 1.6, "the error is larger: +0.90 m (+0.20 to +1.60)"),
    (-1.6, -0.2, "the error is smaller: -0.90 m (-1.60 to -0.20)"),
])  # fmt: skip
def test_the_smallest_change_that_would_be_seen_follows_from_the_interval(low: float, high: float, words: str) -> None:
    error = ErrorDifference(10.0, (low + high) / 2, low, high, 0.0, 0.0, 0.0, paired=False)
    pair = ComparedPair("old", "new", (), (error,), "")
    log = CalibrationLog("a", "", "", 9.0, 0.0, 0.0)
    groups = {name: ComparedGroup("icr", (log,), {}) for name in ("old", "new")}
    found = GroupComparison(
        schema="icrtool/compare/1", tool_version="0", groups=groups, pairs=(pair,), transfer=(), costs=()
    )
    text = change_sentence(pair, found)
    assert words in text
    heading = comparison_title(found)
    assert words.partition(";")[0] in heading.text
    assert "would not have been seen" in heading.facts
    # A true change of this size is beyond the interval in four of five comparisons, of normal errors.
    smallest = float(text.rpartition("a change below ")[2].split(" m")[0])
    drawn = np.random.default_rng(1).normal(smallest, (high - low) / 2 / 1.96, 20_000)
    assert np.mean(drawn > (high - low) / 2) == pytest.approx(0.8, abs=0.02)


def test_several_pages_do_not_go_into_one_file(icrtool: Command, run_directory: Path) -> None:
    status, _, errors = icrtool("report", run_directory, run_directory, "-o", "one.html")
    assert status == 1
    assert "-o" in errors


def test_a_fleet_and_a_comparison_have_pages(icrtool: Command, run_place: Path) -> None:
    fleet = run_place / "results"
    fleet.mkdir()
    log = {"log": "a", "run": "runs/a", "status": "failed", "reason": "<b>no heading</b>", "robot": "", "group": "",
           "tags": [], "start_utc": "", "duration_s": None, "distance_m": None, "icr": {}, "multiplier": None,
           "multiplier_std": None, "errors": {}, "events": None, "warnings": None, "verdicts": []}  # fmt: skip
    document = {"schema": "icrtool/fleet/1", "tool_version": "0", "counts": {"done": 0, "failed": 1, "skipped": 0},
                "gates_failed": 0, "logs": [log]}  # fmt: skip
    (fleet / "fleet.json").write_text(json.dumps(document), encoding="utf-8")
    numbers = dict.fromkeys(
        ("p95_m", "p95_low_m", "p95_high_m", "expected_m", "expected_low_m", "expected_high_m"), 0.5
    )
    log = {"path": "", "sha256": "", "distance_m": 9.0, "heading_offset_deg": 0.0, "wheels_delay_s": 0.0}
    groups = {name: {"model": "icr", "logs": [log | {"name": name}], "geometry": {}} for name in ("old", "<i>new</i>")}
    parameter = {"quantity": "multiplier", "first": 1.0, "second": 2.0, "difference": 1.0, "std": 0.1}
    pair = {"first": "old", "second": "<i>new</i>", "verdict": "they differ",
            "parameters": [parameter | {"significant": True}],
            "errors": [{"horizon_m": 10.0, "paired": False, **numbers}]}  # fmt: skip
    transfer = [{"calibrated_on": "old", "tested_on": "<i>new</i>", "horizon_m": 10.0, "trials": 3, **numbers}]
    compared = {
        "schema": "icrtool/compare/1",
        "tool_version": "0",
        "groups": groups,
        "pairs": [pair],
        "transfer": transfer,
        "costs": [],
    }
    (run_place / "compared.json").write_text(json.dumps(compared), encoding="utf-8")
    status, _, errors = icrtool("report", "results", "compared.json")
    assert (status, errors) == (0, "")
    page = (fleet / "report.html").read_text(encoding="utf-8")
    assert "&lt;b&gt;no heading&lt;/b&gt;" in page
    page = (run_place / "compared.html").read_text(encoding="utf-8")
    assert "they differ" in page
    assert "0.50 / 0.50" in spaced(page)
    assert "<i>" not in page
