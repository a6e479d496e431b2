"""The motion models of one run: fitted for `icrtool.fit`, and tested on distance that they were not fitted to.

Each model is fitted to windows that share no distance with its trials (`icrtool.calibration.held_out`). The filter's
momentary and final ICRs are compared with these models. Rows with a gyro combine the turn rates of gyro and wheels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import msgspec
import numpy as np

from icrtool.calibration import pooled
from icrtool.calibration.adaptive_rows import adapt, prior_for
from icrtool.calibration.held_out import GYRO_SUFFIX, HeldOut, fit_models, hold_out
from icrtool.calibration.record import Calibration, controller_numbers, fitted_document
from icrtool.errors import DataError
from icrtool.estimation.filter_setup import configured_noise
from icrtool.estimation.observability import WEAK_SHARE
from icrtool.estimation.odometry import odometry_icrs
from icrtool.estimation.run_filter import noise_of
from icrtool.kernels.arrays import ROWS_AT_ONCE, Complexes, Floats
from icrtool.kernels.track import FrozenIcrs, OpenLoopPath, Track
from icrtool.motion.models import FIVE, ICR_VALUES, NO_SLIP, RECOMMENDED, TrackGeometry
from icrtool.motion.recording import ErrorsOf, PastLines, Recording, TrialErrors, Trials, past_gyro_lines
from icrtool.records.measurements import MeasuredHeading
from icrtool.records.notes import Note, note
from icrtool.records.rows import INSTALLATION, PAST, row_of
from icrtool.records.run import ICR_COLUMNS, ICR_WORDS, Run, vendor_icrs, width_or_usual_m
from icrtool.records.run_document import GeometryDocument, RunDocument


def with_motion(run: Run) -> RunDocument:
    """Return the document of a run with its motion model, ICRs and numbers for a controller.

    Notes
    -----
    ICRs and numbers come from one fit of `FIVE` to the windows of the drive, so that (right - left) / b is the
    multiplier. With preset ``paper`` they are the filter's estimates at the end.
    """
    recording = pooled.recording_of(run, width_m=width_or_usual_m(run.track_width_m))
    try:
        fits = fit_models([recording], (FIVE, RECOMMENDED))
    except DataError:
        fits = {}
    uses_filter_icrs, width = run.config.filter.rules.final_of_filter, recording.width_m
    if uses_filter_icrs:
        # The ICRs are the filter's final ICRs, and the radii are the configured radii.
        right, left, x = run.table.icrs_at(-1)
        geometry = TrackGeometry(right, left, x, (right - left) / width, 1.0, 1.0)
        by_icr = np.zeros((len(geometry), ICR_VALUES))
        by_icr[:ICR_VALUES] = np.eye(ICR_VALUES)
        by_icr[ICR_VALUES, :2] = 1.0 / width, -1.0 / width
        covariance: Floats = by_icr @ np.array(run.document.icr.final_covariance_m2) @ by_icr.T
    elif FIVE in fits:
        geometry, covariance = fits[FIVE].geometry(width)
    else:
        short = "the drive is too short for a motion model: only the filter's ICRs are known"
        return msgspec.structs.replace(run.document, partly_because=short if run.usable else None)
    robot = pooled.robot_of(run, width)
    recommended = None
    if run.usable and run.track_width_m is not None and RECOMMENDED in fits:
        recommended = fitted_document(fits[RECOMMENDED], geometry, covariance, robot)
    # An ICR counts as shown if the drive could show it, and if its own standard deviation is small.
    verdicts = run.document.excitation.verdict
    largest = WEAK_SHARE * abs(geometry.y_icr_right_m - geometry.y_icr_left_m)
    shown: dict[str, float] = {}
    for name, value, std in zip(ICR_COLUMNS, geometry, np.sqrt(np.diag(covariance)).tolist(), strict=False):
        if uses_filter_icrs or (verdicts[name] != "not shown" and std <= largest):
            shown |= {name: float(value), f"{name}_std": std}
    document = msgspec.structs.replace(
        run.document,
        recommended=recommended,
        geometry=GeometryDocument(**shown, covariance_m2=covariance[:ICR_VALUES, :ICR_VALUES].tolist()),
    )
    if recommended is None:
        return _with_verdict(document)
    # A common error of both y ICRs cancels in the multiplier, so the standard deviation of the multiplier decides.
    numbers = controller_numbers(geometry, covariance, robot)
    if uses_filter_icrs or numbers.multiplier_std <= WEAK_SHARE * abs(numbers.multiplier):
        document = msgspec.structs.replace(document, controller=numbers)
    return _with_verdict(document, f" (σ {numbers.multiplier_std:.2f})")


def _with_verdict(document: RunDocument, multiplier_std: str = "") -> RunDocument:
    """Return the document of a run with the numbers that the drive does not show.

    A run that shows neither a y ICR nor the multiplier is not usable.

    Parameters
    ----------
    multiplier_std : text with the standard deviation of a multiplier that is not shown
    """
    if not document.usable:
        return document
    texts = {finding.code: finding.text for finding in document.notes}
    if (changed := texts.get("ground_changed")) and not document.request.changes_s:
        return msgspec.structs.replace(document, partly_because=changed)
    if limited := texts.get("wheels_limited"):
        return msgspec.structs.replace(document, partly_because=limited)
    hidden = [ICR_WORDS[name] for name in ICR_COLUMNS if document.icr_of_drive(name) is None]
    has_width = document.config.robot.track_width_m is not None
    if has_width and document.controller is None:
        hidden = [f"multiplier{multiplier_std}", *hidden]
    if not hidden:
        return document
    words = f"{', '.join(hidden)} not shown: drive two full turns on the spot to each side"
    shown_icrs = [name for name in ICR_COLUMNS[:2] if document.icr_of_drive(name) is not None]
    if shown_icrs or document.controller is not None:
        return msgspec.structs.replace(document, partly_because=words)
    grave = note("nothing_shown", words)
    return msgspec.structs.replace(
        document, usable=False, unusable_because=grave.text, notes=(*document.notes, grave), recommended=None
    )


class Model(NamedTuple):
    """ICRs that predict motion from wheel speeds.

    Attributes
    ----------
    icrs : one triple for each start, or one for all starts
    knows : as in `ComparedRow`
    """

    name: str
    icrs: FrozenIcrs
    knows: str = ""


class ComparedRow(NamedTuple):
    """A row of a report whose numbers do not come from the filter.

    Attributes
    ----------
    errors_of : returns the errors of the row in trials; NaN for a trial that it cannot predict
    path : returns the path of the row between two states; None if it cannot predict the path
    knows : words for the data that its numbers were learned from; empty if `icrtool.records.rows` states them
    """

    name: str
    errors_of: ErrorsOf
    path: Callable[[int, int], OpenLoopPath | None] | None = None
    knows: str = ""


def adaptive_rows(
    recording: Recording,
    heading: str,
    calibrations: Sequence[Calibration] = (),
    past: Recording | None = None,
    *,
    refit_sensors: bool = False,
) -> list[ComparedRow]:
    """Return row ``adaptive`` of a recording, and the same row with a measured heading if there is one.

    Parameters
    ----------
    heading : kind of the measured heading in the recording; empty without one
    calibrations, refit_sensors : as in `icrtool.calibration.adaptive_rows.prior_for`
    past : as in `icrtool.calibration.adaptive_rows.adapt`
    """
    prior = prior_for(recording, calibrations, refit_sensors=refit_sensors)
    drive = adapt(recording, prior, past)
    knows = f"{prior.source}, and {PAST}, {INSTALLATION}"
    rows = [ComparedRow("adaptive", drive.errors, drive.path, knows)]
    if heading:
        gyro_functions = partial(drive.errors, turned=True), partial(drive.path, turned=True)
        rows.append(ComparedRow(f"adaptive_{heading}", *gyro_functions, knows))
    return rows


class ComparedModels(NamedTuple):
    """The rows of a report that do not come from the filter, and their test.

    Attributes
    ----------
    rows : the rows
    table : held-out table of the run's recording
    track : track of the run's recording
    heading : kind of the measured heading that rows use, ``gyro`` or ``heading``; empty without one
    notes : findings about rows that were left out, and about corrections
    calibration : the calibration from this run alone; None if the track width is not known
    """

    rows: tuple[ComparedRow, ...]
    table: HeldOut
    track: Track
    heading: str
    notes: tuple[Note, ...]
    calibration: Calibration | None


def compare_models(
    run: Run,
    headings: Iterable[MeasuredHeading] = (),
    calibrations: Sequence[Calibration] = (),
    past: Run | None = None,
    *,
    refit_sensors: bool = False,
) -> ComparedModels:
    """Return the rows of all models of a run, tested on distance that they were not fitted to.

    Parameters
    ----------
    run : the run
    headings : measured headings of the run, the best first; the first one that turns with the robot is used
    calibrations : row ``adaptive`` begins with the first calibration that was not fitted to this log, else with the
        prior of other robots
    past : the run with the poses that were known when it was driven; default: its own poses
    refit_sensors : row ``adaptive`` begins without the constants of the calibration's sensors

    Raises
    ------
    DataError
        The drive is too short for a held-out test.

    Notes
    -----
    Cross-validation (Stone 1974); `icrtool.calibration.held_out` states the data that the fit for a trial leaves out.
    The filter's momentary ICRs were learned before the start of a trial, its final ICRs from the whole drive.
    """
    recording, heading, notes = _with_heading(run, headings)
    parts = {"ahead of": recording.lever.ahead, "to the right of": recording.lever.aside}
    if unknown := " and ".join(word for word, known in parts.items() if not known):
        unknown_place = f"the distance of the position sensor {unknown} the body's origin is not known"
        lever = "row controller uses the distance that this log shows"
        why = f"{unknown_place}: {lever}; frames.antenna_forward_m and antenna_right_m set it"
        notes.append(note("lever_unknown", why))
    held_out = hold_out([recording])
    driven = recording if past is None else with_poses_of(recording, past)
    rows = [
        row for row in _rows(run, held_out, heading, driven) if run.track_width_m is not None or NO_SLIP not in row.name
    ]
    rows += adaptive_rows(recording, heading, calibrations, driven, refit_sensors=refit_sensors)
    calibration = None
    if run.track_width_m is not None:
        robot, used = pooled.robot_of(run, recording.width_m), pooled.use_notes(run)
        calibration = pooled.calibration_of_table(held_out, robot, used, has_gyro=heading == "gyro")
    return ComparedModels(tuple(rows), held_out, recording.track, heading, tuple(notes), calibration)


def with_poses_of(recording: Recording, run: Run) -> Recording:
    """Return a recording with the poses of a run that has the same states."""
    table = run.table
    track = recording.track._replace(north=table.north_m, east=table.east_m, heading=table.heading_rad)
    return replace(recording, track=track)


def _with_heading(run: Run, headings: Iterable[MeasuredHeading]) -> tuple[Recording, str, list[Note]]:
    """Return the recording with the first measured heading that turns with the robot, its kind, and notes.

    The kind is empty if no heading turns with the robot.
    """
    notes = list[Note]()
    plain = pooled.recording_of(run, width_m=width_or_usual_m(run.track_width_m))
    for measured in headings:
        with_rate = pooled.with_turn_rate(plain, measured, run.config.frames.gyro_delay_s)
        if with_rate.track.gyro is not None:
            if with_rate.gyro_reversed:
                why = f"the {measured.kind} counts turns in the other direction; its sign was changed"
                notes.append(note("gyro_sign_changed", why))
            return with_rate, measured.kind, notes
        why = f"the {measured.kind} does not turn with the robot; rows with it are left out"
        notes.append(note("gyro_not_used", why))
    if not notes:
        why = "the run has no heading that is measured apart from the position; rows with one are left out"
        notes.append(note("gyro_not_used", why))
    return plain, "", notes


def _rows(run: Run, held_out: HeldOut, turn_sensor: str, past: Recording) -> Iterator[ComparedRow]:
    """Yield the held-out rows, then the rows of the filter's ICRs with a measured heading.

    Parameters
    ----------
    held_out : held-out table of the run
    turn_sensor : sensor of the measured heading, ``gyro`` or ``heading``
    past : the recording with the poses that were known when it was driven
    """
    for name in held_out.rows:
        if name == NO_SLIP:
            continue
        public = name.replace(GYRO_SUFFIX, f"_{turn_sensor}")
        yield ComparedRow(public, partial(held_out.errors, name, 0), partial(held_out.path, name, 0))
    if held_out.has_gyro:
        (recording,) = held_out.recordings
        for model in models_of(run):
            # With a measured turn rate, rows for comparison would be equal: their ICRs have the middle at the origin.
            if not row_of(model.name).compared:
                is_past = model.name == "icr"
                lines = partial(past_gyro_lines, past.track) if is_past else partial(pooled.gyro_line, recording)
                errors_of = partial(_errors_turned, run, recording, model.icrs, lines)
                yield ComparedRow(f"{model.name}_{turn_sensor}", errors_of, knows=model.knows)


def models_of(run: Run) -> tuple[Model, ...]:
    """Return the models with the filter's momentary and final ICRs, without slip, and with the published factor."""
    driven = odometry_icrs(run.table, run.track_width_m)
    models = [Model("icr", driven["icr_momentary"], momentary_knows(run))]
    if "no_slip" in driven:
        models.append(Model(NO_SLIP, driven["no_slip"]))
    if (published := vendor_icrs(run.document)) is not None:
        models.append(Model("vendor", FrozenIcrs.constant(*published)))
    return (*models, Model("icr_final", driven["icr"]))


def momentary_knows(run: Run) -> str:
    """Return the data that the momentary ICRs of a run were learned from, in words."""
    start, parts = run.began_with, [PAST]
    if start is not None:
        parts = [f"started from {start.source or 'another run'}", PAST]
    if run.config.filter.rules.corrects:
        parts.append(INSTALLATION)
    if noise_of(run) != configured_noise(run.config):
        parts.append("process noise from all of the drive")
    return ", ".join(parts)


def turned_path(run: Run, recording: Recording, heading_rad: Floats, rows: slice) -> tuple[Floats, Complexes]:
    """Return heading [rad] and place, forward + j right [m], of a path by mean track speed and a heading.

    Parameters
    ----------
    heading_rad : (k,) heading at the states of `rows` [rad]
    rows : states of the path; the place at the first one is 0
    """
    lo, hi = rows.start, rows.stop - 1
    position = np.zeros(hi + 1 - lo, np.complex128)
    for begin in range(lo, hi, ROWS_AT_ONCE):
        chunk = slice(begin, min(begin + ROWS_AT_ONCE, hi))
        filled = slice(chunk.start - lo, chunk.stop - lo)
        displacement = recording.track.held[chunk] * (run.table.v_left_mps[chunk] + run.table.v_right_mps[chunk]) / 2.0
        position[filled.start + 1 : filled.stop + 1] = displacement * np.exp(
            0.5j * (heading_rad[filled] + heading_rad[filled.start + 1 : filled.stop + 1])
        )
    return heading_rad, np.cumsum(position, out=position)


def _errors_turned(
    run: Run, recording: Recording, icrs: FrozenIcrs, lines: Callable[[], PastLines], trials: Trials
) -> TrialErrors:
    """Return the errors (k, h) of ICRs in trials in which a gyro gives the turn rate.

    Parameters
    ----------
    icrs : ICRs (n,) of each start, or (1,) of all starts
    lines : returns scales and biases of the gyro; each pair holds from one state on

    Notes
    -----
    If omega is measured, the displacement has two terms: the sum of V e^{j psi} dt, with the mean track speed V, and
    ((y_r + y_l) / 2 - j x) (e^{j psi_e} - e^{j psi_s}) / j. The displacement does not depend on W = y_r - y_l.
    """
    track, (first_rows, scales, biases) = recording.track, lines()
    gyro = track.gyro if track.gyro is not None else np.zeros(len(track.t))
    turn_by_gyro, duration_s = track.cumulate(gyro), track.cumulate(np.ones(len(track.t)))
    errors = TrialErrors.none(trials.ends.shape)
    line_starts = np.searchsorted(trials.starts, np.append(first_rows, len(track.t)))
    for line, (scale, bias) in enumerate(zip(scales.tolist(), biases.tolist(), strict=True)):
        line_trials = slice(line_starts[line], line_starts[line + 1])
        if line_trials.start == line_trials.stop or (last := int(trials.ends[line_trials].max())) < 0:
            continue
        first = int(trials.starts[line_trials.start])
        rows = slice(first, last + 1)
        psi, position = turned_path(run, recording, scale * turn_by_gyro[rows] + bias * duration_s[rows], rows)
        for h in range(trials.ends.shape[1]):
            tried = line_trials.start + np.flatnonzero(trials.ends[line_trials, h] >= 0)
            s, e = trials.starts[tried], trials.ends[tried, h]
            right, left, x = (column if len(column) == 1 else column[s] for column in icrs)
            arm = (right + left) / 2.0 - 1j * x
            begin, end = psi[s - first], psi[e - first]
            moved = position[e - first] - position[s - first] - 1j * arm * (np.exp(1j * end) - np.exp(1j * begin))
            driven = track.north[e] - track.north[s] + 1j * (track.east[e] - track.east[s])
            errors.position[tried, h] = np.abs(np.exp(1j * (track.heading[s] - begin)) * moved - driven)
            errors.heading[tried, h] = np.abs(end - begin - track.heading[e] + track.heading[s])
    return errors
