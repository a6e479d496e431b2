"""Single blind drives: the worst ones, the examples."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from icrtool.calibration.run_models import compare_models, models_of
from icrtool.dropout_analysis.shown_paths import example_trials, worst_trials
from icrtool.kernels.open_loop import open_loop_errors_direct
from icrtool.kernels.track import trial_ends
from icrtool.motion.recording import Trials
from icrtool.records.run import Run, track_of

EQUAL_M = 1e-9


def errors_of(run: Run, horizon_m: float, model: int = 0) -> tuple[np.ndarray, np.ndarray]:
    drive = track_of(run)
    ends = trial_ends(drive, np.array([horizon_m]))
    return open_loop_errors_direct(drive, models_of(run)[model].icrs, ends)[:, 0], ends[:, 0]


def test_the_worst_trials_are_the_largest_that_do_not_overlap(run: Run) -> None:
    errors, ends = errors_of(run, 3.0)
    expected: list[tuple[int, int]] = []
    for start in np.argsort(-np.nan_to_num(errors, nan=-1.0), kind="stable"):
        span = (int(start), int(ends[start]))
        if not np.isnan(errors[start]) and all(span[1] < begin or end < span[0] for begin, end in expected):
            expected.append(span)
    worst = worst_trials(run, horizon_m=3.0, count=6)
    assert [(drive.start, drive.end) for drive in worst] == expected[:6]
    assert len(worst) == 6
    of_icr = [drive.document.errors_m["icr"] for drive in worst]
    assert of_icr == sorted(of_icr, reverse=True)


def test_the_worst_trials_are_those_of_the_recommended_model(make_run: Callable[..., Run]) -> None:
    run = make_run(duration_s=150.0, troubles=False)
    compared = compare_models(run)
    row = next(row for row in compared.rows if row.name == "recommended")
    ends = trial_ends(track_of(run), np.array([5.0]))[compared.table.trials[0].starts]
    errors = row.errors_of(Trials(compared.table.trials[0].starts, ends)).position[:, 0]
    worst = worst_trials(run, compared, 5.0, count=3)
    assert {one.document.model for one in worst} == {"recommended"}
    assert worst[0].start == compared.table.trials[0].starts[np.nanargmax(errors)]
    assert worst[0].document.errors_m["recommended"] == pytest.approx(np.nanmax(errors), abs=1e-4)
    assert set(worst[0].paths) == {"icr", "no_slip", "recommended", "controller", "adaptive"}


def test_fewer_drives_fit_than_are_asked_for(run: Run) -> None:
    worst = worst_trials(run, horizon_m=10.0)
    assert 1 <= len(worst) < 10
    spans = sorted((drive.start, drive.end) for drive in worst)
    assert all(earlier[1] < later[0] for earlier, later in pairwise(spans))


def test_a_drive_tells_time_place_turn_speed_and_paths(run: Run) -> None:
    drive, table = worst_trials(run, horizon_m=3.0)[0], run.table
    k, j = drive.start, drive.end
    assert (drive.document.stamp_ns, drive.document.t_s) == (table.stamp_ns[k], table.t_s[k])
    assert (drive.document.north_m, drive.document.east_m) == (table.north_m[k], table.east_m[k])
    assert drive.document.heading_change_deg == np.degrees(table.heading_rad[j] - table.heading_rad[k])
    assert drive.document.speed_mean_mps == pytest.approx(3.0 / (table.t_s[j] - table.t_s[k]), rel=0.02)
    assert drive.reference_north_m.tolist() == table.north_m[k : j + 1].tolist()
    for number, name in enumerate(("icr", "no_slip")):
        path, (errors, _) = drive.paths[name], errors_of(run, 3.0, number)
        assert len(path.north) == j - k + 1
        assert (path.north[0], path.east[0]) == (drive.document.north_m, drive.document.east_m)
        assert drive.document.errors_m[name] == pytest.approx(errors[k], abs=EQUAL_M)


def test_examples_are_a_turning_and_a_straight_drive_with_ordinary_errors(run: Run) -> None:
    cornering, straight = example_trials(run, 5.0)
    errors, ends = errors_of(run, 5.0)
    turned = np.abs(run.table.heading_rad[np.maximum(ends, 0)] - run.table.heading_rad)[ends >= 0]
    assert abs(cornering.document.heading_change_deg) >= np.degrees(turned.max()) - 10.5
    assert abs(straight.document.heading_change_deg) < np.degrees(np.median(turned))
    for drive in (cornering, straight):
        assert errors[drive.start] < np.nanmax(errors)


def test_no_drive_is_long_enough(make_run: Callable[..., Run]) -> None:
    parked = make_run(duration_s=20.0, speed_mps=0.01, troubles=False)
    assert worst_trials(parked) == ()
    assert example_trials(parked) == ()
