"""A calibration from its file: types, bounds and shapes are checked, so that nothing later meets a wrong one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
from msgspec import UNSET

from icrtool.calibration.record import Calibration
from icrtool.motion.models import FittedModel, find_model
from icrtool.records.calibration_document import CalibrationDocument, ControllerErrors, FittedDocument, GyroDocument
from icrtool.records.text import escaped_texts

LARGEST = 1e6
"""Of a parameter, in its unit: beyond it is damage, whose squares overflow."""


def read_calibration(stored: Mapping[str, Any]) -> Calibration:
    """Return the calibration that plain data of a file hold.

    Raises
    ------
    ValueError
        They are not those of a calibration.
    """
    return calibration_of(msgspec.convert(escaped_texts(stored), CalibrationDocument))


def calibration_of(document: CalibrationDocument) -> Calibration:
    """Return the calibration of a document.

    Raises
    ------
    LookupError, ValueError
        Its terms or numbers are not those of a motion model.
    """
    fitted, gyro = _fitted(document.model, document), document.gyro
    errors = msgspec.structs.asdict(document.controller)
    found = Calibration(
        robot=document.robot,
        fitted=fitted,
        others={name: _fitted(name, one) for name, one in document.models.items()},
        gyro=None if gyro is None else replace(_fitted(gyro.model, gyro), wheels=fitted),
        logs=document.logs,
        held_out=document.held_out,
        pooled=document.held_out_pooled,
        controller=None if errors["pose_variance"] is UNSET else msgspec.convert(errors, ControllerErrors),
        warnings=document.warnings,
        created=document.created or "",
        tool_version=document.tool_version,
        sources=document.error_sources,
        gyro_sources=None if gyro is None else gyro.error_sources,
    )
    with np.errstate(all="ignore"):
        geometry, covariance = found.geometry()
        if not (np.isfinite(geometry).all() and np.isfinite(covariance).all() and (np.diag(covariance) >= 0).all()):
            raise ValueError("its parameters give no geometry of the tracks")
    return found


def _fitted(name: str, document: CalibrationDocument | FittedDocument | GyroDocument) -> FittedModel:
    model = find_model(name)
    k = len(model.terms)
    if document.terms != model.terms:
        raise ValueError(f"terms of {name}")
    parameters = np.array([document.parameters[term].value for term in model.terms], np.float64)
    covariance = np.array(document.covariance, np.float64).reshape(k, k)
    if (np.diag(covariance) < 0).any():
        raise ValueError(f"variances of {name}")
    if not (np.abs(parameters).max(initial=0) < LARGEST and np.abs(covariance).max(initial=0) < LARGEST):
        raise ValueError(f"parameters of {name}")
    return FittedModel(model, parameters, covariance)
