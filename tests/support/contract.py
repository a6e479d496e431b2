"""Names that the contract with users fixes."""

from __future__ import annotations

RUN_KEYS = {"tool_version", "inputs", "config", "streams", "warnings", "drive", "icr", "gnss", "filter"}
"""Of run.json."""

SUMMARY_COLUMNS = [
    "model", "horizon_m", "trials", "expected_error_m", "p50_m", "p95_m", "max_m", "expected_pct", "p95_pct",
]  # fmt: skip
"""Of the dropout analysis' summary.csv, which come first."""
