"""The paths of a run for other programs: poses in ENU (REP-103) as text, and on the globe as GeoJSON and KML.

Text is for evo and KITTI tools, GeoJSON for QGIS and web maps, KML 2.2 for Google Earth.

x is east, y is north, z is up; yaw is counter-clockwise from east; the body's x is forward and its y left. The origin
is the datum of the run, or the origin of its position reference where this was metric already.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple
from xml.etree import ElementTree as ET

import numpy as np
import orjson

from icrtool import __version__
from icrtool.alignment.gnss_quality import CLASSES
from icrtool.dropout_analysis.trials import errors_from_states
from icrtool.errors import DataError
from icrtool.estimation.odometry import OdometryName, OdometryPath, drive_wheels, odometry_icrs
from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.filter_records import GATED, UNSEEN
from icrtool.kernels.track import FrozenIcrs
from icrtool.output.series import BLUE, ORANGE, rows_entering_cells
from icrtool.output.text_format import PATH_WORDS, driven_text, duration_text, run_title, xml_text
from icrtool.records.choices import TrajectoryFormat
from icrtool.records.plain_data import plain_value
from icrtool.records.run import ICR_COLUMNS, Run
from icrtool.records.tables import States
from icrtool.records.text import distance_text

PathName = Literal["filter", "smoothed"] | OdometryName
"""Name of a path of a run."""

ERROR_HORIZON_M = 10.0
"""Distance after which open-loop errors are exported [m]."""

LINE_CELL_M = 0.05
"""Side of the grid cells that thin a line [m]. A line has a point where it enters another cell."""

METRIC_ONLY = "its position reference is metric, so its place on the globe is not known"
"""Reason for which a run has no place on the globe."""


@dataclass(frozen=True, slots=True)
class ExportPath:
    """One path of a run, at every recorded state.

    Attributes
    ----------
    name : name of the path
    stamp_ns : int64 (n,), of the log's clock
    x_m, y_m : float64 (n,), east and north of the datum
    yaw_rad : float64 (n,), counter-clockwise from east, unwrapped
    icrs : ICRs that give this path's velocities from wheel speeds; for filter and smoother the filter's ICRs
    end_error_m : distance to the filter's estimate at the last state
    """

    name: PathName
    stamp_ns: Ints
    x_m: Floats
    y_m: Floats
    yaw_rad: Floats
    icrs: FrozenIcrs
    end_error_m: float

    @property
    def quaternion(self) -> tuple[Floats, Floats]:
        """The z and w components (n,) of the orientation; x and y are zero."""
        return np.sin(self.yaw_rad / 2), np.cos(self.yaw_rad / 2)


class Globe(NamedTuple):
    """Origin of the local plane: latitude and longitude [deg], WGS 84, height above the ellipsoid [m]."""

    latitude_deg: float
    longitude_deg: float
    height_m: float

    def places(self, x_m: Floats, y_m: Floats) -> tuple[Floats, Floats]:
        """Return latitude and longitude (n,) [deg] of points in the local plane."""
        from pymap3d import enu2geodetic

        latitude, longitude, _ = enu2geodetic(x_m, y_m, np.zeros_like(x_m), *self)
        return np.asarray(latitude, np.float64), np.asarray(longitude, np.float64)


def paths_of(run: Run) -> tuple[ExportPath, ...]:
    """Return the paths of a run: filter, smoother where it has one, ICR odometry, no slip where b is known."""
    table = run.table
    icrs_of = odometry_icrs(table, run.track_width_m)
    momentary = icrs_of.pop("icr_momentary")
    parts: list[tuple[PathName, States | OdometryPath, FrozenIcrs, float]] = [("filter", table, momentary, 0.0)]
    if run.smoothed is not None:
        parts.append(("smoothed", run.smoothed, momentary, 0.0))
    for name, icrs in icrs_of.items():
        driven = drive_wheels(table, run.in_gap, icrs)
        parts.append((name, driven, icrs, driven.end_error_m))
    return tuple(
        ExportPath(name, table.stamp_ns, path.east_m, path.north_m, math.pi / 2 - path.heading_rad, icrs, end_error_m)
        for name, path, icrs, end_error_m in parts
    )


def about_run(run: Run) -> dict[str, str | bool | None]:
    """Return the facts that an export states about its run."""
    return {
        "log": run.name,
        "robot": run.config.robot.name,
        "usable": run.usable,
        "unusable_because": run.document.unusable_because,
        "tool_version": __version__,
    }


def globe_of(run: Run) -> Globe | None:
    """Return the datum of a run; None where its positions were metric and none was configured."""
    if (datum := run.document.gnss.datum) is not None:
        return Globe(*datum)
    return Globe(*run.config.frames.datum, 0.0) if run.config.frames.datum is not None else None


def find_globe(run: Run) -> Globe:
    """Return the datum of a run.

    Raises
    ------
    DataError
        Its positions were metric, and none was configured.
    """
    if (globe := globe_of(run)) is None:
        advice = "fit it with --set frames.datum=[latitude,longitude] if its axes are north and east, or use --for evo"
        raise DataError(run.name, METRIC_ONLY, advice)
    return globe


def utc_text(stamp_ns: Ints) -> list[str]:
    """Return stamps (n,) as texts in ISO 8601, to the millisecond."""
    return [f"{text}Z" for text in np.datetime_as_string(stamp_ns.astype("datetime64[ns]"), unit="ms").tolist()]


def rows_apart(stamp_ns: Ints, interval_s: float) -> Ints:
    """Return rows (m,) of stamps, at most one in each interval; the last row is always one of them."""
    number = (stamp_ns - stamp_ns[0]) // round(interval_s * 1e9)
    return np.unique(np.concatenate([[0], np.flatnonzero(np.diff(number)) + 1, [len(stamp_ns) - 1]]))


def line_rows(x_m: Floats, y_m: Floats) -> Ints:
    """Return rows (m,) of points (n,) at which a line enters another cell of a fine grid, at least two."""
    rows = rows_entering_cells(y_m, x_m, LINE_CELL_M)
    return rows if len(rows) > 1 else np.repeat(rows, 2)


def outage_rows(run: Run) -> Iterator[tuple[tuple[int, int], slice]]:
    """Yield start and end [ns] of each outage, and the states in it."""
    stamps = run.table.stamp_ns
    for begin_ns, end_ns in run.outages_ns.tolist():
        first, last = np.searchsorted(stamps, [begin_ns, end_ns])
        yield (begin_ns, end_ns), slice(min(int(first), len(stamps) - 1), int(last) + 1)


SUFFIXES: dict[TrajectoryFormat, str] = {"evo": ".tum", "kitti": ".kitti"}
"""Suffix of a file with a trajectory, by format."""

DIGITS = 9
"""Number of decimals of positions [m] and of entries of rotations."""


def format_trajectory(path: ExportPath, target: TrajectoryFormat) -> str:
    """Return a path as text: one line for each state, with a line end after the last.

    Notes
    -----
    TUM (``evo``): stamp [s], x, y, z, and the quaternion x, y, z, w. KITTI: the upper three rows of the pose matrix,
    row by row, without a stamp. World ENU, body x forward and y left (REP-103); KITTI's own camera frame is not used.
    """
    cos, sin = np.cos(path.yaw_rad), np.sin(path.yaw_rad)
    columns = (cos, -sin, path.x_m, sin, path.y_m) if target == "kitti" else (path.x_m, path.y_m, *path.quaternion)
    # Adding zero turns -0.0 into 0.0.
    rows = zip(*((np.round(column, DIGITS) + 0.0).tolist() for column in columns), strict=True)
    if target == "kitti":
        return "".join(f"{c} {n} 0 {x} {s} {c} 0 {y} 0 0 1 0\n" for c, n, x, s, y in rows)
    stamps = (divmod(stamp, 1_000_000_000) for stamp in path.stamp_ns.tolist())
    lines = zip(stamps, rows, strict=True)
    return "".join(f"{whole}.{part:09d} {x} {y} 0 0 0 {z} {w}\n" for (whole, part), (x, y, z, w) in lines)


def is_trajectory(first: bytes) -> bool:
    """Return whether a file holds lines of numbers only, by its first bytes."""
    return re.fullmatch(rb"[-+.0-9e \n]*", first) is not None


STATE_CELL_M = 0.2
"""Side of the grid cells that thin the states [m]. A state becomes a point where the path enters another cell."""

DEGREE_DIGITS = 9
"""Number of decimals of latitude and longitude, for 0.1 mm."""

Feature = dict[str, Any]
"""A feature of GeoJSON."""


def format_geojson(run: Run) -> str:
    """Return a feature collection without the last line end; the attribute ``layer`` states the kind of each feature.

    Layers: ``path`` (a line for each of filter, smoother, ICR and no-slip odometry), ``state`` (points along the
    filter's path, at most one in 0.2 m), ``fix``, ``event`` and ``outage`` (a line).

    Raises
    ------
    DataError
        The run has no place on the globe.
    """
    globe = find_globe(run)
    features = [
        *_path_features(run, paths_of(run), globe),
        *_outage_features(run, globe),
        *_state_features(run, globe),
        *_fix_features(run, globe),
        *_event_features(run, globe),
    ]
    document = {"type": "FeatureCollection", "name": run.name, "icrtool": about_run(run), "features": features}
    return orjson.dumps(plain_value(document)).decode()


def coordinates_of(x_m: Floats, y_m: Floats, globe: Globe) -> list[list[float]]:
    """Return longitude and latitude [deg] of points (n,) east and north of the datum."""
    latitude, longitude = globe.places(x_m, y_m)
    pairs: list[list[float]] = np.round(np.column_stack([longitude, latitude]), DEGREE_DIGITS).tolist()
    return pairs


def _line(layer: str, x_m: Floats, y_m: Floats, globe: Globe, properties: dict[str, Any]) -> Feature:
    """Return a thinned line of a layer through points (n,)."""
    rows = line_rows(x_m, y_m)
    geometry = {"type": "LineString", "coordinates": coordinates_of(x_m[rows], y_m[rows], globe)}
    return {"type": "Feature", "geometry": geometry, "properties": {"layer": layer} | properties}


def _points(layer: str, x_m: Floats, y_m: Floats, globe: Globe, columns: dict[str, list[Any]]) -> Iterator[Feature]:
    """Yield a point for each row; `columns` are its attributes."""
    for pair, values in zip(coordinates_of(x_m, y_m, globe), zip(*columns.values(), strict=True), strict=True):
        properties = {"layer": layer, **dict(zip(columns, values, strict=True))}
        yield {"type": "Feature", "geometry": {"type": "Point", "coordinates": pair}, "properties": properties}


def _path_features(run: Run, paths: Sequence[ExportPath], globe: Globe) -> Iterator[Feature]:
    """Yield a line for each path."""
    for path in paths:
        length_m = float(np.hypot(np.diff(path.x_m), np.diff(path.y_m)).sum())
        begin, end = utc_text(path.stamp_ns[[0, -1]])
        properties = {
            "path": path.name, "label": PATH_WORDS[path.name], "log": run.name, "begin_utc": begin, "end_utc": end,
            "length_m": length_m, "end_error_m": path.end_error_m, "usable": run.usable,
        }  # fmt: skip
        yield _line("path", path.x_m, path.y_m, globe, properties)


def _outage_features(run: Run, globe: Globe) -> Iterator[Feature]:
    """Yield the filter's path in each outage as a line."""
    for span_ns, rows in outage_rows(run):
        begin, end = utc_text(np.array(span_ns, np.int64))
        properties = {"begin_utc": begin, "end_utc": end, "duration_s": (span_ns[1] - span_ns[0]) / 1e9}
        yield _line("outage", run.table.east_m[rows], run.table.north_m[rows], globe, properties)


def _state_features(run: Run, globe: Globe) -> Iterator[Feature]:
    """Yield a point for each state of the thinned path, with its speeds, ICRs and open-loop errors."""
    table = run.table
    rows = rows_entering_cells(table.north_m, table.east_m, STATE_CELL_M)
    stamps = table.stamp_ns[rows]
    columns: dict[str, list[Any]] = {"time_utc": utc_text(stamps), "stamp_ns": stamps.tolist()}
    names = ["t_s", "distance_m", "heading_deg", "v_left_mps", "v_right_mps", "std_north_m", "std_east_m"]
    names += [name for icr in ICR_COLUMNS for name in (icr, f"std_{icr}")]
    for name in names:
        is_heading = name == "heading_deg"
        column = np.mod(np.degrees(table.heading_rad[rows]), 360.0) if is_heading else getattr(table, name)[rows]
        columns[name] = column.tolist()
    for model, errors in errors_from_states(run, ERROR_HORIZON_M).items():
        columns[f"{model}_error_{ERROR_HORIZON_M:g}m_m"] = errors[rows].tolist()
    yield from _points("state", table.east_m[rows], table.north_m[rows], globe, columns)


def _fix_features(run: Run, globe: Globe) -> Iterator[Feature]:
    """Yield a point for each fix, with its class and its use by the filter."""
    fixes, outcome, uses = run.sensors.fixes, run.gnss, {UNSEEN: "not in the run", GATED: "rejected"}
    columns = {
        "time_utc": utc_text(fixes.stamp_ns),
        "stamp_ns": fixes.stamp_ns.tolist(),
        "class": [CLASSES[code] for code in fixes.fix_class.tolist()],
        "use": [uses.get(code, "used") for code in outcome.code.tolist()],
        "nis": outcome.nis.tolist(),
        "difference_m": outcome.difference.tolist(),
        "std_north_m": np.sqrt(fixes.var_north_m2).tolist(),
        "std_east_m": np.sqrt(fixes.var_east_m2).tolist(),
    }
    yield from _points("fix", fixes.east_m, fixes.north_m, globe, columns)


def _event_features(run: Run, globe: Globe) -> Iterator[Feature]:
    """Yield a point for each slip event."""
    for event in plain_value(run.document.events):
        east, north = np.array([event.pop("east_m")]), np.array([event.pop("north_m")])
        begin = utc_text(np.array([event["begin_ns"]], np.int64))
        yield from _points(
            "event", east, north, globe, {"begin_utc": begin} | {key: [value] for key, value in event.items()}
        )


KML, GX = "http://www.opengis.net/kml/2.2", "http://www.google.com/kml/ext/2.2"
"""Namespaces of KML and of its extensions by Google."""

TRACK_INTERVAL_S = 1.0
"""Interval between two places of the drive over time [s]."""

EXPORT_COLORS: dict[PathName | str, str] = {
    "filter": "#000000", "smoothed": "#606060", "icr": BLUE, "no_slip": ORANGE, "outage": "#ffff00",
}  # fmt: skip
"""Colours of lines in KML, by path, and of outages."""


def format_kml(run: Run) -> str:
    """Return a KML document without the last line end: lines on the ground, a track with times, outages, events.

    Raises
    ------
    DataError
        The run has no place on the globe.
    """
    globe, paths = find_globe(run), paths_of(run)
    ET.register_namespace("", KML)
    ET.register_namespace("gx", GX)
    about = f"{utc_text(run.table.stamp_ns[:1])[0]}: {driven_text(run.document.drive)}"
    about = about if run.usable else f"{about}. Not usable: {run.document.unusable_because}"
    styles = []
    for name, color in EXPORT_COLORS.items():
        red, green, blue = color[1:3], color[3:5], color[5:7]
        width = _element("width", "6" if name == "outage" else "3")
        styles.append(
            _element("Style", _element("LineStyle", _element("color", f"ff{blue}{green}{red}"), width), id=name)
        )
    folders = [
        _folder("paths", _path_features(run, paths, globe)),
        _element("Folder", _element("name", "drive over time"), _track(paths[0], globe)),
        _folder("outages", _outage_features(run, globe)),
        _folder("slip events", _event_features(run, globe)),
    ]
    titled = _element("name", run_title(run.document)), _element("description", about)
    root = _element("kml", _element("Document", *titled, *styles, *folders))
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode")


def _element(tag: str, *content: str | ET.Element, **attributes: str) -> ET.Element:
    """Return an element of KML that holds a text or other elements, in their order."""
    element = ET.Element(tag if tag.startswith("{") else f"{{{KML}}}{tag}", attributes)
    for part in content:
        if isinstance(part, str):
            element.text = xml_text(part)
        else:
            element.append(part)
    return element


def _folder(name: str, features: Iterable[Feature]) -> ET.Element:
    """Return features as place marks on the ground."""
    marks = []
    for number, feature in enumerate(features, start=1):
        title, note, style, times = _description(feature["properties"], number)
        geometry, line = feature["geometry"], feature["geometry"]["type"] == "LineString"
        places = geometry["coordinates"] if line else [geometry["coordinates"]]
        text = " ".join(f"{east:.9f},{north:.9f},0" for east, north in places)
        shape = [*([_element("tessellate", "1")] if line else []), _element("coordinates", text)]
        facts = [
            *([_element("description", note)] if note else []),
            *([_element("TimeSpan", _element("begin", times[0]), _element("end", times[1]))] if times else []),
            *([_element("styleUrl", style)] if style else []),
        ]
        marks.append(_element("Placemark", _element("name", title), *facts, _element(geometry["type"], *shape)))
    return _element("Folder", _element("name", name), *marks)


def _description(facts: Mapping[str, Any], number: int) -> tuple[str, str, str, Sequence[str]]:
    """Return name, note, style and times of a feature, by its attributes."""
    if facts["layer"] == "path":
        drifts = facts["path"] not in ("filter", "smoothed")
        note = f"ends {distance_text(facts['end_error_m'])} off the filter" if drifts else ""
        return facts["label"], note, f"#{facts['path']}", ()
    if facts["layer"] == "outage":
        note = f"{duration_text(facts['duration_s'])} without usable GNSS"
        return f"outage {number}", note, "#outage", (facts["begin_utc"], facts["end_utc"])
    lasted = duration_text(facts["end_s"] - facts["begin_s"])
    note = f"{lasted}, {100 * facts['severity']:.0f} % of the wheels' motion missed"
    return facts["kind"], note, "", utc_text(np.array([facts["begin_ns"], facts["end_ns"]], np.int64))


def _track(path: ExportPath, globe: Globe) -> ET.Element:
    """Return the place mark of a path over time."""
    rows = rows_apart(path.stamp_ns, TRACK_INTERVAL_S)
    headings_deg = np.mod(90.0 - np.degrees(path.yaw_rad[rows]), 360.0).tolist()
    track = _element(
        f"{{{GX}}}Track",
        _element("altitudeMode", "clampToGround"),
        *(_element("when", time) for time in utc_text(path.stamp_ns[rows])),
        *(
            _element(f"{{{GX}}}coord", f"{east:.9f} {north:.9f} 0")
            for east, north in coordinates_of(path.x_m[rows], path.y_m[rows], globe)
        ),
        *(_element(f"{{{GX}}}angles", f"{heading_deg:.1f} 0 0") for heading_deg in headings_deg),
    )
    return _element("Placemark", _element("name", "robot"), _element("styleUrl", "#filter"), track)
