"""The page of a comparison: what `icrtool compare` found between groups of runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from icrtool.motion.models import FAMILY
from icrtool.output.files.json_file import schema_of
from icrtool.output.page.drive_data import ERROR_KEYS
from icrtool.output.page.pictures import drawn_pictures
from icrtool.output.page.render import render
from icrtool.records.dropout import CHOICE_HORIZON_M

SCRIPTS = ("vendor/uPlot.iife.min.js", "vendor/d3.min.js", "columns.js", "charts.js", "comparison.js")

COMPARISON_FAMILY = "icrtool/compare/"


def comparison_page(document: Mapping[str, Any], title: str) -> str:
    """Return the page of a comparison as HTML.

    Parameters
    ----------
    document : what `icrtool compare` writes as JSON
    """
    from icrtool.output.figures.transfer import transfer

    names, cells = list(document["groups"]), document["transfer"]
    at_choice = {(one["calibrated_on"], one["tested_on"]): one for one in cells if one["horizon_m"] == CHOICE_HORIZON_M}
    drawn = drawn_pictures([("transfer", transfer(document))])["transfer"]
    return render(
        "comparison.html", SCRIPTS, {"by_group": [_errors(cells, names, name) for name in names]}, title=title,
        groups=document["groups"], pairs=document["pairs"], names=names, cells=at_choice, horizon_m=CHOICE_HORIZON_M,
        drawn=drawn, labels={name: model.label for name, model in FAMILY.items()},
    )  # fmt: skip


def _errors(cells: Sequence[Mapping[str, Any]], names: Sequence[str], tested_on: str) -> dict[str, Any]:
    """Return the errors in the runs of one group over distance, by the group of the calibration."""
    mine = [one for one in cells if one["tested_on"] == tested_on]
    horizons = sorted({one["horizon_m"] for one in mine})
    rows = {(one["calibrated_on"], one["horizon_m"]): one for one in mine}
    return {
        "horizons_m": horizons,
        "models": [
            {"name": f"of {name}", "label": f"calibration of {name}{' (held out)' if name == tested_on else ''}"}
            | {key: [rows.get((name, h), {}).get(f"{key}_m") for h in horizons] for key in ERROR_KEYS}
            for name in names
        ],
        "reference": {"p95": [], "expected": []},
    }


def comparison_in(place: Path) -> Path | None:
    """Return the file of a comparison: `place` itself, or the one in that folder; None where there is none."""
    inside = place if place.is_dir() else None
    files = [place] if inside is None else sorted(place.glob("*.json"))
    return next((file for file in files if schema_of(file, inside).startswith(COMPARISON_FAMILY)), None)
