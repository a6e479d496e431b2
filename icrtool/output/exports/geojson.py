"""A run as GeoJSON (RFC 7946) for QGIS and other geographic information systems: lines and points with attributes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import orjson

from icrtool import __version__
from icrtool.alignment.sensors.gnss_quality import CLASSES
from icrtool.dropout_analysis.trials import errors_from_states
from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.filter_records import GATED, UNSEEN
from icrtool.output.decimate import places
from icrtool.output.exports.paths import (
    ERROR_HORIZON_M,
    LABELS,
    ExportPath,
    Globe,
    find_globe,
    line_rows,
    outage_rows,
    paths_of,
    utc_text,
)
from icrtool.records.plain_data import plain
from icrtool.records.run import ICR_COLUMNS, Run

STATE_CELL_M = 0.2
"""A state becomes a point where the path enters another cell of a grid of this side."""

DEGREE_DIGITS = 9
"""Decimals of latitude and longitude: 0.1 mm."""


def format_geojson(run: Run) -> str:
    """Return a feature collection, no line end; each feature's attribute ``layer`` is what it is.

    Layers: ``path`` (a line for each of filter, smoother, ICR and no-slip odometry), ``state`` (points along the
    filter's path, at most one in 0.2 m), ``fix``, ``event`` and ``outage`` (a line).

    Raises
    ------
    DataError
        The run has no place on the globe.
    """
    globe, paths = find_globe(run), paths_of(run)
    features = [
        *path_features(run, paths, globe),
        *outage_features(run, globe),
        *_state_features(run, globe),
        *_fix_features(run, globe),
        *event_features(run, globe),
    ]
    about = {
        "log": run.name, "robot": run.config.robot.name, "usable": run.usable,
        "unusable_because": run.document.unusable_because, "tool_version": __version__,
    }  # fmt: skip
    document = {"type": "FeatureCollection", "name": run.name, "icrtool": about, "features": features}
    return orjson.dumps(plain(document)).decode()


def _feature(layer: str, geometry: dict[str, Any], properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": geometry, "properties": {"layer": layer, **properties}}


def coordinates(x_m: Floats, y_m: Floats, globe: Globe) -> list[list[float]]:
    """Return longitude and latitude [deg] of points (n,) east and north of the datum."""
    latitude, longitude = globe.places(x_m, y_m)
    pairs: list[list[float]] = np.round(np.column_stack([longitude, latitude]), DEGREE_DIGITS).tolist()
    return pairs


def _line(x_m: Floats, y_m: Floats, globe: Globe) -> dict[str, Any]:
    rows = line_rows(x_m, y_m)
    return {"type": "LineString", "coordinates": coordinates(x_m[rows], y_m[rows], globe)}


def _points(
    layer: str, x_m: Floats, y_m: Floats, globe: Globe, columns: dict[str, list[Any]]
) -> Iterator[dict[str, Any]]:
    """Yield a point for each row; `columns` are its attributes."""
    for pair, values in zip(coordinates(x_m, y_m, globe), zip(*columns.values(), strict=True), strict=True):
        geometry = {"type": "Point", "coordinates": pair}
        yield _feature(layer, geometry, dict(zip(columns, values, strict=True)))


def path_features(run: Run, paths: Sequence[ExportPath], globe: Globe) -> Iterator[dict[str, Any]]:
    """Yield a line for each path."""
    for path in paths:
        length_m = float(np.hypot(np.diff(path.x_m), np.diff(path.y_m)).sum())
        begin, end = utc_text(path.stamp_ns[[0, -1]])
        properties = {
            "path": path.name, "label": LABELS[path.name], "log": run.name, "begin_utc": begin, "end_utc": end,
            "length_m": length_m, "end_error_m": path.end_error_m, "usable": run.usable,
        }  # fmt: skip
        yield _feature("path", _line(path.x_m, path.y_m, globe), properties)


def outage_features(run: Run, globe: Globe) -> Iterator[dict[str, Any]]:
    """Yield the filter's path in each outage as a line."""
    for span_ns, rows in outage_rows(run):
        begin, end = utc_text(np.array(span_ns, np.int64))
        properties = {"begin_utc": begin, "end_utc": end, "duration_s": (span_ns[1] - span_ns[0]) / 1e9}
        yield _feature("outage", _line(run.table.east_m[rows], run.table.north_m[rows], globe), properties)


def _state_features(run: Run, globe: Globe) -> Iterator[dict[str, Any]]:
    table = run.table
    rows = places(table.north_m, table.east_m, STATE_CELL_M)
    columns = _times(table.stamp_ns[rows]) | {
        "t_s": table.t_s[rows].tolist(),
        "distance_m": table.distance_m[rows].tolist(),
        "heading_deg": np.mod(np.degrees(table.heading_rad[rows]), 360.0).tolist(),
        "v_left_mps": table.v_left_mps[rows].tolist(),
        "v_right_mps": table.v_right_mps[rows].tolist(),
    }
    for name in ("north_m", "east_m", *ICR_COLUMNS):
        if name in ICR_COLUMNS:
            columns[name] = getattr(table, name)[rows].tolist()
        columns[f"std_{name}"] = getattr(table, f"std_{name}")[rows].tolist()
    for model, errors in errors_from_states(run, ERROR_HORIZON_M).items():
        columns[f"{model}_error_{ERROR_HORIZON_M:g}m_m"] = errors[rows].tolist()
    yield from _points("state", table.east_m[rows], table.north_m[rows], globe, columns)


def _fix_features(run: Run, globe: Globe) -> Iterator[dict[str, Any]]:
    fixes, outcome = run.sensors.fixes, run.gnss
    columns = _times(fixes.stamp_ns) | {
        "class": [CLASSES[code] for code in fixes.fix_class.tolist()],
        "use": [_USES.get(code, "used") for code in outcome.code.tolist()],
        "nis": outcome.nis.tolist(),
        "difference_m": outcome.difference.tolist(),
        "std_north_m": np.sqrt(fixes.var_north_m2).tolist(),
        "std_east_m": np.sqrt(fixes.var_east_m2).tolist(),
    }
    yield from _points("fix", fixes.east_m, fixes.north_m, globe, columns)


_USES = {UNSEEN: "not in the run", GATED: "rejected"}


def event_features(run: Run, globe: Globe) -> Iterator[dict[str, Any]]:
    """Yield a point for each slip event."""
    events: list[dict[str, Any]] = plain(run.document.events)
    if not events:
        return
    columns = {name: [event[name] for event in events] for name in events[0] if name not in ("north_m", "east_m")}
    begin = np.array([event["begin_ns"] for event in events], np.int64)
    east, north = (np.array([event[name] for event in events], np.float64) for name in ("east_m", "north_m"))
    yield from _points("event", east, north, globe, {"begin_utc": utc_text(begin)} | columns)


def _times(stamp_ns: Ints) -> dict[str, list[Any]]:
    return {"time_utc": utc_text(stamp_ns), "stamp_ns": stamp_ns.tolist()}
