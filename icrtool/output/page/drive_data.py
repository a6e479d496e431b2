"""The numbers that the script of a run's page draws: the drive, decimated, and the wheels, from which paths are driven.

Time series keep the least and the greatest value of each interval. The wheels are not thinned up to `MOST_STEPS`: an
open-loop path that the page integrates ends where the library's does.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from typing import Any, Literal, NamedTuple

import numpy as np
from msgspec import UNSET

from icrtool.calibration.pooled import calibrated
from icrtool.calibration.record import calibration_of
from icrtool.calibration.run_recording import turning_recording_of
from icrtool.errors import DataError
from icrtool.estimation.odometry import drive_wheels
from icrtool.kernels.arrays import Bools, Bytes, Complexes, Floats, Ints
from icrtool.motion.fit import own_constants
from icrtool.motion.models import CONTROLLER, FIVE, RECOMMENDED, FittedModel, controller_model, find_model
from icrtool.motion.recording import Recording, cut_windows, predicted_path
from icrtool.output.decimate import extremes, places
from icrtool.output.tables.errors import in_order, main_rows
from icrtool.records.dropout_document import DropoutDocument, FitDocument
from icrtool.records.run import Run, no_slip_icrs, track_of, width_or_usual_m
from icrtool.records.tables import Icrs

MOST_STEPS = 150_000
"""Wheel samples of a page, of more, equally many are joined to one; and points of all calibrated paths together."""

SERIES_POINTS = 16_000
"""Rows of the time series: some ten per pixel column, so that a stretch of a tenth still has its extremes."""

FIX_POINTS = 8_000

PATH_CELLS = 4000.0
"""An odometry path has a point in each cell of this fraction of the drive's extent."""

ERROR_KEYS = {"p95": "p95_m", "p95_low": "p95_low_m", "p95_high": "p95_high_m", "expected": "expected_error_m",
              "expected_low": "expected_low_m", "expected_high": "expected_high_m"}  # fmt: skip


class PageSteps(NamedTuple):
    """Which states a page has, all of them or every `joined`-th.

    Attributes
    ----------
    rows : (n,) states; the last one is always there
    joined : wheel samples between two of them
    """

    rows: Ints
    joined: int


def drive_data(run: Run, report: DropoutDocument, *, coordinates: bool) -> dict[str, Any]:
    """Return plain data for the page of a run.

    Parameters
    ----------
    run : what trials of `report` are compared with are its states
    report : what report.json holds
    coordinates : whether the axes of the map count from the datum; else from the first state
    """
    table = run.table
    joined = -(-len(table) // MOST_STEPS)
    steps = PageSteps(np.unique(np.append(np.arange(0, len(table), joined), len(table) - 1)), joined)
    origin = float(np.round(table.north_m[0])), float(np.round(table.east_m[0]))
    return {
        "origin": origin if coordinates else None,
        "duration_s": float(table.t_s[-1]),
        "steps": _steps_data(run, steps, origin),
        "series": _series_data(run, steps),
        "fixes": _fixes_data(run, origin),
        "headings": _headings_data(run),
        "odometry": _odometry_data(run, origin),
        "models": _models(run, report, steps),
        "events": _events_data(run, origin),
        "outages": [{"kind": one.kind, "begin_s": one.begin_s, "end_s": one.end_s} for one in report.outages],
        "changes_s": list(run.changes_s),
        "errors": errors_data(report),
        "budgets_m": sorted({one.budget_m for one in report.budgets}),
    }


def errors_data(report: DropoutDocument) -> dict[str, Any]:
    """Return the errors over distance by model, and those of the reference alone."""
    models, main = in_order(report.models), main_rows(report)
    reference = report.reference_error
    return {
        "horizons_m": [row.horizon_m for row in models[0].by_horizon] if models else [],
        "models": [
            {"name": one.name, "label": one.label, "main": one.name in main}
            | {key: [getattr(row, column) for row in one.by_horizon] for key, column in ERROR_KEYS.items()}
            for one in models
        ],
        "reference": {"p95": [row.p95_m for row in reference], "expected": [row.expected_m for row in reference]},
    }


def _steps_data(run: Run, steps: PageSteps, origin: tuple[float, float]) -> dict[str, Any]:
    """Return what the wheels did and where the reference was, at every step."""
    track, rows = track_of(run), steps.rows
    columns = {
        "left": track.cumulate(track.v_left)[rows],
        "right": track.cumulate(track.v_right)[rows],
        "distance": track.distance[rows],
        "north": track.north[rows],
        "east": track.east[rows],
    }
    gaps = np.searchsorted(rows, np.flatnonzero(track.held[:-1] == 0.0), side="right") - 1
    return {
        "joined": steps.joined,
        "first_north": float(track.north[0]) - origin[0],
        "first_east": float(track.east[0]) - origin[1],
        "gaps": np.unique(gaps).tolist(),
        "without_reference": _spans(track.in_outage[rows]),
    } | {name: packed_sums(column) for name, column in columns.items()}


def _series_data(run: Run, steps: PageSteps) -> dict[str, Any]:
    """Return the states that the time series show; each is a step too."""
    table = run.table
    columns = {
        "v_left": table.v_left_mps, "v_right": table.v_right_mps,
        "y_right": table.y_icr_right_m, "y_left": table.y_icr_left_m, "x": table.x_icr_m,
    }  # fmt: skip
    at = {name: column[steps.rows] for name, column in columns.items()}
    rows = extremes(*at.values(), points=SERIES_POINTS)
    state = steps.rows[rows]
    at |= {
        "std_y_right": table.std_y_icr_right_m[steps.rows], "std_y_left": table.std_y_icr_left_m[steps.rows],
        "std_x": table.std_x_icr_m[steps.rows],
        "heading": np.angle(np.exp(1j * table.heading_rad[steps.rows])),
    }  # fmt: skip
    return {"step": packed(rows, "i32"), "t": packed(table.t_s[state], "f32")} | {
        name: packed(column[rows], "f32") for name, column in at.items()
    }


def _fixes_data(run: Run, origin: tuple[float, float]) -> dict[str, Any]:
    """Return the fixes that the filter used and those that it rejected: where, when, and how far from the filter."""
    fixes = run.sensors.fixes
    found = {}
    for name, chosen in {"used": run.gnss.used, "rejected": run.gnss.rejected}.items():
        rows = _extreme_rows(run.gnss.difference, chosen)
        found[name] = {
            "t": packed(run.gnss.t_s[rows], "f32"),
            "north": packed(fixes.north_m[rows] - origin[0], "f32"),
            "east": packed(fixes.east_m[rows] - origin[1], "f32"),
            "difference": packed(run.gnss.difference[rows], "f32"),
        }
    return found


def _headings_data(run: Run) -> dict[str, Any]:
    """Return how far the headings that the filter used were from its own [deg]."""
    rows = _extreme_rows(run.heading.difference, run.heading.used)
    return {
        "t": packed(run.heading.t_s[rows], "f32"),
        "difference_deg": packed(np.degrees(run.heading.difference[rows]), "f32"),
    }


def _extreme_rows(difference: Floats, chosen: Bools) -> Ints:
    """Return the chosen rows, the extremes of many."""
    rows = np.flatnonzero(chosen)
    return rows[extremes(difference[rows], points=FIX_POINTS)]


def _odometry_data(run: Run, origin: tuple[float, float]) -> dict[str, Any]:
    table, b = run.table, run.track_width_m
    extent = max(float(np.ptp(table.north_m)), float(np.ptp(table.east_m)), 1.0)

    def path(icrs: Icrs) -> dict[str, Any]:
        one = drive_wheels(table, run.in_gap, icrs)
        rows = places(one.north_m, one.east_m, extent / PATH_CELLS)
        north, east = one.north_m[rows] - origin[0], one.east_m[rows] - origin[1]
        return {"north": packed(north, "f32"), "east": packed(east, "f32"), "t": packed(table.t_s[rows], "f32")}

    return {"icr": path(table.icrs_at(-1)), "no_slip": None if b is None else path(no_slip_icrs(b))}


class ModelPath(NamedTuple):
    """The path of a model through the whole drive, at the steps of the page alone: a drive has many states and models.

    Attributes
    ----------
    heading, place : [rad], forward + j right [m], of the robot at the steps
    """

    name: str
    label: str
    heading: Floats
    place: Complexes


def _models(run: Run, report: DropoutDocument, steps: PageSteps) -> list[dict[str, Any]]:
    """Return how each model of the report moves: by ICRs, or along a path that is turned to where a trial starts."""
    labels = {one.name: one.label for one in report.models}
    b = run.track_width_m
    icrs = {"icr": None, "no_slip": None if b is None else no_slip_icrs(b), "icr_final": run.table.icrs_at(-1)}
    models: list[dict[str, Any]] = [
        {"name": name, "label": labels[name], "icrs": icrs[name]} for name in icrs if name in labels
    ]
    recording = cache(lambda kind: turning_recording_of(run, kind, width_m=width_or_usual_m(b)))
    paths = [*_held_out(recording, report, labels, steps.rows), *_calibrated(recording, report, steps.rows)]
    count = len(steps.rows)
    every = max(-(-len(paths) * count // MOST_STEPS), 1)
    rows = np.unique(np.append(np.arange(0, count, every), count - 1))
    for one in paths:
        columns = {"forward": one.place.real, "right": one.place.imag, "turn": one.heading}
        path: dict[str, Any] = {"every": every, "first_turn": float(one.heading[0])}
        path |= {name: packed_sums(column[rows]) for name, column in columns.items()}
        models.append({"name": one.name, "label": one.label, "path": path})
    return sorted(models, key=lambda one: one["name"] != RECOMMENDED)


def _held_out(
    recording_of: Callable[[str], Recording], report: DropoutDocument, labels: Mapping[str, str], rows: Ints
) -> Iterator[ModelPath]:
    """Yield the path of each held-out model of the report, here as fitted to the whole drive."""
    ladder = report.ladder
    if ladder.fits is UNSET:
        return
    kind = ladder.heading or ""
    recording = recording_of(kind)
    windows = cache(partial(cut_windows, recording))
    wheels = {name: _fitted(name, ladder.fits) for name in (FIVE, RECOMMENDED)}
    for model, base in ((RECOMMENDED, RECOMMENDED), (CONTROLLER, FIVE)):
        fits = {model: wheels[base]}
        if recording.track.gyro is not None:
            fits[f"{model}_{kind}"] = replace(_fitted(f"{base}_gyro", ladder.fits), wheels=wheels[base])
        for name, fit in fits.items():
            # Too short a drive to find the delay of its wheels has no path.
            with suppress(DataError):
                own = own_constants(windows(), fit, recording.width_m)
                fitted = controller_model(fit, recording.lever, recording.width_m) if model == CONTROLLER else fit
                yield ModelPath(name, labels[name], *predicted_path(recording, fitted, own)(recording.track.t[rows]))


def _fitted(name: str, fits: Mapping[str, FitDocument]) -> FittedModel:
    """Return a model as it was fitted to the whole drive."""
    model, value = find_model(name), fits[name].value
    k = len(model.terms)
    return FittedModel(model, np.array([value[term] for term in model.terms]), np.zeros((k, k)))


def _calibrated(recording_of: Callable[[str], Recording], report: DropoutDocument, rows: Ints) -> Iterator[ModelPath]:
    """Yield the path of each calibration that was given; with the gyro too where there is one."""
    recording = recording_of("gyro") if report.calibrations else None
    for one in report.calibrations:
        turned, document = one.with_gyro, one.calibration
        if recording is not None and document and not (turned and recording.track.gyro is None):
            with suppress(DataError):
                model = calibrated(calibration_of(document), recording, with_gyro=turned)
                yield ModelPath(one.name, one.label, *predicted_path(recording, *model)(recording.track.t[rows]))


def _events_data(run: Run, origin: tuple[float, float]) -> list[dict[str, Any]]:
    return [
        {"kind": one.kind, "begin_s": one.begin_s, "end_s": one.end_s, "severity": one.severity,
         "north": one.north_m - origin[0], "east": one.east_m - origin[1]}
        for one in run.document.events
    ]  # fmt: skip


def _spans(flags: Bools) -> list[list[int]]:
    """Return first and last row of each stretch of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [[int(first), int(end) - 1] for first, end in edges.reshape(-1, 2)]


_TYPES = {"f32": "<f4", "f64": "<f8", "i32": "<i4", "u8": "u1"}

LARGEST_STEP = 32_000
"""Units of the largest step: what 16 bits hold, with a margin for rounding."""

SMALLEST_UNIT = 1e-7
"""Metres or radians: finer steps mean nothing."""


def packed(column: Floats | Ints | Bytes | Bools, kind: Literal["f32", "f64", "i32", "u8"]) -> dict[str, Any]:
    """Return a column (n,) for a page.

    Notes
    -----
    ``f32`` has seven digits: enough for metres within some kilometres of the origin, and for seconds of a day (8 ms).
    """
    return {"type": kind, "data": b64encode(np.asarray(column).astype(_TYPES[kind]).tobytes()).decode("ascii")}


def packed_sums(column: Floats) -> dict[str, Any]:
    """Return a running sum (n,) for a page, as steps of 16 bits each; the page gets it from zero on.

    Notes
    -----
    The sum is rounded and not the steps, so that its error stays within half a unit everywhere: about 2 micrometres
    where a step is 0.1 m at most.
    """
    sums = column - column[0]
    unit = max(float(np.abs(np.diff(sums)).max(initial=0.0)) / LARGEST_STEP, SMALLEST_UNIT)
    steps = np.diff(np.rint(sums / unit)).astype("<i2")
    return {"type": "sums", "unit": unit, "data": b64encode(steps.tobytes()).decode("ascii")}
