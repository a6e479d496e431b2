"""One record a question: the same names and defaults on the command line, in Python and in the result documents."""

from __future__ import annotations

import json
from inspect import signature
from typing import Any

import click
import msgspec
import pytest

import icrtool
from icrtool.cli.commands import icrtool as group
from icrtool.dropout_analysis.dropout_report import report_on
from icrtool.output.files.formats import json_bytes
from icrtool.pipeline import fit_log
from icrtool.records.plain_data import Record
from icrtool.records.requests import FitRequest, ReportRequest, ResultFiles
from icrtool.records.run import Run
from support.barn import configured, simulate


def arguments_of(*words: str) -> dict[str, Any]:
    """Return the arguments of a command that is called with these words, by their names."""
    command = group.get_command(click.Context(group), words[0])
    assert command is not None
    return command.make_context(words[0], list(words[1:])).params


@pytest.mark.parametrize(
    ("record", "words"),
    [
        (FitRequest, ("fit", "log.bag")),
        (ResultFiles, ("fit", "log.bag")),
        (ReportRequest, ("dropout-report", "log.bag")),
        (ResultFiles, ("dropout-report", "log.bag")),
        (ReportRequest, ("report", "log.bag")),
        (ReportRequest, ("batch", "season", "-o", "out")),
        (ResultFiles, ("batch", "season", "-o", "out")),
    ],
)
def test_an_option_has_the_default_of_the_field_that_it_sets(record: type[Record], words: tuple[str, ...]) -> None:
    defaults = msgspec.structs.asdict(record())
    # what is repeatable and was not given is empty, and leaves the configured values
    given = {name: value for name, value in arguments_of(*words).items() if value not in (None, ())}
    both = given.keys() & defaults.keys()
    assert both
    assert {name: given[name] for name in both} == {name: defaults[name] for name in both}


def test_every_question_is_an_option_and_a_keyword_of_the_same_name() -> None:
    assert {*FitRequest.__struct_fields__} <= arguments_of("fit", "log.bag").keys()
    assert {"start", "end"} <= arguments_of("info", "log.bag").keys()
    assert {*ReportRequest.__struct_fields__} <= arguments_of("dropout-report", "log.bag").keys()
    # a log is cut where it is read
    fit = signature(icrtool.fit).parameters.keys() | signature(icrtool.read_log).parameters.keys()
    assert {*FitRequest.__struct_fields__} <= fit
    assert {*ReportRequest.__struct_fields__} <= signature(icrtool.dropout_report).parameters.keys()


def test_a_keyword_has_the_default_of_the_field_that_it_sets(run: Run) -> None:
    assert icrtool.dropout_report(run, ladder=False).document.request == ReportRequest(ladder=False)
    assert run.document.request == FitRequest()


def test_the_documents_hold_the_requests_as_they_were_made(run: Run) -> None:
    asked = ReportRequest(horizons_m=(2.0,), gates=("icr.p95@5m <= 9",), starts="all", ladder=False, seed=7)
    report = report_on(run, asked)
    assert report.document.request is asked
    stored = json.loads(json_bytes(report.document))["request"]
    assert msgspec.convert(stored, ReportRequest) == asked
    fitting = FitRequest(changes_s=(20.0,), smooth=True)
    again = fit_log(simulate(), configured(), fitting)
    assert again.document.request is fitting
    assert again.smoothed is not None
    assert msgspec.convert(again.summary["request"], FitRequest) == fitting


def test_a_report_on_smoothed_states_asks_the_fit_for_them() -> None:
    assert ReportRequest(reference="smoothed").fit == FitRequest(smooth=True)
    assert ReportRequest().fit == FitRequest()


def test_a_configuration_sets_what_the_request_leaves_open() -> None:
    config = icrtool.load_config(sets=["dropout.horizons_m=[3.0]"])
    assert ReportRequest().configured(config).horizons_m == (3.0,)
    assert ReportRequest(horizons_m=(4.0,)).configured(config).horizons_m == (4.0,)
    assert ReportRequest().configured(icrtool.load_config()).horizons_m is None
