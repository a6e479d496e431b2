"""Acceptance limits of a batch for machines that watch pull requests: JUnit suites, and Markdown to paste."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from icrtool.fleet.row import Row, counts_text

if TYPE_CHECKING:
    from icrtool.output.exports.acceptance import Suite


def suites_of(rows: Sequence[Row]) -> list[Suite]:
    """Return a suite per log."""
    # Not at import: it loads the analysis, which a batch that is finished does not need.
    from icrtool.output.exports.acceptance import Suite

    return [Suite(row.log, row.verdicts, row.reason if row.status == "failed" else "") for row in rows]


def format_fleet_markdown(rows: Sequence[Row], missing: Sequence[str] = ()) -> str:
    """Return a batch as Markdown: counts, limits that were missed, every log against the baseline, what changed.

    Parameters
    ----------
    missing : logs of the baseline that the batch does not have
    """
    from icrtool.output.exports.acceptance import escaped_markdown, markdown_table

    lines = [f"## {len(rows)} logs", ""]
    lines += [counts_text(rows), ""]
    if verdicts := sorted((one for row in rows for one in row.verdicts), key=lambda one: one.passed):
        missed = sum(not one.passed for one in verdicts)
        lines += [f"**Acceptance limits not met: {missed}.**" if missed else "All acceptance limits are met.", ""]
        lines += [*(f"- {escaped_markdown(one.line())}" for one in verdicts), ""]
    errors = []
    for row in rows:
        if row.status == "failed":
            errors.append([escaped_markdown(row.log), f"could not be used: {escaped_markdown(row.reason)}", "", ""])
            continue
        now, before = row.shown_error(), row.shown_error(baseline=True)
        difference = f"{now - before:+.3f} m" if now is not None and before is not None else "-"
        errors.append([escaped_markdown(row.log), _metres(now), _metres(before), difference])
    lines += markdown_table(("log", "95 % after 10 m", "baseline", "difference"), errors)
    changes = changes_of(rows, missing)
    return "\n".join([*lines, *([""] if changes else []), *(f"- {escaped_markdown(change)}" for change in changes), ""])


def changes_of(rows: Sequence[Row], missing: Sequence[str]) -> list[str]:
    """Return how the logs, their configuration and the version differ from those of the baseline, a sentence each."""
    found = [f"not in this batch, but in the baseline: {', '.join(missing)}"] if missing else []
    new = [row.log for row in rows if row.status != "failed" and not row.baseline]
    if new and len(new) < len(rows):
        found.append(f"not in the baseline: {', '.join(new)}")
    by_change: dict[str, list[str]] = {}
    for row in rows:
        for change in row.changes:
            by_change.setdefault(change, []).append(row.log)
    found += [
        f"{', '.join(logs) if len(logs) < len(rows) or len(rows) == 1 else 'all logs'}: {change}"
        for change, logs in by_change.items()
    ]
    return found


def _metres(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f} m"
