"""The layout with which Foxglove shows the file of `icrtool.output.exports.foxglove`."""

from __future__ import annotations

import json
from importlib.resources import files
from typing import Any

from icrtool.output.exports.paths import globe_of
from icrtool.records.run import Run

SMALLEST_VIEW_M = 5.0
VIEW_IN_EXTENT = 1.4
"""Distance of the camera, in sizes of the filter's path."""


def foxglove_layout(run: Run) -> dict[str, Any]:
    """Return the layout of a run as plain data: paths from above, map, ICRs ± σ, open-loop error, speeds, events.

    It is that of ``foxglove_layout.json``, as Foxglove exports it; the camera sees all of the filter's path.
    """
    text = files("icrtool.output.exports").joinpath("foxglove_layout.json").read_text(encoding="utf-8")
    layout: dict[str, Any] = json.loads(text)
    panels = layout["configById"]
    east, north = ((float(column.min()), float(column.max())) for column in (run.table.east_m, run.table.north_m))
    extent_m = max(SMALLEST_VIEW_M, east[1] - east[0], north[1] - north[0])
    middle = [sum(east) / 2, sum(north) / 2, 0.0]
    panels["3D!paths"]["cameraState"] |= {"distance": VIEW_IN_EXTENT * extent_m, "targetOffset": middle}
    if (globe := globe_of(run)) is not None:
        panels["map!place"]["center"] = {"lat": globe.latitude_deg, "lon": globe.longitude_deg}
    else:
        del panels["map!place"]
        layout["layout"]["first"] = "3D!paths"
    return layout


def is_layout(first: bytes) -> bool:
    """Return whether a file is a layout of ours, by its first bytes."""
    return b"3D!paths" in first[:100]
