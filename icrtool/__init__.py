"""Learn the track ICRs of a skid-steer robot from its field logs, and how far it can drive without GNSS.

Every name, frame, sign and unit in this package means what stands here.

Frames and signs
    World: local plane, north and east [m] about a datum, z down. Body: x forward, y right, z down.
    Heading psi [rad] is clockwise from north. A faster *left* side turns the robot clockwise.
    Track ICRs are body coordinates [m]: ``y_icr_right > 0 > y_icr_left`` and ``x_icr`` (both tracks share it).
    ROS logs are ENU/FLU (REP-103); they are converted once, in ``icrtool.logs``, where a message becomes columns.
Units
    SI and radians inside. At every boundary (column, option, configuration key) the unit is the suffix of the name:
    ``_s _ns _m _mps _rad _radps _deg _pct``.
Time
    ``stamp_ns``: int64 nanoseconds of the log's clock. ``t_s``: float64 seconds since the first recorded state.
    A speed stamped k holds over [k, k+1).
Tables
    ``RobotLog``: what was measured (wheels, position, heading), in this frame, by stamp.
    ``Run``: what the filter made of it, one recorded state per wheel sample; equal when read back from its directory.
    ``DropoutReport``: open-loop errors over distance, from recorded states.
    ``Calibration``: constant parameters from one run or many, for the robot and for predicting other logs.
Source of the method
    Pentzer, Brennan, Reichard: "Model-based Prediction of Skid-steer Robot Kinematics Using Online Estimation of
    Track Instantaneous Centers of Rotation", J. Field Robotics 31(3), 2014. Equation numbers in the code are its.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from icrtool import figures
    from icrtool.calibration.pooled import calibrate
    from icrtool.calibration.record import Calibration
    from icrtool.config import Config, load_config
    from icrtool.dropout_analysis.dropout_report import dropout, dropout_report
    from icrtool.dropout_analysis.report import DropoutReport
    from icrtool.errors import IcrToolError
    from icrtool.logs.read_log import read_log
    from icrtool.motion.adaptive import AdaptiveModel
    from icrtool.motion.robot_prior import prior_of_robots
    from icrtool.output.files.formats import open_calibration
    from icrtool.output.page.pages import write_page
    from icrtool.output.run_directory import open_run
    from icrtool.pipeline import fit
    from icrtool.records.run import Run, WarmStart
    from icrtool.records.tables import RobotLog

__version__ = "0.1.0"

__all__ = [
    "AdaptiveModel",
    "Calibration",
    "Config",
    "DropoutReport",
    "IcrToolError",
    "RobotLog",
    "Run",
    "WarmStart",
    "__version__",
    "calibrate",
    "dropout",
    "dropout_report",
    "figures",
    "fit",
    "load_config",
    "open_calibration",
    "open_run",
    "prior_of_robots",
    "read_log",
    "write_page",
]

_HOMES = {
    "AdaptiveModel": "icrtool.motion.adaptive",
    "Calibration": "icrtool.calibration.record",
    "Config": "icrtool.config",
    "DropoutReport": "icrtool.dropout_analysis.report",
    "IcrToolError": "icrtool.errors",
    "RobotLog": "icrtool.records.tables",
    "Run": "icrtool.records.run",
    "WarmStart": "icrtool.records.run",
    "calibrate": "icrtool.calibration.pooled",
    "dropout": "icrtool.dropout_analysis.dropout_report",
    "dropout_report": "icrtool.dropout_analysis.dropout_report",
    "fit": "icrtool.pipeline",
    "load_config": "icrtool.config",
    "open_calibration": "icrtool.output.files.formats",
    "open_run": "icrtool.output.run_directory",
    "prior_of_robots": "icrtool.motion.robot_prior",
    "read_log": "icrtool.logs.read_log",
    "write_page": "icrtool.output.page.pages",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used, so that ``icrtool --help`` loads no numpy."""
    if name == "figures":
        return importlib.import_module("icrtool.figures")
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module 'icrtool' has no attribute {name!r}")
    return getattr(importlib.import_module(home), name)


def __dir__() -> list[str]:
    return __all__
