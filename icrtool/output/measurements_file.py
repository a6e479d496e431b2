"""``measurements.npz`` of a run: the sensors as the filter used them, and what became of each measurement.

The wheel samples from the first recorded state on are columns of the states; only those before it are here.
"""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from tokenize import TokenError
from typing import Any, NamedTuple
from zipfile import ZIP_STORED, BadZipFile, ZipFile, ZipInfo

import numpy as np
from numpy.typing import NDArray

from icrtool.kernels.arrays import Ints
from icrtool.records.events import SlipEvent
from icrtool.records.measurements import Fixes, IcrStart, SensorData
from icrtool.records.run import MeasurementOutcome, Run
from icrtool.records.samples import GyroSamples, HeadingSamples, WheelSamples
from icrtool.records.tables import States

MEASUREMENTS_FILE = "measurements.npz"

OUTCOME_COLUMNS = ("nis", "code", "difference")

LARGEST = 1e30
"""Of a measurement: squares of larger numbers overflow."""

KINDS = {
    "stamp_ns": np.int64,
    "fix_class": np.uint8,
    "misreported": np.bool_,
    "down_weighted": np.bool_,
    "code": np.uint8,
}
"""Types of the columns that are not float64."""


WHEEL_COLUMNS = ("stamp_ns", "v_left_mps", "v_right_mps")
"""Stored for the samples before the first state; the states hold the others."""


class FilterInputs(NamedTuple):
    """What run.json holds of the sensors: numbers that are no column."""

    name: str
    heading_from_position: bool
    heading_is_estimated: bool
    heading_correlation_s: float
    antenna_m: tuple[float, float]
    losses_ns: Ints
    events: tuple[SlipEvent, ...]
    icr_start: IcrStart | None


def write_measurements(run: Run, path: Path) -> None:
    """Write the measurements of a run as arrays that `numpy.load` reads.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    sensors, before = run.sensors, len(run.sensors.wheels.stamp_ns) - len(run.table)
    columns: dict[str, NDArray[Any]] = {}
    for name in WHEEL_COLUMNS:
        columns[f"wheels_{name}"] = getattr(sensors.wheels, name)[:before]
    for group, record in (("fixes", sensors.fixes), ("headings", sensors.headings)):
        columns |= {f"{group}_{name}": getattr(record, name) for name in _names(type(record))}
    for group, outcome in (("fixes", run.gnss), ("headings", run.heading)):
        columns |= {f"{group}_{name}": getattr(outcome, name) for name in OUTCOME_COLUMNS}
    if sensors.gyro is not None:
        columns["gyro_topic"] = np.frombuffer(sensors.gyro.topic.encode("utf-8", "surrogatepass"), np.uint8)
        columns |= {"gyro_stamp_ns": sensors.gyro.stamp_ns, "gyro_rate_radps": sensors.gyro.rate_radps}
    if sensors.attitude is not None:
        columns |= {f"attitude_{name}": getattr(sensors.attitude, name) for name in _names(HeadingSamples)}
    with path.open("xb") as file:
        np.savez(file, **columns)  # type: ignore[arg-type]  # numpy's stub takes the columns for its own flag


def read_measurements(
    path: Path, table: States, inputs: FilterInputs
) -> tuple[SensorData, MeasurementOutcome, MeasurementOutcome]:
    """Read what `write_measurements` wrote: the sensors, and what became of fixes and headings.

    Raises
    ------
    ValueError
        It is no such file, or its columns do not belong together.
    OSError
        The file cannot be read.
    """
    try:
        with ZipFile(path) as stored:
            if any(member.compress_type != ZIP_STORED for member in stored.infolist()):
                raise ValueError(f"{MEASUREMENTS_FILE} is compressed")  # its size would have no bound
            columns = {member.filename.removesuffix(".npy"): _array(stored, member) for member in stored.infolist()}
        before = _columns(columns, "wheels", WHEEL_COLUMNS)
        stamps, left, right = (np.concatenate([before[name], getattr(table, name)]) for name in WHEEL_COLUMNS)
        fixes = Fixes(**_columns(columns, "fixes", _names(Fixes)))
        headings = HeadingSamples(**_columns(columns, "headings", _names(HeadingSamples)))
        sensors = SensorData(
            name=inputs.name,
            wheels=WheelSamples(stamps, left, right),
            fixes=fixes,
            headings=headings,
            gyro=_gyro(columns) if "gyro_topic" in columns else None,
            heading_from_position=inputs.heading_from_position,
            heading_correlation_s=inputs.heading_correlation_s,
            antenna_m=inputs.antenna_m,
            losses_ns=inputs.losses_ns,
            events=inputs.events,
            icr_start=inputs.icr_start,
            heading_is_estimated=inputs.heading_is_estimated,
            attitude=HeadingSamples(**_columns(columns, "attitude", _names(HeadingSamples)))
            if "attitude_stamp_ns" in columns
            else None,
        )
        outcomes = [
            _outcome(columns, group, stamps_ns, table)
            for group, stamps_ns in (("fixes", fixes.stamp_ns), ("headings", headings.stamp_ns))
        ]
    except (BadZipFile, KeyError, EOFError, RuntimeError, MemoryError, SyntaxError, TokenError) as err:
        raise ValueError(f"{MEASUREMENTS_FILE}: {err}") from err
    return sensors, outcomes[0], outcomes[1]


def _array(stored: ZipFile, member: ZipInfo) -> NDArray[Any]:
    with stored.open(member) as file:
        return np.lib.format.read_array(file, allow_pickle=False)


def _names(record: type) -> tuple[str, ...]:
    return tuple(field.name for field in fields(record))


def _columns(columns: dict[str, NDArray[Any]], group: str, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    """Return the columns of a group, all of one length and of their types."""
    found = {name: _checked(columns, f"{group}_{name}", name) for name in names}
    if len({len(column) for column in found.values()}) > 1:
        raise ValueError(f"the columns of the {group} differ in length")
    return found


def _checked(columns: dict[str, NDArray[Any]], key: str, name: str) -> NDArray[Any]:
    column, kind = columns[key], KINDS.get(name, np.float64)
    if column.ndim != 1 or column.dtype != kind:
        raise ValueError(f"{key} is no column of {np.dtype(kind)}")
    if kind is np.float64 and name not in OUTCOME_COLUMNS and (np.abs(column) > LARGEST).any():
        raise ValueError(f"{key} holds a number beyond {LARGEST:g}")
    return column


def _gyro(columns: dict[str, NDArray[Any]]) -> GyroSamples:
    topic = columns["gyro_topic"].astype(np.uint8).tobytes().decode("utf-8", "surrogatepass")
    return GyroSamples(topic, *(_checked(columns, f"gyro_{name}", name) for name in ("stamp_ns", "rate_radps")))


def _outcome(columns: dict[str, NDArray[Any]], group: str, stamps: Ints, table: States) -> MeasurementOutcome:
    nis, code, difference = (_checked(columns, f"{group}_{name}", name) for name in OUTCOME_COLUMNS)
    if not len(nis) == len(code) == len(difference) == len(stamps):
        raise ValueError(f"the outcomes of the {group} are not as many as those")
    return MeasurementOutcome(stamps, (stamps - table.stamp_ns[0]) / 1e9, nis, code, difference)
