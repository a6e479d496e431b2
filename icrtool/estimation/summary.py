"""The numbers of a run: distance, speed, ICR means, convergence, GNSS difference, NIS (Pentzer 2014, Tables I-III)."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from msgspec.structs import asdict

from icrtool import __version__
from icrtool.alignment.gnss_quality import CLASSES
from icrtool.config import Config
from icrtool.estimation.convergence import converge
from icrtool.estimation.observability import (
    cut_states,
    final_covariance,
    find_excitation,
    multiplier_std,
    unlearned_icrs,
)
from icrtool.estimation.odometry import (
    GapPaths,
    OdometryName,
    drive_summary,
    drive_wheels,
    measure_gaps,
    odometry_icrs,
)
from icrtool.estimation.run_filter import Filtered
from icrtool.estimation.run_warnings import (
    antenna_warning,
    contradicts_windows,
    noise_warnings,
    rejected_share,
    run_warnings,
    unusable_reasons,
)
from icrtool.kernels.arrays import Bools, Floats, Ints
from icrtool.kernels.filter_records import RECOVERED
from icrtool.kernels.kinematics import MIN_ICR_SEPARATION_M
from icrtool.records.measurements import Fixes, LogFacts, Measurements, ReferenceJump, SlipEvent
from icrtool.records.notes import Note, note, notes_about, unusable_because, warnings_of
from icrtool.records.plain_data import finite_or_none
from icrtool.records.requests import FitRequest
from icrtool.records.run import ICR_COLUMNS, MeasurementOutcome, track_of_states
from icrtool.records.run_document import (
    RUN_SCHEMA,
    ChangeDocument,
    ClassDocument,
    EventDocument,
    ExcitationDocument,
    FilterDocument,
    GnssDocument,
    HeadingDocument,
    IcrColumn,
    IcrDocument,
    NumberByIcr,
    OdometryDocument,
    PathErrorDocument,
    ReferenceJumpDocument,
    RunDocument,
    SegmentDocument,
    SpanByIcr,
    Spans,
    TerrainDocument,
    WarmStartDocument,
)
from icrtool.records.samples import Datum, InputFile, are_twist
from icrtool.records.tables import States


def summarise(
    measurements: Measurements,
    filtered: Filtered,
    config: Config,
    request: FitRequest,
    *,
    inputs: tuple[InputFile, ...],
    datum: Datum | None,
    rejected_fixes: dict[str, int],
) -> RunDocument:
    """Return the document of a run: all its numbers and warnings.

    Parameters
    ----------
    measurements : result of the alignment
    filtered : result of the filter
    config : the effective configuration
    request : request of the fit
    inputs, datum : files and datum of the log
    rejected_fixes : number of fixes that were left out before the filter, by reason
    """
    table, sensors, width = filtered.table, filtered.sensors, config.robot.track_width_m
    changes_s = tuple(t for t in filtered.changes_s if 0.0 < t < table.t_s[-1])
    convergence = converge(table, min(changes_s, default=None))
    covariance, excitation, x_clock_std_m = assess_icrs(filtered, config, sensors.facts)
    multiplier = None if width is None else (separation_multiplier(table, width), multiplier_std(covariance, width))
    inverted, rejected = bool(table.y_icr_right_m[-1] <= table.y_icr_left_m[-1]), _rejected_shares(filtered)
    unusable = _unusable_reasons(
        measurements, filtered, config, multiplier, excitation, changes_s, covariance, rejected, inverted=inverted
    )
    notes = _notes(
        measurements, filtered, config, None if unusable else multiplier, excitation, changes_s, covariance,
        rejected, inverted=inverted,
    )  # fmt: skip
    gaps = measure_gaps(table, filtered.in_gap, sensors, filtered.gnss.used)
    notes = (*notes, *_notes_of_gaps(gaps, sensors.name), *notes_about(sensors.name, unusable))
    hidden = () if config.filter.rules.final_of_filter else excitation.verdict.not_shown
    return RunDocument(
        schema=RUN_SCHEMA,
        tool_version=__version__,
        log=sensors.name,
        inputs=inputs,
        config=config,
        request=request,
        streams=measurements.streams,
        notes=notes,
        warnings=warnings_of(notes),
        alignment=measurements.estimates,
        drive=drive_summary(table, sensors.jumps, gaps),
        usable=not unusable,
        unusable_because=unusable_because(notes),
        icr=icr_summary(table, convergence, covariance, filtered.covariance[3:, 3:], x_clock_std_m, multiplier, hidden),
        odometry=_odometry(table, filtered.in_gap, width),
        terrain=TerrainDocument(tuple(map(ChangeDocument, changes_s))),
        segments=segment_summary(table, changes_s),
        gnss=gnss_summary(datum, rejected_fixes, filtered.gnss, sensors.fixes, measurements),
        heading=_heading_document(measurements, filtered),
        wheels=measurements.wheels,
        events=tuple(EventDocument(**_span_with_seconds(event, table)) for event in sensors.events),
        reference_jumps=tuple(ReferenceJumpDocument(**_span_with_seconds(jump, table)) for jump in sensors.jumps),
        outages_ns=_spans(filtered.outages_ns),
        rtk_losses_ns=_spans(sensors.losses_ns),
        wheel_gaps_ns=_spans(table.stamp_ns[np.flatnonzero(filtered.in_gap)[:, None] + [0, 1]]),
        facts=sensors.facts,
        filter=filter_summary(measurements, filtered, config),
        excitation=excitation,
    )  # fmt: skip


def _notes_of_gaps(gaps: GapPaths, log: str) -> tuple[Note, ...]:
    """Return the note about gaps in which neither wheels nor positions show the driven distance."""
    if gaps.unseen_m <= 0.0:
        return ()
    why = (
        f"the driven distance is a lower limit: for {gaps.unseen_s:.1f} s the log has neither wheel samples nor "
        f"positions, and the {gaps.unseen_m:.1f} m between their ends are counted"
    )
    return (note("distance_is_lower_limit", why, log),)


def _rejected_shares(filtered: Filtered) -> dict[str, float]:
    """Return the shares of fixes and of headings that were rejected while the wheels turned."""
    moving_fixes, moving_headings = filtered.sensors.moving()
    return {
        "fixes": rejected_share(filtered.gnss.code[moving_fixes]),
        "headings": rejected_share(filtered.heading.code[moving_headings]),
    }


def _unusable_reasons(
    measurements: Measurements, filtered: Filtered, config: Config, multiplier: tuple[float, float] | None,
    excitation: ExcitationDocument, changes_s: Sequence[float], covariance: Floats, rejected: dict[str, float], *,
    inverted: bool,
) -> list[Note]:  # fmt: skip
    """Return why the ICRs must not be used; empty if they can be used. `summarise` computes the arguments."""
    corrects, wheels = config.filter.rules.corrects, measurements.wheels
    widths_from_twist = are_twist(measurements.streams) and config.wheels.twist_width_m is None
    one_ground = not changes_s and wheels.ground_change_s is None
    contradiction = ""
    if corrects and one_ground:
        contradiction = contradicts_windows(filtered.table, covariance, measurements.estimates)
    return unusable_reasons(
        excitation, rejected, filtered.noise, measurements.estimates["wheel_scale"] if corrects else None,
        multiplier if widths_from_twist else None, contradiction, wheels.filtered or "" if corrects else "", wheels,
        inverted=inverted,
    )  # fmt: skip


def _odometry(table: States, in_gap: Bools, width_m: float | None) -> OdometryDocument:
    """Return the errors of the paths by wheel speeds alone over the whole drive."""
    errors: dict[OdometryName, PathErrorDocument] = {}
    for name, icrs in odometry_icrs(table, width_m).items():
        path = drive_wheels(table, in_gap, icrs, len(table))
        errors[name] = PathErrorDocument(path.end_error_m, path.mean_error_m, path.max_error_m)
    return OdometryDocument(errors["icr"], errors.get("no_slip"), errors["icr_momentary"])


def _notes(
    measurements: Measurements, filtered: Filtered, config: Config, multiplier: tuple[float, float] | None,
    excitation: ExcitationDocument, changes_s: Sequence[float], covariance: Floats,
    rejected: dict[str, float], *, inverted: bool,
) -> tuple[Note, ...]:  # fmt: skip
    """Return the findings of alignment and filter, in the order in which they were found."""
    name, table = filtered.sensors.name, filtered.table
    end_s = float(table.t_s[-1])
    return (
        *measurements.notes,
        *run_warnings(name, rejected, multiplier, excitation, measurements.estimates, inverted=inverted),
        *(
            []
            if filtered.sensors.facts.antenna_is_known or not excitation.verdict.shows_sides
            else antenna_warning(name, table, covariance)
        ),
        *(
            note("terrain_change_outside", f"no terrain change at {t:g} s: the drive lasts {end_s:.1f} s", name)
            for t in filtered.changes_s
            if t not in changes_s
        ),
        *noise_warnings(name, config, filtered.noise),
        *notes_about(name, excitation.notes),
    )


def filter_summary(measurements: Measurements, filtered: Filtered, config: Config) -> FilterDocument:
    """Return the settings of the filter, and the statistics of the innovations of accepted measurements.

    If the noise is right, the mean NIS is 2 for fixes and 1 for headings.
    """
    start = filtered.began_with
    return FilterDocument(
        preset=config.filter.preset,
        process_position_mps=filtered.noise.position_mps,
        process_heading_degps=filtered.noise.heading_degps,
        reference_delay_s=measurements.estimates["position_delay_s"].applied,
        states=len(filtered.table),
        warm_start=None
        if start is None
        else WarmStartDocument(start.icrs_m.tolist(), start.covariance_m2.tolist(), start.source),
        icr_start=filtered.icr_start,
        nis_gnss_mean=_mean(filtered.gnss.nis[filtered.gnss.used]),
        gnss_rejected=_count(filtered.gnss.rejected),
        nis_heading_mean=_mean(filtered.heading.nis[filtered.heading.used]),
        heading_rejected=_count(filtered.heading.rejected),
    )


def _count(marked: Bools) -> int:
    """Return the number of marked rows."""
    return int(np.count_nonzero(marked))


def _mean(values: Floats) -> float | None:
    """Return the mean of values; None without values."""
    return finite_or_none(float(values.mean())) if len(values) else None


def _spans(stamps_ns: Ints) -> Spans:
    """Return spans (k, 2) [ns] as they are stored."""
    return tuple((int(begin), int(end)) for begin, end in stamps_ns)


def assess_icrs(filtered: Filtered, config: Config, facts: LogFacts) -> tuple[Floats, ExcitationDocument, float]:
    """Return the covariance of the final ICRs, the ICRs that the drive shows, and the clocks' part of the std of x_icr.

    Parameters
    ----------
    filtered, config : result of the filter, and the configuration
    facts : of the log. A lag of positions behind headings has the same effect as an x_icr further back

    Returns
    -------
    covariance : (3, 3) [m^2]
    excitation : verdict on each ICR
    x_clock_std_m : part of the clocks in the standard deviation of x_icr

    Notes
    -----
    In preset ``paper`` the covariance is the filter's own, and an ICR counts as shown if the drive could show it.
    """
    table, width = filtered.table, config.robot.track_width_m
    track = track_of_states(table, filtered.in_gap, filtered.outages_ns)
    windows = cut_states(table, track, width, facts.heading_common_std_rad)
    filter_covariance = filtered.covariance[3:, 3:]
    if config.filter.rules.final_of_filter:
        return filter_covariance, find_excitation(windows, {}), 0.0
    covariance = final_covariance(
        windows,
        filter_covariance,
        process_icr_mps=config.filter.process_icr_mps,
        track_width_m=width,
        since_s=max((t for t in filtered.changes_s if t < table.t_s[-1]), default=0.0),
    )
    unlearned = unlearned_icrs(table, std_m=np.sqrt(np.diag(covariance)), least_icr_m=filtered.least_icr_m)
    x_clock_std_m = abs(_speed_while_turning(table)) * facts.clock_std_s
    covariance_of_all = covariance + np.diag([0.0, 0.0, x_clock_std_m**2])
    return covariance_of_all, find_excitation(windows, unlearned), x_clock_std_m


def _speed_while_turning(table: States) -> float:
    """Return the mean speed [m/s] of a drive, weighted by the square of the difference of the side speeds."""
    turning = table.v_left_mps - table.v_right_mps
    turning *= turning
    turning[:-1] *= np.diff(table.t_s)
    turning[-1:] = 0.0
    return float(turning @ (table.v_left_mps + table.v_right_mps)) / 2 / max(float(turning.sum()), 1e-12)


def _span_with_seconds(span: SlipEvent | ReferenceJump, table: States) -> dict[str, Any]:
    """Return the fields of a span, and its start and end in seconds since the first recorded state."""
    start_ns = int(table.stamp_ns[0])
    seconds = {"begin_s": (span.begin_ns - start_ns) / 1e9, "end_s": (span.end_ns - start_ns) / 1e9}
    return asdict(span) | seconds


def _heading_document(measurements: Measurements, filtered: Filtered) -> HeadingDocument:
    """Return the facts about the heading, its delay, and how many headings the filter used and rejected."""
    lag = measurements.estimates["heading_delay_s"]
    return HeadingDocument(
        **asdict(measurements.heading), delay_s=lag.value, delay_std_s=lag.std, applied_delay_s=lag.applied,
        used=_count(filtered.heading.used), rejected=_count(filtered.heading.rejected),
    )  # fmt: skip


def icr_summary(
    table: States, convergence: dict[IcrColumn, tuple[float, float] | None], covariance: Floats, of_filter: Floats,
    x_clock_std_m: float, multiplier: tuple[float, float] | None, hidden: Collection[str],
) -> IcrDocument:  # fmt: skip
    """Return the ICRs of the filter: final, mean and standard deviation after convergence, and convergence times.

    Parameters
    ----------
    table, convergence : the recorded states, and the result of `converge`
    covariance, of_filter : (3, 3) covariance of the final ICRs, and the filter's own covariance [m^2]
    x_clock_std_m : part of the clocks in the standard deviation of x_icr
    multiplier : (y_r - y_l) / b and its standard deviation; None if b is not known
    hidden : ICRs that are not shown; they become null, and so does a multiplier that is computed from one
    """
    settled = max((span[1] for span in convergence.values() if span is not None), default=0.0)
    after = table.t_s >= settled

    def by_icr(values: Iterable[float]) -> NumberByIcr:
        """Return numbers by ICR; None for hidden ICRs."""
        rows = zip(ICR_COLUMNS, values, strict=True)
        return NumberByIcr(*(None if column in hidden else finite_or_none(value) for column, value in rows))

    settled_icrs = (getattr(table, column)[after] for column in ICR_COLUMNS)
    means, stds = zip(*((float(icr.mean()), float(icr.std())) for icr in settled_icrs), strict=True)
    if multiplier is None or {"y_icr_right_m", "y_icr_left_m"} & set(hidden):
        apart, apart_std = None, None
    else:
        apart, apart_std = multiplier
    return IcrDocument(
        final=by_icr(table.icrs_at(-1)),
        final_std=by_icr(np.sqrt(np.diag(covariance)).tolist()),
        mean=by_icr(means),
        std=by_icr(stds),
        convergence_s=NumberByIcr(*(span[1] - span[0] if span is not None else None for span in convergence.values())),
        convergence_span_s=SpanByIcr(*convergence.values()),
        separation_multiplier=apart,
        separation_multiplier_std=apart_std,
        final_covariance_m2=of_filter.tolist(),
        x_clock_std_m=x_clock_std_m,
    )


def segment_summary(table: States, changes_s: tuple[float, ...]) -> tuple[SegmentDocument, ...]:
    """Return mean and standard deviation of the ICRs in the second half of each stretch between terrain changes."""
    segments = []
    for begin, end in pairwise([0.0, *sorted(changes_s), float(table.t_s[-1])] if changes_s else []):
        inside = (table.t_s >= (begin + end) / 2) & (table.t_s <= end)
        icrs: list[Floats] = [getattr(table, column)[inside] for column in ICR_COLUMNS]
        means, stds = (
            [_mean(icr) for icr in icrs],
            [finite_or_none(float(icr.std())) if len(icr) else None for icr in icrs],
        )
        segments.append(SegmentDocument(begin, end, NumberByIcr(*means), NumberByIcr(*stds)))
    return tuple(segments)


def separation_multiplier(table: States, track_width_m: float) -> float:
    """Return (y_r - y_l) / b of the final estimates, the wheel_separation_multiplier of a diff_drive_controller."""
    separation = abs(float(table.y_icr_right_m[-1]) - float(table.y_icr_left_m[-1]))
    return max(separation, MIN_ICR_SEPARATION_M) / track_width_m


def gnss_summary(
    datum: Datum | None, rejected_fixes: dict[str, int], outcome: MeasurementOutcome, fixes: Fixes,
    measurements: Measurements,
) -> GnssDocument:  # fmt: skip
    """Return the numbers of used and rejected fixes, also by class, and the filter's distance from the used fixes."""
    delay = measurements.estimates["position_delay_s"]
    difference = outcome.difference[outcome.used & ~fixes.down_weighted]
    classes = {
        name: ClassDocument(
            fixes=_count(rows),
            used=_count(rows & outcome.used),
            rejected=_count(rows & outcome.rejected),
            down_weighted=_count(rows & fixes.down_weighted),
            sold_as_fixed=_count(rows & fixes.misreported),
            std_m=finite_or_none(measurements.fix_statistics.std_m[name]),
            step_std_m=finite_or_none(measurements.fix_statistics.step_std_m[name]),
        )
        for code, name in CLASSES.items()
        if (rows := fixes.fix_class == code).any()
    }
    return GnssDocument(
        used=_count(outcome.used),
        rejected=_count(outcome.rejected) + sum(rejected_fixes.values()),
        rejected_by_gate=_count(outcome.rejected),
        rejected_by_reason=dict(rejected_fixes),
        recoveries=_count(outcome.code == RECOVERED),
        mean_difference_m=_mean(difference),
        max_difference_m=finite_or_none(float(difference.max())) if len(difference) else None,
        datum=(datum.latitude_deg, datum.longitude_deg, datum.height_m) if datum is not None else None,
        delay_s=delay.value,
        delay_std_s=delay.std,
        classes=classes,
    )
