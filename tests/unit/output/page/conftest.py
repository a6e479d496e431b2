"""A run of the barn's drive with its dropout report, and pages made of them."""

from __future__ import annotations

import pytest

from icrtool.dropout_analysis.dropout_report import dropout_report
from icrtool.dropout_analysis.report import DropoutReport
from icrtool.records.run import Run
from support.documents import with_summary

HOSTILE = "</script><script>window.hostile=1</script><img src=x onerror='window.hostile=1'>\"'&\u202e"
"""A name that would be HTML, script and attribute at once, and that reverses what follows."""


@pytest.fixture(scope="session")
def report(run: Run) -> DropoutReport:
    return dropout_report(run, outage_s=(4.0,), gates=("icr.p95@5m <= 0.001",))


@pytest.fixture(scope="session")
def hostile_run(run: Run) -> Run:
    """The same run, with hostile text wherever a log can put some."""
    return with_summary(
        run,
        log=HOSTILE,
        warnings=[HOSTILE],
        config={"robot": run.summary["config"]["robot"] | {"name": HOSTILE}},
        streams=[
            stream | {"topic": HOSTILE, "message_type": HOSTILE, "why": HOSTILE} for stream in run.summary["streams"]
        ],
        inputs=[{"path": HOSTILE, "bytes": 1, "sha256": HOSTILE}],
        unusable_because=HOSTILE,
        usable=False,
    )
