"""The layout with which Foxglove shows the file of `icrtool.output.exports.foxglove`."""

from __future__ import annotations

from typing import Any

from icrtool.output.exports.foxglove import BODIES, ERROR_HORIZON_M, WORLD
from icrtool.output.exports.paths import LABELS, Globe, PathName, globe_of, paths_of
from icrtool.records.run import ICR_COLUMNS, Run

COLORS: dict[PathName, str] = {"filter": "#000000", "smoothed": "#808080", "icr": "#0072b2", "no_slip": "#d55e00"}
ICR_COLORS = ("#0072b2", "#d55e00", "#009e73")
BACKGROUND = "#ffffff"

SMALLEST_VIEW_M = 5.0
VIEW_IN_EXTENT = 1.4
"""Distance of the camera, in sizes of the filter's path."""

MAP_ZOOM = 18


def foxglove_layout(run: Run) -> dict[str, Any]:
    """Return the layout of a run as plain data: paths from above, map, ICRs ± σ, open-loop error, speeds, events."""
    names = [path.name for path in paths_of(run)]
    panels = {
        "3D!paths": _view(run, names),
        "Plot!icrs": _plot("Track ICRs ± σ [m]", _icr_curves()),
        "Plot!error": _plot(f"Open-loop error after {ERROR_HORIZON_M:g} m [m]", _error_curves(names)),
        "Plot!speed": _plot("Forward speed [m/s] and turn rate [rad/s]", _speed_curves()),
        "StateTransitions!events": {
            "foxglovePanelTitle": "Slip events and outages",
            "isSynced": True,
            "paths": [
                {"value": f"/{topic}.kind", "enabled": True, "timestampMethod": "receiveTime"}
                for topic in ("events", "outages")
            ],
        },
    }
    left: str | dict[str, Any] = "3D!paths"
    if (globe := globe_of(run)) is not None:
        panels["map!place"] = _map(globe)
        left = _split("column", "3D!paths", "map!place", 65)
    right = _split("column", "Plot!icrs", _split("column", "Plot!error", "Plot!speed", 50), 40)
    tree = _split("row", left, _split("column", right, "StateTransitions!events", 85), 50)
    playback = {"speed": 1}
    return {
        "configById": panels, "globalVariables": {}, "userNodes": {}, "playbackConfig": playback, "layout": tree,
    }  # fmt: skip


def _split(direction: str, first: str | dict[str, Any], second: str | dict[str, Any], percent: int) -> dict[str, Any]:
    return {"direction": direction, "first": first, "second": second, "splitPercentage": percent}


def _view(run: Run, names: list[PathName]) -> dict[str, Any]:
    """Return the panel of the paths, seen from above with north up."""
    table = run.table
    ranges = [(float(column.min()), float(column.max())) for column in (table.east_m, table.north_m)]
    extent_m = max(SMALLEST_VIEW_M, *(high - low for low, high in ranges))
    middle = [*((low + high) / 2 for low, high in ranges), 0.0]
    camera = {
        "perspective": False, "distance": VIEW_IN_EXTENT * extent_m, "phi": 0, "thetaOffset": 0, "fovy": 45,
        "near": 0.5, "far": 100_000, "target": [0, 0, 0], "targetOffset": middle, "targetOrientation": [0, 0, 0, 1],
    }  # fmt: skip
    topics = {
        f"/{name}/path": {"visible": True, "type": "line", "lineWidth": 0.05, "gradient": [COLORS[name]] * 2}
        for name in names
    }
    bodies = {f"frame:{BODIES[name]}": {"visible": True} for name in names}
    return {
        "foxglovePanelTitle": "Paths (" + ", ".join(LABELS[name] for name in names) + ")",
        "followTf": WORLD, "followMode": "follow-none", "cameraState": camera, "scene": {"backgroundColor": BACKGROUND},
        "topics": topics, "transforms": bodies, "layers": {},
    }  # fmt: skip


def _map(globe: Globe) -> dict[str, Any]:
    colors = {"/filter/fix": COLORS["filter"], "/gnss/fix": "#009e73", "/gnss/fix_rejected": "#cc0000"}
    return {
        "foxglovePanelTitle": "Filter and fixes", "center": {"lat": globe.latitude_deg, "lon": globe.longitude_deg},
        "zoomLevel": MAP_ZOOM, "followTopic": "", "disabledTopics": [], "topicColors": colors,
    }  # fmt: skip


def _plot(title: str, curves: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "foxglovePanelTitle": title, "paths": curves, "isSynced": True, "xAxisVal": "timestamp", "showLegend": True,
        "legendDisplay": "floating", "showXAxisLabels": True, "showYAxisLabels": True, "sidebarDimension": 240,
    }  # fmt: skip


def _curve(value: str, label: str, color: str) -> dict[str, Any]:
    return {"value": value, "label": label, "color": color, "enabled": True, "timestampMethod": "receiveTime"}


def _icr_curves() -> list[dict[str, Any]]:
    curves = []
    for name, color in zip(ICR_COLUMNS, ICR_COLORS, strict=True):
        curves.append(_curve(f"/icrs.{name}", name, color))
        for sign, word in (("-", "minus"), ("+", "plus")):
            curves.append(_curve(f"/icrs.{name[:-2]}_{word}_std_m", f"{name} {sign} σ", f"{color}80"))
    return curves


def _error_curves(names: list[PathName]) -> list[dict[str, Any]]:
    curves = [
        _curve("/open_loop_error.icr_m", "ICR, momentary", ICR_COLORS[0]),
        _curve("/open_loop_error.icr_final_m", "ICR, final", ICR_COLORS[2]),
    ]
    if "no_slip" in names:
        curves.append(_curve("/open_loop_error.no_slip_m", "no slip", ICR_COLORS[1]))
    return curves


def _speed_curves() -> list[dict[str, Any]]:
    twist = "/filter/odometry.twist.twist"
    return [
        _curve(f"{twist}.linear.x", "forward speed [m/s]", ICR_COLORS[0]),
        _curve(f"{twist}.angular.z", "turn rate [rad/s], counter-clockwise", ICR_COLORS[1]),
    ]
