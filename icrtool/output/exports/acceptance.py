"""Dropout reports for the CI of pull requests: JUnit XML, and Markdown to paste."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree as ET

from icrtool.dropout_analysis.report import DropoutReport
from icrtool.errors import IcrToolError
from icrtool.output.files.atomic import write_file
from icrtool.output.text_blocks import Block, Items, Section, Title, format_markdown
from icrtool.output.text_format import run_title, xml_text
from icrtool.records.fleet_document import FleetVerdict, fleet_verdict

Outcome = DropoutReport | IcrToolError
"""The outcome of one argument: a report, or the error that prevented it."""


class Suite(NamedTuple):
    """The acceptance limits of a log; `error`: why the log could not be used, empty if it could."""

    log: str
    verdicts: Sequence[FleetVerdict] = ()
    error: str = ""


def suite_of(name: str, outcome: Outcome) -> Suite:
    """Return the acceptance limits of a report, or of a log that has none."""
    if isinstance(outcome, IcrToolError):
        return Suite(name, error=str(outcome))
    log = outcome.run_document.log
    return Suite(run_title(outcome.run_document), [fleet_verdict(verdict, log) for verdict in outcome.document.gates])


def write_junit(path: Path, suites: Sequence[Suite], command: str = "dropout-report") -> None:
    """Write JUnit XML: one suite for each log, and in it one test case for each limit.

    Parameters
    ----------
    path : the file to make or to replace, whole or not at all
    suites : a log that could not be used is a suite with one error

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    root = ET.Element("testsuites", name=f"icrtool {command}")
    for suite in suites:
        root.append(_suite(suite, command))
    for total in ("tests", "failures", "errors", "skipped"):
        root.set(total, str(sum(int(suite.get(total, "0")) for suite in root)))
    ET.indent(root)
    write_file(path, ET.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n")


def format_outcomes(outcomes: Iterable[tuple[str, Outcome]]) -> str:
    """Return a summary for a pull request, of the name and outcome of each run."""
    blocks: list[Block] = []
    for name, outcome in outcomes:
        if isinstance(outcome, IcrToolError):
            blocks.append(Title(name, f"Could not be used: {outcome}"))
        else:
            blocks += _summary_blocks(outcome)
    return format_markdown(blocks)


def _summary_blocks(report: DropoutReport) -> list[Block]:
    """Return one report: its title, the verdicts, then the sentences and tables that are printed."""
    # The import is here because a batch needs only the verdicts.
    from icrtool.output.tables.dropout import dropout_blocks

    *blocks, _ = dropout_blocks(report)
    title = next(block for block in blocks if isinstance(block, Title))
    verdicts = suite_of("", report).verdicts
    return [title, limit_section(verdicts), *(block for block in blocks if block is not title)]


def limit_section(verdicts: Sequence[FleetVerdict]) -> Section:
    """Return the verdicts under their common result, limits that are not met first; empty without verdicts."""
    not_met = sum(not verdict.passed for verdict in verdicts)
    title = f"Acceptance limits not met: {not_met}" if not_met else "All acceptance limits are met"
    return Section(title, [Items([verdict.line for verdict in sorted(verdicts, key=lambda verdict: verdict.passed)])])


def _suite(tested: Suite, command: str) -> ET.Element:
    """Return the element of a suite; an error is a test case with the name of the `command`."""
    name = xml_text(tested.log)
    counts = {
        "tests": len(tested.verdicts) + bool(tested.error),
        "failures": sum(not verdict.passed for verdict in tested.verdicts),
        "errors": int(bool(tested.error)),
        "skipped": sum(bool(verdict.not_checked) for verdict in tested.verdicts),
    }
    suite = ET.Element("testsuite", {"name": name, **{key: str(count) for key, count in counts.items()}})
    for verdict in tested.verdicts:
        element = ET.SubElement(suite, "testcase", classname=name, name=xml_text(verdict.gate))
        line = xml_text(verdict.line)
        if verdict.not_checked:
            ET.SubElement(element, "skipped", message=xml_text(verdict.not_checked))
        elif not verdict.passed:
            ET.SubElement(element, "failure", type="gate", message=line).text = line
        else:
            ET.SubElement(element, "system-out").text = line
    if tested.error:
        element = ET.SubElement(suite, "testcase", classname=name, name=command)
        ET.SubElement(element, "error", type="IcrToolError", message=xml_text(tested.error))
    return suite
