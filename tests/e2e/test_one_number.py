"""Each number on the first screens stands, equal, in the page, the CSV files and the JSON documents of the run."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

Json = dict[str, Any]
SHARED = {
    "real/husky_wet_grass": "husky-a200",
    "real/husky_parking_lot.bag": "husky-a200",
    "simulated/tracked_trouble": "jackal",
    "simulated/wheeled_stuck": "segway-rmp400",
}

NUMBER = re.compile(r"(?<![\w.,/])[+-]?\d[\d,]*(?:\.\d+)?(?![\w])")
"""A number on a screen: not a part of a name, a path or another number."""

WITHOUT_PAGE = ("written to", "page  ", "next  ")
"""Lines about files and commands."""


class Content(HTMLParser):
    """The text of a page, and the rows of its tables as texts of their cells."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.words: list[str] = []
        self.rows: list[list[str]] = []
        self._inside, self._in_cell = "", False
        self.feed(page)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self._inside = tag if tag in {"script", "style"} else self._inside
        if tag == "tr":
            self.rows.append([])
        if tag in {"td", "th"} and self.rows:
            self.rows[-1].append("")
            self._in_cell = True
        if tag in {"br", "small"} and self._in_cell:
            self.rows[-1][-1] += " "

    def handle_endtag(self, tag: str) -> None:
        self._inside = "" if tag in {"script", "style"} else self._inside
        self._in_cell = self._in_cell and tag not in {"td", "th"}

    def handle_data(self, data: str) -> None:
        if not self._inside:
            self.words.append(data)
            if self._in_cell:
                self.rows[-1][-1] += data


def plain(text: str) -> str:
    """A page's text with the characters of a terminal."""
    signs = {"\N{MINUS SIGN}": "-", "\N{NON-BREAKING HYPHEN}": "-", "\N{NO-BREAK SPACE}": " "}
    for sign, typed in signs.items():
        text = text.replace(sign, typed)
    return " ".join(text.split())


def shows(text: str, value: float) -> bool:
    """Whether a text that begins with a number shows this value: equal to half of its last digit."""
    digits = re.match(r"[+-]?[\d,]+(?:\.(\d+))?", text)
    assert digits is not None, text
    half = 0.5 * 10.0 ** -len(digits.group(1) or "")
    return abs(float(digits.group().replace(",", "")) - value) <= half * (1.0 + 1e-9)


def results_on(screen: str) -> list[str]:
    return [line for line in screen.splitlines() if not line.startswith(WITHOUT_PAGE)]


def numbers_on(page: Content) -> set[str]:
    return set(NUMBER.findall(plain(" ".join(page.words))))


def check_screen(icrtool, log: Path, robot: str, place: Path) -> tuple[Path, str, Content]:
    """Compare the screen of a log with page, CSV and JSON; return the run, the screen and the page."""
    status, screen, errors = icrtool("report", log, "--robot", robot)
    assert status == 0, errors
    (folder,) = (place / "icrtool-runs").iterdir()
    results = results_on(screen)
    run = json.loads((folder / "run.json").read_bytes())
    report = json.loads((folder / "dropout" / "report.json").read_bytes())
    page = Content((folder / "report.html").read_text(encoding="utf-8"))
    summary = pd.read_csv(folder / "dropout" / "summary.csv").set_index(["model", "horizon_m"])
    words = plain(" ".join(page.words))
    on_page = numbers_on(page)
    for line in results:
        assert not (missing := set(NUMBER.findall(line)) - on_page), f"{line!r}: {missing} not on the page"
    checked = check_distances(results, report, page)
    checked += check_errors(results, report, summary, page)
    checked += check_controller(results, run, report, words)
    checked += check_worst(results, report, summary, folder)
    assert checked >= 12
    return folder, screen, page


def cells_of(line: str) -> list[str]:
    return [cell for cell in re.split("  +", line.strip()) if cell]


def check_distances(lines: list[str], report: Json, page: Content) -> int:
    """The distances within the budget, on this drive and the next one."""
    begin = next((k for k, line in enumerate(lines) if line.startswith("within ")), None)
    if begin is None:
        assert not report["usable"]
        return 12
    checked = 0
    # The first row of a name: of the first table of the page.
    rows = {row[0]: [plain(cell) for cell in row] for row in reversed(page.rows) if len(row) > 2}
    for line in lines[begin + 1 :]:
        if not line.startswith("   "):
            break
        name, *cells = cells_of(line)
        found = next((one for one in report["budgets"] if one["model"] == name), None)
        if found is None:  # A row about slip events, or one that is not known.
            continue
        assert [cell for cell in rows[name][1:] if cell] == cells
        distance, following = cells[:2]
        assert found["beyond"] == distance.startswith("more than ")
        assert shows(distance.removeprefix("more than "), found["distance_m"])
        if match := re.match(r"([\d.]+)-([\d.]+) m", following):
            assert shows(match.group(1), found["next_low_m"])
            assert shows(match.group(2), found["next_high_m"])
        elif match := re.match(r"([\d.]+) m or more", following):
            assert shows(match.group(1), found["next_low_m"])
        checked += len(cells[:2])
    return checked


def check_errors(lines: list[str], report: Json, summary: pd.DataFrame, page: Content) -> int:
    """The errors at 1, 5, 10 and 20 m, and the numbers of trials."""
    begin = next(k for k, line in enumerate(lines) if line.startswith("distance without GNSS"))
    horizons = [float(cell.removesuffix(" m")) for cell in cells_of(lines[begin])[1:]]
    models = {one["name"]: {row["horizon_m"]: row for row in one["by_horizon"]} for one in report["models"]}
    of_page = {(row[0], plain(row[1]).partition(" interval")[0]): row for row in page.rows if len(row) > 2}
    checked = 0
    for line in lines[begin + 1 :]:
        name, *cells = cells_of(line)
        if name == "trials":
            first = cells_of(lines[begin + 1])[0]
            assert [plain(cell) for cell in of_page["trials", ""][2:]] == cells
            for horizon, cell in zip(horizons, cells, strict=True):
                assert int(cell.replace(",", "")) == models[first][horizon]["trials"]
                assert int(cell.replace(",", "")) == summary.loc[(first, horizon), "trials"]
            return checked + len(cells)
        shown = [plain(cell) for cell in of_page[name, "95 %"][2:]]
        for horizon, cell, on_page in zip(horizons, cells[1:], shown, strict=True):
            if not cell[0].isdigit():
                continue
            assert on_page.startswith(f"{cell} ")
            assert shows(cell, models[name][horizon]["p95_m"])
            assert models[name][horizon]["p95_m"] == summary.loc[(name, horizon), "p95_m"]
            checked += 1
    raise AssertionError("no line with the numbers of trials")


def check_controller(lines: list[str], run: Json, report: Json, words: str) -> int:
    """The multiplier and the radii: of the run, of the report and on the page."""
    line = next((one for one in lines if "wheel_separation_multiplier" in one), None)
    if line is None:
        assert not (run["usable"] and report["recommended"] and run["config"]["robot"]["track_width_m"])
        return 0
    numbers = report["recommended"]["controller"] if report["recommended"] else run["controller"]
    assert run["controller"]["multiplier"] == numbers["multiplier"]
    value, std, following = re.findall(r"[\d.]+", line.partition("multiplier")[2])
    assert shows(value, numbers["multiplier"])
    assert shows(std, numbers["multiplier_std"])
    assert f"{value} ± {std}, next drive ± {following}" in words
    radii = next(one for one in lines if "wheel radius" in one)
    left, right, radius_std = re.findall(r"\d\.\d+", radii)
    assert shows(left, numbers["left_radius"])
    assert shows(right, numbers["right_radius"])
    assert shows(radius_std, max(numbers["left_radius_std"], numbers["right_radius_std"]))
    # The configuration that is copied has the same number with a digit more.
    (copied,) = set(re.findall(r"wheel_separation_multiplier: ([\d.]+)", words)) or {value}
    assert shows(value, float(copied)) or shows(copied, numbers["multiplier"])
    return 5


def check_worst(lines: list[str], report: Json, summary: pd.DataFrame, folder: Path) -> int:
    """The trial with the largest error."""
    line = next((one for one in lines if one.startswith("Worst ")), None)
    if line is None:
        return 0
    worst, first = report["worst"][0], pd.read_csv(folder / "dropout" / "worst.csv").iloc[0]
    error = worst["errors_m"][worst["model"]]
    assert shows(line.removeprefix("Worst").strip(), error)
    assert (first["model"], first["t_s"], first[f"{worst['model']}_error_m"]) == (worst["model"], worst["t_s"], error)
    assert error == pytest.approx(summary.loc[(worst["model"], worst["horizon_m"]), "max_m"], rel=1e-9)
    return 1


@pytest.mark.usefixtures("without_drawing")
def test_a_number_on_a_first_screen_is_that_of_page_csv_and_json(icrtool, short_logs: Path, run_place: Path) -> None:
    folder, screen, page = check_screen(icrtool, short_logs / "field.mcap", "husky-a200", run_place)
    # Of the run alone, screen and page are the same.
    status, again, _ = icrtool("dropout-report", folder, "--plots", "none", "--no-page")
    assert status == 0
    assert results_on(again) == results_on(screen)
    assert icrtool("report", folder, "-o", "page.html", "-q") == (0, "", "")
    assert numbers_on(Content((run_place / "page.html").read_text(encoding="utf-8"))) == numbers_on(page)


@pytest.mark.usefixtures("without_drawing")
@pytest.mark.parametrize("name", SHARED)
def test_a_number_is_one_number_for_other_robots_too(icrtool, shared_logs: Path, run_place: Path, name: str) -> None:
    check_screen(icrtool, shared_logs / name, SHARED[name], run_place)
