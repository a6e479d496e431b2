"""Runs whose run.json holds something else."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import msgspec

from icrtool.records.notes import note
from icrtool.records.plain_data import plain_value
from icrtool.records.run import Run
from icrtool.records.run_document import RunDocument


def document_of(run: Run, **changes: Any) -> RunDocument:
    """What a run's run.json holds, with other values of some keys; a mapping changes the keys of a section.

    Warnings that are given become its findings.
    """
    summary = run.summary
    if "warnings" in changes:
        changes["notes"] = [plain_value(note("log_damaged", text)) for text in changes["warnings"]]
    for name, value in changes.items():
        summary[name] = summary[name] | value if isinstance(value, dict) else value
    return msgspec.convert(summary, RunDocument)


def with_summary(run: Run, **changes: Any) -> Run:
    """The run with such a document."""
    return replace(run, document=document_of(run, **changes))
