"""An earlier report to compare with: its numbers, and whether a difference is more than chance."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icrtool import __version__
from icrtool.errors import ConfigError
from icrtool.kernels.arrays import Floats
from icrtool.kernels.open_loop.block_sums import BlockSums
from icrtool.records.dropout import METRICS, Gate
from icrtool.records.dropout_document import BlocksDocument, EarlierReport
from icrtool.records.run_document import RunDocument
from icrtool.records.text import escaped, listed


class BaselineRow(NamedTuple):
    """The numbers of one model and horizon by metric [m], and their block sums; None where the report has none."""

    values_m: Mapping[str, float]
    sums: BlockSums | None


@dataclass(frozen=True, slots=True)
class BaselineReport:
    """An earlier report.

    Attributes
    ----------
    log : name of its log; path : of the report
    document : what it holds
    rows : its numbers by model and horizon [m]
    """

    log: str
    path: str
    document: EarlierReport
    rows: Mapping[tuple[str, float], BaselineRow]

    @property
    def sha256(self) -> tuple[str, ...]:
        """SHA-256 of each file of its log; none where one is not known."""
        return known_content(one.sha256 for one in self.document.run.inputs)

    @property
    def tool_version(self) -> str:
        """Version that made it."""
        return escaped(self.document.tool_version)

    def row(self, gate: Gate) -> BaselineRow:
        """Return the row that a gate names.

        Raises
        ------
        ConfigError
            The report has no such model or horizon.
        """
        for (model, horizon_m), row in self.rows.items():
            if model == gate.model and math.isclose(horizon_m, gate.horizon_m or math.nan, rel_tol=1e-6):
                return row
        what = f"no {gate.model} over {gate.horizon_m:g} m"
        raise ConfigError(f"gate {gate.text!r}", f"{what} in the baseline {self.path}", "make the baseline again")

    def p95_of(self, gate: Gate) -> tuple[Floats, Floats]:
        """Return distances (h,) and p95 (h,) [m] of the model that a gate names.

        Raises
        ------
        ConfigError
            The report has no such model.
        """
        found = sorted((at, row.values_m["p95"]) for (model, at), row in self.rows.items() if model == gate.model)
        if not found:
            raise ConfigError(f"gate {gate.text!r}", f"no {gate.model} in the baseline {self.path}", "make it again")
        horizons_m, p95_m = np.array(found).T
        return horizons_m, p95_m

    def changes(self, run_document: RunDocument) -> tuple[str, ...]:
        """Return what differs beside the numbers: log, configuration, version; a sentence each."""
        found = []
        if not self.is_of(run_document):
            found.append(f"another recording than in the baseline ({self.log}): the difference has a wider interval")
        keys = sorted(_different_keys(self.document.run.config, run_document.config.effective()))
        if keys:
            found.append(f"another configuration than in the baseline: {listed(keys)}")
        if self.tool_version != __version__:
            found.append(f"icrtool {__version__}; the baseline was made with {self.tool_version}")
        return tuple(found)

    def is_of(self, run_document: RunDocument) -> bool:
        """Return whether the report was made of the same recording as a run."""
        return bool(self.sha256) and self.sha256 == run_document.content


def baseline_report(document: EarlierReport, path: str, log: str) -> BaselineReport:
    """Return an earlier report; parameters as the fields."""
    rows = {}
    for model in document.models:
        sums = {one.horizon_m: _sums(one) for one in model.blocks}
        for row in model.by_horizon:
            values = {metric: _number(getattr(row, column)) for metric, (_, column) in METRICS.items()}
            rows[model.name, row.horizon_m] = BaselineRow(values, sums.get(row.horizon_m))
    return BaselineReport(log, path, document, rows)


def _sums(one: BlocksDocument) -> BlockSums:
    trials, p50, p95 = (np.array(column, np.int64) for column in (one.trials, one.above_p50, one.above_p95))
    errors = np.array([_number(error) for error in one.errors_m])
    return BlockSums(trials, errors, p50, p95, _number(one.p50_slope_m), _number(one.p95_slope_m))


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def known_content(content: Iterable[str | None]) -> tuple[str, ...]:
    """Return the SHA-256 of the files of a log; none where one is not known."""
    found = tuple(content)
    return () if None in found else tuple(map(str, found))


def _different_keys(before: Mapping[str, object], now: Mapping[str, object], prefix: str = "") -> Iterator[str]:
    for key in {*before, *now}:
        old, new = before.get(key), now.get(key)
        if isinstance(old, Mapping) and isinstance(new, Mapping):
            yield from _different_keys(old, new, f"{prefix}{key}.")
        elif old != new:
            yield f"{prefix}{key}"
