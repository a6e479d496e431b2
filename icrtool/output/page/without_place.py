"""A run and its report without where on the globe the robot was: for pages that are passed on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from icrtool.records.run import Run

HIDDEN = "left out"
"""Stands in place of a number that would show the place."""


def without_place(run: Run, report: Mapping[str, Any]) -> tuple[Run, dict[str, Any]]:
    """Return a run and what report.json holds of it, with the first state as origin and without the datum.

    Notes
    -----
    Where a position reference is metric its coordinates may be those of a map grid, so the origin moves there too.
    Magnetic declination and grid convergence narrow the place down, and are left out with their name.
    """
    table = run.table
    north, east = float(table.north_m[0]), float(table.east_m[0])

    def moved(one: Mapping[str, Any]) -> dict[str, Any]:
        return {**one, "north_m": one["north_m"] - north, "east_m": one["east_m"] - east}

    summary, heading = run.summary, run.summary["heading"]
    cause = heading.get("offset_name")
    config = {**summary["config"], "frames": {**summary["config"]["frames"], "datum": None}}
    hidden = dict.fromkeys(("magnetic_declination_deg", "utm_convergence_deg", "offset_name"))
    datum = summary["gnss"]["datum"]
    shown: Any = {
        **summary,
        "config": config,
        "warnings": [one.replace(cause, f"its cause is {HIDDEN}") if cause else one for one in summary["warnings"]],
        "gnss": {**summary["gnss"], "datum": None if datum is None else [HIDDEN]},
        "heading": {**heading, **hidden},
        "events": [moved(one) for one in summary["events"]],
    }
    sensors, fixes = run.sensors, run.sensors.fixes
    at_origin = replace(
        run,
        table=replace(table, north_m=table.north_m - north, east_m=table.east_m - east),
        sensors=replace(
            sensors,
            fixes=replace(fixes, north_m=fixes.north_m - north, east_m=fixes.east_m - east),
            events=tuple(one._replace(north_m=one.north_m - north, east_m=one.east_m - east) for one in sensors.events),
        ),
        summary=shown,
    )
    drives = {name: [moved(one) for one in report[name]] for name in ("worst", "examples")}
    return at_origin, {**report, **drives}
