"""A run and its report without where on the globe the robot was: for pages that are passed on."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TypeVar

import msgspec

from icrtool.records.dropout_document import DropoutDocument, TrialDocument
from icrtool.records.run import Run
from icrtool.records.run_document import EventDocument

Placed = TypeVar("Placed", EventDocument, TrialDocument)

HIDDEN = "left out"
"""Stands in place of a number that would show the place."""


def without_place(run: Run, report: DropoutDocument) -> tuple[Run, DropoutDocument]:
    """Return a run and what report.json holds of it, with the first state as origin and without the datum.

    Notes
    -----
    Where a position reference is metric its coordinates may be those of a map grid, so the origin moves there too.
    Magnetic declination and grid convergence narrow the place down, and are left out with their name.
    """
    table = run.table
    north, east = float(table.north_m[0]), float(table.east_m[0])

    changed, document = msgspec.structs.replace, run.document

    def moved(one: Placed) -> Placed:
        return changed(one, north_m=one.north_m - north, east_m=one.east_m - east)

    cause, datum = document.heading.offset_name, document.gnss.datum
    shown = changed(
        document,
        config=replace(document.config, frames=replace(document.config.frames, datum=None)),
        warnings=tuple(one.replace(cause, f"its cause is {HIDDEN}") if cause else one for one in document.warnings),
        gnss=changed(document.gnss, datum=None if datum is None else (math.nan, math.nan, math.nan)),
        heading=changed(document.heading, offset_name=None, magnetic_declination_deg=None, utm_convergence_deg=None),
        events=tuple(map(moved, document.events)),
    )
    sensors, fixes = run.sensors, run.sensors.fixes
    at_origin = replace(
        run,
        table=replace(table, north_m=table.north_m - north, east_m=table.east_m - east),
        sensors=replace(
            sensors,
            fixes=replace(fixes, north_m=fixes.north_m - north, east_m=fixes.east_m - east),
            events=tuple(one._replace(north_m=one.north_m - north, east_m=one.east_m - east) for one in sensors.events),
        ),
        document=shown,
    )
    return at_origin, changed(
        report, worst=tuple(map(moved, report.worst)), examples=tuple(map(moved, report.examples))
    )  # fmt: skip
