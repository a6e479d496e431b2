"""The ladder of a report: of a run just made, or of one read back with the headings stored beside it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from icrtool.calibration.model_comparison import Ladder, judge_ladder
from icrtool.errors import DataError
from icrtool.estimation.measured_heading import measured_headings
from icrtool.output.run_directory import StoredRun, read_measured_headings
from icrtool.records.run import DrivenRun

if TYPE_CHECKING:
    from icrtool.estimation.fit import FilterRun


def ladder_of(judged: DrivenRun, run: StoredRun | FilterRun) -> tuple[Ladder | None, str]:
    """Judge the models of a run; where that cannot be, None and why.

    Parameters
    ----------
    judged : the run with the reference to hold against
    run : the run itself, which knows the measured headings

    Raises
    ------
    RunError
        The stored headings were edited or cannot be read.
    """
    headings = read_measured_headings(run) if isinstance(run, StoredRun) else measured_headings(run)
    try:
        return judge_ladder(judged, headings), ""
    except DataError as err:
        return None, f"{err.why}, {err.advice}"
