"""A study as text: what was found by setting, and beside it what the paper reports."""

from __future__ import annotations

import math
from typing import Any

from icrtool.output.text_blocks import Block, Table, Text
from icrtool.records.text import counted
from icrtool.simulation.studies import KINDS, StudyNumber, StudyRequest, StudyResult

ERRORS = tuple(
    (f"error_{icr}_m", name) for icr, name in (("y_icr_right", "y right"), ("y_icr_left", "y left"), ("x_icr", "x"))
)
SETTLE = (("settle_s", "all within 10 % [s]"),)
INVERTED = (("inverted", "inverted"),)

SHOWN: dict[str, tuple[tuple[str, str], ...]] = {
    "convergence": SETTLE + INVERTED,
    "icr-change": (("change1_settle_s", "change 1 [s]"), ("change2_settle_s", "change 2 [s]"), *INVERTED),
    "turn-radius": SETTLE + INVERTED,
    "input-noise": ERRORS + INVERTED,
    "input-bias": ERRORS + INVERTED,
    "input-source": ERRORS + INVERTED,
    "gnss": (("rms_y_icr_right_m", "rms y right [m]"), ("blind_icr_10m_p95_m", "10 m without GNSS [m]"), *INVERTED),
    "rate": ERRORS,
}
"""Metrics by study, with the heading of their column; the studies left out have no settings to list."""


def format_study(result: StudyResult) -> Text:
    """Return the tables of a study; no line end."""
    request, kind = result.request, KINDS[result.request.name]
    figures = f" (Fig{'s' if len(kind.figures) > 2 else ''}. {kind.figures})" if kind.figures else ""
    path = request.plan.path
    icrs = ", ".join(f"{icr:+.3f}" for icr in request.plan.icrs_m)
    driven = f"{getattr(path, 'kind', 'path')} at {getattr(path, 'speed_mps', 0):g} m/s, ICRs {icrs} m"
    blocks: list[Block] = [
        f"{request.name}{figures}: {kind.about}",
        f"{runs_text(request)} each, seed {request.seed}; {driven}",
        "",
    ]
    if request.name in SHOWN:
        blocks += [*_level_blocks(result), ""]
    findings = [(one.what, finding_text(one), one.paper) for one in result.findings]
    return Text([*blocks, Table("l", findings, ("", "ours", "expected" if request.name == "consistency" else "paper"))])


def _level_blocks(result: StudyResult) -> list[Block]:
    """Return one row a setting: median and, in brackets, the 5th and 95th percentile over its runs."""
    shown = [metric for metric in SHOWN[result.request.name] if metric[0] in result.levels[0]["metrics"]]
    rows = []
    for level in result.levels:
        value = level["value"]
        cells = (_cell(name, level["metrics"][name], result.request.runs) for name, _ in shown)
        rows.append((level["series"], value if isinstance(value, str) else f"{value:g}", *cells))
    head = ("preset", KINDS[result.request.name].varies or "setting", *(heading for _, heading in shown))
    errors = any(name.startswith("error") for name, _ in shown)
    return [Table("l", rows, head), f"{'errors [m]: ' if errors else ''}median [5 %, 95 %] over the runs"]


def _cell(name: str, found: dict[str, Any], runs: int) -> str:
    if name == "inverted":
        return f"{100 * found['mean']:.0f} %"
    if not found["count"]:
        return "never"
    form = "+.3f" if name.startswith("error") else ".3g"
    never = f", never in {runs - found['count']}" if found["count"] < runs else ""
    return f"{found['p50']:{form}} [{found['p5']:{form}}, {found['p95']:{form}}]{never}"


def finding_text(finding: StudyNumber) -> str:
    """Return our number as ``1.23 s``, or ``0.5-1.23 s``, or median with percentiles."""
    if any(math.isnan(value) for value in finding.ours):
        return "never"
    texts = [_number(value) for value in finding.ours]
    unit = f" {finding.unit}" if finding.unit else ""
    if len(texts) == 1:
        return f"{texts[0]}{unit}"
    if len(texts) == 2:
        return f"{texts[0]} to {texts[1]}{unit}"
    return f"{texts[1]}{unit} [{texts[0]}, {texts[2]}]"


def _number(value: float) -> str:
    if value == 0 or abs(value) < 1e-3:
        return "0.000" if abs(value) < 5e-4 else f"{value:.3f}"
    return f"{value:.3f}" if abs(value) < 1 else f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"


def runs_text(request: StudyRequest) -> str:
    """Return number and length of the runs, as ``1 run of 60 s``."""
    return f"{counted(request.runs, 'run')} of {request.plan.duration_s:g} s"


def study_title(result: StudyResult) -> str:
    """Return a study's name, with the robot's where it has one, and the true ICRs."""
    robot = result.request.config.robot.name
    icrs = ", ".join(f"{icr:+.2f}".replace("-", "−") for icr in result.request.plan.icrs_m)
    return f"Study {result.request.name}  ({f'{robot}, ' if robot else ''}ICRs {icrs} m)"


def capital(text: str) -> str:
    """Return a text that begins with a capital."""
    return text[:1].upper() + text[1:]
