"""A calibration: the recommended motion model of a robot, its parameters with covariance, and its tests.

Frames and signs follow `icrtool`: x forward, y right, turn rate clockwise. Parameters refer to wheel speeds at the
configured wheel radius.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType

from icrtool.alignment.wheel_units import with_wheel_speeds
from icrtool.calibration.held_sensors import pooled_constants, remaining_constants
from icrtool.config import Config, RobotConfig
from icrtool.kernels.arrays import Floats, Ints
from icrtool.motion.adaptive import TermsPrior
from icrtool.motion.models import (
    FIVE,
    MODELS,
    NO_SLIP,
    RECOMMENDED,
    TERMS,
    FittedModel,
    TrackGeometry,
    find_model,
    wheel_motion,
)
from icrtool.motion.recording import NO_CONSTANTS, LogConstants
from icrtool.motion.robot_prior import prior_of_model
from icrtool.records import calibration_document as documents
from icrtool.records.acceptance import CHOICE_HORIZON_M
from icrtool.records.notes import Note, is_grave, note
from icrtool.records.plain_data import plain_value
from icrtool.records.run import WarmStart
from icrtool.records.run_document import ControllerNumbers, ParameterDocument, RecommendedDocument
from icrtool.records.tables import RobotLog
from icrtool.records.text import counted


class Odometry(NamedTuple):
    """A path from wheel speeds alone, from the origin with heading zero; (n,) each, heading clockwise, unwrapped."""

    stamp_ns: Ints
    forward_m: Floats
    right_m: Floats
    heading_rad: Floats


Frame = Literal["ned", "enu"]
"""Body frames: x forward, y right, z down; or (REP-103) x forward, y left, z up."""


class Calibration(documents.CalibrationDocument, frozen=True, kw_only=True):
    """Constant parameters of a robot's motion model, their covariance, and their errors.

    The fields are the keys of a calibration file.

    Attributes
    ----------
    recommended : label of the recommended model
    model, terms, parameters, covariance : name, terms, parameters and covariance of the recommended model
    models : all models that were fitted, by name
    gyro : the recommended model with a gyro; None if a log has no gyro
    logs : the logs that the models were fitted to
    held_out : errors by model, horizon and log, each predicted without this log; for a single log, by block
    held_out_pooled : errors of all these trials together
    geometry, geometry_std : ICRs [m], multiplier and radius factors from one fit, and their standard deviations
    controller : numbers for a controller, and their errors if the drives are long enough to measure them
    error_sources : variances of the effects that the model leaves out, for wheels alone; None if the drives are too
        short
    notes : findings that a user needs before using the calibration; `warnings` : their sentences
    created : date and time, UTC, ISO 8601
    name : stem of the file that the calibration was read from; the file does not hold it

    Raises
    ------
    LookupError, ValueError
        The terms or numbers do not form a motion model.
    """

    name: str | UnsetType = UNSET

    def __post_init__(self) -> None:
        for name, document in self.models.items():
            model_in_document(name, document)
        _ = self.fitted_with_gyro
        if not set(TrackGeometry._fields) <= self.geometry.keys() & self.geometry_std.keys():
            raise ValueError("its geometry is not complete")
        with np.errstate(all="ignore"):
            geometry, covariance = self._geometry()
            if not (np.isfinite(geometry).all() and np.isfinite(covariance).all() and (np.diag(covariance) >= 0).all()):
                raise ValueError("its parameters give no geometry of the tracks")

    @property
    def fitted(self) -> FittedModel:
        """The recommended model."""
        return model_in_document(self.model, self)

    @property
    def fitted_with_gyro(self) -> FittedModel | None:
        """The recommended model with a gyro; None if a log has no gyro."""
        gyro = self.gyro
        return None if gyro is None else replace(model_in_document(gyro.model, gyro), wheels=self.fitted)

    @property
    def width_m(self) -> float:
        """Track width b [m]."""
        return self.robot.track_width_m

    def _geometry(self) -> tuple[TrackGeometry, Floats]:
        """Return ICRs [m], multiplier and radius factors, from one fit, and their covariance (6, 6)."""
        five = self.models.get(FIVE)
        return (self.fitted if five is None else model_in_document(FIVE, five)).geometry(self.width_m)

    @property
    def controller_errors(self) -> documents.ControllerErrors | None:
        """Errors of the controller's model; None if the drives are too short to measure them."""
        errors = {name: error for name, error in msgspec.structs.asdict(self.controller).items() if error is not UNSET}
        return msgspec.convert(errors, documents.ControllerErrors) if "pose_variance" in errors else None

    def log_names(self) -> str:
        """Return the names of the logs, and their number if there are several."""
        names = ", ".join(log.name for log in self.logs)
        return names if len(self.logs) == 1 else f"{len(self.logs)} logs ({names})"

    def held_out_m(self, model: str, horizon_m: float) -> tuple[float, float]:
        """Return p95 and expected error [m] of a model in all held-out trials of a length; NaN without trials."""
        for score in self.held_out_pooled:
            if score.model == model and score.horizon_m == horizon_m:
                return score.p95_m, score.expected_m
        return math.nan, math.nan

    def twist(self, v_left: Floats | float, v_right: Floats | float, *, frame: Frame = "ned") -> Floats:
        """Return the body twist v_x, v_y [m/s], omega [rad/s] of wheel speeds [m/s], (3,) or (3, n).

        Parameters
        ----------
        v_left, v_right : speeds of the sides at the configured wheel radius, forward positive
        frame : ``ned``: x forward, y right, omega clockwise; ``enu`` (REP-103): y left, omega counter-clockwise

        Raises
        ------
        ValueError
            The frame is neither ``ned`` nor ``enu``.
        """
        if frame not in get_args(Frame):
            raise ValueError(f"frame {frame!r}: is neither ned nor enu")
        left, right = np.atleast_1d(np.asarray(v_left, np.float64)), np.atleast_1d(np.asarray(v_right, np.float64))
        twist = self.fitted.twist(wheel_motion(left, right, self.width_m))
        if frame == "enu":
            twist = twist * np.array([[1.0], [-1.0], [-1.0]])
        return twist[:, 0] if np.ndim(v_left) == 0 else twist

    def odometry(self, log: RobotLog) -> Odometry:
        """Return the path that the model makes of the wheels of a log, from the origin with heading zero.

        Parameters
        ----------
        log : result of `icrtool.read_log`; its sides and signs are used as they were sent, its gyro is not used

        Raises
        ------
        ConfigError
            The unit of the wheels needs a radius or resolution, which neither the calibration nor the log has.
        DataError
            The log has fewer than two usable wheel samples.

        Notes
        -----
        A speed holds until the next sample, and the path consists of Euler steps, as in the dropout analysis. Angles
        and counts become metres with the numbers that the calibration was fitted with.
        """
        robot = RobotConfig(
            wheel_radius_m=self.robot.wheel_radius_m,
            encoder_counts_per_rev=self.robot.encoder_counts_per_rev or None,
        )
        wheels = with_wheel_speeds(log, Config(robot=robot)).wheels
        v_x, v_y, omega = self.twist(wheels.v_left_mps, wheels.v_right_mps)
        duration_s = np.diff(wheels.stamp_ns) / 1e9
        heading = np.concatenate([[0.0], np.cumsum(duration_s * omega[:-1])])
        step = duration_s * (v_x + 1j * v_y)[:-1] * np.exp(1j * heading[:-1])
        position = np.concatenate([[0.0], np.cumsum(step)])
        return Odometry(wheels.stamp_ns, position.real, position.imag, heading)

    def warm_start(self) -> WarmStart:
        """Return the three ICRs [m] and their covariance [m^2] for a filter to begin with (`icrtool.fit`)."""
        geometry, covariance = self._geometry()
        source = "" if self.name is UNSET else self.name
        return WarmStart(np.array(geometry[:3]), covariance[:3, :3], self.width_m, source)

    def prior(self, *, corrected: LogConstants | None = NO_CONSTANTS, heading_source: str | None = None) -> TermsPrior:
        """Return the prior of the robot's next drive, as a start for `icrtool.AdaptiveModel`.

        Parameters
        ----------
        corrected : corrections of the sensors' constants in the data that the model will observe. A constant that is
            NaN was found in the drive itself, and has its usual spread about zero. None: all constants are corrected,
            and begin at zero. Default: no constant is corrected, and the model begins with those of the calibration
        heading_source : source of the heading in these data, as ``heading.source`` of run.json; the calibration's
            heading offset is used only for the same source. Default: the source of the calibration's logs
        """
        source = "calibration" if self.name is UNSET else self.name
        prior = prior_of_model(self.width_m, self.fitted, self.fitted_with_gyro, source)
        if corrected is None:
            return prior
        wheel_constants, gyro_constants = (
            remaining_constants(pooled_constants(self.logs, heading_source, with_gyro=with_gyro), corrected).usual()
            for with_gyro in (False, True)
        )
        return replace(prior, constants=wheel_constants, turned_constants=gyro_constants)

    def fitted_to(self, sha256: str) -> bool:
        """Return whether the calibration was fitted to the log with this SHA-256."""
        return bool(sha256) and any(log.sha256 == sha256 for log in self.logs)

    def write(self, path: str | Path) -> Path:
        """Write the calibration file, whole or not at all; if `path` is a folder, write calibration.json into it.

        Returns
        -------
        Path
            The path of the file.

        Raises
        ------
        OutputError
            A file that is not a calibration is there, or the file cannot be written.
        """
        from icrtool.output.files.formats import write_calibration

        document = msgspec.structs.replace(self, name=UNSET)
        return write_calibration(document, Path(path))

    def __repr__(self) -> str:
        p95, _ = self.held_out_m("recommended", 10.0)
        logs = counted(len(self.logs), "log")
        return (
            f"<Calibration of {self.robot.name or 'a robot'}: {self.recommended} from {logs}, "
            f"95 % within {p95:.2f} m after 10 m, held out>"
        )

    def summary(self) -> dict[str, Any]:
        """Return the content of the calibration file, as plain data."""
        content: dict[str, Any] = plain_value(msgspec.structs.replace(self, name=UNSET))
        return content


def stored_calibration(document: documents.CalibrationDocument) -> Calibration:
    """Return the calibration that a report holds.

    Raises
    ------
    LookupError, ValueError
        The terms or numbers do not form a motion model.
    """
    return Calibration(**msgspec.structs.asdict(document))


def fitted_document(
    fitted_model: FittedModel, geometry: TrackGeometry, covariance: Floats, robot: documents.CalibratedRobot, *,
    shared_std: float | None = None,
) -> RecommendedDocument:  # fmt: skip
    """Return the document of a model for a robot: parameters with covariance, ICRs, and numbers for a controller.

    Parameters
    ----------
    fitted_model : the model
    geometry, covariance : ICRs, multiplier and radius factors, and their covariance (6, 6)
    robot, shared_std : as in `controller_numbers`
    """
    std = np.sqrt(np.diag(covariance)).tolist()
    return RecommendedDocument(
        fitted_model.model.label, fitted_model.model.name, *parameter_documents(fitted_model), fitted_model.not_shown,
        geometry._asdict(),
        dict(zip(geometry._fields, std, strict=True)),
        controller_numbers(geometry, covariance, robot, shared_std=shared_std),
    )  # fmt: skip


MULTIPLIER_BETWEEN_SHARE = 0.02
"""Standard deviation of the multiplier between drives of one robot on one kind of ground, as a share of the multiplier.

Ten recorded drives of a Warthog differ by 1.4 %, 60 simulated robots with two drives each by 1.9 %."""

RADIUS_BETWEEN_STD = 0.006
"""Standard deviation of the radius factors between drives, measured on ten recorded drives of a Warthog."""


def controller_numbers(
    geometry: TrackGeometry, covariance: Floats, robot: documents.CalibratedRobot, *, shared_std: float | None = None
) -> ControllerNumbers:
    """Return multiplier and radius factors, each with its standard deviations in this drive and between drives.

    Parameters
    ----------
    geometry, covariance : ICRs, multiplier and radius factors, and their covariance (6, 6)
    robot : the robot, whose wheel scales multiply the radius factors
    shared_std : standard deviation of the multiplier between drives, from several drives; default: the value of other
        robots
    """
    std = dict(zip(geometry._fields, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    left, right = (1.0 if scale is UNSET else scale for scale in (robot.left_scale, robot.right_scale))
    return ControllerNumbers(
        geometry.multiplier, std["multiplier"],
        left * geometry.radius_left, left * std["radius_left"],
        right * geometry.radius_right, right * std["radius_right"],
        MULTIPLIER_BETWEEN_SHARE * abs(geometry.multiplier) if shared_std is None else shared_std, RADIUS_BETWEEN_STD,
    )  # fmt: skip


def parameter_documents(
    fitted_model: FittedModel,
) -> tuple[tuple[str, ...], dict[str, ParameterDocument], list[list[float]]]:
    """Return terms, parameters and covariance of a model as they are stored."""
    rows = zip(fitted_model.model.terms, fitted_model.parameters.tolist(), fitted_model.std.tolist(), strict=True)
    not_shown = fitted_model.not_shown
    documents_by_term = {
        name: ParameterDocument(value, std, "not shown" if name in not_shown else "shown") for name, value, std in rows
    }
    return fitted_model.model.terms, documents_by_term, fitted_model.covariance.tolist()


LARGEST_PARAMETER = 1e6
"""Largest size of a parameter, in its unit. A larger value is damaged, and its square could overflow."""


def model_in_document(
    name: str, document: documents.CalibrationDocument | documents.FittedDocument | documents.GyroDocument
) -> FittedModel:
    """Return the motion model that a document holds.

    Raises
    ------
    LookupError, ValueError
        The terms or numbers do not form a motion model.
    """
    model = find_model(name)
    k = len(model.terms)
    if document.terms != model.terms:
        raise ValueError(f"terms of {name}")
    parameters = np.array([document.parameters[term].value for term in model.terms], np.float64)
    covariance = np.array(document.covariance, np.float64).reshape(k, k)
    if (np.diag(covariance) < 0).any():
        raise ValueError(f"variances of {name}")
    if not (
        np.abs(parameters).max(initial=0) < LARGEST_PARAMETER and np.abs(covariance).max(initial=0) < LARGEST_PARAMETER
    ):
        raise ValueError(f"parameters of {name}")
    return FittedModel(model, parameters, covariance)


POSE_AFTER_M = CHOICE_HORIZON_M
"""Distance after which the errors of a calibration are stated in exports [m]."""

LARGEST_SHARE = 0.5
"""Largest 95 % error of a calibration, as a share of the distance. Beyond it the calibration is not fit for use."""


def unfit_reasons(calibration: Calibration) -> tuple[Note, ...]:
    """Return why a calibration is not fit for use, from its held-out errors; empty if it is fit."""
    reasons = [finding for finding in calibration.notes if is_grave(finding)]
    p95, expected = calibration.held_out_m(RECOMMENDED, POSE_AFTER_M)
    _, without = calibration.held_out_m(NO_SLIP, POSE_AFTER_M)
    if p95 > LARGEST_SHARE * POSE_AFTER_M:
        why = f"its error after {POSE_AFTER_M:g} m is {p95:.1f} m (95 %, held out of the fit)"
        reasons.append(note("calibration_error_large", why))
    if expected >= without:
        errors = f"expected error {expected:.2f} m and {without:.2f} m, held out of the fit"
        reasons.append(note("calibration_no_better", f"it is no better than no slip: {errors}"))
    if "omega_w" in calibration.fitted.not_shown:
        reasons.append(note("turning_not_shown", "the driving did not show how the robot turns (omega_w)"))
    return tuple(reasons)


def export_notes(calibration: Calibration, model: str = RECOMMENDED) -> tuple[Note, ...]:
    """Return the notes that a user needs before a calibration is used.

    Parameters
    ----------
    model : name of the model whose terms are used; a controller has no parameters for the last three terms of
        `RECOMMENDED`
    """
    reasons = [reason for reason in unfit_reasons(calibration) if reason not in calibration.notes]
    for name in (name for name in calibration.fitted.not_shown if name in MODELS[model].terms):
        why = f"not shown by this driving: {name} ({TERMS[name].meaning}); its value is the prior's"
        reasons.append(note("parameter_not_shown", why))
    if (multiplier := calibration.controller.multiplier) < 1.0:
        why = "a skid-steer robot turns less than its wheels, not more"
        reasons.append(note("multiplier_below_one", f"a multiplier of {multiplier:.2f} is below 1: {why}"))
    return (*calibration.notes, *reasons)


def factor_to_old(calibration: Calibration) -> float | None:
    """Return the ratio of the multiplier to the multiplier of the log's odometry; None if the latter is not known."""
    old_width_m = calibration.robot.twist_width_m
    if old_width_m is UNSET:
        return None
    return calibration.controller.multiplier * calibration.width_m / old_width_m
