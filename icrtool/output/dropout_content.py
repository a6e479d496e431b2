"""What a dropout report says of one run: the numbers that its files, pictures and tables share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from icrtool.calibration.model_comparison import Ladder
from icrtool.dropout_analysis.acceptance_limits import BudgetDistance, Verdict
from icrtool.dropout_analysis.straight_and_turning import TurningSplit
from icrtool.records.dropout import BlindDrive, DropoutReport, ModelResult, Outage
from icrtool.records.run import DrivenRun

SHOWN_HORIZONS_M = (1.0, 5.0, 10.0, 20.0)


@dataclass(frozen=True, slots=True)
class DropoutContent:
    """One finished analysis.

    Attributes
    ----------
    title : the log's name, and the robot's where it has one
    run_summary : what run.json says
    budgets : by budget and model
    worst : largest error first
    examples : a cornering and a straight drive; empty where no trial is that long
    outages : forced ones, then real ones
    by_turning : straight and turning trials apart
    ladder : the models judged on way they were not fitted to; None where it was left out, and `no_ladder` says why
    smoothed : the reference is the smoother's trajectory, not the filter's
    """

    title: str
    run_summary: dict[str, Any]
    report: DropoutReport
    budgets: tuple[BudgetDistance, ...]
    verdicts: tuple[Verdict, ...]
    worst: tuple[BlindDrive, ...]
    examples: tuple[BlindDrive, ...]
    outages: tuple[Outage, ...]
    by_turning: tuple[TurningSplit, ...] = ()
    ladder: Ladder | None = None
    no_ladder: str = ""
    smoothed: bool = False

    @property
    def passed(self) -> bool:
        """Whether no gate failed."""
        return all(verdict.passed for verdict in self.verdicts)


def title_of(run: DrivenRun) -> str:
    """Return the log's name, and the robot's where it has one."""
    robot = run.summary["config"]["robot"]["name"]
    return f"{run.name}  ({robot})" if robot else run.name


def shown_horizons(report: DropoutReport) -> list[int]:
    """Return the places of the horizons nearest to 1, 5, 10 and 20 m, each once; of a few horizons, all."""
    if len(report.horizons_m) <= len(SHOWN_HORIZONS_M):
        return list(range(len(report.horizons_m)))
    nearest = (int(np.argmin(np.abs(report.horizons_m - metres))) for metres in SHOWN_HORIZONS_M)
    return sorted(set(nearest))


def p95_at(result: ModelResult, report: DropoutReport, distance_m: float) -> float | None:
    """Return a model's p95 [m] at the horizon nearest to a distance; None beyond the last one, or without trials."""
    if distance_m > report.horizons_m[-1]:
        return None
    value = float(result.summary.p95[int(np.argmin(np.abs(report.horizons_m - distance_m)))])
    return value if np.isfinite(value) else None
