"""Names in titles: no formula, no warning about a missing glyph, no control character."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest

from icrtool.output.figures.style import drawable, new_figure, save, style

HOSTILE = ("a$b^{$", "$\\frac{$", "\u6f22\u5b57", "\x1b[2J", "\udc80.mcap", "line\nbreak", "\U0010ffff", "\u202egpj")


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_name_is_drawn_as_text(tmp_path: Path, name: str) -> None:
    with warnings.catch_warnings(), style():
        warnings.simplefilter("error")
        save(new_figure(name, name, width_in=3.0, height_in=2.0), tmp_path / "title", ("png", "svg", "pdf"))
    assert drawable(name).isprintable()


def test_an_ordinary_name_is_unchanged() -> None:
    assert drawable("drive 12 – é, ±2σ, 4 m²") == "drive 12 – é, ±2σ, 4 m²"
