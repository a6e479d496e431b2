"""Paths of a run for other programs, read back by those programs' own readers."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from numpy.testing import assert_allclose

from icrtool.calibration.run_models import models_of
from icrtool.errors import DataError
from icrtool.estimation.odometry import drive_wheels, odometry_icrs
from icrtool.kernels.open_loop import open_loop_errors_direct
from icrtool.kernels.track import trial_ends
from icrtool.output.exports.foxglove import BODIES, ERROR_HORIZON_M, WORLD, foxglove_layout, write_foxglove
from icrtool.output.exports.paths import GX, KML, format_geojson, format_kml, format_trajectory, paths_of
from icrtool.records.run import Run, track_of
from support.barn import BAD_FIXES, OUTAGE_S
from support.documents import with_summary

Floats = np.ndarray[Any, np.dtype[np.float64]]

WRITTEN_M = 2e-9
"""Half a unit of the last written decimal of a position, and its rounding."""

ON_GLOBE_M = 0.002
"""Over 60 m, radii of curvature at the datum approximate the ellipsoid to this."""

EVENT = {
    "kind": "slip", "begin_s": 10.0, "end_s": 12.5, "begin_ns": 1_760_000_010_000_000_000,
    "end_ns": 1_760_000_012_500_000_000, "north_m": 3.0, "east_m": 4.0, "distance_m": 0.5, "severity": 0.75,
    "confidence": 0.99,
}  # fmt: skip


@pytest.fixture(scope="module")
def slipping(run: Run) -> Run:
    return with_summary(run, events=[EVENT])


@pytest.fixture(scope="module")
def metric(make_run: Callable[..., Run]) -> Run:
    return make_run(datum=False, duration_s=30.0, troubles=False, track_width_m=None)


def local_plane(longitude: Floats, latitude: Floats, run: Run) -> tuple[Floats, Floats]:
    """Return east and north of the datum [m], by the radii of curvature there (WGS 84)."""
    latitude_deg, longitude_deg, height_m = run.summary["gnss"]["datum"]
    a, e2, phi = 6_378_137.0, 6.694_379_990_14e-3, np.radians(latitude_deg)
    bend = 1.0 - e2 * np.sin(phi) ** 2
    meridian, normal = a * (1.0 - e2) / bend**1.5, a / np.sqrt(bend)
    north = np.radians(latitude - latitude_deg) * (meridian + height_m)
    return np.radians(longitude - longitude_deg) * (normal + height_m) * np.cos(phi), north


def farthest_from_path(x: Floats, y: Floats, path_x: Floats, path_y: Floats) -> float:
    """Return how far the farthest point is from the nearest state of a path [m]."""
    gaps = np.hypot(x[:, None] - path_x[None, :], y[:, None] - path_y[None, :])
    return float(gaps.min(axis=1).max())


def test_evo_reads_the_trajectories_with_their_poses(run: Run, tmp_path: Path) -> None:
    file_interface = pytest.importorskip("evo.tools.file_interface")
    for path in paths_of(run):
        (tmp_path / "p.tum").write_text(format_trajectory(path, "evo"), encoding="utf-8")
        (tmp_path / "p.kitti").write_text(format_trajectory(path, "kitti"), encoding="utf-8")
        tum = file_interface.read_tum_trajectory_file(tmp_path / "p.tum")
        kitti = file_interface.read_kitti_poses_file(tmp_path / "p.kitti")
        assert tum.check()[0]
        assert kitti.check()[0]
        assert_allclose(tum.timestamps, path.stamp_ns / 1e9, rtol=0, atol=1e-6)
        for read in (tum, kitti):
            assert_allclose(read.positions_xyz[:, :2], np.column_stack([path.x_m, path.y_m]), rtol=0, atol=WRITTEN_M)
            ahead = np.array([pose[:2, 0] for pose in read.poses_se3])
            assert_allclose(ahead, np.column_stack([np.cos(path.yaw_rad), np.sin(path.yaw_rad)]), rtol=0, atol=1e-8)


def test_the_command_evo_ape_finds_the_error_of_the_odometry(run: Run, tmp_path: Path) -> None:
    evo_ape = Path(sys.executable).with_name("evo_ape")
    if not evo_ape.exists():
        pytest.skip("evo is not installed: pip install icrtool[bench]")
    filtered, icr, _ = paths_of(run)
    for path in (filtered, icr):
        (tmp_path / f"{path.name}.tum").write_text(format_trajectory(path, "evo"), encoding="utf-8")
    command = [evo_ape, "tum", tmp_path / "filter.tum", tmp_path / "icr.tum"]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"HOME": str(tmp_path)}, check=True)
    found = dict(line.split() for line in done.stdout.splitlines() if len(line.split()) == 2)
    error = np.hypot(icr.x_m - filtered.x_m, icr.y_m - filtered.y_m)
    assert float(found["max"]) == pytest.approx(error.max(), abs=1e-5)
    assert float(found["rmse"]) == pytest.approx(np.sqrt(np.mean(error**2)), abs=1e-5)


def test_the_yaw_of_the_odometry_points_along_its_path(run: Run) -> None:
    """Without slip a robot moves where it points; x_icr is zero in that model."""
    path = paths_of(run)[-1]
    assert path.name == "no_slip"
    drive = track_of(run)
    steps = np.diff(path.x_m) + 1j * np.diff(path.y_m)
    along = (np.abs(steps) > 0.005) & (drive.held[:-1] > 0.0)
    assert np.count_nonzero(along) > 1000
    assert np.abs(np.angle(steps[along] / np.exp(1j * path.yaw_rad[:-1][along]))).max() < 1e-6


def test_paths_of_a_run_without_width_leave_no_slip_out(metric: Run) -> None:
    assert [path.name for path in paths_of(metric)] == ["filter", "icr"]


def test_the_lines_of_the_kml_lie_on_the_paths(slipping: Run) -> None:
    root = ET.fromstring(format_kml(slipping))
    names = [mark.findtext(f"{{{KML}}}name") for mark in root.iter(f"{{{KML}}}Placemark")]
    assert names == ["filter", "ICR odometry", "no-slip odometry", "robot", "outage 1", "slip"]
    lines = [line.text or "" for line in root.findall(f".//{{{KML}}}LineString/{{{KML}}}coordinates")]
    for path, text in zip(paths_of(slipping), lines, strict=False):
        longitude, latitude, _ = np.array([place.split(",") for place in text.split()], np.float64).T
        x, y = local_plane(longitude, latitude, slipping)
        assert farthest_from_path(x, y, path.x_m, path.y_m) < ON_GLOBE_M
        assert farthest_from_path(path.x_m, path.y_m, x, y) < 0.1
    track = root.find(f".//{{{GX}}}Track")
    assert track is not None
    times, places = track.findall(f"{{{KML}}}when"), track.findall(f"{{{GX}}}coord")
    assert len(times) == len(places) == len(track.findall(f"{{{GX}}}angles"))
    assert times[0].text == "2025-10-09T08:53:20.000Z"


KML_SEQUENCES = {
    "kml": ["Document"], "Document": ["name", "description", "Style", "Folder"], "Style": ["LineStyle"],
    "LineStyle": ["color", "width"], "Folder": ["name", "Placemark"],
    "Placemark": ["name", "description", "TimeSpan", "styleUrl", "Point", "LineString", "Track"],
    "TimeSpan": ["begin", "end"], "LineString": ["tessellate", "coordinates"], "Point": ["coordinates"],
    "Track": ["altitudeMode", "when", "coord", "angles"],
}  # fmt: skip
"""Children in the order of the sequences of OGC 07-147r2 (KML 2.2) and of Google's extension, those that we write."""

KML_VALUES = {
    "color": r"[0-9a-f]{8}", "width": r"\d+", "tessellate": "1", "altitudeMode": "clampToGround",
    "begin": r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z", "angles": r"\d+\.\d 0 0",
    "coordinates": r"(-?\d+\.\d{9},-?\d+\.\d{9},0 ?)+", "coord": r"-?\d+\.\d{9} -?\d+\.\d{9} 0",
}  # fmt: skip


def test_the_kml_has_the_structure_of_its_schema(slipping: Run) -> None:
    root = ET.fromstring(format_kml(slipping))
    extended = {f"{{{GX}}}{name}" for name in ("Track", "coord", "angles")}
    for element in root.iter():
        namespace, _, name = element.tag[1:].partition("}")
        assert namespace == (GX if element.tag in extended else KML)
        order = [KML_SEQUENCES[name].index(child.tag.partition("}")[2]) for child in element]
        assert order == sorted(order), name
        assert re.fullmatch(KML_VALUES.get(name, ".*"), (element.text or "").strip(), re.DOTALL), (name, element.text)
    styles = {f"#{style.get('id')}" for style in root.iter(f"{{{KML}}}Style")}
    assert {url.text for url in root.iter(f"{{{KML}}}styleUrl")} <= styles


def test_a_hostile_name_stays_text_in_the_kml(run: Run) -> None:
    named = with_summary(run, log="<b>&]]>\x1b\x00")
    document = ET.fromstring(format_kml(named)).find(f"{{{KML}}}Document")
    assert document is not None
    assert str(document.findtext(f"{{{KML}}}name")).startswith("<b>&]]>??")


def test_the_geojson_holds_states_fixes_events_and_outages(slipping: Run) -> None:
    features = json.loads(format_geojson(slipping))["features"]
    layers: dict[str, list[dict[str, Any]]] = {}
    for feature in features:
        layers.setdefault(feature["properties"]["layer"], []).append(feature)
    assert [line["properties"]["path"] for line in layers["path"]] == ["filter", "icr", "no_slip"]
    ends = [line["properties"]["end_error_m"] for line in layers["path"]]
    driven = drive_wheels(slipping.table, slipping.in_gap, odometry_icrs(slipping.table, None)["icr"])
    assert ends[1] == pytest.approx(driven.end_error_m)
    (outage,) = layers["outage"]
    assert outage["properties"]["duration_s"] == pytest.approx(OUTAGE_S[1] - OUTAGE_S[0], abs=0.2)
    (event,) = layers["event"]
    assert event["properties"]["severity"] == 0.75
    uses = [fix["properties"]["use"] for fix in layers["fix"]]
    assert uses.count("rejected") == BAD_FIXES
    assert len(uses) == len(slipping.sensors.fixes.stamp_ns)

    table, drive = slipping.table, track_of(slipping)
    row_of = {stamp: row for row, stamp in enumerate(table.stamp_ns.tolist())}
    rows = [row_of[state["properties"]["stamp_ns"]] for state in layers["state"]]
    assert len(rows) > 100
    values = [state["properties"] for state in layers["state"]]
    assert [one["std_x_icr_m"] for one in values] == table.std_x_icr_m[rows].tolist()
    ends_at = trial_ends(drive, np.array([10.0]))
    for model in models_of(slipping):
        errors = open_loop_errors_direct(drive, model.icrs, ends_at)[rows, 0]
        found = np.array([one[f"{model.name}_error_10m_m"] for one in values], np.float64)
        assert_allclose(found, errors, rtol=0, atol=1e-6)
    longitude, latitude = np.array([state["geometry"]["coordinates"] for state in layers["state"]]).T
    x, y = local_plane(longitude, latitude, slipping)
    assert np.hypot(x - table.east_m[rows], y - table.north_m[rows]).max() < ON_GLOBE_M


def test_gdal_reads_geojson_and_kml(slipping: Run, tmp_path: Path) -> None:
    pyogrio = pytest.importorskip("pyogrio", reason="GDAL is not installed: pip install pyogrio")
    for name, text in (("run.geojson", format_geojson(slipping)), ("run.kml", format_kml(slipping))):
        (tmp_path / name).write_text(text, encoding="utf-8")
    info = pyogrio.read_info(tmp_path / "run.geojson")
    assert info["crs"] == "EPSG:4326"
    assert {"layer", "nis", "icr_error_10m_m", "y_icr_right_m"} <= set(info["fields"])
    layers = [str(name) for name, _ in pyogrio.list_layers(tmp_path / "run.kml")]
    assert layers == ["paths", "drive over time", "outages", "slip events"]
    assert [pyogrio.read_info(tmp_path / "run.kml", layer=name)["features"] for name in layers] == [3, 1, 1, 1]


def test_a_metric_run_is_not_put_on_the_globe_unless_its_datum_is_configured(metric: Run) -> None:
    for export in (format_kml, format_geojson):
        with pytest.raises(DataError, match=r"frames\.datum"):
            export(metric)
    frames = metric.summary["config"]["frames"] | {"datum": [48.0, 11.0]}
    placed = json.loads(format_geojson(with_summary(metric, config={"frames": frames})))
    longitude, latitude = placed["features"][0]["geometry"]["coordinates"][0]
    assert (round(longitude, 4), round(latitude, 4)) == (11.0, 48.0)


@pytest.fixture(scope="module")
def mcap_file(slipping: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("foxglove") / "run.mcap"
    write_foxglove(slipping, path)
    return path


def decoded(path: Path) -> dict[str, list[Any]]:
    """Return all messages by topic, read by the mcap library and its ROS 2 decoder."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    messages: dict[str, list[Any]] = {}
    with path.open("rb") as stream:
        for found in make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            messages.setdefault(found.channel.topic, []).append(found.decoded_message)
    return messages


def test_the_mcap_library_reads_the_poses_and_speeds_of_each_path(slipping: Run, mcap_file: Path) -> None:
    messages, table = decoded(mcap_file), slipping.table
    row_of = {stamp: row for row, stamp in enumerate(table.stamp_ns.tolist())}
    for path in paths_of(slipping):
        poses = messages[f"/{path.name}/odometry"]
        rows = [row_of[one.header.stamp.sec * 1_000_000_000 + one.header.stamp.nanosec] for one in poses]
        assert rows[0] == 0
        assert rows[-1] == len(table) - 1
        assert [one.pose.pose.position.x for one in poses] == path.x_m[rows].tolist()
        assert [one.pose.pose.position.y for one in poses] == path.y_m[rows].tolist()
        yaw = [2 * np.arctan2(one.pose.pose.orientation.z, one.pose.pose.orientation.w) for one in poses]
        assert np.abs(np.angle(np.exp(1j * (np.array(yaw) - path.yaw_rad[rows])))).max() < 1e-9
    # The paper's Eqs. 8-10 with the final ICRs, turned into x forward, y left, counter-clockwise.
    right, left, x = (float(column[-1]) for column in (table.y_icr_right_m, table.y_icr_left_m, table.x_icr_m))
    twists = [one.twist.twist for one in messages["/icr/odometry"]]
    v_left, v_right = table.v_left_mps[rows], table.v_right_mps[rows]
    clockwise = (v_left - v_right) / (right - left)
    forward = (v_left * right - v_right * left) / (right - left)
    assert_allclose([twist.angular.z for twist in twists], -clockwise, rtol=0, atol=1e-12)
    assert_allclose([twist.linear.x for twist in twists], forward, rtol=0, atol=1e-12)
    assert_allclose([twist.linear.y for twist in twists], clockwise * x, rtol=0, atol=1e-12)


def test_the_mcap_holds_fixes_icrs_errors_and_events(slipping: Run, mcap_file: Path) -> None:
    messages, table = decoded(mcap_file), slipping.table
    assert len(messages["/gnss/fix_rejected"]) == BAD_FIXES
    last, icrs = messages["/filter/fix"][-1], messages["/icrs"][-1]
    x, y = local_plane(np.array(last.longitude), np.array(last.latitude), slipping)
    assert np.hypot(x - table.east_m[-1], y - table.north_m[-1]) < ON_GLOBE_M
    assert last.position_covariance[0] == table.std_east_m[-1] ** 2
    assert (icrs.y_icr_left_m, icrs.std_y_icr_left_m) == (table.y_icr_left_m[-1], table.std_y_icr_left_m[-1])
    assert icrs.y_icr_left_plus_std_m == icrs.y_icr_left_m + icrs.std_y_icr_left_m
    assert [event.kind for event in messages["/events"]] == ["slip", "none"]
    assert [event.kind for event in messages["/outages"]] == ["outage", "none"]
    ends = trial_ends(track_of(slipping), np.array([10.0]))
    direct = open_loop_errors_direct(track_of(slipping), models_of(slipping)[1].icrs, ends)[:, 0]
    stamps = {stamp: row for row, stamp in enumerate(table.stamp_ns.tolist())}
    for one in messages["/open_loop_error"]:
        row = stamps[one.header.stamp.sec * 1_000_000_000 + one.header.stamp.nanosec]
        assert one.no_slip_m == pytest.approx(direct[row], abs=1e-6)


def test_rosbags_reads_every_message(mcap_file: Path) -> None:
    from rosbags.highlevel import AnyReader

    with AnyReader([mcap_file]) as reader:
        read = [reader.deserialize(raw, link.msgtype) for link, _, raw in reader.messages()]
        assert len(read) == reader.message_count > 5_000


def test_every_path_of_the_layout_is_a_field_of_a_topic(slipping: Run, mcap_file: Path) -> None:
    messages, layout = decoded(mcap_file), foxglove_layout(slipping)
    panels = layout["configById"]
    curves = [curve["value"] for panel in panels.values() for curve in panel.get("paths", [])]
    assert len(curves) > 10
    for curve in curves:
        topic, *fields = curve.split(".")
        value = messages[topic][0]
        for field in fields:
            value = getattr(value, field)
    # This run has no smoothed states; Foxglove passes over topics that a file lacks.
    assert set(panels["3D!paths"]["topics"]) - {"/smoothed/path"} <= set(messages)
    assert set(panels["map!place"]["topicColors"]) <= set(messages)
    assert set(panels["3D!paths"]["transforms"]) == {f"frame:{body}" for body in BODIES.values()}
    assert panels["3D!paths"]["followTf"] == WORLD
    assert f"{ERROR_HORIZON_M:g} m" in panels["Plot!error"]["foxglovePanelTitle"]
    shown = json.dumps(layout["layout"])
    assert all(f'"{panel}"' in shown for panel in panels)
    assert {panel.partition("!")[0] for panel in panels} == {"3D", "Plot", "StateTransitions", "map"}
    for panel in panels.values():
        for curve in panel.get("paths", []):
            assert curve["enabled"] is True
            assert curve["timestampMethod"] == "receiveTime"


def test_a_metric_run_has_an_mcap_without_fixes(metric: Run, tmp_path: Path) -> None:
    write_foxglove(metric, tmp_path / "run.mcap")
    assert not [topic for topic in decoded(tmp_path / "run.mcap") if "fix" in topic]
    assert "map!place" not in foxglove_layout(metric)["configById"]
