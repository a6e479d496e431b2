"""``measurements.npz`` of a run: the sensors as the filter used them, and the outcome of each measurement.

The wheel samples from the first recorded state on are columns of the states; only those before it are here.
"""

from __future__ import annotations

import math
from dataclasses import fields, replace
from pathlib import Path
from tokenize import TokenError
from typing import Any
from zipfile import ZIP_STORED, BadZipFile, ZipFile, ZipInfo

import msgspec
import numpy as np
from numpy.typing import NDArray

from icrtool.kernels.arrays import Ints
from icrtool.records.measurements import Fixes, ReferenceJump, SensorData, SlipEvent
from icrtool.records.regular_file import open_regular
from icrtool.records.run import MeasurementOutcome, Run
from icrtool.records.run_document import RunDocument
from icrtool.records.samples import GyroSamples, HeadingSamples, WheelSamples, thin
from icrtool.records.tables import LARGEST, States

MEASUREMENTS_FILE = "measurements.npz"

OUTCOME_COLUMNS = ("nis", "code", "difference")

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
    directory: Path, table: States, document: RunDocument
) -> tuple[States, SensorData, MeasurementOutcome, MeasurementOutcome]:
    """Read what `write_measurements` wrote: the sensors, and the outcome of fixes and headings.

    The states come back with the columns of the wheels in the wheels' memory.

    Parameters
    ----------
    directory : of the run
    table : the states of the run; `document`: its run.json, which holds what is no column

    Raises
    ------
    ValueError
        It is no such file, or its columns do not belong together.
    OSError
        The file cannot be read.
    """
    facts = document.filter
    try:
        with open_regular(directory / MEASUREMENTS_FILE, directory) as file, ZipFile(file) as stored:
            if any(member.compress_type != ZIP_STORED for member in stored.infolist()):
                raise ValueError(f"{MEASUREMENTS_FILE} is compressed")  # its size would have no bound
            columns = {member.filename.removesuffix(".npy"): _array(stored, member) for member in stored.infolist()}
        before = _columns(columns, "wheels", WHEEL_COLUMNS)
        stamps, left, right = (np.concatenate([before[name], getattr(table, name)]) for name in WHEEL_COLUMNS)
        fixes = Fixes(**_columns(columns, "fixes", _names(Fixes)))
        headings = HeadingSamples(**_columns(columns, "headings", _names(HeadingSamples)))
        sensors = SensorData(
            name=document.log,
            wheels=WheelSamples(stamps, left, right),
            fixes=fixes,
            headings=headings,
            gyro=_gyro(columns) if "gyro_topic" in columns else None,
            heading_from_position=facts.heading_from_position,
            heading_correlation_s=facts.heading_correlation_s,
            antenna_m=facts.antenna_m,
            losses_ns=spans_of(document.rtk_losses_ns),
            events=tuple(SlipEvent(*(getattr(one, name) for name in SlipEvent._fields)) for one in document.events),
            jumps=tuple(ReferenceJump(*msgspec.structs.astuple(one)[:-2]) for one in document.reference_jumps),
            icr_start=facts.icr_start,
            heading_is_estimated=facts.heading_is_estimated,
            heading_is_measured=facts.heading_is_measured,
            turn_wander_rad=math.inf if facts.turn_wander_rad is None else facts.turn_wander_rad,
            attitude=_attitude(columns) if "attitude_stamp_ns" in columns else None,
        )
        outcomes = [
            _outcome(columns, group, stamps_ns, table)
            for group, stamps_ns in (("fixes", fixes.stamp_ns), ("headings", headings.stamp_ns))
        ]
    except (BadZipFile, KeyError, EOFError, RuntimeError, MemoryError, SyntaxError, TokenError) as err:
        raise ValueError(f"{MEASUREMENTS_FILE}: {err}") from err
    first = len(stamps) - len(table)
    states = replace(table, stamp_ns=stamps[first:], v_left_mps=left[first:], v_right_mps=right[first:])
    return states, sensors, outcomes[0], outcomes[1]


def _array(stored: ZipFile, member: ZipInfo) -> NDArray[Any]:
    with stored.open(member) as file:
        return np.lib.format.read_array(file, allow_pickle=False)


def spans_of(pairs: object) -> Ints:
    """Return the spans of a run.json as an array (k, 2) [ns]."""
    return np.array(pairs, np.int64).reshape(-1, 2)


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


def _attitude(columns: dict[str, NDArray[Any]]) -> HeadingSamples:
    found = HeadingSamples(**_columns(columns, "attitude", _names(HeadingSamples)))
    return replace(found, var_rad2=thin(found.var_rad2))


def _gyro(columns: dict[str, NDArray[Any]]) -> GyroSamples:
    topic = columns["gyro_topic"].astype(np.uint8).tobytes().decode("utf-8", "surrogatepass")
    return GyroSamples(topic, *(_checked(columns, f"gyro_{name}", name) for name in ("stamp_ns", "rate_radps")))


def _outcome(columns: dict[str, NDArray[Any]], group: str, stamps: Ints, table: States) -> MeasurementOutcome:
    nis, code, difference = (_checked(columns, f"{group}_{name}", name) for name in OUTCOME_COLUMNS)
    if not len(nis) == len(code) == len(difference) == len(stamps):
        raise ValueError(f"the outcomes of the {group} are not as many as those")
    return MeasurementOutcome(stamps, (stamps - table.stamp_ns[0]) / 1e9, nis, code, difference)
