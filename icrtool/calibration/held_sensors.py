"""Constants of the sensors in a calibration: measured in each of its logs, pooled, and held in a further log.

The sensors of a robot are installed once. Heading offset and delays of a log are the sum of the corrections before the
fit and the remainders that the windows show, so that logs with different corrections can be compared. A calibration
holds their mean over its logs, with the spread between drives. The bias of a gyro changes with its temperature, so a
row with a gyro learns the bias from the drive before each start.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from icrtool.kernels.arrays import Floats
from icrtool.kernels.error_statistics import between_variance, pooled_variance
from icrtool.kernels.track import Windows
from icrtool.motion.models import FittedModel
from icrtool.motion.recording import GYRO_START_STD, LogConstants, Recording
from icrtool.motion.window_fit import KnownConstants, measured_constants
from icrtool.records import calibration_document as documents
from icrtool.records.notes import Note, note

FEWEST_POOLED = 3
"""Smallest number of logs from which the spread between drives is estimated."""

BETWEEN_DRIVES_STD = LogConstants(math.radians(0.5), 0.02, GYRO_START_STD[1], 0.02)
"""Standard deviations of the constants between drives of one robot, before its logs show them [rad, s, rad/s, s].

The installation does not change between drives. The robot's response to its wheels changes with ground and speed, and
the bias of a gyro with its temperature."""

SENSORS_CONTRADICT = "sensors_contradict_calibration"
"""Code of a note about a constant that a log contradicts."""

SENSOR_SIGMAS = 3.0
"""Difference between a held constant and the constant of a log above which the log contradicts it, in standard
deviations."""

_TO_DOCUMENT = np.array([math.degrees(1.0), -1.0, math.degrees(1.0), 1.0])
"""Factors from `LogConstants` to the numbers of `SensorConstants`."""


def sensors_of(
    recording: Recording, windows: Windows, fitted_model: FittedModel, gyro_model: FittedModel | None = None
) -> documents.LogSensors:
    """Return the constants of a recording's sensors, with the corrections before the fit.

    Parameters
    ----------
    windows : windows of the recording
    fitted_model, gyro_model : models of the calibration, with wheels alone and with a gyro
    """
    constants = [
        None if model is None else constants_document(measured_in(recording, windows, model))
        for model in (fitted_model, gyro_model)
    ]
    return documents.LogSensors(recording.heading_source, constants[0] or documents.SensorConstants(), constants[1])


def measured_in(recording: Recording, windows: Windows, fitted_model: FittedModel) -> KnownConstants:
    """Return the constants that a recording's sensors had before any correction, for the parameters of a model."""
    constants = measured_constants(windows, fitted_model, recording.width_m)
    return KnownConstants(recording.corrected.plus(constants.mean), constants.std)


def constants_document(constants: KnownConstants) -> documents.SensorConstants:
    """Return constants as a document, in the units and signs of the configuration."""
    values, stds = np.array(constants.mean) * _TO_DOCUMENT, np.array(constants.std) * np.abs(_TO_DOCUMENT)
    pairs = zip(documents.SensorConstants.__struct_fields__, values.tolist(), stds.tolist(), strict=True)
    return documents.SensorConstants(
        **{name: documents.MeasuredConstant(value, std) for name, value, std in pairs if math.isfinite(value + std)}
    )


def known_constants(document: documents.SensorConstants) -> KnownConstants:
    """Return the constants of a document; NaN where it has none."""
    both = np.full((2, len(_TO_DOCUMENT)), np.nan)
    for column, name in enumerate(documents.SensorConstants.__struct_fields__):
        constant: documents.MeasuredConstant | None = getattr(document, name)
        if constant is not None:
            both[:, column] = constant.value / _TO_DOCUMENT[column], constant.std / abs(_TO_DOCUMENT[column])
    return KnownConstants(*(LogConstants(*row) for row in both.tolist()))


def pooled_constants(
    logs: Sequence[documents.CalibrationLog], heading_source: str | None = None, *, with_gyro: bool = False
) -> KnownConstants:
    """Return the constants that the logs of a calibration predict for a further drive; NaN where they predict none.

    Parameters
    ----------
    heading_source : source of the heading in the further drive. Offsets of headings of another source are not used.
        None: the source of the logs, if all have the same source
    with_gyro : return the constants for the model with a gyro

    Notes
    -----
    The value is the mean of the logs, weighted by their variances and the variance between drives. The standard
    deviation holds for a further drive. The variance between drives is the variance of the logs beyond their own
    uncertainty (`between_variance`), pooled with `BETWEEN_DRIVES_STD`, which stands alone for one or two logs.
    """
    stored = [log.sensors for log in logs if log.sensors is not None]
    sources = {sensors.heading_source for sensors in stored}
    if heading_source is None and len(sources) == 1:
        (heading_source,) = sources
    log_constants = [(sensors.heading_source, sensors.gyro if with_gyro else sensors.wheels) for sensors in stored]
    source_constants = [
        (source, known_constants(constants)) for source, constants in log_constants if constants is not None
    ]
    pairs = []
    for column, usual_std in enumerate(BETWEEN_DRIVES_STD):
        is_offset = column == 0
        known = np.array([
            (constants.mean[column], constants.std[column])
            for source, constants in source_constants
            if math.isfinite(constants.mean[column]) and not (is_offset and source != heading_source)
        ])  # fmt: skip
        if is_offset and len(known):
            # Angles are unwrapped about the first one.
            known[:, 0] -= 2.0 * np.pi * np.round((known[:, 0] - known[0, 0]) / (2.0 * np.pi))
        pairs.append(_further(known, usual_std) if len(known) else (math.nan, math.nan))
    mean, std = zip(*pairs, strict=True)
    return KnownConstants(LogConstants(*mean), LogConstants(*std))


def _further(values_and_stds: Floats, usual_std: float) -> tuple[float, float]:
    """Return mean and standard deviation for a further drive, from values and standard deviations of drives (k, 2)."""
    (values, std), usual = values_and_stds.T, usual_std**2
    variances, between = std**2, usual
    if len(values) >= FEWEST_POOLED:
        measured = between_variance(values, np.maximum(variances, np.finfo(np.float64).tiny))
        between = pooled_variance(measured, len(values) - 1.0, usual)[0]
    weights = 1.0 / (variances + between)
    total = float(weights.sum())
    return float(weights @ values) / total, math.sqrt(1.0 / total + between)


def remaining_constants(total: KnownConstants, corrected: LogConstants) -> KnownConstants:
    """Return constants minus the corrections that were made before; NaN where a constant is not known."""
    return total._replace(mean=total.mean.minus(corrected))


CONSTANT_WORDS = {
    "heading_offset_deg": ("heading offset", "°", 2),
    "reference_delay_s": ("delay of the poses behind the wheels", " s", 3),
    "gyro_bias_degps": ("gyro bias", "°/s", 2),
    "gyro_delay_s": ("delay of the gyro behind the wheels", " s", 3),
}
"""Words, unit and number of decimals of each field of `SensorConstants`."""

LEARNED = "gyro_bias_degps"
"""Field of `SensorConstants` that a row learns from the drive before each start, and does not hold."""


def words_of(names: Iterable[str]) -> str:
    """Return the words for some fields of `SensorConstants`."""
    return ", ".join(CONSTANT_WORDS[name][0] for name in names)


def constant_text(constants: documents.SensorConstants, name: str) -> str:
    """Return a constant with its standard deviation and unit as text; empty if the constant is not known."""
    constant: documents.MeasuredConstant | None = getattr(constants, name)
    _, unit, digits = CONSTANT_WORDS[name]
    return "" if constant is None else f"{constant.value:+z.{digits}f} ± {constant.std:.{digits}f}{unit}"


def contradictions(row: str, sensors: documents.HeldSensors, among: Iterable[str]) -> list[Note]:
    """Return a note for each constant that a row holds and its log contradicts.

    Parameters
    ----------
    row : name of the row
    sensors : constants that the row holds, and that the log shows
    among : names of the fields of `SensorConstants` that are compared
    """
    notes = list[Note]()
    if sensors.measured is None:
        return notes
    for name in among:
        held: documents.MeasuredConstant | None = getattr(sensors.held, name)
        measured: documents.MeasuredConstant | None = getattr(sensors.measured, name)
        if held is None or measured is None:
            continue
        words, unit, _ = CONSTANT_WORDS[name]
        apart = math.remainder(measured.value - held.value, 360.0) if unit == "°" else measured.value - held.value
        std = math.hypot(held.std, measured.std)
        if abs(apart) > SENSOR_SIGMAS * std:
            both = (
                f"holds {constant_text(sensors.held, name)} and this log shows {constant_text(sensors.measured, name)}"
            )
            why = f"{words}: the calibration {both}, {abs(apart) / std:.1f} σ apart"
            consequence = (
                "the errors of its rows include this difference; --refit-sensors takes the constants of this log"
            )
            advice = "calibrate again if a sensor was moved or a clock has changed"
            notes.append(note(SENSORS_CONTRADICT, f"row {row}: {why}: {consequence}; {advice}"))
    return notes
