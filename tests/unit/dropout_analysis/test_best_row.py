"""Which row to drive with: the smallest expected error of rows that a robot can drive with, by wheels alone."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from icrtool.dropout_analysis.dropout_report import dropout_report
from icrtool.dropout_analysis.report import DropoutReport, best_row
from icrtool.records.run import Run


@pytest.fixture(scope="module")
def run(make_run: Callable[..., Run]) -> Run:
    return make_run(duration_s=60.0)


@pytest.fixture(scope="module")
def report(run: Run) -> DropoutReport:
    return dropout_report(run, horizons_m=[5.0, 10.0])


def test_it_has_the_smallest_expected_error_at_10_m_and_no_gyro(report: DropoutReport) -> None:
    best = best_row(report)
    assert best is not None
    assert best.horizon_m == 10.0
    errors = {
        name: found.column("expected_error_m")[1]
        for name in ("controller", "recommended")
        if (found := report.result(name)) is not None
    }
    assert best.model == min(errors, key=lambda name: errors[name])
    assert best.expected_error_m == pytest.approx(min(errors.values()))
    assert report.document.best == best


def test_no_slip_is_not_as_good_for_a_robot_that_slips(report: DropoutReport) -> None:
    best = best_row(report)
    assert best is not None
    assert best.as_good == ()


def test_a_row_whose_interval_lies_apart_is_worse_however_wide_the_difference_is(
    report: DropoutReport, monkeypatch: pytest.MonkeyPatch
) -> None:
    no_slip, first = report.result("no_slip"), best_row(report)
    assert no_slip is not None
    assert first is not None
    best = report.result(first.model)
    assert best is not None
    assert no_slip.column("expected_low_m")[1] > best.column("expected_high_m")[1]
    monkeypatch.setattr("icrtool.dropout_analysis.report.difference_half_width", lambda *_, **__: math.inf)
    found = best_row(report)
    assert found is not None
    assert found.as_good == ()


def test_without_rows_that_a_robot_can_drive_with_there_is_none(run: Run) -> None:
    assert best_row(dropout_report(run, horizons_m=[5.0], ladder=False)) is None
