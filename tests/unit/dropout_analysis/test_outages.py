"""Outages: planned, forced on the filter, and those the log really had."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from icrtool.config import load_config
from icrtool.dropout_analysis.shown_paths import force_outages, plan_outages, real_outages
from icrtool.errors import ConfigError, DataError
from icrtool.kernels.filter_records import GATED, RECOVERED, USED
from icrtool.logs.read_log import read_log
from icrtool.pipeline import fit
from icrtool.records.run import STATE_COLUMNS, Run, WarmStart, track_of
from support.barn import OUTAGE_S, START_NS, configured, simulate
from support.documents import with_summary
from support.matrix_filter import step_state

SPEEDS = ("v_left_mps", "v_right_mps")


@pytest.fixture(scope="module")
def clean(make_run: Callable[..., Run]) -> Run:
    return make_run(troubles=False)


def seconds(run: Run, spans: tuple[tuple[int, int], ...]) -> list[tuple[float, float]]:
    origin = int(run.table.stamp_ns[0])
    return [((begin - origin) / 1e9, (end - origin) / 1e9) for begin, end in spans]


def test_spaced_outages_leave_half_of_the_drive_to_learn(clean: Run) -> None:
    last = clean.table.t_s[-1]
    for length in (1.0, 4.0, 10.0):
        spans = seconds(clean, plan_outages(clean, length))
        assert 1 <= len(spans) <= 10
        assert len(spans) * length <= last / 2
        assert spans[0][0] > 0
        assert spans[-1][1] <= last
        assert all(end - begin == pytest.approx(length) for begin, end in spans)
        pauses = [later[0] - earlier[1] for earlier, later in pairwise(spans)]
        assert all(pause > 0 for pause in pauses)
        assert pauses == pytest.approx(pauses[:1] * len(pauses), abs=0.03)


def test_no_spaced_outage_begins_where_the_robot_stands(clean: Run) -> None:
    t, way = clean.table.t_s, clean.table.distance_m
    stood = np.interp(np.where(t < 20, t, np.maximum(t - 20, 20)), t, way)
    speeds = {name: np.where((t > 20) & (t < 40), 0.0, getattr(clean.table, name)) for name in SPEEDS}
    parked = replace(clean, table=replace(clean.table, distance_m=stood, **speeds))
    spans = seconds(parked, plan_outages(parked, 2.0))
    assert len(spans) > 3
    for begin, end in spans:
        assert not 20 < begin < 39.9
        assert float(np.diff(np.interp([begin, end], t, stood))[0]) > 0.05


def test_no_outage_reaches_into_one_of_the_logs_own(run: Run) -> None:
    origin = int(run.table.stamp_ns[0])
    ((own_begin, own_end),) = [((a - origin) / 1e9, (b - origin) / 1e9) for a, b in run.outages_ns.tolist()]
    spans = seconds(run, plan_outages(run, 2.0))
    assert len(spans) > 3
    assert all(end <= own_begin + 0.03 or begin >= own_end - 0.03 for begin, end in spans)
    with pytest.raises(ConfigError, match="overlaps an outage of the log itself"):
        plan_outages(run, 2.0, (own_begin - 1.0,))


@pytest.mark.parametrize("length_s", [1.0, 2.0, 3.0])
def test_no_spaced_outage_reaches_into_a_gap_in_the_wheel_data(run: Run, length_s: float) -> None:
    (gap,) = np.flatnonzero(run.in_gap)
    begin_s, end_s = run.table.t_s[[gap, gap + 1]]
    spans = plan_outages(run, length_s)
    assert len(spans) > 3
    assert all(end <= begin_s + 0.03 or begin >= end_s for begin, end in seconds(run, spans))
    assert len(force_outages(run, spans)) == len(spans)


def test_an_outage_that_takes_nothing_away_is_refused(clean: Run) -> None:
    for length, begin in ((5.0, 0.0), (1e-6, 20.0)):
        with pytest.raises(ConfigError, match="fewer than two states"):
            force_outages(clean, plan_outages(clean, length, (begin,)))


def test_outages_do_not_change_how_headings_at_odd_times_are_weighed(make_run: Callable[..., Run]) -> None:
    log = simulate(troubles=False)
    # A little more than half of the headings come at a third of the rate: without some of them the median interval
    # would be that of the others.
    rows = np.arange(len(log.heading.stamp_ns))
    kept = (rows < len(rows) * 0.24) | (rows % 3 == 0)
    columns = {field.name: getattr(log.heading, field.name) for field in fields(log.heading)}
    thinned = {name: column[kept] for name, column in columns.items() if isinstance(column, np.ndarray)}
    heading = replace(log.heading, **thinned)
    run = fit(replace(log, heading=heading))
    assert force_outages(run, plan_outages(run, 15.0, (40.0,)))


def test_outages_stand_where_they_are_asked_for(clean: Run) -> None:
    assert seconds(clean, plan_outages(clean, 5.0, (30.0, 12.0))) == [(12.0, 17.0), (30.0, 35.0)]


@pytest.mark.parametrize(
    ("length", "at", "why"),
    [
        (0.0, (), "no duration"),
        (-1.0, (3.0,), "no duration"),
        (100.0, (), "too long"),
        (5.0, (58.0,), "does not fit"),
        (5.0, (-1.0,), "does not fit"),
        (5.0, (10.0, 14.0), "reaches the next outage"),
        (5.0, (10.0, 15.0), "reaches the next outage"),
    ],
)
def test_outages_that_do_not_fit_are_refused(clean: Run, length: float, at: tuple[float, ...], why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        plan_outages(clean, length, at)


def test_a_forced_outage_is_driven_open_loop_with_the_icrs_of_its_begin(clean: Run) -> None:
    (outage,) = force_outages(clean, plan_outages(clean, 8.0, (20.0,)))
    table = clean.table
    first, last = np.searchsorted(table.t_s, [20.0, 28.0])
    # The state at the begin's own stamp has lost its fix and its heading already: the last one with them is before.
    before = int(first) - 1
    x = np.array([getattr(table, column)[before] for column in STATE_COLUMNS])
    path = []
    for k in range(before, last - 1):
        x = step_state(x, table.v_left_mps[k], table.v_right_mps[k], table.t_s[k + 1] - table.t_s[k], 0.5)
        path.append(x[:2])
    north, east = np.array(path).T
    np.testing.assert_allclose(outage.north_m, north, rtol=0, atol=1e-9)
    np.testing.assert_allclose(outage.east_m, east, rtol=0, atol=1e-9)
    away = np.hypot(north - table.north_m[first:last], east - table.east_m[first:last])
    assert outage.document.end_error_m == pytest.approx(away[-1], abs=1e-9)
    assert outage.document.max_error_m == pytest.approx(away.max(), abs=1e-9)
    assert (outage.document.kind, outage.document.begin_s, outage.document.end_s) == ("forced", 20.0, 28.0)
    assert outage.document.distance_m == pytest.approx(table.distance_m[last - 1] - table.distance_m[first])


def test_the_filter_learns_on_after_a_forced_outage(clean: Run) -> None:
    alone = force_outages(clean, plan_outages(clean, 5.0, (40.0,)))[0]
    after_another = force_outages(clean, plan_outages(clean, 5.0, (20.0, 40.0)))[1]
    assert after_another.document.end_error_m == pytest.approx(alone.document.end_error_m, abs=0.05)


def test_an_outage_is_never_better_than_none_and_none_costs_nothing(clean: Run) -> None:
    short, long = (force_outages(clean, plan_outages(clean, length, (20.0,)))[0] for length in (0.1, 15.0))
    assert 0 <= short.document.max_error_m < 0.03 < long.document.max_error_m
    for outage in (short, long):
        assert outage.document.end_error_m <= outage.document.max_error_m


def test_a_warm_started_run_is_made_again_from_its_own_start(clean: Run) -> None:
    warm = fit(
        simulate(troubles=False), clean.config, warm_start=WarmStart(np.array([0.9, -0.4, 0.2]), 1e-4 * np.eye(3))
    )
    (cold_outage,), (outage,) = (force_outages(run, plan_outages(run, 5.0, (2.0,))) for run in (clean, warm))
    assert outage.document.end_error_m != pytest.approx(cold_outage.document.end_error_m, rel=0.01)
    cold = with_summary(warm, filter={"warm_start": None})
    with pytest.raises(DataError, match="cannot be made again"):
        force_outages(cold, plan_outages(warm, 5.0, (20.0,)))


def test_a_run_with_terrain_changes_is_made_again_with_them(clean: Run) -> None:
    changing = fit(simulate(troubles=False), clean.config, changes_s=(15.0,))
    assert len(force_outages(changing, plan_outages(changing, 5.0, (20.0,)))) == 1


def test_a_real_outage_is_compared_with_the_fixes_that_ended_it(run: Run) -> None:
    (outage,), table = real_outages(run), run.table
    (begin, end), origin = run.outages_ns[0], table.stamp_ns[0]
    one = outage.document
    assert (one.kind, one.begin_s, one.end_s) == ("real", (begin - origin) / 1e9, (end - origin) / 1e9)
    first, last = np.searchsorted(table.stamp_ns, [begin, end])
    assert outage.document.distance_m == pytest.approx(table.distance_m[last] - table.distance_m[first])
    fix = int(np.flatnonzero(run.gnss.stamp_ns == end)[0])
    fixes = run.sensors.fixes
    error = np.hypot(outage.north_m[-1] - fixes.north_m[fix], outage.east_m[-1] - fixes.east_m[fix])
    # several fixes of 0.01 m are compared, and the path drifts on for a second
    assert outage.document.end_error_m == outage.document.max_error_m == pytest.approx(error, abs=0.05)
    assert 0 < error < 1.0
    assert len(outage.north_m) == last - first + 1


def test_a_real_outage_that_never_ends_or_spans_a_wheel_gap_has_no_miss(run: Run) -> None:
    (begin, end), last = run.outages_ns[0], int(run.table.stamp_ns[-1])
    endless = replace(run, outages_ns=np.array([[begin, last + 1]]))
    assert real_outages(endless) == ()
    gap = int(run.table.stamp_ns[np.flatnonzero(run.in_gap)[0]])
    across = replace(run, outages_ns=np.array([[gap - 10**9, gap + 10**9]]))
    assert real_outages(across) == ()
    assert end > begin


def test_an_outage_lasts_until_a_fix_is_used_again_and_its_error_is_that_of_the_fixes() -> None:
    # The fixes after the outage are 3 m away from where the filter drove to: it rejects them for a second.
    log = simulate()
    away = (log.gnss.stamp_ns - START_NS) / 1e9 >= OUTAGE_S[1]
    moved = fit(replace(log, gnss=replace(log.gnss, north_m=log.gnss.north_m + 3.0 * away)), configured())
    stamps, code = moved.gnss.stamp_ns, moved.gnss.code
    (begin, end), origin = moved.outages_ns[0], moved.table.stamp_ns[0]
    inside = (stamps > begin) & (stamps < end)
    assert (code[inside] == GATED).all()
    assert inside.any()
    assert code[stamps == end] == RECOVERED
    (outage,) = (one for one in real_outages(moved) if one.document.begin_s == (begin - origin) / 1e9)
    assert outage.document.end_error_m == pytest.approx(3.0, abs=0.15)
    # No trial ends where the filter was without fixes; from the outage's end on it is where the fixes are.
    drive = track_of(moved)
    assert drive.in_outage[np.searchsorted(moved.table.stamp_ns, stamps[inside])].all()
    first, fix = np.searchsorted(moved.table.stamp_ns, end), np.searchsorted(stamps, end)
    assert not drive.in_outage[first]
    assert abs(drive.north[first] - moved.sensors.fixes.north_m[fix]) < 0.1


def test_the_end_error_of_a_real_outage_is_near_the_truth(shared_logs: Path) -> None:
    log = shared_logs / "simulated" / "tracked_trouble"
    # the wheels of another robot, uncorrected, so that the error is large
    config = load_config(robot="jackal", sets=["wheels.left_scale=1", "wheels.right_scale=1"])
    run = fit(read_log(log, config), config)
    outage = max(real_outages(run), key=lambda one: one.document.end_s - one.document.begin_s)
    with np.load(log.with_name(f"{log.name}.truth.npz")) as columns:
        truth = dict(columns)
    # Fixes and truth have the same axes; the datum is where they differ, and fixes wander by 0.2 m about it.
    fixes, seconds = run.sensors.fixes, (run.sensors.fixes.stamp_ns - run.table.stamp_ns[0]) / 1e9
    before = (run.gnss.code == USED) & (seconds < outage.document.begin_s)
    off = []
    for name, measured, path in (("z_north", fixes.north_m, outage.north_m), ("z_east", fixes.east_m, outage.east_m)):
        datum = np.median(measured[before] - np.interp(seconds[before], truth["t"], truth[name]))
        off.append(path[-1] - datum - np.interp(outage.document.end_s, truth["t"], truth[name]))
    assert np.hypot(*off) > 0.5
    assert outage.document.end_error_m == pytest.approx(np.hypot(*off), abs=0.2)
