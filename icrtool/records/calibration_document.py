"""Documents of calibrations: the calibration file, the comparison of groups of runs, and the forecast along a path."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import UNSET, UnsetType, field

from icrtool.config import Positive
from icrtool.records.notes import Note
from icrtool.records.plain_data import Record
from icrtool.records.run_document import ControllerNumbers, ParameterDocument
from icrtool.records.samples import InputFile

CALIBRATION_SCHEMA: Literal["icrtool/calibration/1"] = "icrtool/calibration/1"
"""Version of calibration files."""

CALIBRATION_FRAME = "x forward, y right, turn rate clockwise; wheel speeds at the configured radius"

WIDEST_M = 20.0
"""Largest `robot.track_width_m` in a configuration [m]."""

UpTo1000 = Annotated[float, msgspec.Meta(gt=0, le=1000)]
Share = Annotated[float, msgspec.Meta(ge=0, le=1e300)]


class CalibratedRobot(Record, frozen=True, kw_only=True):
    """The robot of a calibration. `left_scale` and `right_scale` are `Run.radius_errors`; a scale of 1 is left out."""

    name: str | None = None
    wheel_radius_m: UpTo1000 | None = None
    encoder_counts_per_rev: Positive | UnsetType = UNSET
    twist_width_m: Positive | UnsetType = UNSET
    left_scale: UpTo1000 | UnsetType = UNSET
    right_scale: UpTo1000 | UnsetType = UNSET
    track_width_m: Annotated[float, msgspec.Meta(ge=0.001, le=WIDEST_M)]


class PooledScore(Record, frozen=True):
    """Errors of one model at one horizon over all held-out trials: of all logs, or of all blocks of a single log."""

    model: str
    horizon_m: float
    p95_m: float
    expected_m: float


class HeldOutScore(PooledScore, frozen=True):
    """Errors of one model at one horizon on a log, or on a block of a log, that the model was not fitted to."""

    log: str


class MeasuredConstant(Record, frozen=True):
    """A constant of a sensor and its standard deviation."""

    value: float
    std: Share


class SensorConstants(Record, frozen=True, kw_only=True):
    """Constants of the sensors of a log, with respect to the streams as they were sent; None: not known.

    A user of a motion model needs these constants too.

    Attributes
    ----------
    heading_offset_deg : added to the heading, as the configuration key of this name in ``frames``
    reference_delay_s : time by which positions and headings lag the wheels
    gyro_bias_degps : added to the turn rate of a model with a gyro, clockwise
    gyro_delay_s : time by which the gyro lags the wheels
    """

    heading_offset_deg: MeasuredConstant | None = None
    reference_delay_s: MeasuredConstant | None = None
    gyro_bias_degps: MeasuredConstant | None = None
    gyro_delay_s: MeasuredConstant | None = None


class LogSensors(Record, frozen=True):
    """Constants of the sensors of one log for both models of a calibration; corrections before the fit are included.

    Attributes
    ----------
    heading_source : kind of the log's heading, as in ``heading`` of run.json; empty where it is not known
    wheels, gyro : constants for the recommended model with wheels alone, and for the model with a gyro. They were
        measured with the parameters of the calibration
    """

    heading_source: str
    wheels: SensorConstants
    gyro: SensorConstants | None = None


class HeldSensors(Record, frozen=True):
    """Constants of the sensors that the row of a calibration holds for the log that is tested.

    Attributes
    ----------
    held : constants for a further drive, by the logs of the calibration, with standard deviations
    measured : the constants that this log shows with the same parameters; None where the drive is too short
    refitted : the row has the constants of this log in place of the held ones
    """

    held: SensorConstants
    measured: SensorConstants | None
    refitted: bool


class CalibrationLog(Record, frozen=True):
    """A log that a calibration was fitted to, with the constants of this log.

    Attributes
    ----------
    heading_offset_deg, wheels_delay_s : offset of the heading [deg], and delay of the poses with respect to the wheels
        [s], both after the corrections before the fit
    begin_ns : stamp of the first state; 0 where it is not known
    ground : name of the ground, where the user gave a name
    sensors : the constants of its sensors, corrections included; None in a file of an earlier version
    """

    name: str
    path: str
    sha256: str
    distance_m: float
    heading_offset_deg: float
    wheels_delay_s: float
    begin_ns: int = 0
    ground: str | UnsetType = UNSET
    sensors: LogSensors | None = None


class GroundScore(Record, frozen=True):
    """Errors [m] of a model on the logs of one ground, with numbers that were fitted to the other grounds."""

    model: str
    horizon_m: float
    p95_m: float
    expected_m: float
    ground: str


class ControllerErrors(Record, frozen=True):
    """Errors of the motion model that a controller can express, on distance that the model was not fitted to.

    Attributes
    ----------
    pose_variance : (3,) variances of x forward, y left, yaw after 10 m [m^2, m^2, rad^2]
    twist_variance : (3,) variances of the velocities averaged over 1 m [m^2/s^2, m^2/s^2, rad^2/s^2]
    turn_noise, way_noise : shares of variance: AMCL's alpha1 and alpha2, and AMCL's alpha3 and alpha4
    p95_m, full_p95_m : 95th percentile of the error after 10 m [m], of the controller's model and of the recommended
        model; None without a trial of 10 m
    twist_variance_std : (3,) standard deviations of `twist_variance`; None in files of older versions
    gyro_rate_variance, gyro_rate_variance_std : variance of the turn rate of the model with a gyro, averaged over 1 m
        [rad^2/s^2], and its standard deviation; None without a gyro
    """

    pose_variance: tuple[float, float, float]
    twist_variance: tuple[float, float, float]
    turn_noise: tuple[float, float]
    way_noise: tuple[float, float]
    p95_m: float | None
    full_p95_m: float | None
    twist_variance_std: tuple[float, float, float] | None = None
    gyro_rate_variance: float | None = None
    gyro_rate_variance_std: float | None = None


class ControllerDocument(ControllerNumbers, frozen=True, kw_only=True):
    """Numbers for a controller; with the fields of `ControllerErrors` where errors were measured."""

    pose_variance: tuple[float, float, float] | UnsetType = UNSET
    twist_variance: tuple[float, float, float] | UnsetType = UNSET
    turn_noise: tuple[float, float] | UnsetType = UNSET
    way_noise: tuple[float, float] | UnsetType = UNSET
    p95_m: float | UnsetType | None = UNSET
    full_p95_m: float | UnsetType | None = UNSET
    twist_variance_std: tuple[float, float, float] | UnsetType | None = UNSET
    gyro_rate_variance: float | UnsetType | None = UNSET
    gyro_rate_variance_std: float | UnsetType | None = UNSET


class ErrorSources(Record, frozen=True):
    """Variances of errors that a model leaves out, and the factors on its quantiles.

    Attributes
    ----------
    heading_start_rad2 : variance of the heading at the start
    heading_rate_rad2pm2 : variance of a turn per metre that is constant along the path
    turn_share : variance of the relative error of turns
    heading_wander_rad2pm : growth of the variance of the heading for each metre
    speed_share : variance of the relative error of the distance
    distance_wander_m2pm : growth of the variance of the distance for each metre
    heading_noise_rad2, position_noise_m2 : variances of the reference's noise
    p95_factor, expected_factor : measured error over predicted error
    measured_to_m : length of the longest windows; a longer forecast extrapolates
    """

    heading_start_rad2: Share
    heading_rate_rad2pm2: Share
    turn_share: Share
    heading_wander_rad2pm: Share
    speed_share: Share
    distance_wander_m2pm: Share
    heading_noise_rad2: Share
    position_noise_m2: Share
    p95_factor: Share
    expected_factor: Share
    measured_to_m: Share = 20.0


class FittedDocument(Record, frozen=True):
    """A motion model that was fitted: its terms, their parameters, and the covariance of the parameters."""

    terms: tuple[str, ...]
    parameters: dict[str, ParameterDocument]
    covariance: list[list[float]]


class GyroDocument(Record, frozen=True):
    """The recommended model with a gyro."""

    model: str
    terms: tuple[str, ...]
    parameters: dict[str, ParameterDocument]
    covariance: list[list[float]]
    error_sources: ErrorSources | None = None


SensorVerdict = Literal["shown", "weak", "not shown", "not separable", "given"]
"""Whether a drive shows a parameter. `not separable`: no drive shows it; `given`: the user gave it."""


class SensorParameter(Record, frozen=True):
    """One parameter of the sensors (antenna, offset, delay, scale), by one log; null where the log does not show it.

    `note` is the reason for the verdict.
    """

    value: float | None
    std: float | None
    verdict: SensorVerdict
    note: str


class SensorDrive(Record, frozen=True):
    """Distance, turns and speeds of the drive of one log; speeds are taken while the robot moves."""

    distance_m: float = field(name="way_m")
    turned_right_deg: float
    turned_left_deg: float
    turn_rate_p95_degps: float
    speed_mean_mps: float
    speed_std_mps: float


class CalibrationFile(Record, frozen=True, kw_only=True):
    """The fields that every calibration file has, and the fields that only the file of one log has.

    Attributes
    ----------
    log, inputs : name and files of the log
    windows, independent_stretches : number of windows of driven distance, and number of independent windows
    window_miss_m : robust standard deviation of the residual displacements of the windows [m]
    settings : configuration keys whose values the log shows
    alignment : estimates of the sensors
    """

    schema: Literal["icrtool/calibration/1"]
    log: str | UnsetType = UNSET
    inputs: tuple[InputFile, ...] | UnsetType = UNSET
    windows: int | UnsetType = UNSET
    independent_stretches: int | UnsetType = UNSET
    window_miss_m: float | UnsetType | None = UNSET
    drive: SensorDrive | UnsetType = UNSET
    settings: dict[str, float] | UnsetType = UNSET
    alignment: dict[str, SensorParameter] | UnsetType = UNSET


class SensorDocument(CalibrationFile, frozen=True, kw_only=True):
    """Calibration file without a motion model: the parameters of the sensors that one log shows.

    Attributes
    ----------
    parameters : estimates as in `alignment`, then estimates derived from them, by the keys of
        `icrtool.calibration.sensor_findings.LABELS`
    """

    log: str
    inputs: tuple[InputFile, ...]
    windows: int
    independent_stretches: int
    window_miss_m: float | None
    drive: SensorDrive
    settings: dict[str, float]
    alignment: dict[str, SensorParameter]
    parameters: dict[str, SensorParameter]


class CalibrationDocument(CalibrationFile, frozen=True, kw_only=True):
    """A calibration file.

    `created`: date and time, UTC, ISO 8601; not in a report's ``recommended``, which is the same whenever it is made.
    `held_out_pooled`: scores of all held-out trials together. `other_grounds`: scores on each ground, left out in turn;
    missing where the grounds were not given. `error_sources`: null where the drive is too short.
    """

    tool_version: str
    created: str | UnsetType = UNSET
    robot: CalibratedRobot
    frame: str = CALIBRATION_FRAME
    recommended: str
    model: str
    terms: tuple[str, ...]
    parameters: dict[str, ParameterDocument]
    covariance: list[list[float]]
    not_shown: tuple[str, ...]
    geometry: dict[str, float]
    geometry_std: dict[str, float]
    controller: ControllerDocument
    gyro: GyroDocument | None
    models: dict[str, FittedDocument]
    logs: tuple[CalibrationLog, ...]
    held_out: tuple[HeldOutScore, ...]
    held_out_pooled: tuple[PooledScore, ...]
    other_grounds: tuple[GroundScore, ...] | UnsetType = UNSET
    error_sources: ErrorSources | None
    notes: tuple[Note, ...]
    warnings: tuple[str, ...]


COMPARE_SCHEMA: Literal["icrtool/compare/1"] = "icrtool/compare/1"
"""Version of comparisons of groups."""


class ErrorsAt(Record, frozen=True):
    """Errors at one horizon, or differences of errors, with 95 % intervals [m]; None where there is none."""

    horizon_m: float
    p95_m: float | None
    p95_low_m: float | None
    p95_high_m: float | None
    expected_m: float | None
    expected_low_m: float | None
    expected_high_m: float | None


class TransferCost(ErrorsAt, frozen=True, kw_only=True):
    """Cost of one group's calibration in the runs of another group.

    Errors of this calibration minus the errors of the tested group's own calibration, in the same trials; the own
    calibration is held out.
    """

    calibrated_on: str
    tested_on: str


class TransferCell(TransferCost, frozen=True, kw_only=True):
    """Errors of the calibration of one group in the runs of another."""

    trials: int


class ErrorDifference(ErrorsAt, frozen=True, kw_only=True):
    """Held-out errors of two groups, second minus first; `paired`: of trials at the same distance of one route."""

    paired: bool


class ParameterDifference(Record, frozen=True):
    """A quantity of two groups: second minus first, with one standard deviation.

    `significant`: zero lies outside the 95 % interval.
    """

    quantity: str
    first: float
    second: float
    difference: float
    std: float
    significant: bool


class ComparedPair(Record, frozen=True):
    """Two groups: how their parameters differ and their held-out errors, and both in a sentence."""

    first: str
    second: str
    parameters: tuple[ParameterDifference, ...]
    errors: tuple[ErrorDifference, ...]
    verdict: str


class ComparedGroup(Record, frozen=True):
    """A group of runs and its calibration: the name of its model, and the geometry of the tracks."""

    model: str
    logs: tuple[CalibrationLog, ...]
    geometry: dict[str, float]


class GroupComparison(Record, frozen=True, kw_only=True):
    """Comparison of groups of runs.

    Attributes
    ----------
    pairs : comparisons of the first group with each of the others
    transfer : the transfer matrix, by row, column and horizon
    costs : costs in the cells of the matrix off the diagonal
    """

    schema: Literal["icrtool/compare/1"]
    tool_version: str
    groups: dict[str, ComparedGroup]
    pairs: tuple[ComparedPair, ...]
    transfer: tuple[TransferCell, ...]
    costs: tuple[TransferCost, ...]


class ForecastSource(Record, frozen=True):
    """The calibration that a forecast was made with."""

    name: str
    model: str
    created: str


class ForecastBudget(Record, frozen=True):
    """The distance up to which 95 % of the errors stay within a budget; also with a gyro, where known."""

    budget_m: float
    distance_m: float | None
    distance_gyro_m: float | UnsetType | None = UNSET


class ForecastColumns(Record, frozen=True):
    """The forecast after each metre, as `icrtool.calibration.error_growth.Forecast`; of a gyro where that is known."""

    distance_m: list[float | None]
    east_m: list[float | None]
    north_m: list[float | None]
    expected_error_m: list[float | None]
    p95_error_m: list[float | None]
    std_east_m: list[float | None]
    std_north_m: list[float | None]
    heading_std_deg: list[float | None]
    expected_error_gyro_m: list[float | None] | UnsetType = UNSET
    p95_error_gyro_m: list[float | None] | UnsetType = UNSET


class ForecastDocument(Record, frozen=True, kw_only=True):
    """The forecast of errors along a path."""

    schema: Literal["icrtool/forecast/1"]
    tool_version: str = ""
    calibration: ForecastSource
    measured_to_m: float
    budgets: tuple[ForecastBudget, ...]
    not_shown: tuple[str, ...]
    notes: tuple[Note, ...]
    warnings: tuple[str, ...]
    along: ForecastColumns
