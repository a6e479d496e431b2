"""The numbers of a run: distance, speed, ICR means, convergence, GNSS difference, NIS (Pentzer 2014, Tables I-III)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from itertools import pairwise
from typing import Any

import numpy as np

from icrtool import __version__
from icrtool.alignment.position.gnss_quality import CLASSES
from icrtool.config import Config
from icrtool.estimation.icr_uncertainty import cut_states, final_covariance, multiplier_std
from icrtool.estimation.observability import Excitation, find_excitation, nominal_icrs, withhold_unlearned
from icrtool.estimation.odometry import drive_wheels
from icrtool.estimation.run_filter import Filtered
from icrtool.estimation.run_warnings import (
    antenna_warning,
    contradicts_windows,
    noise_warnings,
    run_warnings,
    unusable_reasons,
)
from icrtool.kernels.arrays import Bools, Floats, Ints
from icrtool.kernels.chords import chord_rows
from icrtool.kernels.filter.measurement_codes import RECOVERED
from icrtool.kernels.kinematics import MIN_ICR_SEPARATION_M
from icrtool.records.events import ReferenceJump, SlipEvent
from icrtool.records.measurements import Fixes, FixStatistics, Measurements
from icrtool.records.plain_data import plain
from icrtool.records.run import ICR_COLUMNS, RUN_SCHEMA, MeasurementOutcome, no_slip_icrs, track_of_states
from icrtool.records.run_document import EVENT_COLUMNS, IcrColumn, RunDocument
from icrtool.records.samples import Datum, InputFile
from icrtool.records.tables import States

SETTLED_S = 2.0
"""An estimate has arrived when it stays within 10 % of its final change for this long: an overshoot passes through."""

SMALLEST_CHANGE_M = 0.03
"""An ICR whose estimate moved less than this from its start has no convergence to time."""

SHORTEST_STEP_M, STEP_IN_STD = 0.1, 5.0
"""Chords of the driven path are at least this long, and so many standard deviations of the position."""

LEAST_MODELLED = 0.5
"""Part of a chord that the model shows where the speed within it is the model's."""


def summarise(
    measurements: Measurements,
    filtered: Filtered,
    config: Config,
    *,
    inputs: tuple[InputFile, ...],
    datum: Datum | None,
    rejected_fixes: dict[str, int],
) -> RunDocument:
    """Return all numbers and warnings of a run as plain data, equal to what run.json gives back.

    Parameters
    ----------
    measurements : what the alignment made of a log
    filtered : what the filter made of that
    config : the effective configuration
    inputs, datum, rejected_fixes : of the log
    """
    table, sensors, width = filtered.table, filtered.sensors, config.robot.track_width_m
    changes_s = tuple(t for t in filtered.changes_s if 0.0 < t < table.t_s[-1])
    end_errors = _end_errors(table, filtered.in_gap, width)
    convergence = converge(table, min(changes_s, default=None))
    covariance, excitation, x_clock_std_m = learned(filtered, config, measurements.clock_std_s)
    multiplier = separation_multiplier(table, width) if width is not None else None
    field = config.filter.preset == "field"
    scale = measurements.findings["wheel_scale"] if field else None
    of_twist = any(stream.is_twist for stream in measurements.streams) and config.wheels.twist_width_m is None
    unusable = unusable_reasons(
        excitation, *filtered.in_use, filtered.noise, scale, multiplier if of_twist else None,
        contradicts_windows(table, covariance, measurements.findings) if field and not changes_s else "",
        str(measurements.sections["wheels"]["filtered"] or "") if field else "",
        inverted=bool(table.y_icr_right_m[-1] <= table.y_icr_left_m[-1]),
    )  # fmt: skip
    document: RunDocument = plain(
        {
            "schema": RUN_SCHEMA,
            "tool_version": __version__,
            "log": sensors.name,
            "inputs": [asdict(file) for file in inputs],
            "config": config.effective(),
            "streams": [asdict(stream) for stream in measurements.streams],
            "warnings": _warnings(
                measurements, filtered, config, None if unusable else multiplier, excitation, changes_s, covariance
            ),
            "alignment": {key: asdict(finding) for key, finding in measurements.findings.items()},
            "drive": drive_summary(table),
            "usable": not unusable,
            "unusable_because": "; ".join(unusable) if unusable else None,
            "icr": icr_summary(table, convergence, covariance)
            | {
                "separation_multiplier": multiplier,
                "separation_multiplier_std": multiplier_std(covariance, width) if width is not None else None,
                "final_covariance_m2": filtered.covariance[3:, 3:],
                "x_clock_std_m": x_clock_std_m,
            },
            "odometry": end_errors,
            "terrain": {"changes": [{"t_s": t} for t in changes_s]},
            "segments": segment_summary(table, changes_s),
            "gnss": gnss_summary(datum, rejected_fixes, filtered.gnss, sensors.fixes.down_weighted)
            | measurements.sections["gnss"]
            | class_summary(sensors.fixes, measurements.fix_statistics, filtered.gnss),
            "heading": measurements.sections["heading"] | counts(filtered.heading),
            "wheels": measurements.sections["wheels"],
            "events": event_summary(sensors.events, int(table.stamp_ns[0])),
            "reference_jumps": span_rows(sensors.jumps, int(table.stamp_ns[0])),
            "outages_ns": filtered.outages_ns,
            "rtk_losses_ns": sensors.losses_ns,
            "wheel_gaps_ns": [[table.stamp_ns[k], table.stamp_ns[k + 1]] for k in np.flatnonzero(filtered.in_gap)],
            "filter": filter_summary(measurements, filtered, config),
            "excitation": excitation.summary(),
        }
    )
    return document if config.filter.preset == "paper" else without_unlearned(document)


def _warnings(
    measurements: Measurements, filtered: Filtered, config: Config, multiplier: float | None, excitation: Excitation,
    changes_s: Sequence[float], covariance: Floats,
) -> list[str]:  # fmt: skip
    """Return the warnings of alignment and filter, in the order they were found; `covariance` of the final ICRs."""
    name, table, width = filtered.sensors.name, filtered.table, config.robot.track_width_m
    apart = None if multiplier is None or width is None else (multiplier, multiplier_std(covariance, width))
    end_s = float(table.t_s[-1])
    return [
        *measurements.warnings,
        *run_warnings(name, table, *filtered.in_use, apart, excitation, measurements.findings),
        *(
            []
            if measurements.antenna_is_known or not excitation.shows_sides
            else antenna_warning(name, table, covariance)
        ),
        *(
            f"{name}: no terrain change at {t:g} s: the drive lasts {end_s:.1f} s"
            for t in filtered.changes_s
            if t not in changes_s
        ),
        *noise_warnings(name, config, filtered.noise),
        *(f"{name}: {sentence}" for sentence in excitation.sentences),
    ]


def filter_summary(measurements: Measurements, filtered: Filtered, config: Config) -> dict[str, Any]:
    """Return what the filter was run with, and the statistics of its innovations."""
    sensors, start = filtered.sensors, filtered.began_with
    return {
        "preset": config.filter.preset,
        "process_position_mps": filtered.noise.position_mps,
        "process_heading_degps": filtered.noise.heading_degps,
        "reference_delay_s": measurements.findings["position_delay_s"].applied,
        "heading_correlation_s": sensors.heading_correlation_s,
        "heading_from_position": sensors.heading_from_position,
        "heading_is_estimated": sensors.heading_is_estimated,
        "heading_is_measured": sensors.heading_is_measured,
        "turn_wander_rad": sensors.turn_wander_rad,
        "antenna_m": sensors.antenna_m,
        "antenna_is_known": measurements.antenna_is_known,
        "states": len(filtered.table),
        "warm_start": None if start is None else {"icrs_m": start.icrs_m, "covariance_m2": start.covariance_m2},
        "icr_start": None if sensors.icr_start is None else sensors.icr_start._asdict(),
    } | nis_summary(filtered.gnss, filtered.heading)


def learned(filtered: Filtered, config: Config, clock_std_s: float = 0.0) -> tuple[Floats, Excitation, float]:
    """Return the covariance (3, 3) of the final ICRs [m^2], what was shown, and the clocks' part of x_icr's std [m].

    Parameters
    ----------
    clock_std_s : of the time between position and heading: positions that lag look like an x_icr further back

    Preset ``paper``: the filter's own covariance, and what the drive could show.
    """
    table, width = filtered.table, config.robot.track_width_m
    track = track_of_states(table, filtered.in_gap, filtered.outages_ns)
    p = nominal_icrs(table, width)
    windows, own = cut_states(table, track, p), filtered.covariance[3:, 3:]
    excitation = find_excitation(table, track, width, windows)
    if config.filter.preset == "paper":
        return own, excitation, 0.0
    covariance = final_covariance(
        windows,
        own,
        width_m=float(p[0] - p[1]),
        process_icr_mps=config.filter.process_icr_mps,
        track_width_m=width,
    )
    excitation = withhold_unlearned(
        excitation,
        table,
        std_m=np.sqrt(np.diag(covariance)),
        start_std_m=filtered.start_std_m,
        least_icr_m=filtered.least_icr_m,
    )
    turning = np.diff(table.t_s, append=table.t_s[-1:]) * (track.v_left - track.v_right) ** 2
    speed = float((turning * (track.v_left + track.v_right)).sum() / 2 / max(float(turning.sum()), 1e-12))
    x_clock_std_m = abs(speed) * clock_std_s
    return covariance + np.diag([0.0, 0.0, x_clock_std_m**2]), excitation, x_clock_std_m


def without_unlearned(document: RunDocument) -> RunDocument:
    """Return the summary with null in place of the ICRs that are not shown, and of a multiplier made of one."""
    icr: Any = dict(document["icr"])
    hidden = [name for name, verdict in document["excitation"]["verdict"].items() if verdict == "not shown"]
    for key in ("final", "final_std", "mean", "std"):
        icr[key] = {name: None if name in hidden else value for name, value in icr[key].items()}
    if "y_icr_right_m" in hidden or "y_icr_left_m" in hidden:
        icr |= {"separation_multiplier": None, "separation_multiplier_std": None}
    return {**document, "icr": icr}


def event_summary(events: tuple[SlipEvent, ...], start_ns: int) -> list[dict[str, Any]]:
    """Return the slip events with the columns of events.csv; `start_ns` is the stamp of the first recorded state."""
    return [{column: row[column] for column in EVENT_COLUMNS} for row in span_rows(events, start_ns)]


def span_rows(spans: Sequence[SlipEvent | ReferenceJump], start_ns: int) -> list[dict[str, Any]]:
    """Return spans as rows, begin and end also in seconds since the first recorded state, of stamp `start_ns`."""
    return [
        one._asdict() | {"begin_s": (one.begin_ns - start_ns) / 1e9, "end_s": (one.end_ns - start_ns) / 1e9}
        for one in spans
    ]


def _end_errors(table: States, in_gap: Bools, track_width_m: float | None) -> dict[str, Any]:
    """Return how far from the filter's last position the wheels-only paths end."""
    icrs = {"icr": table.icrs_at(-1), "no_slip": None if track_width_m is None else no_slip_icrs(track_width_m)}
    return {
        name: None if one is None else {"end_error_m": drive_wheels(table, in_gap, one).end_error_m}
        for name, one in icrs.items()
    }


def class_summary(fixes: Fixes, statistics: FixStatistics, outcome: MeasurementOutcome) -> dict[str, Any]:
    """Return how many fixes of each class there were and how they were used."""
    classes = {}
    for code, name in CLASSES.items():
        rows = fixes.fix_class == code
        if rows.any():
            counted = {"fixes": rows, "used": rows & outcome.used, "rejected": rows & outcome.rejected}
            counted |= {"down_weighted": rows & fixes.down_weighted, "sold_as_fixed": rows & fixes.misreported}
            counts = {key: int(np.count_nonzero(marked)) for key, marked in counted.items()}
            classes[name] = counts | {"std_m": statistics.std_m[name], "step_std_m": statistics.step_std_m[name]}
    return {"classes": classes}


def converge(table: States, until_s: float | None = None) -> dict[IcrColumn, tuple[float, float] | None]:
    """Find when each ICR estimate converged, up to a time where one is given.

    Returns
    -------
    dict
        By column: time [s] at which the estimate has made 10 % of the change from its start to its settled value
        (median over the second half of the run), and time from which on it stays within 10 % of that change for
        `SETTLED_S`; None where the change is below `SMALLEST_CHANGE_M` or the estimate never settles.

    Notes
    -----
    Pentzer 2014, Section 5.2: the time from 10 % change to within 90 % of the final value.
    """
    spans: dict[IcrColumn, tuple[float, float] | None] = {}
    rows = max(int(np.searchsorted(table.t_s, until_s)), 1) if until_s is not None else len(table)
    t_s = table.t_s[:rows]
    settled_by = np.searchsorted(t_s, t_s + SETTLED_S)
    for column in ICR_COLUMNS:
        estimate: Floats = getattr(table, column)[:rows]
        settled = float(np.median(estimate[len(estimate) // 2 :]))
        change = settled - float(estimate[0])
        if abs(change) < SMALLEST_CHANGE_M:
            spans[column] = None
            continue
        gone = (estimate - estimate[0]) / change
        first = int(np.argmax(np.abs(gone) >= 0.1))
        last = _first_stay(settled_by, np.abs(gone - 1.0) <= 0.1)
        spans[column] = (float(t_s[first]), float(t_s[last])) if last is not None else None
    return spans


def _first_stay(until: Ints, inside: Bools) -> int | None:
    """Return the first row from which `inside` holds up to row `until` of it, which must be one; None if none does."""
    outside = np.concatenate([[0], np.cumsum(~inside)])
    stays = inside & (outside[until] == outside[:-1]) & (until < len(inside))
    return int(np.argmax(stays)) if stays.any() else None


def path_speed(table: States) -> Floats:
    """Return the speed over each interval between states (n - 1,) [m/s]; NaN where no time passes."""
    interval = np.diff(table.t_s)
    speed = np.full(len(interval), np.nan)
    np.divide(np.diff(table.distance_m), interval, out=speed, where=interval > 0)
    return speed


def drive_summary(table: States) -> dict[str, float]:
    """Return duration, distance of the positions, and mean and standard deviation of the speed over time.

    Notes
    -----
    The distance is the sum of chords between positions that lie a step apart: longer than their noise, so that a
    parked robot stays where it is. Wheels that turn on the spot do not count. Between the ends of a chord the speed
    follows the model's, or is constant where the model shows less than half of it.
    """
    weight = np.diff(table.t_s)
    duration = float(table.t_s[-1])
    noise = float(np.median(np.hypot(table.std_north_m, table.std_east_m)))
    rows, chords = _chords(table, max(SHORTEST_STEP_M, STEP_IN_STD * noise))
    distance = float(chords.sum())
    modelled, lasted = np.diff(table.distance_m[rows]), np.diff(table.t_s[rows])
    # in a gap of the wheel data the model stands still
    known = LEAST_MODELLED * chords < modelled
    stretched = np.divide(chords, modelled, out=np.zeros(len(chords)), where=known)
    even = np.divide(chords, lasted, out=np.zeros(len(chords)), where=~known & (lasted > 0))
    speed = np.nan_to_num(path_speed(table)) * np.repeat(stretched, np.diff(rows)) + np.repeat(even, np.diff(rows))
    mean = distance / duration if duration > 0 else 0.0
    spread = float(np.sqrt(np.average((speed - mean) ** 2, weights=weight))) if duration > 0 else 0.0
    return {"duration_s": duration, "distance_m": distance, "speed_mean_mps": mean, "speed_std_mps": spread}


def _chords(table: States, step_m: float) -> tuple[Ints, Floats]:
    """Return rows of states (c + 1,), first and last included, at least a step apart, and the chords between (c,) [m].

    The last chord may be shorter than a step; it counts for nothing then.
    """
    rows, last = chord_rows(table.north_m, table.east_m, step_m), len(table) - 1
    chords = np.hypot(np.diff(table.north_m[rows]), np.diff(table.east_m[rows]))
    if rows[-1] != last:
        rows, chords = np.append(rows, last), np.append(chords, 0.0)
    return rows, chords


def icr_summary(
    table: States, convergence: dict[IcrColumn, tuple[float, float] | None], covariance: Floats
) -> dict[str, Any]:
    """Return the ICRs: final, mean and standard deviation over the states after convergence, and when they did.

    `covariance` (3, 3) is that of the final ICRs.
    """
    settled = max((span[1] for span in convergence.values() if span is not None), default=0.0)
    after = table.t_s >= settled
    columns: dict[str, Floats] = {column: getattr(table, column) for column in ICR_COLUMNS}
    return {
        "final": {column: float(values[-1]) for column, values in columns.items()},
        "final_std": dict(zip(columns, np.sqrt(np.diag(covariance)).tolist(), strict=True)),
        "mean": {column: float(values[after].mean()) for column, values in columns.items()},
        "std": {column: float(values[after].std()) for column, values in columns.items()},
        "convergence_s": {
            column: span[1] - span[0] if span is not None else None for column, span in convergence.items()
        },
        "convergence_span_s": dict(convergence),
    }


def segment_summary(table: States, changes_s: tuple[float, ...]) -> list[dict[str, Any]]:
    """Return mean and standard deviation of the ICRs over the second half of each stretch between terrain changes."""
    if not changes_s:
        return []
    edges = [0.0, *sorted(changes_s), float(table.t_s[-1])]
    segments = []
    for begin, end in pairwise(edges):
        inside = (table.t_s >= (begin + end) / 2) & (table.t_s <= end)
        columns: dict[str, Floats] = {column: getattr(table, column)[inside] for column in ICR_COLUMNS}
        segments.append(
            {
                "begin_s": begin,
                "end_s": end,
                "mean": {column: float(values.mean()) if len(values) else None for column, values in columns.items()},
                "std": {column: float(values.std()) if len(values) else None for column, values in columns.items()},
            }
        )
    return segments


def separation_multiplier(table: States, track_width_m: float) -> float:
    """Return (y_r - y_l)/b of the final estimates: the wheel_separation_multiplier of a ROS diff-drive controller."""
    separation = abs(float(table.y_icr_right_m[-1]) - float(table.y_icr_left_m[-1]))
    return max(separation, MIN_ICR_SEPARATION_M) / track_width_m


def counts(outcome: MeasurementOutcome) -> dict[str, int]:
    """Return how many measurements were used, and rejected by the innovation gate."""
    return {"used": int(np.count_nonzero(outcome.used)), "rejected": int(np.count_nonzero(outcome.rejected))}


def gnss_summary(
    datum: Datum | None, rejected_fixes: dict[str, int], gnss: MeasurementOutcome, down_weighted: Bools
) -> dict[str, Any]:
    """Return how many fixes were used and rejected, and how far the filter stays from those it used and trusted."""
    by_gate = int(np.count_nonzero(gnss.rejected))
    difference = gnss.difference[gnss.used & ~down_weighted]
    return {
        "used": int(np.count_nonzero(gnss.used)),
        "rejected": by_gate + sum(rejected_fixes.values()),
        "rejected_by_gate": by_gate,
        "rejected_by_reason": dict(rejected_fixes),
        "recoveries": int(np.count_nonzero(gnss.code == RECOVERED)),
        "mean_difference_m": float(difference.mean()) if len(difference) else None,
        "max_difference_m": float(difference.max()) if len(difference) else None,
        "datum": [datum.latitude_deg, datum.longitude_deg, datum.height_m] if datum is not None else None,
    }


def nis_summary(gnss: MeasurementOutcome, heading: MeasurementOutcome) -> dict[str, Any]:
    """Return mean NIS (2 and 1 expected where the noise is right) and rejections, over measurements not gated."""
    summary: dict[str, Any] = {}
    for name, outcome in (("gnss", gnss), ("heading", heading)):
        nis = outcome.nis[outcome.used]
        summary[f"nis_{name}_mean"] = float(nis.mean()) if len(nis) else None
        summary[f"{name}_rejected"] = int(np.count_nonzero(outcome.rejected))
    return summary
