"""Words that a user chooses among: the type of each such argument, whose words `typing.get_args` gives to its option.

Nothing else is imported here: ``icrtool --help`` lists them.
"""

from __future__ import annotations

from typing import Literal

FigureSet = Literal["default", "all"]
"""The figures that a run and its report are written with: those that answer a question, or the paper's too."""

StatesFormat = Literal["csv", "parquet"]

Starts = Literal["moving", "all"]
"""``moving``: each standstill gives one start, the state from which the robot drives on; ``all``: every state."""

Reference = Literal["filter", "smoothed"]
PresetName = Literal["paper", "field"]
HeadingConvention = Literal["enu", "ned"]

PathKind = Literal["circle", "curved", "lawnmower", "figure-eight", "spins", "straight"]
WheelMessages = Literal["joint_states", "odometry", "float64_pair", "ticks", "jackal_feedback", "twist_stamped"]

ControllerTarget = Literal["diff_drive_controller", "clearpath", "nav2", "husarion", "json", "icr"]
TrajectoryFormat = Literal["evo", "kitti"]

StudyName = Literal[
    "convergence", "initial", "icr-change", "turn-radius", "input-noise", "input-bias", "input-source", "gnss", "rate",
    "consistency", "speed",
]  # fmt: skip
