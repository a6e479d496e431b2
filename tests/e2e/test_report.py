"""``icrtool report``: pages of runs, fleets and comparisons, and what cannot be one."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from icrtool.pipeline import fit
from support.barn import configured, simulate

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


def spaced(page: str) -> str:
    """Return a page with plain spaces between values and units."""
    return page.replace("\xa0", " ").replace("&nbsp;", " ")


def test_the_page_of_the_newest_run_is_in_its_directory(icrtool: Command, run_directory: Path) -> None:
    status, output, errors = icrtool("report")
    assert (status, errors) == (0, "")
    assert str(Path("icrtool-runs", "barn", "report.html")) in output
    page = spaced((run_directory / "report.html").read_text(encoding="utf-8"))
    # Neither a dropout report nor pictures were there: both were made for the page, and only for it.
    assert "within 0.5 m (95 %), by wheel speeds alone" in page
    assert "data:image/png;base64," in page
    assert not (run_directory / "dropout").exists()


def test_a_dropout_report_writes_the_page_unless_it_is_not_wanted(icrtool: Command, run_directory: Path) -> None:
    assert icrtool("dropout-report", run_directory, "--plots", "none", "--no-page")[0] == 0
    assert not (run_directory / "report.html").exists()
    assert icrtool("dropout-report", run_directory, "--plots", "none", "--budget", "0.123")[0] == 0
    written = (run_directory / "report.html").read_bytes()
    assert "within 0.123 m" in spaced(written.decode())
    # The page that is made from the files is the same; it draws the pictures that are missing.
    assert icrtool("report", run_directory, "-o", "again.html", "-q") == (0, "", "")
    again = Path("again.html").read_bytes()
    assert "within 0.123 m" in spaced(again.decode())
    assert again.count(b"data:image/png") == written.count(b"data:image/png") + 3


def test_figures_all_adds_those_of_the_paper(icrtool: Command, run_directory: Path) -> None:
    drawn = {}
    for figures in ("default", "all"):
        command = ("dropout-report", run_directory, "--plots", "svg", "--figures", figures, "--no-page", "-q")
        assert icrtool(*command) == (0, "", "")
        drawn[figures] = {file.stem for file in (run_directory / "dropout" / "plots").iterdir()}
    assert {"summary", "histogram", "worst"} <= drawn["default"]
    assert drawn["all"] - drawn["default"] == {"histogram_05m", "histogram_10m", "histogram_20m", "examples_15m"}


def test_a_report_that_was_edited_is_refused_in_one_line(icrtool: Command, run_directory: Path) -> None:
    icrtool("dropout-report", run_directory, "--plots", "none", "--no-page", "-q")
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


@pytest.mark.parametrize("place", ["nothing-here", "."])
def test_what_is_no_result_has_no_page(icrtool: Command, place: str) -> None:
    status, _, errors = icrtool("report", place)
    assert status == 1
    assert errors.startswith(f"Error: {place}: no ")


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
