"""A calibration from the plain data of its file: every value is checked, so that nothing later meets a wrong one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, NotRequired, TypedDict, TypeVar

import msgspec
import numpy as np

from icrtool.calibration.record import (
    Calibration,
    CalibrationLog,
    ControllerErrors,
    ErrorSources,
    HeldOutScore,
    PooledScore,
)
from icrtool.config import Positive
from icrtool.motion.models import FittedModel, find_model
from icrtool.records.run import CALIBRATION_SCHEMA
from icrtool.records.text import escaped

WIDEST_M = 20.0
"""Bound of `robot.track_width_m` in a configuration."""

LARGEST = 1e6
"""Of a parameter, in its unit: beyond it is damage, whose squares overflow."""

Record = TypeVar("Record", CalibrationLog, HeldOutScore, PooledScore, ControllerErrors, ErrorSources)
Scale = Annotated[float, msgspec.Meta(gt=0, le=1000)]


class RobotDocument(TypedDict):
    """The robot of a calibration."""

    name: str | None
    track_width_m: Annotated[float, msgspec.Meta(ge=0.001, le=WIDEST_M)]
    wheel_radius_m: NotRequired[Scale | None]
    encoder_counts_per_rev: NotRequired[Positive]
    left_scale: NotRequired[Scale]
    right_scale: NotRequired[Scale]


def calibration_of(document: Mapping[str, Any]) -> Calibration:
    """Return the calibration that a file's plain data hold.

    Raises
    ------
    KeyError, TypeError, ValueError
        They are not what `Calibration.summary` gives.
    """
    if document["schema"] != CALIBRATION_SCHEMA:
        raise ValueError(f"schema {document['schema']!r}")
    gyro, controller = document["gyro"], document["controller"]
    fitted = _fitted(document["model"], document)
    try:
        found = Calibration(
            robot=_robot(document["robot"]),
            fitted=fitted,
            others={name: _fitted(name, one) for name, one in document["models"].items()},
            gyro=None if gyro is None else replace(_fitted(gyro["model"], gyro), wheels=fitted),
            logs=tuple(_record(CalibrationLog, log) for log in document["logs"]),
            held_out=tuple(_record(HeldOutScore, score) for score in document["held_out"]),
            pooled=tuple(_record(PooledScore, score) for score in document.get("held_out_pooled", ())),
            controller=_record(ControllerErrors, controller) if "pose_variance" in controller else None,
            warnings=tuple(map(_text, document["warnings"])),
            created=_text(document["created"]),
            tool_version=_text(document["tool_version"]),
            sources=_sources(document),
            gyro_sources=None if gyro is None else _sources(gyro),
        )
    except msgspec.ValidationError as err:
        raise ValueError(str(err)) from err
    with np.errstate(all="ignore"):
        geometry, covariance = found.geometry()
        if not (np.isfinite(geometry).all() and np.isfinite(covariance).all() and (np.diag(covariance) >= 0).all()):
            raise ValueError("its parameters give no geometry of the tracks")
    return found


def _text(value: object) -> str:
    return escaped(msgspec.convert(value, str))


def _robot(document: Mapping[str, Any]) -> dict[str, Any]:
    msgspec.convert(document, RobotDocument)
    return {name: escaped(value) if isinstance(value, str) else value for name, value in document.items()}


def _record(kind: type[Record], document: Mapping[str, Any]) -> Record:
    """Return a record from the keys of plain data that it has; null is a number that is not known."""
    given: tuple[Any, ...] = kind(**{name: value for name, value in document.items() if name in kind._fields})
    values = [float("nan") if value is None else escaped(value) if isinstance(value, str) else value for value in given]
    return msgspec.convert(values, kind)


def _sources(document: Mapping[str, Any]) -> ErrorSources | None:
    given = document.get("error_sources")
    found = None if given is None else _record(ErrorSources, given)
    if found is not None and not all(0.0 <= value < np.inf for value in found):
        raise ValueError("error sources")
    return found


def _fitted(name: str, document: Mapping[str, Any]) -> FittedModel:
    model = find_model(name)
    k = len(model.terms)
    if tuple(document["terms"]) != model.terms:
        raise ValueError(f"terms of {name}")
    parameters = np.array([document["parameters"][term]["value"] for term in model.terms], np.float64)
    covariance = np.array(document["covariance"], np.float64).reshape(k, k)
    if (np.diag(covariance) < 0).any():
        raise ValueError(f"variances of {name}")
    if not (np.abs(parameters).max(initial=0) < LARGEST and np.abs(covariance).max(initial=0) < LARGEST):
        raise ValueError(f"parameters of {name}")
    return FittedModel(model, parameters, covariance)
