"""The page of a comparison: what `icrtool compare` found between groups of runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from icrtool.motion.models import FAMILY
from icrtool.output.files.formats import read_document, schema_of
from icrtool.output.page.drive_data import ERROR_KEYS
from icrtool.output.page.render import drawn_pictures, render
from icrtool.output.tables.transfer import transfer_blocks
from icrtool.output.text_blocks import Title
from icrtool.records.calibration_document import GroupComparison, TransferCell
from icrtool.records.text import counted

SCRIPTS = ("vendor/uPlot.iife.min.js", "vendor/d3.min.js", "columns.js", "charts.js", "comparison.js")

COMPARISON_FAMILY = "icrtool/compare/"


def comparison_page(found: GroupComparison, title: str) -> str:
    """Return the page of a comparison as HTML."""
    from icrtool.output.figures.calibrations import transfer

    names = list(found.groups)
    labels = {name: model.label for name, model in FAMILY.items()}
    groups = "; ".join(
        f"{name}: {counted(len(one.logs), 'log')}, model {labels.get(one.model, one.model)}"
        for name, one in found.groups.items()
    )
    return render(
        SCRIPTS, {"by_group": [_errors(found.transfer, names, name) for name in names]}, title=title,
        kind="Drive without GNSS: groups of runs compared",
        blocks=[Title(f"{', '.join(names)} ({title})", groups), *transfer_blocks(found)],
        names=names, pictures=drawn_pictures([("transfer", transfer(found))]),
    )  # fmt: skip


def _errors(cells: Sequence[TransferCell], names: Sequence[str], tested_on: str) -> dict[str, object]:
    """Return the errors in the runs of one group over distance, by the group of the calibration."""
    mine = [one for one in cells if one.tested_on == tested_on]
    horizons = sorted({one.horizon_m for one in mine})
    rows = {(one.calibrated_on, one.horizon_m): one for one in mine}
    return {
        "horizons_m": horizons,
        "models": [
            {"name": f"of {name}", "label": f"calibration of {name}{' (held out)' if name == tested_on else ''}"}
            | {key: [getattr(rows.get((name, h)), f"{key}_m", None) for h in horizons] for key in ERROR_KEYS}
            for name in names
        ],
        "reference": {"p95": [], "expected": []},
    }


def read_comparison(file: Path, inside: Path | None = None) -> GroupComparison:
    """Return what ``icrtool compare -o`` wrote.

    Raises
    ------
    OSError, ValueError, RecursionError
        It cannot be read, or is not of this version.
    """
    return read_document(file, GroupComparison, inside)


def comparison_in(place: Path) -> Path | None:
    """Return the file of a comparison: `place` itself, or the one in that folder; None where there is none."""
    inside = place if place.is_dir() else None
    files = [place] if inside is None else sorted(place.glob("*.json"))
    return next((file for file in files if schema_of(file, inside).startswith(COMPARISON_FAMILY)), None)
