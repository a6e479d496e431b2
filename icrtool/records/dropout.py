"""What a dropout analysis finds: the records that tables, files and pictures show.

No kernel is here: a process that only draws them need not load numba.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from icrtool.kernels.trials import Histogram, Intervals, OpenLoopPath, Summary, TrialCounts
from icrtool.records.tables import Floats, Ints

if TYPE_CHECKING:
    import pandas as pd

OutageKind = Literal["forced", "real"]

DEFAULT_SEED = 20140311
"""Seed of the bootstrap: any number, but the same for every run and every model."""

CHOICE_HORIZON_M = 10.0
"""Where extended models are chosen, and where the ladder of models is pictured."""


class ModelResult(NamedTuple):
    """What one model's trials say, by horizon."""

    name: str
    label: str
    summary: Summary
    intervals: Intervals
    histograms: tuple[Histogram, ...]


@dataclass(frozen=True, slots=True)
class DropoutReport:
    """Open-loop errors by model and horizon.

    Attributes
    ----------
    horizons_m : (h,) ascending
    results : one per model
    counts : trials, and starts that were none, by horizon; the same for every model
    states : recorded states, each a start
    standing : of them, those at which the robot stood: their trials are near copies of one another
    seed : of the bootstrap
    """

    name: str
    horizons_m: Floats
    results: tuple[ModelResult, ...]
    counts: TrialCounts
    states: int
    standing: int
    seed: int

    def result(self, model: str) -> ModelResult | None:
        """Return the result of a model, None when it was not computed."""
        return next((result for result in self.results if result.name == model), None)

    @property
    def summary(self) -> pd.DataFrame:
        """The rows of summary.csv as a DataFrame."""
        import pandas as pd

        return pd.DataFrame(self.summary_columns())

    def summary_columns(self) -> dict[str, list[str] | Floats | Ints]:
        """Return the columns of summary.csv: a row per model and horizon."""
        h = self.horizons_m
        names = [result.name for result in self.results for _ in h]
        horizon = np.tile(h, len(self.results))

        def stacked(values: Sequence[Floats]) -> Floats:
            return np.concatenate(values) if values else np.empty(0)

        summaries = [result.summary for result in self.results]
        intervals = [result.intervals for result in self.results]
        expected, p95 = stacked([s.expected for s in summaries]), stacked([s.p95 for s in summaries])
        return {
            "model": names,
            "horizon_m": horizon,
            "trials": np.concatenate([s.trials for s in summaries]) if summaries else np.empty(0, np.int64),
            "expected_error_m": expected,
            "p50_m": stacked([s.p50 for s in summaries]),
            "p95_m": p95,
            "max_m": stacked([s.largest for s in summaries]),
            "expected_pct": 100.0 * expected / horizon,
            "p95_pct": 100.0 * p95 / horizon,
            "expected_low_m": stacked([i.expected_low for i in intervals]),
            "expected_high_m": stacked([i.expected_high for i in intervals]),
            "p95_low_m": stacked([i.p95_low for i in intervals]),
            "p95_high_m": stacked([i.p95_high for i in intervals]),
        }


@dataclass(frozen=True, slots=True)
class BlindDrive:
    """One trial: from state `start` to state `end`, the reference's path and each model's.

    Attributes
    ----------
    reference_north_m, reference_east_m : (m,)
    paths : by model name
    errors_m : by model name, at the end
    """

    start: int
    end: int
    stamp_ns: int
    t_s: float
    north_m: float
    east_m: float
    horizon_m: float
    heading_change_rad: float
    speed_mean_mps: float
    reference_north_m: Floats
    reference_east_m: Floats
    paths: dict[str, OpenLoopPath]
    errors_m: dict[str, float]


@dataclass(frozen=True, slots=True)
class Outage:
    """One outage.

    Attributes
    ----------
    begin_s, end_s : seconds since the first recorded state
    distance_m : path driven through it
    end_error_m, max_error_m : forced: against the undisturbed estimate; real: miss at re-acquisition (both the same)
    north_m, east_m : (m,) the blind path, for a picture
    """

    kind: OutageKind
    begin_s: float
    end_s: float
    distance_m: float
    end_error_m: float
    max_error_m: float
    north_m: Floats
    east_m: Floats


@dataclass(frozen=True, slots=True)
class Rung:
    """One model's errors.

    Attributes
    ----------
    name : of `icrtool.calibration.model_comparison.MODELS`, with ``_gyro`` or ``_heading`` where it is measured
    fitted : ``never``, ``before`` (from the states up to the start), ``all`` (in sample), ``others`` (held out)
    """

    name: str
    label: str
    fitted: str
    measured_heading: bool
    summary: Summary
