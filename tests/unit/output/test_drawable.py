"""Names in titles: no formula, no warning about a missing glyph, no control character."""

from __future__ import annotations

import subprocess
import sys
import warnings
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from icrtool.output.figures.calibrations import FleetNumbers, fleet_errors, fleet_icrs
from icrtool.output.figures.style import drawable_text, new_figure, picture_bytes, save_figure, style
from icrtool.records.fleet_document import FleetLog

HOSTILE = ("a$b^{$", "$\\frac{$", "\u6f22\u5b57", "\x1b[2J", "\udc80.mcap", "line\nbreak", "\U0010ffff", "\u202egpj")


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_name_is_drawn_as_text(tmp_path: Path, name: str) -> None:
    with warnings.catch_warnings(), style():
        warnings.simplefilter("error")
        save_figure(new_figure(name, name, width_in=3.0, height_in=2.0), tmp_path / "title", ("png", "svg", "pdf"))
    assert drawable_text(name).isprintable()


MOST_APART, MEAN_APART = 24, 0.5
"""Steps of 255: the least of a colour that 256 shades have, and of the whole picture."""


def test_an_ordinary_name_is_unchanged() -> None:
    assert drawable_text("drive 12 – é, ±2σ, 4 m²") == "drive 12 – é, ±2σ, 4 m²"


def test_every_robot_of_a_fleet_has_its_name_in_the_key(tmp_path: Path) -> None:
    names = (*HOSTILE, "_hidden", "W" * 300)
    icr = {"y_icr_right_m": 0.4, "y_icr_left_m": -0.4, "std_y_icr_right_m": 0.01, "std_y_icr_left_m": 0.01}
    points = [
        FleetLog(name, f"runs/{name}", "done", robot=name, start_utc="2025-10-09T08:53:21Z", icr=icr) for name in names
    ]
    fleet = FleetNumbers("logs", points, {name: {name: 0.1, "b": 0.2} for name in names}, "ICR")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for draw in (fleet_icrs, fleet_errors):
            save_figure(draw(fleet), tmp_path / "fleet", ("png", "svg"))
    shown = [text.get_text().strip() for text in fleet_icrs(fleet).legends[0].get_texts()]
    assert sorted(shown) == sorted(drawable_text(name, 24) for name in names)


def test_every_log_of_a_fleet_has_its_name_its_date_and_its_icrs_with_sigma() -> None:
    points = [
        FleetLog(
            f"drive {day}", "runs", "done", robot="husky", start_utc=f"2025-10-{day:02d}T08:53:21Z",
            icr={"y_icr_right_m": 0.5 + 0.01 * day, "y_icr_left_m": -0.5, "std_y_icr_right_m": 0.02,
                 "std_y_icr_left_m": 0.03},
        )
        for day in (9, 2, 17)
    ]  # fmt: skip
    left, right = fleet_icrs(FleetNumbers("3 logs", points, {}, "")).axes
    rows = [text.get_text() for text in left.get_yticklabels()]
    assert rows == ["drive 2   2025-10-02", "drive 9   2025-10-09", "drive 17   2025-10-17"]
    (bars,) = right.containers
    ends = [segment[:, 0].tolist() for segment in bars.lines[2][0].get_segments()]
    assert ends == [pytest.approx([at - 0.02, at + 0.02]) for at in (0.52, 0.59, 0.67)]
    many = FleetNumbers("many", points * 20, {}, "")
    assert fleet_icrs(many).axes[-1].get_xlabel() == "Date, UTC, 2025"


def test_every_log_of_a_fleet_has_its_name_and_its_error() -> None:
    logs = {"barn": {"monday.bag": 0.31, "tuesday.bag": 0.62}, "yard": {"friday.bag": 1.25}}
    starts = {"monday.bag": "2025-10-06T08:53:21Z", "friday.bag": ""}
    (axes,) = fleet_errors(FleetNumbers("3 logs", [], logs, "recommended", starts)).axes
    names = [text.get_text() for text in axes.get_yticklabels()]
    assert names == ["tuesday.bag", "monday.bag   2025-10-06", "friday.bag"]
    assert [text.get_text() for text in axes.texts] == ["0.620 m", "0.310 m", "1.25 m"]
    many = {"barn": {f"{number}.bag": 0.01 * (1 + number) for number in range(100)}}
    (axes,) = fleet_errors(FleetNumbers("100 logs", [], many, "recommended")).axes
    names = [text.get_text() for text in axes.get_yticklabels()]
    assert names == [f"{number}.bag" for number in range(99, 59, -1)]


def test_the_interval_of_the_error_of_a_log_is_a_line_from_end_to_end() -> None:
    logs = {"barn": {"monday.bag": 0.31, "tuesday.bag": 0.62}}
    (axes,) = fleet_errors(FleetNumbers("2 logs", [], logs, "recommended", {}, {"monday.bag": (0.2, 0.5)})).axes
    lines = [line.get_xydata().tolist() for line in axes.lines]
    assert lines == [[[0.62, 0.0], [0.31, 1.0]], [[0.2, 1.0], [0.5, 1.0]]]


def test_settings_of_matplotlib_that_are_no_text_are_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "matplotlibrc").write_bytes(b"axes.grid: \xff")
    code = "import icrtool.figures"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.stderr.splitlines()[-1].startswith("icrtool.errors.OutputError: matplotlibrc: ")


def test_a_png_picture_is_what_matplotlib_would_save_but_for_the_number_of_colours() -> None:
    figure = new_figure("title", "subtitle", width_in=3.0, height_in=2.0)
    figure.subplots().plot([0.0, 1.0], [0.0, 1.0])
    saved = BytesIO()
    with style():
        figure.savefig(saved, format="png")
    with Image.open(BytesIO(picture_bytes(figure, "png"))) as ours, Image.open(saved) as theirs:
        apart = np.abs(np.asarray(ours.convert("RGB"), np.int16) - np.asarray(theirs.convert("RGB"), np.int16))
        assert apart.max() <= MOST_APART
        assert apart.mean() < MEAN_APART
        assert ours.convert("RGB").getpixel((1, 1)) == (255, 255, 255)
        assert ours.info["dpi"] == theirs.info["dpi"]
