"""Words and numbers as a reader of our figures and tables meets them."""

from __future__ import annotations

from icrtool.analysis.fit import FilterRun

ICR_WORDS = {"y_icr_right_m": "right y", "y_icr_left_m": "left y", "x_icr_m": "x"}


def run_title(run: FilterRun) -> str:
    """Return the log's name, and the robot's where it has one."""
    robot = run.config.robot.name
    return f"{run.log.name}  ({robot})" if robot else run.log.name


def position_word(run: FilterRun) -> str:
    """Return what the position measurements are called: fixes of a receiver, or a reference that was metric already."""
    return "GNSS" if run.log.datum is not None else "position reference"


def duration_text(seconds: float) -> str:
    """Return a duration as ``12.3 s``, ``14:59 min`` or ``3:07:40 h``."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60}:{whole % 60:02d} min"
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d} h"
