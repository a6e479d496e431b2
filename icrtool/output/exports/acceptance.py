"""Dropout reports for machines that watch pull requests: JUnit XML, and Markdown to paste."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree as ET

from icrtool.dropout_analysis.report import DropoutReport
from icrtool.errors import IcrToolError
from icrtool.output.atomic_file import atomic_file
from icrtool.output.tables.dropout import budget_lines, metres_text, percent_text, ratio_text, shown_horizons
from icrtool.output.text_format import run_title, xml_text

Outcome = DropoutReport | IcrToolError
"""What became of one argument: a report, or why there is none."""


def write_junit(path: Path, outcomes: Sequence[tuple[str, Outcome]]) -> None:
    """Write JUnit XML: a suite a run, a test case a gate.

    Parameters
    ----------
    path : the file to make or to replace, whole or not at all
    outcomes : name and outcome of each run; one that could not be used is a suite with one error

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    suites = ET.Element("testsuites", name="icrtool dropout-report")
    for name, outcome in outcomes:
        suites.append(_error_suite(name, outcome) if isinstance(outcome, IcrToolError) else _gate_suite(outcome))
    for total in ("tests", "failures", "errors"):
        suites.set(total, str(sum(int(suite.get(total, "0")) for suite in suites)))
    ET.indent(suites)
    with atomic_file(path) as partial:
        partial.write_bytes(ET.tostring(suites, encoding="utf-8", xml_declaration=True) + b"\n")


def write_markdown(path: Path, outcomes: Sequence[tuple[str, Outcome]]) -> None:
    """Write a summary for a pull request.

    Parameters
    ----------
    path, outcomes : as in `write_junit`

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    parts = []
    for name, outcome in outcomes:
        if isinstance(outcome, IcrToolError):
            parts.append(f"## {_escaped(name)}\n\nCould not be used: {_escaped(str(outcome))}\n")
        else:
            parts.append(format_markdown(outcome))
    with atomic_file(path) as partial:
        partial.write_bytes("\n".join(parts).encode("utf-8", errors="backslashreplace"))


def format_markdown(report: DropoutReport) -> str:
    """Return one report as Markdown."""
    shown = shown_horizons(report)
    head = ["distance without GNSS", *(f"{report.horizons_m[h]:g} m" for h in shown)]
    rows = [head, ["---", *("---:" for _ in shown)]]
    for result in report.results:
        for label, column in (("95 %", result.summary.p95), ("expected", result.summary.expected)):
            cells = [
                f"{metres_text(float(column[h]))} ({percent_text(100 * float(column[h] / report.horizons_m[h]))})"
                for h in shown
            ]
            rows.append([f"{_escaped(result.label)}, {label}", *cells])
    icr, no_slip = report.result("icr"), report.result("no_slip")
    if icr is not None and no_slip is not None:
        ratios = [ratio_text(float(no_slip.summary.p95[h]), float(icr.summary.p95[h])) for h in shown]
        rows.append(["no slip : ICR, 95 %", *ratios])
    lines = [f"## {_escaped(run_title(report.run_summary))}", ""]
    if report.verdicts:
        word = "All gates passed." if report.passed else "**A gate failed.**"
        lines += [word, "", *(f"- {_escaped(verdict.line())}" for verdict in report.verdicts), ""]
    lines += [f"Open loop from each of {report.states:,} states. In words:", ""]
    lines += [f"- {_escaped(line)}" for line in budget_lines(report.budgets)]
    lines += ["", *("| " + " | ".join(row) + " |" for row in rows)]
    if report.outages:
        lines += [
            "",
            "| outage | from | length | distance | end error | max error |",
            "| --- | ---: | ---: | ---: | ---: | ---: |",
        ]
        lines += [
            f"| {one.kind} | {one.begin_s:.1f} s | {one.end_s - one.begin_s:.1f} s | {one.distance_m:.1f} m "
            f"| {metres_text(one.end_error_m)} | {metres_text(one.max_error_m)} |"
            for one in report.outages
        ]
    return "\n".join(lines) + "\n"


def _gate_suite(report: DropoutReport) -> ET.Element:
    name = xml_text(run_title(report.run_summary))
    failures = sum(not verdict.passed for verdict in report.verdicts)
    suite = _suite(name, tests=len(report.verdicts), failures=failures, errors=0)
    for verdict in report.verdicts:
        case = ET.SubElement(suite, "testcase", classname=name, name=xml_text(verdict.gate.text))
        if not verdict.passed:
            failure = ET.SubElement(case, "failure", type="gate", message=xml_text(verdict.line()))
            failure.text = xml_text(verdict.line())
    return suite


def _error_suite(name: str, error: IcrToolError) -> ET.Element:
    suite = _suite(xml_text(name), tests=1, failures=0, errors=1)
    case = ET.SubElement(suite, "testcase", classname=xml_text(name), name="dropout-report")
    ET.SubElement(case, "error", type=type(error).__name__, message=xml_text(str(error)))
    return suite


def _suite(name: str, *, tests: int, failures: int, errors: int) -> ET.Element:
    return ET.Element("testsuite", name=name, tests=str(tests), failures=str(failures), errors=str(errors))


def _escaped(text: str) -> str:
    """Return text with what Markdown would take for markup escaped."""
    return re.sub(r"([\\`*_{}\[\]<>|#])", r"\\\1", text)
