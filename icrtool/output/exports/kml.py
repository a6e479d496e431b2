"""A run as KML 2.2 for Google Earth: its paths, the drive over time, outages and slip events."""

from __future__ import annotations

from collections.abc import Iterator
from xml.etree import ElementTree as ET

import numpy as np

from icrtool.kernels.arrays import Floats
from icrtool.output.exports.paths import (
    LABELS,
    ExportPath,
    Globe,
    PathName,
    find_globe,
    line_rows,
    outage_rows,
    paths_of,
    rows_apart,
    utc_text,
)
from icrtool.output.text_format import distance_text, duration_text, run_title, xml_text
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
    _child(document, "name", run_title(run.summary))
    _child(document, "description", _about(run))
    for name, color in COLORS.items():
        style = _child(document, "Style")
        style.set("id", name)
        line = _child(style, "LineStyle")
        _child(line, "color", color)
        _child(line, "width", "6" if name == "outage" else "3")
    folder = _folder(document, "paths")
    for path in paths:
        note = "" if path.name in ("filter", "smoothed") else f"ends {distance_text(path.end_error_m)} off the filter"
        _line(_placemark(folder, LABELS[path.name], note, path.name), path.x_m, path.y_m, globe)
    _track(_folder(document, "drive over time"), paths[0], globe)
    _outages(_folder(document, "outages"), run, paths[0], globe)
    _events(_folder(document, "slip events"), run, globe)
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode")


def _about(run: Run) -> str:
    drive = run.summary["drive"]
    begin, _ = utc_text(run.table.stamp_ns[[0, -1]])
    driven = f"{begin}: {distance_text(drive['distance_m'])} in {duration_text(drive['duration_s'])}"
    return driven if run.usable else f"{driven}. Not usable: {run.summary['unusable_because']}"


def _child(parent: ET.Element, tag: str, text: str | None = None) -> ET.Element:
    child = ET.SubElement(parent, f"{{{KML}}}{tag}")
    child.text = xml_text(text) if text is not None else None
    return child


def _folder(document: ET.Element, name: str) -> ET.Element:
    folder = _child(document, "Folder")
    _child(folder, "name", name)
    return folder


def _placemark(
    folder: ET.Element, name: str, note: str = "", style: str = "", span_ns: tuple[int, int] | None = None
) -> ET.Element:
    """Add a place mark without its geometry; its elements have a fixed order."""
    placemark = _child(folder, "Placemark")
    _child(placemark, "name", name)
    if note:
        _child(placemark, "description", note)
    if span_ns is not None:
        span = _child(placemark, "TimeSpan")
        for tag, time in zip(("begin", "end"), utc_text(np.array(span_ns, np.int64)), strict=True):
            _child(span, tag, time)
    if style:
        _child(placemark, "styleUrl", f"#{style}")
    return placemark


def _line(placemark: ET.Element, x_m: Floats, y_m: Floats, globe: Globe) -> None:
    """Add a line on the ground through points (n,) east and north of the datum."""
    rows = line_rows(x_m, y_m)
    line = _child(placemark, "LineString")
    _child(line, "tessellate", "1")
    _child(line, "coordinates", " ".join(_coordinates(x_m[rows], y_m[rows], globe, ",")))


def _coordinates(x_m: Floats, y_m: Floats, globe: Globe, separator: str) -> Iterator[str]:
    latitude, longitude = globe.places(x_m, y_m)
    for east, north in zip(longitude.tolist(), latitude.tolist(), strict=True):
        yield f"{east:.9f}{separator}{north:.9f}{separator}0"


def _track(folder: ET.Element, path: ExportPath, globe: Globe) -> None:
    rows = rows_apart(path.stamp_ns, TRACK_INTERVAL_S)
    track = ET.SubElement(_placemark(folder, "robot", style="filter"), f"{{{GX}}}Track")
    _child(track, "altitudeMode", "clampToGround")
    for time in utc_text(path.stamp_ns[rows]):
        _child(track, "when", time)
    for place in _coordinates(path.x_m[rows], path.y_m[rows], globe, " "):
        ET.SubElement(track, f"{{{GX}}}coord").text = place
    for heading_deg in np.mod(90.0 - np.degrees(path.yaw_rad[rows]), 360.0).tolist():
        ET.SubElement(track, f"{{{GX}}}angles").text = f"{heading_deg:.1f} 0 0"


def _outages(folder: ET.Element, run: Run, path: ExportPath, globe: Globe) -> None:
    for number, (span_ns, rows) in enumerate(outage_rows(run), start=1):
        note = f"{duration_text((span_ns[1] - span_ns[0]) / 1e9)} without usable GNSS"
        placemark = _placemark(folder, f"outage {number}", note, "outage", span_ns)
        _line(placemark, path.x_m[rows], path.y_m[rows], globe)


def _events(folder: ET.Element, run: Run, globe: Globe) -> None:
    for event in run.summary["events"]:
        lasted = duration_text(event["end_s"] - event["begin_s"])
        note = f"{lasted}, {100 * event['severity']:.0f} % of the wheels' motion missed"
        placemark = _placemark(folder, event["kind"], note, span_ns=(event["begin_ns"], event["end_ns"]))
        x_m, y_m = np.array([event["east_m"]]), np.array([event["north_m"]])
        _child(_child(placemark, "Point"), "coordinates", next(_coordinates(x_m, y_m, globe, ",")))
