"""A run as MCAP for Foxglove and other ROS 2 tools, with a layout that shows it.

World ``map``: ENU about the datum of the run; bodies x forward, y left, z up (REP-103). Body ``base_link`` is the
filter's estimate; ``icr_odometry`` and ``no_slip_odometry`` are computed from wheel speeds alone. Stamps are the log's.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from icrtool.dropout_analysis.trials import errors_from_states
from icrtool.kernels.arrays import Ints
from icrtool.kernels.kinematics import body_velocity
from icrtool.logs import write_log
from icrtool.output.exports.paths import (
    ERROR_HORIZON_M,
    ExportPath,
    Globe,
    PathName,
    about_run,
    globe_of,
    line_rows,
    outage_rows,
    paths_of,
    rows_apart,
)
from icrtool.output.files.atomic import EXPORTED_MCAP
from icrtool.records.plain_data import plain_value
from icrtool.records.run import ICR_COLUMNS, Run
from icrtool.records.samples import FIXED_FIX

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

INTERVAL_S = 0.05
"""Shortest interval between two written states [s]."""

WORLD = "map"
"""Frame of the world."""

LIBRARY = EXPORTED_MCAP.decode()
"""Name of the library in the header of the file."""

BODIES: dict[PathName, str] = {
    "filter": "base_link", "smoothed": "smoothed", "icr": "icr_odometry", "no_slip": "no_slip_odometry",
}  # fmt: skip
"""Frame of the body that drives each path."""

GBAS_FIX, PLAIN_FIX = 2, 0
"""Codes of NavSatStatus."""

DIAGONAL_KNOWN = 2
"""Code of NavSatFix for a covariance of which the diagonal is known."""

ICRS_TYPE, ERROR_TYPE, EVENT_TYPE = (
    "icrtool_msgs/msg/TrackIcrs",
    "icrtool_msgs/msg/OpenLoopError",
    "icrtool_msgs/msg/Event",
)
"""Names of icrtool's own message types."""

_ICR_FIELDS = "".join(
    f"float64 {name}\nfloat64 std_{name}\nfloat64 {name[:-2]}_minus_std_m\nfloat64 {name[:-2]}_plus_std_m\n"
    for name in ICR_COLUMNS
)
DEFINITIONS = {
    ICRS_TYPE: f"# Track ICRs [m]; body frame: x forward, y right.\nstd_msgs/Header header\n{_ICR_FIELDS}",
    ERROR_TYPE: (
        "# Open-loop error [m] after horizon_m of driving from this state; NaN where a model has none.\n"
        "std_msgs/Header header\nfloat64 horizon_m\nfloat64 icr_m\nfloat64 icr_final_m\nfloat64 no_slip_m\n"
    ),
    EVENT_TYPE: (
        "# Begin of a slip event or an outage; kind is none at its end. x_m, y_m in the world frame.\n"
        "std_msgs/Header header\nstring kind\nfloat64 duration_s\nfloat64 x_m\nfloat64 y_m\nfloat64 distance_m\n"
        "float64 severity\nfloat64 confidence\n"
    ),
}
"""Definitions of icrtool's own message types. They are written into the file."""


def write_foxglove(run: Run, path: Path) -> None:
    """Write the MCAP file of a run, compressed with zstd.

    Parameters
    ----------
    run : of `icrtool.fit` or `icrtool.open_run`
    path : the file to make or to replace

    Raises
    ------
    OSError
        The file cannot be written.

    Notes
    -----
    Topics: ``/tf``; ``/filter/odometry``, ``/icr/odometry``, ``/no_slip/odometry`` (``/smoothed/odometry`` where the
    run has it), and a ``path`` for each; ``/filter/fix``, ``/gnss/fix`` and ``/gnss/fix_rejected`` where the run has a
    place on the globe; ``/icrs``, ``/open_loop_error``, ``/events`` and ``/outages``.
    """
    store, globe, paths = _typestore(), globe_of(run), paths_of(run)
    rows = rows_apart(run.table.stamp_ns, INTERVAL_S)
    icrs: dict[str, NDArray[Any]] = {}
    for name in ICR_COLUMNS:
        value, std = (getattr(run.table, column)[rows] for column in (name, f"std_{name}"))
        icrs |= {name: value, f"std_{name}": std}
        icrs |= {f"{name[:-2]}_minus_std_m": value - std, f"{name[:-2]}_plus_std_m": value + std}
    plans = [
        _transforms(paths, rows, store),
        *(_odometry(run, path, rows) for path in paths),
        *(_fixes(run, rows, globe) if globe is not None else ()),
        _plan("/icrs", ICRS_TYPE, run.table.stamp_ns[rows], BODIES["filter"], icrs),
        _errors(run, rows),
    ]
    topics = [write_log.serialise_topic(plan, store) for plan in plans if len(plan.stamp_ns)]
    topics += [_whole_path(path, store) for path in paths]
    slip = ({**plain_value(event), "x_m": event.east_m, "y_m": event.north_m} for event in run.document.events)
    outages: list[dict[str, Any]] = []
    for (begin_ns, end_ns), span in outage_rows(run):
        x_m, y_m, distance = run.table.east_m[span], run.table.north_m[span], run.table.distance_m[span]
        place = {"x_m": float(x_m[0]), "y_m": float(y_m[0]), "distance_m": float(distance[-1] - distance[0])}
        outages.append({"kind": "outage", "begin_ns": begin_ns, "end_ns": end_ns, **place})
    topics += [_event_topic("/events", slip, store), _event_topic("/outages", outages, store)]
    about = {name: "" if value is None else str(value) for name, value in about_run(run).items()}
    about["datum"] = "" if globe is None else " ".join(f"{value!r}" for value in globe)
    write_log.write_mcap(path, topics, store, compression="zstd", metadata=about, library=LIBRARY)


@cache
def _typestore() -> Typestore:
    """Return the message types of ROS 2 and those of icrtool."""
    from rosbags.typesys import get_types_from_msg

    store = write_log.load_typestore(ros1=False)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


def _transforms(paths: Sequence[ExportPath], rows: Ints, store: Typestore) -> write_log.TopicPlan:
    """Return topic ``/tf``: one message for each state, with the pose of each path."""
    stamps = paths[0].stamp_ns[rows]
    message_type = "geometry_msgs/msg/TransformStamped"
    fixed: dict[str, object] = {"transforms": [write_log.blank_message(store, message_type) for _ in paths]}
    columns: dict[str, NDArray[Any]] = {}
    for number, path in enumerate(paths):
        field, (z, w) = f"transforms.{number}", path.quaternion
        fixed |= {f"{field}.header.frame_id": WORLD, f"{field}.child_frame_id": BODIES[path.name]}
        columns |= {f"{field}.{name}": values for name, values in write_log.header_stamps(stamps).items()}
        columns |= {
            f"{field}.transform.translation.x": path.x_m[rows],
            f"{field}.transform.translation.y": path.y_m[rows],
            f"{field}.transform.rotation.z": z[rows],
            f"{field}.transform.rotation.w": w[rows],
        }
    return write_log.TopicPlan("/tf", "tf2_msgs/msg/TFMessage", stamps, fixed, columns)


def _odometry(run: Run, path: ExportPath, rows: Ints) -> write_log.TopicPlan:
    """Return the poses of a path; the twist is computed from the wheel speeds with the path's ICRs."""
    table, stamps, (z, w) = run.table, path.stamp_ns[rows], path.quaternion
    icrs = (column[rows] if len(column) > 1 else column for column in path.icrs)
    v_x, v_y, omega = body_velocity(table.v_left_mps[rows], table.v_right_mps[rows], *icrs)
    columns = {
        "pose.pose.position.x": path.x_m[rows],
        "pose.pose.position.y": path.y_m[rows],
        "pose.pose.orientation.z": z[rows],
        "pose.pose.orientation.w": w[rows],
        "twist.twist.linear.x": v_x,
        "twist.twist.linear.y": -v_y,
        "twist.twist.angular.z": -omega,
    }
    states = {"filter": table, "smoothed": run.smoothed}.get(path.name)
    if states is not None:
        columns |= {
            "pose.covariance.0": states.std_east_m[rows] ** 2,
            "pose.covariance.7": states.std_north_m[rows] ** 2,
            "pose.covariance.35": states.std_heading_rad[rows] ** 2,
        }
    topic, fixed = f"/{path.name}/odometry", {"child_frame_id": BODIES[path.name]}
    return _plan(topic, "nav_msgs/msg/Odometry", stamps, WORLD, columns, fixed)


def _whole_path(path: ExportPath, store: Typestore) -> write_log.TopicMessages:
    """Return a message at the first state that holds the whole path, thinned."""
    name = "nav_msgs/msg/Path"
    message: Any = write_log.blank_message(store, name)
    rows, (z, w) = line_rows(path.x_m, path.y_m), path.quaternion
    message.header.frame_id = WORLD
    _set_stamp(message, int(path.stamp_ns[0]))
    columns = (path.x_m, path.y_m, z, w, path.stamp_ns)
    for x_m, y_m, qz, qw, stamp in zip(*(column[rows].tolist() for column in columns), strict=True):
        pose: Any = write_log.blank_message(store, "geometry_msgs/msg/PoseStamped")
        pose.header.frame_id = WORLD
        _set_stamp(pose, stamp)
        pose.pose.position.x, pose.pose.position.y = x_m, y_m
        pose.pose.orientation.z, pose.pose.orientation.w = qz, qw
        message.poses.append(pose)
    return write_log.TopicMessages(
        f"/{path.name}/path", name, path.stamp_ns[:1], [bytes(store.serialize_cdr(message, name))]
    )


def _fixes(run: Run, rows: Ints, globe: Globe) -> Iterator[write_log.TopicPlan]:
    """Yield the filter's position, the fixes that it used and those that it rejected, as NavSatFix."""
    table, fixes = run.table, run.sensors.fixes
    variances = table.std_east_m**2, table.std_north_m**2
    filter_values = table.stamp_ns, table.east_m, table.north_m, *variances, np.full(len(table), PLAIN_FIX, np.int8)
    status = np.where(fixes.fix_class == FIXED_FIX, GBAS_FIX, PLAIN_FIX).astype(np.int8)
    fix_values = fixes.stamp_ns, fixes.east_m, fixes.north_m, fixes.var_east_m2, fixes.var_north_m2, status
    topics: list[tuple[str, str, tuple[NDArray[Any], ...], Ints]] = [
        ("/filter/fix", BODIES["filter"], filter_values, rows),
        ("/gnss/fix", "antenna", fix_values, np.flatnonzero(run.gnss.used)),
        ("/gnss/fix_rejected", "antenna", fix_values, np.flatnonzero(run.gnss.rejected)),
    ]
    for topic, frame, values, chosen in topics:
        stamp_ns, east, north, var_east, var_north, status = (column[chosen] for column in values)
        latitude, longitude = globe.places(east, north)
        columns: dict[str, NDArray[Any]] = {
            "status.status": status,
            "latitude": latitude,
            "longitude": longitude,
            "position_covariance.0": var_east,
            "position_covariance.4": var_north,
        }
        fixed = {"status.service": 1, "altitude": globe.height_m, "position_covariance_type": DIAGONAL_KNOWN}
        yield _plan(topic, "sensor_msgs/msg/NavSatFix", stamp_ns, frame, columns, fixed)


def _plan(
    topic: str, message_type: str, stamp_ns: Ints, frame: str, columns: dict[str, NDArray[Any]],
    fixed: Mapping[str, object] = MappingProxyType({}),
) -> write_log.TopicPlan:  # fmt: skip
    """Return a topic whose messages begin with a header."""
    return write_log.TopicPlan(
        topic, message_type, stamp_ns, {"header.frame_id": frame, **fixed}, write_log.header_stamps(stamp_ns) | columns
    )


def _errors(run: Run, rows: Ints) -> write_log.TopicPlan:
    """Return topic ``/open_loop_error``: the errors from the states that have a trial."""
    errors, unknown = errors_from_states(run, ERROR_HORIZON_M), np.full(len(run.table), np.nan)
    rows = rows[np.isfinite(errors["icr"][rows])]
    columns = {f"{name}_m": errors.get(name, unknown)[rows] for name in ("icr", "icr_final", "no_slip")}
    stamps = run.table.stamp_ns[rows]
    return _plan("/open_loop_error", ERROR_TYPE, stamps, BODIES["filter"], columns, {"horizon_m": ERROR_HORIZON_M})


def _event_topic(topic: str, events: Iterable[dict[str, Any]], store: Typestore) -> write_log.TopicMessages:
    """Return a message at the start of each event, and a message of kind ``none`` at its end."""
    stamps, payload = [], []
    for event in events:
        for kind, stamp in ((event["kind"], event["begin_ns"]), ("none", event["end_ns"])):
            message: Any = write_log.blank_message(store, EVENT_TYPE)
            message.header.frame_id, message.kind = WORLD, kind
            _set_stamp(message, stamp)
            for name in ("x_m", "y_m", "distance_m", "severity", "confidence"):
                setattr(message, name, event.get(name, 0.0))
            message.duration_s = (event["end_ns"] - event["begin_ns"]) / 1e9
            stamps.append(stamp)
            payload.append(bytes(store.serialize_cdr(message, EVENT_TYPE)))
    return write_log.TopicMessages(topic, EVENT_TYPE, np.array(stamps, np.int64), payload)


def _set_stamp(message: Any, stamp_ns: int) -> None:  # noqa: ANN401 - a message with a header
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)


SMALLEST_SCENE_M = 5.0
"""Smallest size of the scene in view [m]."""

VIEW_IN_EXTENT = 1.4
"""Distance of the camera, in sizes of the filter's path."""


def foxglove_layout(run: Run) -> dict[str, Any]:
    """Return the layout of a run as plain data: paths from above, map, ICRs ± σ, open-loop error, speeds, events.

    It is the layout in ``foxglove_layout.json``, as Foxglove exports it, with a camera that shows the filter's whole
    path.
    """
    text = files("icrtool.output.exports").joinpath("foxglove_layout.json").read_text(encoding="utf-8")
    layout: dict[str, Any] = json.loads(text)
    panels = layout["configById"]
    east, north = ((float(column.min()), float(column.max())) for column in (run.table.east_m, run.table.north_m))
    extent_m = max(SMALLEST_SCENE_M, east[1] - east[0], north[1] - north[0])
    middle = [sum(east) / 2, sum(north) / 2, 0.0]
    panels["3D!paths"]["cameraState"] |= {"distance": VIEW_IN_EXTENT * extent_m, "targetOffset": middle}
    if (globe := globe_of(run)) is not None:
        panels["map!place"]["center"] = {"lat": globe.latitude_deg, "lon": globe.longitude_deg}
    else:
        del panels["map!place"]
        layout["layout"]["first"] = "3D!paths"
    return layout


def is_layout(first: bytes) -> bool:
    """Return whether icrtool wrote a layout, by the first bytes of the file."""
    return b"3D!paths" in first[:100]
