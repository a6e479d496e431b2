"""The dropout analysis: its trials, its counts, and what may not change it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import icrtool
from icrtool.calibration.run_models import Model, models_of
from icrtool.dropout_analysis import trials as module
from icrtool.dropout_analysis.dropout_report import dropout
from icrtool.dropout_analysis.starts import first_learned
from icrtool.errors import ConfigError, DataError
from icrtool.kernels.open_loop import open_loop_errors_direct
from icrtool.kernels.track import FrozenIcrs, trial_ends
from icrtool.records.dropout_document import ErrorRow, ModelResult, SummaryRow, column_of
from icrtool.records.run import ICR_COLUMNS, Run, track_of
from support.contract import SUMMARY_COLUMNS
from support.documents import with_summary

EQUAL_M = 1e-9
"""What the fast algorithm promises against direct integration."""

HORIZONS_M = (0.5, 1.0, 3.0, 10.0)

PARKED = {"speed_mps": 0.008, "turn_mps": 0.0, "troubles": False}
"""Below what counts as motion, and not refused as a robot that never moved."""


def gathered(run, horizons_m=HORIZONS_M, **options):
    """All single errors by model and horizon."""
    errors: dict[tuple[str, float], np.ndarray] = {}

    def sink(model, horizons, table):
        errors.update({(model, float(h)): table[:, i].copy() for i, h in enumerate(horizons)})

    return dropout(run, horizons_m, sink=sink, **options), errors


def changed(run: Run, **columns) -> Run:
    return replace(run, table=replace(run.table, **columns))


def test_every_single_error_equals_brute_force_for_all_models(run: Run) -> None:
    _, errors = gathered(run)
    drive, horizons = track_of(run), np.array(HORIZONS_M)
    ends = trial_ends(drive, horizons)
    assert [model.name for model in models_of(run)] == ["icr", "no_slip", "icr_final"]
    for model in models_of(run):
        expected = open_loop_errors_direct(drive, model.icrs, ends)
        for h, horizon in enumerate(HORIZONS_M):
            np.testing.assert_allclose(errors[model.name, horizon], expected[:, h], rtol=0, atol=EQUAL_M)


def test_the_summary_is_that_of_the_single_errors(run: Run) -> None:
    report, errors = gathered(run)
    frame = report.summary.set_index(["model", "horizon_m"])
    for key, error in errors.items():
        tried, row = error[~np.isnan(error)], frame.loc[key]
        assert row.trials == len(tried)
        for column, value in (
            ("expected_error_m", tried.mean()),
            ("p50_m", np.percentile(tried, 50)),
            ("p95_m", np.percentile(tried, 95)),
            ("max_m", tried.max()),
            ("p95_pct", 100 * np.percentile(tried, 95) / key[1]),
            ("expected_pct", 100 * tried.mean() / key[1]),
        ):
            assert row[column] == pytest.approx(value, rel=1e-12)


def numbers(result: ModelResult, row: type[ErrorRow] = ErrorRow) -> np.ndarray:
    return np.array([result.column(name) for name in row.__struct_fields__])


def test_the_contracts_columns_come_first(run: Run) -> None:
    assert list(icrtool.dropout(run, [1.0]).summary.columns)[:9] == SUMMARY_COLUMNS


def test_starts_that_are_no_trial_are_counted_by_kind(run: Run) -> None:
    report = dropout(run, HORIZONS_M)
    table, counts = run.table, report.counts
    assert report.states == len(table)
    distance, stamps = table.distance_m, table.stamp_ns
    (outage,) = run.outages_ns
    place_std, psi_std = np.hypot(table.std_north_m, table.std_east_m), table.std_heading_rad
    lost, after_gap = run.in_gap.copy(), False
    for k in range(1, len(table)):
        # states that are not known again after a gap are no start either
        after_gap |= bool(run.in_gap[k - 1])
        after_gap &= bool(place_std[k] > 2 * np.median(place_std) or psi_std[k] > 2 * np.median(psi_std))
        lost[k] |= after_gap
    for h, horizon in enumerate(HORIZONS_M):
        kinds = {"trials": 0, "short": 0, "gap": 0, "outage": 0}
        for k in range(len(table)):
            far = np.flatnonzero(distance[k:] - distance[k] >= horizon)
            if not len(far):
                kinds["short"] += 1
            elif lost[k : k + far[0]].any():
                kinds["gap"] += 1
            elif outage[0] < stamps[k + far[0]] < outage[1]:
                kinds["outage"] += 1
            else:
                kinds["trials"] += 1
        assert {kind: int(getattr(counts, kind)[h]) for kind in kinds} == kinds
        assert all(kinds.values())
        assert sum(kinds.values()) == len(table)
        assert not counts.standing.any()


def test_a_run_without_track_width_has_no_no_slip(make_run: Callable[..., Run]) -> None:
    report = dropout(make_run(track_width_m=None, duration_s=20.0), [1.0])
    assert [result.name for result in report.results] == ["icr", "icr_final"]
    assert report.result("no_slip") is None


def test_a_model_is_data(run: Run) -> None:
    models = [Model("mine", FrozenIcrs.constant(0.3, -0.3, 0.0))]
    mine, known = dropout(run, [5.0], models=models).result("mine"), dropout(run, [5.0]).result("no_slip")
    assert mine is not None
    assert known is not None
    np.testing.assert_allclose(numbers(mine), numbers(known), rtol=1e-12)
    assert dropout(run, [5.0], models=models).counts.trials == known.column("trials")


def test_rotating_and_shifting_the_world_changes_no_error(run: Run) -> None:
    _, before = gathered(run)
    angle, table = 2.0, run.table
    cos, sin = math.cos(angle), math.sin(angle)
    north, east = table.north_m * cos - table.east_m * sin, table.north_m * sin + table.east_m * cos
    moved = changed(run, north_m=north + 400.0, east_m=east - 900.0, heading_rad=table.heading_rad + angle)
    _, after = gathered(moved)
    for key, error in before.items():
        np.testing.assert_allclose(after[key], error, rtol=0, atol=EQUAL_M)


def test_neither_order_nor_company_of_horizons_matters(run: Run) -> None:
    report, errors = gathered(run)
    reverse, others = gathered(run, [*HORIZONS_M[::-1], 1.0, 7.0])
    assert reverse.horizons_m.tolist() == [0.5, 1.0, 3.0, 7.0, 10.0]
    for key, error in errors.items():
        np.testing.assert_allclose(others[key], error, rtol=0, atol=EQUAL_M)
    alone, together = dropout(run, [3.0]).results[0], report.results[0]
    assert alone.column("p95_low_m")[0] == pytest.approx(together.column("p95_low_m")[2], abs=EQUAL_M)


def test_small_tables_and_small_ranges_give_the_same(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    report = dropout(run, HORIZONS_M)
    monkeypatch.setattr(module, "LARGEST_TABLE_BYTES", 1)
    monkeypatch.setattr(module, "STARTS_AT_ONCE", 333)
    pieces = dropout(run, HORIZONS_M)
    np.testing.assert_array_equal(np.array(pieces.counts), np.array(report.counts))
    for ours, theirs in zip(pieces.results, report.results, strict=True):
        np.testing.assert_allclose(numbers(ours, SummaryRow), numbers(theirs, SummaryRow), rtol=0, atol=EQUAL_M)


def test_intervals_hold_the_estimate_and_depend_on_no_seed(run: Run) -> None:
    reports = [dropout(run, [2.0], seed=seed) for seed in (1, 2)]
    spans = [(r.results[0].column("p95_low_m")[0], r.results[0].column("p95_high_m")[0]) for r in reports]
    assert spans[0] == spans[1]
    assert spans[0][0] < reports[0].results[0].column("p95_m")[0] < spans[0][1]
    assert [r.document.intervals.seed for r in reports] == [1, 2]


def test_a_histogram_holds_all_trials_and_shows_the_bulk(run: Run) -> None:
    for result in dropout(run, HORIZONS_M).results:
        for h, bins in enumerate(result.histograms):
            assert bins.percent.sum() == pytest.approx(100.0)
            assert bins.right[-1] >= result.column("max_m")[h]
            assert len(bins.left) <= 600
            assert np.count_nonzero(bins.left < result.column("p95_m")[h]) >= 6


def test_horizons_default_to_the_configured_ones(run: Run) -> None:
    assert run.config.dropout.horizons_m == tuple(float(d) for d in range(1, 21))
    assert dropout(with_summary(run, config={"dropout": {"horizons_m": [4.0, 2.0]}})).horizons_m.tolist() == [2.0, 4.0]


@pytest.mark.parametrize("horizons", [[], [0.0], [-1.0], [math.inf], [math.nan]])
def test_horizons_that_are_no_distances_are_refused(run: Run, horizons: list[float]) -> None:
    with pytest.raises(ConfigError, match="horizons"):
        dropout(run, horizons)


def test_a_run_of_one_state_is_refused(run: Run) -> None:
    stub = changed(run, **{name: column[:1] for name, column in run.table.columns().items()})
    with pytest.raises(DataError, match="1 state;"):
        dropout(stub, [1.0])


def test_a_drive_shorter_than_every_horizon_has_no_numbers(make_run: Callable[..., Run]) -> None:
    report = dropout(make_run(duration_s=12.0, troubles=False), [500.0])
    assert report.counts.trials.tolist() == [0]
    assert np.isnan(report.results[0].column("p95_m")).all()
    assert np.isnan(report.summary.p95_pct).all()


@pytest.fixture
def stopping(run: Run) -> Run:
    """The drive with two stops put into it: 40 and 400 states at which the robot stands."""
    rows = np.concatenate([np.arange(0, 300), np.full(40, 300), np.arange(300, 1200), np.full(400, 1200),
                           np.arange(1200, len(run.table))])  # fmt: skip
    columns = {name: column[rows].copy() for name, column in run.table.columns().items()}
    stood = np.append(np.diff(rows) == 0, False)
    step = np.append(np.diff(run.table.stamp_ns), 0)[rows]
    step[stood] = 20_000_000
    stamps = run.table.stamp_ns[0] + np.concatenate([[0], np.cumsum(step[:-1])])
    columns |= {"stamp_ns": stamps, "t_s": (stamps - stamps[0]) / 1e9}
    columns |= {name: np.where(stood, 0.0, columns[name]) for name in ("v_left_mps", "v_right_mps")}
    outages = np.interp(run.outages_ns, run.table.stamp_ns, stamps[np.searchsorted(rows, np.arange(len(run.table)))])
    return replace(
        run, table=replace(run.table, **columns), in_gap=run.in_gap[rows] & ~stood, outages_ns=outages.astype(np.int64)
    )


def test_a_standstill_counts_once_whatever_its_length(run: Run, stopping: Run) -> None:
    without, moving = dropout(run, HORIZONS_M), dropout(stopping, HORIZONS_M)
    every = dropout(stopping, HORIZONS_M, starts="all")
    np.testing.assert_array_equal(moving.counts.trials, without.counts.trials)
    np.testing.assert_array_equal(moving.counts.standing, 440)
    np.testing.assert_array_equal(every.counts.trials, without.counts.trials + 440)
    for ours, theirs in zip(moving.results, without.results, strict=True):
        np.testing.assert_allclose(numbers(ours), numbers(theirs), rtol=0, atol=EQUAL_M)
    for report in (moving, every):
        assert sum(int(column[0]) for column in report.counts) == report.states == len(stopping.table)
        assert report.standing == 440
    assert not np.allclose(every.results[0].column("p95_m"), moving.results[0].column("p95_m"), rtol=1e-3)


def test_trials_before_and_after_the_icrs_were_learned_are_all_trials(run: Run) -> None:
    report, errors = gathered(run)
    split, icr, table = report.document.by_learning, report.result("icr"), run.table
    assert split is not None
    assert icr is not None
    assert split.learned_s is not None
    sides = [column_of(side, "trials") for side in (split.before, split.after)]
    np.testing.assert_array_equal(sum(sides), icr.column("trials"))
    early = table.t_s < split.learned_s
    for h, horizon in enumerate(HORIZONS_M):
        for part, rows in ((split.before, early), (split.after, ~early)):
            tried = errors["icr", horizon][rows]
            tried = tried[~np.isnan(tried)]
            assert part[h].trials == len(tried)
            assert part[h].p95_m == pytest.approx(np.percentile(tried, 95))
            assert part[h].expected_error_m == pytest.approx(tried.mean())


def test_icrs_are_learned_when_their_standard_deviations_have_fallen(run: Run, make_run: Callable[..., Run]) -> None:
    row = first_learned(run)
    assert row is not None
    assert 0 < run.table.t_s[row] < 20.0
    stds = np.array([getattr(run.table, f"std_{name}") for name in ICR_COLUMNS])
    settled = np.median(stds[:, stds.shape[1] // 2 :], axis=1)
    limit = settled + 0.1 * (stds[:, 0] - settled)
    assert (stds[:, row] <= limit).all()
    assert (stds[:, :row] > limit[:, None]).any(axis=0).all()
    assert first_learned(make_run(duration_s=20.0, turn_mps=0.0, troubles=False)) is None
    known = {f"std_{name}": np.full(len(run.table), 0.02) for name in ICR_COLUMNS}
    assert first_learned(changed(run, **known)) == 0
    assert first_learned(changed(run, **{name: 10 * std for name, std in known.items()})) is None
    start = {"icrs_m": [0.7, -0.7, 0.0], "covariance_m2": (1e-4 * np.eye(3)).tolist()}
    warm = with_summary(run, filter={"warm_start": start})
    assert first_learned(warm) == 0


def test_standing_states_are_counted(make_run: Callable[..., Run]) -> None:
    assert dropout(make_run(duration_s=20.0, troubles=False), [1.0]).standing == 0
    parked = make_run(duration_s=20.0, **PARKED)
    assert dropout(parked, [1.0]).standing == len(parked.table) - 1


def test_two_models_of_one_name_are_refused(run: Run) -> None:
    model = models_of(run)[0]
    with pytest.raises(ValueError, match="same name"):
        dropout(run, [1.0], models=[model, model])
