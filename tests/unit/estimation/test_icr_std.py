"""The standard deviation of an ICR over time: it ends at the number of run.json and begins as configured."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from icrtool.estimation.convergence import icr_std_m
from icrtool.records.run import ICR_COLUMNS, Run


def with_final_std(run: Run, std_m: float | None, clock_m: float = 0.0) -> Run:
    names = ("final", "final_std", "mean", "std") if std_m is None else ("final_std",)
    numbers = {name: msgspec.structs.replace(getattr(run.document.icr, name), x_icr_m=std_m) for name in names}
    icr = msgspec.structs.replace(run.document.icr, x_clock_std_m=clock_m, **numbers)
    return replace(run, document=msgspec.structs.replace(run.document, icr=icr))


def test_it_ends_at_the_number_of_the_text_and_begins_as_the_filter(run: Run) -> None:
    for column in ICR_COLUMNS:
        std, own = icr_std_m(run, column), getattr(run.table, f"std_{column}")
        assert std[-1] == pytest.approx(run.document.icr.final_std[column], rel=1e-12)
        clock = run.document.icr.x_clock_std_m if column == "x_icr_m" else 0.0
        assert std[0] == pytest.approx(np.hypot(own[0], clock), rel=1e-9)


@pytest.mark.parametrize("factor", [0.4, 1.0, 3.0])
def test_the_filters_information_is_counted_with_one_factor(run: Run, factor: float) -> None:
    own = run.table.std_x_icr_m
    given = with_final_std(run, factor * float(own[-1]))
    std = icr_std_m(given, "x_icr_m")
    rows = own < 0.99 * own[0]
    gained, counted = (1.0 / one[rows] ** 2 - 1.0 / own[0] ** 2 for one in (own, std))
    assert np.allclose(counted / gained, counted[-1] / gained[-1], rtol=1e-6)
    assert np.isfinite(std).all()
    assert (np.diff(std[np.argsort(own, kind="stable")]) > -1e-12).all()
    if factor == 1.0:
        assert np.allclose(std, own, rtol=1e-9)


def test_the_part_of_the_clocks_is_there_from_the_start(run: Run) -> None:
    own = run.table.std_x_icr_m
    std = icr_std_m(with_final_std(run, 0.05, clock_m=0.03), "x_icr_m")
    assert std[-1] == pytest.approx(0.05, rel=1e-12)
    assert std[0] == pytest.approx(np.hypot(own[0], 0.03), rel=1e-9)


def test_a_start_that_knew_more_than_the_end_still_ends_at_the_number(run: Run) -> None:
    late = replace(run, table=replace(run.table, std_x_icr_m=np.ascontiguousarray(run.table.std_x_icr_m[::-1])))
    for std_m in (0.5 * float(late.table.std_x_icr_m[-1]), 2.0 * float(late.table.std_x_icr_m[-1])):
        std = icr_std_m(with_final_std(late, std_m), "x_icr_m")
        assert std[-1] == pytest.approx(std_m, rel=1e-12)
        assert (std > 0.0).all()


def test_of_an_icr_that_is_not_shown_it_is_the_filters(run: Run) -> None:
    assert np.array_equal(icr_std_m(with_final_std(run, None), "x_icr_m"), run.table.std_x_icr_m)
