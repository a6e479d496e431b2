"""Words that a user chooses among: the type of each such argument, whose words `typing.get_args` gives to its option.

Nothing else is imported here: ``icrtool --help`` lists them.
"""

from __future__ import annotations

from typing import Literal

FigureSet = Literal["default", "all"]
StatesFormat = Literal["csv", "parquet"]

Starts = Literal["moving", "all"]
"""Whether a standstill is one start of a trial, or every recorded state is one."""

Reference = Literal["filter", "smoothed"]
Preset = Literal["paper", "field"]
HeadingConvention = Literal["enu", "ned"]

PathKind = Literal["circle", "curved", "lawnmower", "figure-eight", "spins", "straight"]
WheelMessages = Literal["joint_states", "odometry", "float64_pair", "ticks", "jackal_feedback", "twist_stamped"]

ControllerTarget = Literal["diff_drive_controller", "clearpath", "nav2", "husarion", "json", "icr"]
TrajectoryFormat = Literal["evo", "kitti"]

StudyName = Literal[
    "convergence", "initial", "icr-change", "turn-radius", "input-noise", "input-bias", "input-source", "gnss", "rate",
    "consistency",
]  # fmt: skip
