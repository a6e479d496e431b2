"""An earlier report to compare with: its numbers, and whether a difference is more than chance."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from icrtool import __version__
from icrtool.errors import ConfigError
from icrtool.kernels.arrays import Floats
from icrtool.kernels.open_loop.block_sums import BlockSums
from icrtool.records.dropout import Gate
from icrtool.records.run_document import RunDocument
from icrtool.records.text import listed


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
    sha256 : of the log's files
    config : effective configuration
    rows : by model and horizon [m]
    """

    log: str
    path: str
    sha256: tuple[str, ...]
    tool_version: str
    config: Mapping[str, Any]
    rows: Mapping[tuple[str, float], BaselineRow]

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
        keys = sorted(_different_keys(self.config, run_document.config.effective()))
        if keys:
            found.append(f"another configuration than in the baseline: {listed(keys)}")
        if self.tool_version != __version__:
            found.append(f"icrtool {__version__}; the baseline was made with {self.tool_version}")
        return tuple(found)

    def is_of(self, run_document: RunDocument) -> bool:
        """Return whether the report was made of the same recording as a run."""
        return bool(self.sha256) and self.sha256 == run_document.content


def _different_keys(before: Mapping[str, Any], now: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    for key in {*before, *now}:
        old, new = before.get(key), now.get(key)
        if isinstance(old, Mapping) and isinstance(new, Mapping):
            yield from _different_keys(old, new, f"{prefix}{key}.")
        elif old != new:
            yield f"{prefix}{key}"
