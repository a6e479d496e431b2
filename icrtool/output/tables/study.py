"""A study as text: the numbers of icrtool and the numbers of the paper."""

from __future__ import annotations

import math
from itertools import groupby

from icrtool.output.text_blocks import Block, Table
from icrtool.records.run import ICR_WORDS
from icrtool.records.text import counted
from icrtool.simulation.study_records import Level, StudyNumber, StudyRequest, StudyResult

ERROR_WORDS = {f"error_{column}": word for column, word in ICR_WORDS.items()}
"""Headings of the columns with the error of each ICR."""

SETTLE = {"settle_s": "all within 10 % [s]"}
"""Heading of the column with the settling time."""

INVERTED = {"inverted": "inverted"}
"""Heading of the column with the share of inverted runs."""

SHOWN: dict[str, dict[str, str]] = {
    "convergence": SETTLE | INVERTED,
    "icr-change": {"change1_settle_s": "change 1 [s]", "change2_settle_s": "change 2 [s]"} | INVERTED,
    "turn-radius": SETTLE | INVERTED,
    "input-noise": ERROR_WORDS | INVERTED,
    "input-bias": ERROR_WORDS | INVERTED,
    "input-source": ERROR_WORDS | INVERTED,
    "gnss": {"rms_y_icr_right_m": "rms y right [m]", "blind_icr_10m_p95_m": "10 m without GNSS [m]"} | INVERTED,
    "rate": ERROR_WORDS,
    "speed": {f"mean_{column}": word for column, word in ICR_WORDS.items()} | INVERTED,
}
"""Metrics by study, with the heading of their column. Other studies have no settings to list."""


def study_blocks(result: StudyResult) -> list[Block]:
    """Return the tables of a study, at most 80 columns wide without the paper's numbers."""
    request, study = result.request, result.study
    figures = f" (Fig{'s' if len(study.figures) > 2 else ''}. {study.figures})" if study.figures else ""
    icrs = ", ".join(f"{icr:+z.3f}" for icr in request.plan.icrs_m)
    driven = f"{request.path.kind} at {request.path.speed_mps:g} m/s, ICRs {icrs} m"
    blocks: list[Block] = [f"{request.name}{figures}: {study.about}"]
    blocks += [f"{runs_text(request)} each, seed {request.seed}; {driven}", ""]
    if shown := {name: head for name, head in SHOWN.get(request.name, {}).items() if name in result.columns}:
        errors = "; errors [m]" if shown.keys() >= ERROR_WORDS.keys() else ""
        varies = f"by preset and {study.varies or 'setting'}"
        levels = [row for level in result.levels for row in _level_rows(level, shown)]
        blocks += [Table("lr", levels, ("", varies.rpartition(" ")[2], *shown.values()))]
        blocks += [f"{varies}{errors}; median, and below it [5 %, 95 %] of the runs", ""]
    # The numbers of one setting are listed below its name.
    rows: list[tuple[str, str, str]] = []
    for head, group in groupby(result.findings, lambda number: number.what.rpartition(": ")[0]):
        rows.append((head, "", ""))
        rows += [(f"  {number.what.rpartition(': ')[2]}", finding_text(number), number.paper) for number in group]
    return [*blocks, Table("l", rows, ("", "ours", "expected" if request.name == "consistency" else "paper"))]


def _level_rows(level: Level, heads: dict[str, str]) -> list[list[str]]:
    """Return the medians of a setting, and below them the 5th and 95th percentiles over its runs."""
    value = level.setting.value
    first, second = [level.setting.series, value if isinstance(value, str) else f"{value:g}"], ["", ""]
    for name in heads:
        metric = level.metrics()[name]
        form, never = "+z.3f" if name in ERROR_WORDS else ".3g", len(level.found[name]) - metric["count"]
        if name == "inverted":
            middle, around = f"{100 * metric['mean']:.0f} %", ""
        elif not metric["count"]:
            middle, around = "never", ""
        else:
            middle = f"{metric['p50']:{form}}{f', never in {never}' if never else ''}"
            around = f"[{metric['p5']:{form}}, {metric['p95']:{form}}]"
        first.append(middle)
        second.append(around)
    return [first, second] if any(second) else [first]


def finding_text(finding: StudyNumber) -> str:
    """Return our number as ``1.23 s``, or ``0.5-1.23 s``, or median with percentiles."""
    if any(math.isnan(value) for value in finding.ours):
        return "never"
    texts = []
    for value in finding.ours:
        digits = 3 if abs(value) < 1 else 2 if abs(value) < 10 else 1
        texts.append(f"{value:z.{digits}f}")
    unit = f" {finding.unit}" if finding.unit else ""
    if len(texts) == 3:
        return f"{texts[1]}{unit} [{texts[0]}, {texts[2]}]"
    return f"{' to '.join(texts)}{unit}"


def runs_text(request: StudyRequest) -> str:
    """Return number and length of the runs, as ``1 run of 60 s``."""
    return f"{counted(request.runs, 'run')} of {request.plan.duration_s:g} s"
