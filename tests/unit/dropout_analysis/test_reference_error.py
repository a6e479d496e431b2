"""The reference's own error, against trials of a perfect model on references of known noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icrtool.calibration.run_models import Model
from icrtool.dropout_analysis.dropout_report import dropout
from icrtool.kernels.track import FrozenIcrs
from icrtool.records.dropout_document import column_of
from icrtool.records.run import Run
from support.barn import ICRS_M, RATE_HZ
from support.documents import with_summary

HORIZONS_M = [1.0, 5.0, 20.0]
PERFECT = [Model("icr", FrozenIcrs.constant(*ICRS_M))]
STDS = [(0.05, 0.05, 0.0), (0.0, 0.0, 0.01), (0.02, 0.10, 0.02)]
"""North and east [m], heading [rad]."""


def true_path(run: Run) -> dict[str, np.ndarray]:
    """Integrate the held wheel speeds with the true ICRs: what a perfect model predicts."""
    table, (right, left, x) = run.table, ICRS_M
    omega = (table.v_left_mps - table.v_right_mps) / (right - left)
    ahead, aside = (table.v_left_mps * right - table.v_right_mps * left) / (right - left), -omega * x
    dt = np.diff(table.stamp_ns) / 1e9
    psi = np.concatenate([[0.0], np.cumsum(omega[:-1] * dt)])
    north = np.concatenate([[0.0], np.cumsum(((ahead * np.cos(psi) - aside * np.sin(psi))[:-1]) * dt)])
    east = np.concatenate([[0.0], np.cumsum(((ahead * np.sin(psi) + aside * np.cos(psi))[:-1]) * dt)])
    return {"north_m": north, "east_m": east, "heading_rad": psi}


def with_noise(run: Run, stds: tuple[float, float, float], factor: float = 1.0) -> Run:
    """Return the run with a reference that has `factor` times white noise of these standard deviations."""
    rng, columns = np.random.default_rng(11), {}
    for (name, column), std in zip(true_path(run).items(), stds, strict=True):
        columns[name] = column + factor * std * rng.standard_normal(len(column))
        columns[f"std_{name}"] = np.full(len(column), std)
    noisy = with_summary(run, filter={"nis_gnss_mean": 2.0 * factor**2, "nis_heading_mean": factor**2})
    return replace(noisy, table=replace(run.table, **columns))


@pytest.fixture(scope="module")
def clean(make_run) -> Run:
    run = make_run(troubles=False)
    assert len(run.table) > 50 * RATE_HZ
    return run


@pytest.mark.parametrize("stds", STDS)
@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_a_perfect_model_shows_the_references_error_and_nothing_else(
    clean: Run, stds: tuple[float, float, float], factor: float
) -> None:
    report = dropout(with_noise(clean, stds, factor), HORIZONS_M, models=PERFECT)
    shown = report.results[0]
    std, expected, p95 = (column_of(report.document.reference_error, name) for name in ("std_m", "expected_m", "p95_m"))
    np.testing.assert_allclose(shown.column("expected_error_m"), expected, rtol=0.06)
    np.testing.assert_allclose(shown.column("p95_m"), p95, rtol=0.06)
    assert (expected < std).all()
    assert (std < p95).all()


def test_a_worse_model_shows_more(clean: Run) -> None:
    noisy = with_noise(clean, STDS[0])
    wrong = [Model("icr", FrozenIcrs.constant(0.6, -0.6, 0.0))]
    report = dropout(noisy, [20.0], models=wrong)
    assert report.results[0].column("p95_m")[0] > 2 * report.document.reference_error[0].p95_m


def test_the_filters_own_states_hold_what_their_standard_deviations_promise(clean: Run) -> None:
    report = dropout(clean, HORIZONS_M, models=PERFECT)
    ratio = report.results[0].column("p95_m") / column_of(report.document.reference_error, "p95_m")
    assert (ratio < 1.2).all(), ratio
    assert (ratio > 0.1).all(), ratio


def test_horizons_without_trials_have_none(clean: Run) -> None:
    own = dropout(clean, [1.0, 900.0]).document.reference_error
    assert [row.p95_m is not None for row in own] == [True, False]
