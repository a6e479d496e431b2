"""The page of a comparison: what `icrtool compare` found between groups of runs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from icrtool.output.json_file import schema_of
from icrtool.output.page.render import render
from icrtool.records.dropout import CHOICE_HORIZON_M

COMPARISON_FAMILY = "icrtool/compare/"


def comparison_page(document: Mapping[str, Any], title: str) -> str:
    """Return the page of a comparison as HTML.

    Parameters
    ----------
    document : what `icrtool compare` writes as JSON
    """
    at_choice = (one for one in document["transfer"] if one["horizon_m"] == CHOICE_HORIZON_M)
    return render(
        "comparison.html", (), None, title=title, groups=document["groups"], pairs=document["pairs"],
        names=list(document["groups"]), cells={(one["calibrated_on"], one["tested_on"]): one for one in at_choice},
        horizon_m=CHOICE_HORIZON_M,
    )  # fmt: skip


def comparison_in(place: Path) -> Path | None:
    """Return the file of a comparison: `place` itself, or the one in that folder; None where there is none."""
    files = sorted(place.glob("*.json")) if place.is_dir() else [place]
    return next((file for file in files if schema_of(file).startswith(COMPARISON_FAMILY)), None)
