"""Data for the scripts of the page of a run: the decimated drive, and the path of each model through it.

Time series keep the smallest and the largest value of each interval. A model with constant parameters has one path of
the whole drive, which a script turns and shifts to the start of a trial. Momentary ICRs have no such path: the script
integrates the wheel speeds with the ICRs of the start. Up to `MOST_PAGE_STEPS` wheel samples are kept, so that the
script's path ends where the library's path ends.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from typing import Any, Literal

import numpy as np
from msgspec import UNSET, UnsetType
from numpy.typing import NDArray

from icrtool.calibration.calibration_rows import calibrated_drive
from icrtool.calibration.pooled import turning_recording_of
from icrtool.calibration.record import stored_calibration
from icrtool.calibration.run_models import models_of
from icrtool.errors import DataError
from icrtool.estimation.convergence import icr_std_m
from icrtool.estimation.odometry import drive_wheels
from icrtool.kernels.arrays import Bools, Complexes, Floats, Ints, wrapped
from icrtool.motion.models import CONTROLLER, FIVE, RECOMMENDED, FittedModel, controller_model, find_model
from icrtool.motion.recording import Recording, cut_windows, predicted_path
from icrtool.motion.window_fit import own_constants
from icrtool.output.series import (
    RANGE_PERCENT,
    breaks_after,
    evenly_spaced_rows,
    extremes,
    percentiles,
    scale_end_m,
    scale_of,
)
from icrtool.output.tables.errors import in_row_order
from icrtool.records.dropout_document import DropoutDocument, FitDocument
from icrtool.records.plain_data import Record
from icrtool.records.rows import REST_OF_DRIVE, Row, rows_of, shown_rows
from icrtool.records.run import ICR_COLUMNS, MeasurementOutcome, Run, track_of, width_or_usual_m
from icrtool.records.run_document import IcrColumn

MOST_PAGE_STEPS = 150_000
"""Largest number of wheel samples of a page. Of a longer drive, equal numbers of samples are joined to one."""

PATH_POINTS = 200_000
"""Largest number of points of the paths of all models together. Beyond it, paths are thinned evenly."""

SERIES_POINTS = 16_000
"""Number of rows of the time series: about ten for each column of pixels, so that a view of a tenth of the drive still
shows all extremes."""

FIX_POINTS = 8_000
"""Largest number of used, and of rejected, fixes of a page."""

ERROR_KEYS = {"p95": "p95_m", "p95_low": "p95_low_m", "p95_high": "p95_high_m", "expected": "expected_error_m",
              "expected_low": "expected_low_m", "expected_high": "expected_high_m"}  # fmt: skip
"""Fields of `ErrorRow` by the keys that the scripts read."""


def drive_data(run: Run, report: DropoutDocument, *, coordinates: bool) -> dict[str, object]:
    """Return the data of the page of a run, by the keys that the scripts read.

    Parameters
    ----------
    run : run whose states are the reference of the trials in `report`
    report : content of report.json
    coordinates : count the axes of the map from the datum; otherwise from the first state
    """
    table = run.table
    rows, joined = evenly_spaced_rows(len(table), MOST_PAGE_STEPS)
    north, east = float(table.north_m[0]), float(table.east_m[0])
    origin = (float(round(north)), float(round(east))) if coordinates else (north, east)
    half = None if run.track_width_m is None else run.track_width_m / 2
    # The scale covers the same numbers of each ICR as the figure, and the ICRs without slip.
    shown = [] if half is None else [half, -half]
    for icr in (getattr(table, name) for name in ICR_COLUMNS):
        shown += [*percentiles(icr, RANGE_PERCENT), float(icr[0]), float(icr[-1])]
    return {
        "origin": origin if coordinates else None,
        "duration_s": float(table.t_s[-1]),
        "steps": {"joined": joined} | _steps_data(run, rows, origin),
        "series": _series_data(run, rows),
        "fixes": _fixes_data(run, origin),
        "headings": _differences(run.heading, run.heading.used, np.degrees(run.heading.difference))[1],
        "half_width_m": half,
        "icr_scale_m": scale_of(shown),
        **_models_data(run, report, rows, joined, origin),
        "events": [{"begin_s": event.begin_s, "end_s": event.end_s} for event in run.document.events],
        "outages": [{"begin_s": outage.begin_s, "end_s": outage.end_s} for outage in report.outages],
        "changes_s": list(run.changes_s),
        "errors": errors_data(report),
        "budgets_m": sorted({reach.budget_m for reach in report.budgets}),
    }


def errors_data(report: DropoutDocument) -> dict[str, object]:
    """Return the errors over distance of each model, and the errors of the reference alone."""
    models = in_row_order(report.models)
    rows = rows_of(model.name for model in models)
    shown_names = shown_rows(list(rows))
    reference = report.reference_error
    return {
        "horizons_m": [row.horizon_m for row in models[0].by_horizon] if models else [],
        "models": [
            {"name": model.name, "label": model.name, "shown": model.name in shown_names, **row_look(rows[model.name])}
            | {key: [getattr(row, column) for row in model.by_horizon] for key, column in ERROR_KEYS.items()}
            for model in models
        ],
        "reference": {"p95": [row.p95_m for row in reference], "expected": [row.expected_m for row in reference]},
        "banded": report.best.model if report.best is not None else next(iter(shown_names), ""),
    }


def row_look(row: Row) -> dict[str, object]:
    """Return colour (a name in page.css), dash and width [pixels] with which the scripts draw a row."""
    return {"color": row.color, "dash": row.dash, "width": 2.0 * row.width}


def _steps_data(run: Run, rows: Ints, origin: tuple[float, float]) -> dict[str, object]:
    """Return travel of the sides, distance and reference position at every step, gaps, and steps without reference.

    Parameters
    ----------
    rows : rows of the states at the steps
    origin : north and east of the origin of the map [m]
    """
    track = track_of(run)
    columns = {
        "left": track.cumulate(track.v_left)[rows],
        "right": track.cumulate(track.v_right)[rows],
        "distance": track.distance[rows],
        "north": track.north[rows] - origin[0],
        "east": track.east[rows] - origin[1],
    }
    gaps = np.searchsorted(rows, np.flatnonzero(track.held[:-1] == 0.0), side="right") - 1
    # The edges are the first and last steps of the stretches without a reference.
    edges = np.flatnonzero(np.diff(np.concatenate([[False], track.in_outage[rows], [False]]).astype(np.int8)))
    return {
        "gaps": np.unique(gaps).tolist(),
        "without_reference": (edges.reshape(-1, 2) - [0, 1]).tolist(),
    } | {name: packed_sums(column) for name, column in columns.items()}


def _series_data(run: Run, steps: Ints) -> dict[str, Column]:
    """Return the states that the time series show, at some of the steps."""
    table = run.table
    icrs: dict[str, IcrColumn] = {"y_right": "y_icr_right_m", "y_left": "y_icr_left_m", "x": "x_icr_m"}
    values = {name: getattr(table, column)[steps] for name, column in icrs.items()}
    speeds = {"v_left": table.v_left_mps, "v_right": table.v_right_mps}
    rows = extremes(*(speed[steps] for speed in speeds.values()), *values.values(), points=SERIES_POINTS)
    state = steps[rows]
    return {
        "step": packed_sums(rows, unit=1),
        "t": packed_sums(table.t_s[state]),
        "heading": pack_column(wrapped(table.heading_rad[state])),
        **{name: pack_column(column[rows]) for name, column in values.items()},
        **{name: packed_levels(column[state]) for name, column in speeds.items()},
        **{f"std_{name}": packed_levels(icr_std_m(run, column)[state]) for name, column in icrs.items()},
    }


def _fixes_data(run: Run, origin: tuple[float, float]) -> dict[str, object]:
    """Return place, time and distance from the filter of used and of rejected fixes; `origin` as in `_steps_data`."""
    fixes, difference = run.sensors.fixes, run.gnss.difference
    data: dict[str, object] = {"top_m": scale_end_m(difference[run.gnss.used])}
    for name, chosen in {"used": run.gnss.used, "rejected": run.gnss.rejected}.items():
        rows, differences = _differences(run.gnss, chosen, difference)
        north, east = pack_column(fixes.north_m[rows] - origin[0]), pack_column(fixes.east_m[rows] - origin[1])
        data[name] = differences | {"north": north, "east": east}
    return data


def _differences(outcome: MeasurementOutcome, chosen: Bools, difference: Floats) -> tuple[Ints, dict[str, object]]:
    """Return rows of the chosen measurements, and their times, differences and line breaks.

    Of many measurements, the extremes are returned.
    """
    rows = np.flatnonzero(chosen)
    t_s = outcome.t_s
    used_s = t_s[rows]
    after = breaks_after(used_s)
    breaks = (used_s[after] + used_s[after + 1]) / 2
    rows = rows[extremes(difference[rows], points=FIX_POINTS)]
    columns = {"t": pack_column(t_s[rows]), "difference": pack_column(difference[rows])}
    return rows, {**columns, "breaks_s": breaks.tolist()}


Paths = Iterator[tuple[str, tuple[Floats, Complexes]]]
"""Name of a model, and heading [rad] and place [m] of the robot on its path at the steps of the page."""


def _models_data(
    run: Run, report: DropoutDocument, steps: Ints, joined: int, origin: tuple[float, float]
) -> dict[str, object]:
    """Return the models of the report, and the path of each model with constant parameters from the first state.

    Parameters
    ----------
    steps : rows of the states at the steps of the page
    joined : number of wheel samples from one step to the next
    origin : north and east of the origin of the map [m]
    """
    recording = cache(
        lambda turn_sensor: turning_recording_of(run, turn_sensor, width_m=width_or_usual_m(run.track_width_m))
    )
    paths = {
        **dict(_odometry(run, joined, origin)),
        **dict(_held_out(recording, report, steps)),
        **dict(_calibrated(recording, report, steps)),
    }
    rows, every = evenly_spaced_rows(len(steps), PATH_POINTS / max(len(paths), 1))
    packed_paths = {
        name: {
            "every": every,
            "heading": packed_sums(heading[rows]),
            "north": packed_sums(position.real[rows]),
            "east": packed_sums(position.imag[rows]),
        }
        for name, (heading, position) in paths.items()
    }
    report_rows = rows_of(model.name for model in report.models)
    driven = {name: row for name, row in report_rows.items() if name in paths or name == "icr"}
    shown_names = shown_rows(list(report_rows))
    models = [
        {
            "name": name,
            "label": name,
            "shown": name in shown_names,
            "held_out": row.knows == REST_OF_DRIVE,
            **row_look(row),
        }
        for name, row in driven.items()
    ]
    return {"models": models, "paths": packed_paths}


def _odometry(run: Run, every: int, origin: tuple[float, float]) -> Paths:
    """Yield the path of each row with constant ICRs."""
    for model in models_of(run):
        if len(model.icrs.x_icr) > 1:
            continue
        path = drive_wheels(run.table, run.in_gap, model.icrs, every)
        yield model.name, (path.heading_rad, path.north_m + 1j * path.east_m - complex(*origin))


def _held_out(recording_of: Callable[[str], Recording], report: DropoutDocument, rows: Ints) -> Paths:
    """Yield the path of each held-out model of the report, with parameters that are fitted to the whole drive."""
    ladder = report.ladder
    if ladder.fits is UNSET:
        return
    turn_sensor = ladder.heading or ""
    recording = recording_of(turn_sensor)
    windows = cache(partial(cut_windows, recording))
    wheels = {name: _fitted(name, ladder.fits) for name in (FIVE, RECOMMENDED)}
    for model, base in ((RECOMMENDED, RECOMMENDED), (CONTROLLER, FIVE)):
        fits = {model: wheels[base]}
        if recording.track.gyro is not None:
            fits[f"{model}_{turn_sensor}"] = replace(_fitted(f"{base}_gyro", ladder.fits), wheels=wheels[base])
        for name, fit in fits.items():
            # A drive that is too short to find the delay of the wheels has no path.
            with suppress(DataError):
                constants = own_constants(windows(), fit, recording.width_m)
                fitted_model = controller_model(fit, recording.lever, recording.width_m) if model == CONTROLLER else fit
                yield name, predicted_path(recording, fitted_model, constants)(recording.track.t[rows])


def _fitted(name: str, fits: Mapping[str, FitDocument]) -> FittedModel:
    """Return the model of this name that was fitted to the whole drive."""
    model, value = find_model(name), fits[name].value
    k = len(model.terms)
    return FittedModel(model, np.array([value[term] for term in model.terms]), np.zeros((k, k)))


def _calibrated(recording_of: Callable[[str], Recording], report: DropoutDocument, rows: Ints) -> Paths:
    """Yield the path of each calibration of the report, without and with a gyro."""
    recording = recording_of("gyro") if report.calibrations else None
    for used in report.calibrations:
        with_gyro, document = used.with_gyro, used.calibration
        if recording is not None and document and not (with_gyro and recording.track.gyro is None):
            with suppress(DataError):
                tested = calibrated_drive(
                    stored_calibration(document), recording, used.name, with_gyro=with_gyro,
                    refit_sensors=report.request.refit_sensors,
                )  # fmt: skip
                # The path has the last bias of the gyro, because there is one path for all starts.
                last_learned = tested.drive.learned[-1]
                yield (
                    used.name,
                    predicted_path(recording, last_learned.fitted, last_learned.constants)(recording.track.t[rows]),
                )


LARGEST_STEP = 32_000
"""Largest step, in units: the range of 16 bits less a margin for rounding."""

SMALLEST_UNIT = 1e-7
"""Smallest unit of steps [m or rad]. Finer steps have no meaning."""


class Column(Record, frozen=True, kw_only=True):
    """Numbers (n,) for a page.

    Attributes
    ----------
    type : ``f32``: the numbers; ``levels``: numbers in multiples of a unit; ``sums``: steps in multiples of a unit
    data : base64 of little-endian float32 (``f32``) or int16
    unit : the unit of levels and of steps
    first : first number, to which the steps are added
    """

    type: Literal["f32", "levels", "sums"]
    data: str
    unit: float | UnsetType = UNSET
    first: float | UnsetType = UNSET


def pack_column(column: Floats) -> Column:
    """Return a column (n,) for a page as float32.

    Notes
    -----
    Seven digits are enough for metres within some kilometres of the origin, and for seconds of a day (8 ms).
    """
    return Column(type="f32", data=_base64(column, "<f4"))


def packed_levels(column: Floats) -> Column:
    """Return a column (n,) without NaN for a page, in 16 bits: multiples of the largest size over `LARGEST_STEP`."""
    unit = max(float(np.abs(column).max(initial=0.0)) / LARGEST_STEP, SMALLEST_UNIT)
    return Column(type="levels", data=_base64(np.rint(column / unit), "<i2"), unit=unit)


def packed_sums(column: Floats | Ints, unit: float | None = None) -> Column:
    """Return a running sum (n,) for a page: its first number, and its steps in 16 bits, in multiples of `unit`.

    Notes
    -----
    The sum is rounded, not the steps, so that its error is at most half a unit everywhere: about 2 micrometres for
    steps up to 0.1 m.
    """
    sums = column - column[0]
    unit = unit or max(float(np.abs(np.diff(sums)).max(initial=0.0)) / LARGEST_STEP, SMALLEST_UNIT)
    steps = np.diff(np.rint(sums / unit))
    return Column(type="sums", data=_base64(steps, "<i2"), unit=unit, first=float(column[0]))


def _base64(column: NDArray[Any], number_type: str) -> str:
    """Return a column as numbers of a type of NumPy, in base64."""
    return b64encode(column.astype(number_type).tobytes()).decode("ascii")
