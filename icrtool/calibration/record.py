"""A calibration: the motion model recommended for a robot, its parameters with covariance, and how it was tested.

Frames and signs are those of `icrtool`: x forward, y right, turn rate clockwise. Parameters refer to wheel speeds at
the configured wheel radius.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from msgspec import UNSET

from icrtool.alignment.sensors.wheel_units import with_wheel_speeds
from icrtool.config import Config, RobotConfig
from icrtool.kernels.arrays import Floats, Ints
from icrtool.motion.models import FIVE, FittedModel, TrackGeometry, find_model, wheel_motion
from icrtool.records.calibration_document import (
    CALIBRATION_SCHEMA,
    CalibratedRobot,
    CalibrationDocument,
    CalibrationFile,
    CalibrationLog,
    ControllerDocument,
    ControllerErrors,
    ErrorSources,
    FittedDocument,
    GyroDocument,
    HeldOutScore,
    PooledScore,
)
from icrtool.records.plain_data import plain
from icrtool.records.run import WarmStart, call_output
from icrtool.records.run_document import ControllerNumbers, ParameterDocument, RecommendedDocument
from icrtool.records.tables import RobotLog
from icrtool.records.text import counted


class Odometry(NamedTuple):
    """A path from wheel speeds alone, from the origin with heading zero; (n,) each, heading clockwise, unwrapped."""

    stamp_ns: Ints
    forward_m: Floats
    right_m: Floats
    heading_rad: Floats


@dataclass(frozen=True, slots=True, repr=False)
class Calibration:
    """Constant parameters of a robot's motion model, their covariance, and the error that they give.

    Attributes
    ----------
    fitted : the recommended model; others : every model that was fitted, by name
    gyro : the recommended model with a gyro, None where a log has none
    logs : what it was fitted to
    held_out : scores by model, horizon and log, each predicted without that log, or block of a single one
    pooled : scores of all these trials together; empty in files of earlier versions
    controller : errors of what a controller can express; None where the drive is too short to measure them
    sources, gyro_sources : variances of what the model leaves out, wheels alone and with a gyro; None where the drive
        is too short to measure them
    warnings : what to know before use
    created : date and time, UTC, ISO 8601
    name : stem of its file; empty for one just made
    """

    robot: CalibratedRobot
    fitted: FittedModel
    others: Mapping[str, FittedModel]
    gyro: FittedModel | None
    logs: tuple[CalibrationLog, ...]
    held_out: tuple[HeldOutScore, ...]
    controller: ControllerErrors | None
    warnings: tuple[str, ...]
    created: str
    tool_version: str
    name: str = field(default="", compare=False)
    sources: ErrorSources | None = None
    gyro_sources: ErrorSources | None = None
    pooled: tuple[PooledScore, ...] = ()

    @property
    def recommended(self) -> str:
        """Name of the recommended model."""
        return self.fitted.model.name

    @property
    def width_m(self) -> float:
        """Track width b [m]."""
        return self.robot.track_width_m

    def geometry(self) -> tuple[TrackGeometry, Floats]:
        """Return ICRs [m], multiplier and radius factors, from one fit, and their covariance (6, 6)."""
        return self.others.get(FIVE, self.fitted).geometry(self.width_m)

    def controller_numbers(self) -> ControllerNumbers:
        """Return multiplier and radius factors for a controller."""
        return controller_numbers(*self.geometry(), self.robot)

    def log_names(self) -> str:
        """Return the names of the logs that it was fitted to, and their number."""
        names = ", ".join(log.name for log in self.logs)
        return names if len(self.logs) == 1 else f"{len(self.logs)} logs ({names})"

    def held_out_m(self, model: str, horizon_m: float) -> tuple[float, float]:
        """Return p95 and expected error [m] of all held-out trials of a model together, NaN without one.

        A file of an earlier version has them by log or block alone: then the median over these.
        """
        scores: tuple[PooledScore | HeldOutScore, ...] = self.pooled or self.held_out
        rows = [one for one in scores if one.model == model and one.horizon_m == horizon_m]
        if not rows:
            return float("nan"), float("nan")
        return float(np.median([one.p95_m for one in rows])), float(np.median([one.expected_m for one in rows]))

    def twist(self, v_left: Floats | float, v_right: Floats | float) -> Floats:
        """Return the body twist v_x, v_y [m/s], omega [rad/s] of wheel speeds [m/s], (3,) or (3, n).

        Parameters
        ----------
        v_left, v_right : speeds of the sides at the configured wheel radius, forward positive

        Notes
        -----
        x forward, y right, omega clockwise; for REP-103 (y left, counter-clockwise) negate v_y and omega.
        """
        left, right = np.atleast_1d(np.asarray(v_left, np.float64)), np.atleast_1d(np.asarray(v_right, np.float64))
        found = self.fitted.twist(wheel_motion(left, right, self.width_m))
        return found[:, 0] if np.ndim(v_left) == 0 else found

    def odometry(self, log: RobotLog) -> Odometry:
        """Return the path that the wheels of a log make, from the origin with heading zero.

        Parameters
        ----------
        log : of `icrtool.read_log`, its sides and senses as sent; its gyro is not used

        Raises
        ------
        ConfigError
            Wheels whose unit needs a radius or resolution that the calibration does not hold and the log does not show.
        DataError
            Fewer than two usable wheel samples.

        Notes
        -----
        A speed holds until the next sample; Euler steps, as in the dropout analysis. Angles and counts become metres
        with the numbers that the calibration was fitted with.
        """
        known = RobotConfig(
            wheel_radius_m=self.robot.wheel_radius_m,
            encoder_counts_per_rev=self.robot.encoder_counts_per_rev or None,
        )
        wheels = with_wheel_speeds(log, Config(robot=known)).wheels
        v_x, v_y, omega = self.twist(wheels.v_left_mps, wheels.v_right_mps)
        held = np.diff(wheels.stamp_ns) / 1e9
        heading = np.concatenate([[0.0], np.cumsum(held * omega[:-1])])
        moved = held * (v_x + 1j * v_y)[:-1] * np.exp(1j * heading[:-1])
        place = np.concatenate([[0.0], np.cumsum(moved)])
        return Odometry(wheels.stamp_ns, place.real, place.imag, heading)

    def warm_start(self) -> WarmStart:
        """Return the three ICRs [m] and their covariance [m^2] for a filter to begin with (`icrtool.fit`)."""
        geometry, covariance = self.geometry()
        return WarmStart(np.array(geometry[:3]), covariance[:3, :3], self.width_m)

    def fitted_to(self, sha256: str) -> bool:
        """Return whether a log was among those the calibration was fitted to."""
        return bool(sha256) and any(log.sha256 == sha256 for log in self.logs)

    def write(self, path: str | Path) -> Path:
        """Write the calibration file, whole or not at all; into `path` where that is a folder.

        Returns
        -------
        Path
            The file.

        Raises
        ------
        OutputError
            Something that is not a calibration is there, or it cannot be written.
        """
        file: Path = call_output("files.documents", "write_calibration", self.document(), Path(path))
        return file

    def __repr__(self) -> str:
        p95, _ = self.held_out_m("recommended", 10.0)
        logs = counted(len(self.logs), "log")
        return (
            f"<Calibration of {self.robot.name or 'a robot'}: {self.recommended} from {logs}, "
            f"95 % within {p95:.2f} m after 10 m, held out>"
        )

    def document(self, sensors: CalibrationFile | None = None) -> CalibrationDocument:
        """Return what the calibration file holds; `sensors`: what the only log shows of its sensors."""
        geometry, covariance = self.geometry()
        own = fitted_document(self.fitted, geometry, covariance, self.robot)
        errors = {} if self.controller is None else msgspec.structs.asdict(self.controller)
        of_log = (
            {} if sensors is None else {name: getattr(sensors, name) for name in CalibrationFile.__struct_fields__[1:]}
        )
        return CalibrationDocument(
            schema=CALIBRATION_SCHEMA,
            **of_log,
            tool_version=self.tool_version,
            created=self.created,
            robot=self.robot,
            recommended=self.recommended,
            model=own.model,
            terms=own.terms,
            parameters=own.parameters,
            covariance=own.covariance,
            not_shown=own.not_shown,
            geometry=own.geometry,
            geometry_std=own.geometry_std,
            controller=ControllerDocument(**msgspec.structs.asdict(own.controller), **errors),
            gyro=None
            if self.gyro is None
            else GyroDocument(self.gyro.model.name, *_parameters(self.gyro), self.gyro_sources),
            models={name: FittedDocument(*_parameters(one)) for name, one in self.others.items()},
            logs=self.logs,
            held_out=self.held_out,
            held_out_pooled=self.pooled,
            error_sources=self.sources,
            warnings=self.warnings,
        )

    def summary(self) -> dict[str, Any]:
        """Return what the calibration file holds, as plain data."""
        found: dict[str, Any] = plain(self.document())
        return found


def fitted_document(
    fitted: FittedModel, geometry: TrackGeometry, covariance: Floats, robot: CalibratedRobot
) -> RecommendedDocument:
    """Return a model for one robot: parameters with covariance, ICRs, and what a controller is given."""
    std = np.sqrt(np.diag(covariance)).tolist()
    return RecommendedDocument(
        fitted.model.label, fitted.model.name, *_parameters(fitted), fitted.not_shown, geometry._asdict(),
        dict(zip(geometry._fields, std, strict=True)), controller_numbers(geometry, covariance, robot),
    )  # fmt: skip


def controller_numbers(geometry: TrackGeometry, covariance: Floats, robot: CalibratedRobot) -> ControllerNumbers:
    """Return multiplier and radius factors with one standard deviation each."""
    std = dict(zip(geometry._fields, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    left, right = (1.0 if scale is UNSET else scale for scale in (robot.left_scale, robot.right_scale))
    return ControllerNumbers(
        geometry.multiplier, std["multiplier"],
        left * geometry.radius_left, left * std["radius_left"],
        right * geometry.radius_right, right * std["radius_right"],
    )  # fmt: skip


def _parameters(one: FittedModel) -> tuple[tuple[str, ...], dict[str, ParameterDocument], list[list[float]]]:
    """Return terms, parameters and covariance of a model."""
    rows = zip(one.model.terms, one.parameters.tolist(), one.std.tolist(), strict=True)
    unseen = one.not_shown
    found = {name: ParameterDocument(at, std, "not shown" if name in unseen else "shown") for name, at, std in rows}
    return one.model.terms, found, one.covariance.tolist()


LARGEST = 1e6
"""Of a parameter, in its unit: beyond it is damage, whose squares overflow."""


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
