"""The rows of a report that do not come from the filter's ICRs: calibrations, scored topics, this log's own models."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import msgspec
from msgspec import UNSET

from icrtool.calibration.calibration_rows import calibrated_drive
from icrtool.calibration.pooled import turning_recording_of
from icrtool.calibration.record import Calibration
from icrtool.calibration.run_models import ComparedModels, ComparedRow, compare_models, with_poses_of
from icrtool.dropout_analysis.topic_rows import topic_rows
from icrtool.errors import DataError
from icrtool.estimation.odometry import measured_headings
from icrtool.records.calibration_document import CalibrationFile
from icrtool.records.dropout_document import UsedCalibration
from icrtool.records.notes import Note
from icrtool.records.requests import ReportRequest
from icrtool.records.run import Run, track_of
from icrtool.records.stages import Watch
from icrtool.records.topic_poses import TopicPoses


class TestedRows(NamedTuple):
    """The rows of a report that do not come from the filter's ICRs.

    Attributes
    ----------
    of_calibrations, of_topics : rows of the calibrations, and of the scored topics
    calibrations : the record of each used calibration
    notes : findings about the sensors of calibrations, and about topics
    compared_models : the rows of this log's own models; None if they were left out
    left_out : reason for which they were left out
    """

    of_calibrations: Sequence[ComparedRow]
    of_topics: Sequence[ComparedRow]
    calibrations: tuple[UsedCalibration, ...]
    notes: tuple[Note, ...]
    compared_models: ComparedModels | None
    left_out: str

    @property
    def all(self) -> list[ComparedRow]:
        """All rows, in the order of the report."""
        return [
            *(() if self.compared_models is None else self.compared_models.rows),
            *self.of_calibrations,
            *self.of_topics,
        ]


def tested_rows(
    compared: Run,
    filtered: Run,
    calibrations: Sequence[Calibration],
    scored: Sequence[TopicPoses],
    request: ReportRequest,
    watch: Watch,
) -> TestedRows:
    """Return the rows of calibrations, of scored topics and of this log's own models."""
    watch("calibrations")
    used, calibration_rows, notes = _calibration_rows(compared, filtered, calibrations, request)
    scored_rows, topic_notes = topic_rows(compared, track_of(compared), scored) if scored else ([], [])
    compared_models, left_out = None, ""
    if request.ladder:
        watch("comparing models")
        try:
            compared_models = compare_models(
                compared, measured_headings(filtered), calibrations, filtered, refit_sensors=request.refit_sensors
            )
        except DataError as err:
            left_out = f"{err.why}, {err.advice}"
    return TestedRows(calibration_rows, scored_rows, used, (*notes, *topic_notes), compared_models, left_out)


def _calibration_rows(
    run: Run, past: Run, calibrations: Sequence[Calibration], request: ReportRequest
) -> tuple[tuple[UsedCalibration, ...], list[ComparedRow], list[Note]]:
    """Return the record of each used calibration, the rows of the calibrations, and notes about their sensors.

    `past` is the run with the poses of the filter.
    """
    used, models, notes = [], [], list[Note]()
    if not calibrations:
        return (), [], []
    recording = turning_recording_of(run)
    driven = with_poses_of(recording, past)
    for number, calibration in enumerate(calibrations, start=1):
        name = "calibration"
        if len(calibrations) > 1:
            stem = calibration.name or str(number)
            if calibration.name and sum(other.name == calibration.name for other in calibrations) > 1:
                stem = f"{stem}-{number}"
            name = f"calibration:{stem}"
        created = calibration.created or ""
        without_sensors = dict.fromkeys(CalibrationFile.__struct_fields__[1:], UNSET)
        short_record = msgspec.structs.replace(calibration, models={}, held_out=(), name=UNSET, **without_sensors)
        fitted_to_this = calibration.fitted_to(recording.sha256)
        fitted = "fitted to this log" if fitted_to_this else "not fitted to this log"
        refitted = "; sensors refitted" if request.refit_sensors else ""
        rows = [(name, calibration.recommended, False)]
        if calibration.gyro is not None and recording.track.gyro is not None:
            rows.append((f"{name}_gyro", calibration.gyro.model, True))
        for row, model, with_gyro in rows:
            tested = calibrated_drive(
                calibration, recording, row, driven, with_gyro=with_gyro, refit_sensors=request.refit_sensors
            )
            models.append(ComparedRow(row, tested.drive.errors, knows=f"other logs ({fitted}); {tested.knows}"))
            notes += tested.notes
            words = f"{fitted}{refitted}", tested.sensors
            used.append(
                UsedCalibration(
                    row, model, len(calibration.logs), fitted_to_this, created, with_gyro, short_record, *words
                )
            )
    return tuple(used), models, notes
