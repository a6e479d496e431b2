"""Dropout reports that differ from one that was made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import msgspec

from icrtool.dropout_analysis.report import DropoutReport
from icrtool.records.dropout_document import ModelResult, Outage
from icrtool.records.plain_data import finite_or_none
from icrtool.records.run_document import RunDocument


def with_content(report: DropoutReport, **changes: Any) -> DropoutReport:
    """Return a report with other content of report.json."""
    return replace(report, document=msgspec.structs.replace(report.document, **changes))


def with_run(report: DropoutReport, run: RunDocument) -> DropoutReport:
    """Return a report of another run."""
    of_run = msgspec.structs.replace(report.document.run, log=run.log)
    return replace(with_content(report, run=of_run), run_document=run)


def with_outages(report: DropoutReport, outages: tuple[Outage, ...]) -> DropoutReport:
    return replace(with_content(report, outages=tuple(one.document for one in outages)), outages=outages)


def with_models(report: DropoutReport, *results: ModelResult) -> DropoutReport:
    """Return a report of other models."""
    document = msgspec.structs.replace(report.document, models=tuple(one.document for one in results))
    return replace(report, document=document, results=results)


def with_numbers(result: ModelResult, name: str | None = None, **columns: Sequence[float]) -> ModelResult:
    """Return a model with other numbers, by horizon; NaN for none."""
    rows = [
        msgspec.structs.replace(row, **dict(zip(columns, map(finite_or_none, map(float, values)), strict=True)))
        for row, *values in zip(result.document.by_horizon, *columns.values(), strict=True)
    ]
    named = {} if name is None else {"name": name}
    return result._replace(document=msgspec.structs.replace(result.document, by_horizon=rows, **named))
