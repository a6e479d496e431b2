"""Rows ``calibration`` of a report: given calibrations, tested in a log with the constants of their sensors."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from icrtool.calibration.adaptive_rows import KnownDrive
from icrtool.calibration.held_sensors import (
    CONSTANT_WORDS,
    LEARNED,
    constants_document,
    contradictions,
    measured_in,
    pooled_constants,
    remaining_constants,
    words_of,
)
from icrtool.calibration.pooled import model_for
from icrtool.calibration.record import Calibration
from icrtool.errors import DataError
from icrtool.motion.adaptive import Learned
from icrtool.motion.models import FittedModel
from icrtool.motion.recording import LogConstants, Recording, cut_windows, past_lines, predicted_path
from icrtool.motion.window_fit import own_constants
from icrtool.records.calibration_document import HeldSensors
from icrtool.records.notes import Note
from icrtool.records.rows import PAST


class CalibratedDrive(NamedTuple):
    """A calibration, and a log that it is tested in.

    Attributes
    ----------
    drive : the log, with the model and constants that were known at each time of it
    sensors : the constants that the calibration holds, and the constants that the log shows
    knows : sources of the used constants, in words
    notes : findings about constants that the log contradicts
    """

    drive: KnownDrive
    sensors: HeldSensors
    knows: str
    notes: tuple[Note, ...]


def calibrated_drive(
    calibration: Calibration,
    recording: Recording,
    row: str,
    past: Recording | None = None,
    *,
    with_gyro: bool = False,
    refit_sensors: bool = False,
) -> CalibratedDrive:
    """Return a calibration with the constants of its sensors, ready to be tested in a recording.

    Parameters
    ----------
    row : name of the row in the report
    past : the recording with the poses that were known when it was driven; default: its own poses
    with_gyro : use the recording's gyro
    refit_sensors : fit all constants to the whole recording, and hold none

    Raises
    ------
    ConfigError
        `model_for` raises it: the calibration is of another robot, or there is no gyro.
    DataError
        The drive is too short to find constants that the calibration does not hold.

    Notes
    -----
    Held constants include the corrections before a fit, so the corrections of this log are subtracted from them. The
    bias of a gyro begins at the held bias, and is learned from the turns before each start.
    """
    fitted_model = model_for(calibration, recording, with_gyro=with_gyro)
    total = pooled_constants(calibration.logs, recording.heading_source, with_gyro=with_gyro)
    measured = None
    with suppress(DataError):
        measured = constants_document(measured_in(recording, cut_windows(recording), fitted_model))
    sensors = HeldSensors(constants_document(total), measured, refit_sensors)
    names = [name for name in CONSTANT_WORDS if with_gyro or not name.startswith("gyro")]
    if refit_sensors:
        own_values = own_constants(cut_windows(recording), fitted_model, recording.width_m)
        knows = f"{words_of(names)} refitted in this drive (--refit-sensors)"
        return CalibratedDrive(KnownDrive(recording, (_learned(fitted_model, own_values),)), sensors, knows, ())
    remaining = remaining_constants(total, recording.corrected)
    unknown = [name for name in names if getattr(sensors.held, name) is None]
    # A model without a gyro uses no constants of a gyro.
    constants = remaining.usual().mean
    if unknown:
        constants = own_constants(cut_windows(recording), fitted_model, recording.width_m, remaining.mean)
    learned: tuple[Learned, ...] = (_learned(fitted_model, constants),)
    if with_gyro:
        usual = remaining.usual()
        constants = constants._replace(gyro_bias_radps=usual.mean.gyro_bias_radps)
        learned = _with_biases(recording if past is None else past, fitted_model, constants, usual.std.gyro_bias_radps)
    knows = _knows([name for name in names if name not in unknown], unknown)
    # Both rows of a calibration hold offset and delay, so a contradiction is noted for the first row only.
    notes = contradictions(row, sensors, ["gyro_delay_s"] if with_gyro else names)
    return CalibratedDrive(KnownDrive(recording, learned), sensors, knows, tuple(notes))


def _knows(known: Sequence[str], unknown: Sequence[str]) -> str:
    """Return the sources of constants in words; `known` and `unknown` are names of `SensorConstants`."""
    parts = []
    if shown := [name for name in known if name != LEARNED]:
        parts.append(f"{words_of(shown)} held")
    if fitted := [name for name in unknown if name != LEARNED]:
        parts.append(f"{words_of(fitted)} from this drive, as the calibration has none")
    if LEARNED in (*known, *unknown):
        parts.append(f"{words_of([LEARNED])} from {PAST}")
    return ", ".join(parts)


def _learned(fitted_model: FittedModel, constants: LogConstants, since_s: float = -np.inf) -> Learned:
    """Return a model and constants that are known from a time [s] on."""
    return Learned(since_s, 0.0, fitted_model, constants)


def _with_biases(
    past: Recording, fitted_model: FittedModel, constants: LogConstants, std_radps: float
) -> tuple[Learned, ...]:
    """Return a model with a gyro and its constants, with the bias that the turns before each time show.

    Parameters
    ----------
    constants : constants with the bias that is known before the drive
    std_radps : standard deviation of this bias [rad/s]
    """
    path = predicted_path(past, fitted_model, constants)
    lines = past_lines(past.track, lambda rows: path(past.track.t[rows])[0], (0.0, std_radps))
    known_s = [-np.inf, *past.track.t[lines.row[1:]].tolist()]
    return tuple(
        _learned(fitted_model, constants._replace(gyro_bias_radps=constants.gyro_bias_radps + bias), since_s)
        for since_s, bias in zip(known_s, lines.bias_radps.tolist(), strict=True)
    )
