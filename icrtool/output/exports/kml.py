"""A run as KML 2.2 for Google Earth: its paths, the drive over time, outages and slip events."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from icrtool.output.exports.geojson import coordinates, event_features, outage_features, path_features
from icrtool.output.exports.paths import ExportPath, Globe, PathName, find_globe, paths_of, rows_apart, utc_text
from icrtool.output.text_format import distance_text, driven_text, duration_text, run_title, xml_text
from icrtool.records.run import Run

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
