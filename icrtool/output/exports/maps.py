"""A run for maps: GeoJSON for QGIS and web maps, KML 2.2 for Google Earth."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import orjson

from icrtool.alignment.gnss_quality import CLASSES
from icrtool.dropout_analysis.trials import errors_from_states
from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.filter_records import GATED, UNSEEN
from icrtool.output.exports.paths import (
    ERROR_HORIZON_M,
    LABELS,
    ExportPath,
    Globe,
    PathName,
    about_run,
    find_globe,
    line_rows,
    outage_rows,
    paths_of,
    rows_apart,
    utc_text,
)
from icrtool.output.series import places
from icrtool.output.text_format import driven_text, duration_text, run_title, xml_text
from icrtool.records.plain_data import plain
from icrtool.records.run import ICR_COLUMNS, Run
from icrtool.records.text import distance_text

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
    document = {"type": "FeatureCollection", "name": run.name, "icrtool": about_run(run), "features": features}
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


KML, GX = "http://www.opengis.net/kml/2.2", "http://www.google.com/kml/ext/2.2"

TRACK_INTERVAL_S = 1.0
"""The drive over time has a place each second."""

COLORS: dict[PathName | str, str] = {
    "filter": "ff000000", "smoothed": "ff606060", "icr": "ffb27200", "no_slip": "ff005ed5", "outage": "ff00ffff",
}  # fmt: skip
"""Alpha, blue, green, red: the colours of the figures."""


def format_kml(run: Run) -> str:
    """Return a KML document, no line end: lines on the ground, a track with times, outages, events.

    Raises
    ------
    DataError
        The run has no place on the globe.
    """
    globe, paths = find_globe(run), paths_of(run)
    ET.register_namespace("", KML)
    ET.register_namespace("gx", GX)
    root = ET.Element(f"{{{KML}}}kml")
    document = _child(root, "Document")
    _child(document, "name", run_title(run.document))
    _child(document, "description", _about(run))
    for name, color in COLORS.items():
        style = _child(document, "Style")
        style.set("id", name)
        line = _child(style, "LineStyle")
        _child(line, "color", color)
        _child(line, "width", "6" if name == "outage" else "3")
    folder = _folder(document, "paths")
    for one in path_features(run, paths, globe):
        facts = one["properties"]
        drifts = facts["path"] not in ("filter", "smoothed")
        note = f"ends {distance_text(facts['end_error_m'])} off the filter" if drifts else ""
        _placemark(folder, facts["label"], note, facts["path"], geometry=one["geometry"])
    _track(_folder(document, "drive over time"), paths[0], globe)
    folder = _folder(document, "outages")
    for number, one in enumerate(outage_features(run, globe), start=1):
        facts = one["properties"]
        note = f"{duration_text(facts['duration_s'])} without usable GNSS"
        span = facts["begin_utc"], facts["end_utc"]
        _placemark(folder, f"outage {number}", note, "outage", span, one["geometry"])
    folder = _folder(document, "slip events")
    for one in event_features(run, globe):
        facts = one["properties"]
        lasted = duration_text(facts["end_s"] - facts["begin_s"])
        note = f"{lasted}, {100 * facts['severity']:.0f} % of the wheels' motion missed"
        times = utc_text(np.array([facts["begin_ns"], facts["end_ns"]], np.int64))
        _placemark(folder, facts["kind"], note, span=times, geometry=one["geometry"])
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode")


def _about(run: Run) -> str:
    begin, _ = utc_text(run.table.stamp_ns[[0, -1]])
    driven = f"{begin}: {driven_text(run.document.drive)}"
    return driven if run.usable else f"{driven}. Not usable: {run.document.unusable_because}"


def _child(parent: ET.Element, tag: str, text: str | None = None) -> ET.Element:
    child = ET.SubElement(parent, f"{{{KML}}}{tag}")
    child.text = xml_text(text) if text is not None else None
    return child


def _folder(document: ET.Element, name: str) -> ET.Element:
    folder = _child(document, "Folder")
    _child(folder, "name", name)
    return folder


def _placemark(
    folder: ET.Element, name: str, note: str = "", style: str = "", span: Sequence[str] = (),
    geometry: Mapping[str, Any] | None = None,
) -> ET.Element:  # fmt: skip
    """Add a place mark with a geometry of GeoJSON on the ground; its elements have a fixed order."""
    placemark = _child(folder, "Placemark")
    _child(placemark, "name", name)
    if note:
        _child(placemark, "description", note)
    if span:
        times = _child(placemark, "TimeSpan")
        for tag, time in zip(("begin", "end"), span, strict=True):
            _child(times, tag, time)
    if style:
        _child(placemark, "styleUrl", f"#{style}")
    if geometry is not None:
        shape, places = _child(placemark, geometry["type"]), geometry["coordinates"]
        if geometry["type"] == "LineString":
            _child(shape, "tessellate", "1")
        else:
            places = [places]
        _child(shape, "coordinates", " ".join(f"{east:.9f},{north:.9f},0" for east, north in places))
    return placemark


def _track(folder: ET.Element, path: ExportPath, globe: Globe) -> None:
    rows = rows_apart(path.stamp_ns, TRACK_INTERVAL_S)
    track = ET.SubElement(_placemark(folder, "robot", style="filter"), f"{{{GX}}}Track")
    _child(track, "altitudeMode", "clampToGround")
    for time in utc_text(path.stamp_ns[rows]):
        _child(track, "when", time)
    for east, north in coordinates(path.x_m[rows], path.y_m[rows], globe):
        ET.SubElement(track, f"{{{GX}}}coord").text = f"{east:.9f} {north:.9f} 0"
    for heading_deg in np.mod(90.0 - np.degrees(path.yaw_rad[rows]), 360.0).tolist():
        ET.SubElement(track, f"{{{GX}}}angles").text = f"{heading_deg:.1f} 0 0"
