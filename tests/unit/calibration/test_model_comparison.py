"""The comparison: nothing left out reaches a fit, all rows stand on the same trials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import icrtool
from icrtool.calibration.pooled import gyro_line, recording_of
from icrtool.calibration.run_models import ComparedModels, _errors_turned, compare_models
from icrtool.config import parse_config
from icrtool.errors import DataError
from icrtool.estimation.odometry import measured_headings
from icrtool.kernels.arrays import Floats
from icrtool.kernels.track import FrozenIcrs
from icrtool.motion.recording import cut_trials
from icrtool.pipeline import fit
from icrtool.records.measurements import MeasuredHeading
from icrtool.records.run import Run, track_of
from support.drives import make_log

CONFIG = parse_config({"robot": {"track_width_m": 0.6}})
ROUNDING_M = 1e-6
CHORD_M = 1e-5
"""The lever moves along its arc with a measured heading, along the chord of each turn in steps: over 5 m, 3 um."""


def compared_errors(run: Run, headings: Sequence[MeasuredHeading] = ()) -> tuple[ComparedModels, dict[str, Floats]]:
    """Return the comparison, and by row the errors in its trials."""
    found = compare_models(run, headings)
    return found, {row.name: row.errors_of(found.table.trials[0]).position for row in found.rows}


@pytest.fixture(scope="module")
def run() -> Run:
    return fit(make_log(0, 180.0, rate=20.0), CONFIG)


@pytest.fixture(scope="module")
def with_headings(run: Run) -> tuple[ComparedModels, dict[str, Floats]]:
    return compared_errors(run, measured_headings(run))


@pytest.fixture(scope="module")
def with_gyro(run: Run) -> tuple[ComparedModels, dict[str, Floats]]:
    """With a gyro that has a scale and a bias."""
    return compared_errors(run, [MeasuredHeading("gyro", 0.97 * run.table.heading_rad + 0.01 * run.table.t_s)])


def test_along_a_true_heading_the_path_is_the_models_own(run: Run) -> None:
    """A gyro that turns as the wheels do with the ICRs: steps along the middle of each turn."""
    table, width = run.table, 1.1
    dt = np.append(np.diff(table.t_s), 0.0)
    turned = np.concatenate([[0.0], np.cumsum(dt * (table.v_left_mps - table.v_right_mps) / width)[:-1]])
    # the reference turns as the gyro does, so that its scale and bias are one and zero
    run = replace(run, table=replace(table, heading_rad=turned))
    recording = recording_of(run, MeasuredHeading("gyro", turned))
    trials = cut_trials(recording, (5.0,))
    icrs = FrozenIcrs.constant(0.5, -0.6, 0.1)
    found = _errors_turned(run, recording, icrs, partial(gyro_line, recording), trials).position
    ahead = (0.5 * table.v_left_mps + 0.6 * table.v_right_mps) / width
    aside = -0.1 * (table.v_left_mps - table.v_right_mps) / width
    step = (dt * (ahead + 1j * aside))[:-1] * np.exp(0.5j * (turned[1:] + turned[:-1]))
    place = np.concatenate([[0.0], np.cumsum(step)])
    reference = table.north_m + 1j * table.east_m
    some = trials.ends[:, 0] >= 0
    s, e = trials.starts[some], trials.ends[some, 0]
    assert len(s) > 300
    expected = np.abs(place[e] - place[s] - (reference[e] - reference[s]))
    assert np.max(np.abs(found[some, 0] - expected)) < CHORD_M


def test_a_gyro_is_scaled_and_refused_where_it_does_not_turn(
    run: Run, with_gyro: tuple[ComparedModels, dict[str, Floats]]
) -> None:
    heading = run.table.heading_rad
    _, exact = compared_errors(run, [MeasuredHeading("gyro", heading.copy())])
    found, scaled = with_gyro
    assert found.heading == "gyro"
    p95 = [np.nanpercentile(errors["icr_final_gyro"][:, 1], 95) for errors in (exact, scaled)]
    assert p95[1] == pytest.approx(p95[0], abs=0.01)
    other = compare_models(run, [MeasuredHeading("gyro", 0.1 * heading)])
    assert other.heading == ""
    assert "does not turn with the robot" in other.notes[0].text


def test_a_gyro_of_the_other_sign_is_turned_and_reported(
    run: Run, with_gyro: tuple[ComparedModels, dict[str, Floats]]
) -> None:
    angle = 0.97 * run.table.heading_rad + 0.01 * run.table.t_s
    usual, turned = with_gyro, compared_errors(run, [MeasuredHeading("gyro", -angle)])
    known = {one.text for one in usual[0].notes}
    assert {one.text for one in turned[0].notes} - known == {
        "the gyro counts turns in the other direction; its sign was changed"
    }
    for name, errors in usual[1].items():
        assert np.allclose(errors, turned[1][name], atol=ROUNDING_M, equal_nan=True)


def test_all_rows_have_errors_in_the_same_trials(with_headings: tuple[ComparedModels, dict[str, Floats]]) -> None:
    found, errors = with_headings
    assert list(errors) == [
        "controller", "recommended", "no_slip_heading", "controller_heading", "recommended_heading", "icr_heading",
        "icr_final_heading", "adaptive", "adaptive_heading",
    ]  # fmt: skip
    for one in errors.values():
        assert np.array_equal(np.isfinite(one), found.table.trials[0].ends >= 0)


def test_the_path_of_a_row_ends_where_its_trial_does(
    run: Run, with_headings: tuple[ComparedModels, dict[str, Floats]]
) -> None:
    found, errors = with_headings
    drive, (start, end) = track_of(run), (found.table.trials[0].starts, found.table.trials[0].ends[:, 1])
    for row in found.rows:
        if row.path is None:
            continue
        for k in np.flatnonzero(end >= 0)[::200]:
            path = row.path(int(start[k]), int(end[k]))
            assert path is not None
            off = np.hypot(path.north[-1] - drive.north[end[k]], path.east[-1] - drive.east[end[k]])
            assert off == pytest.approx(errors[row.name][k, 1], abs=CHORD_M)
            assert (path.north[0], path.east[0]) == pytest.approx((drive.north[start[k]], drive.east[start[k]]))


def test_the_whole_model_predicts_better_than_the_momentary_icrs(run: Run) -> None:
    report = icrtool.dropout_report(run, horizons_m=[10.0])
    p95 = {one.name: float(one.column("p95_m")[0]) for one in report.results}
    # of a robot whose ICRs are constant, momentary ones are as good once they are learned
    assert p95["recommended"] < 1.1 * p95["icr"] < p95["no_slip"]


def test_where_the_place_of_the_position_is_not_known_a_note_states_it(run: Run) -> None:
    notes = " ".join(one.text for one in compare_models(run).notes)
    assert "ahead of and to the right of the body's origin" in notes
    frames = {"antenna_forward_m": 0.2, "antenna_right_m": 0.0}
    config = parse_config({"robot": {"track_width_m": 0.6}, "frames": frames})
    placed = fit(make_log(0, 180.0, rate=20.0), config)
    assert "body's origin" not in " ".join(one.text for one in compare_models(placed).notes)


def test_too_short_a_drive_is_refused() -> None:
    with pytest.raises(DataError, match="too short to fit on one part"):
        compare_models(fit(make_log(0, 30.0), CONFIG))


def test_the_whole_model_beats_momentary_icrs_on_the_shared_logs(shared_logs) -> None:
    """p95 at 10 m, held out, 1.5 times better, median over simulated logs."""
    robots = {
        "tracked_curved.bag": "pentzer-tracked",
        "tracked_trouble": "pentzer-tracked",
        "wheeled_circle": "segway-rmp400",
    }
    ratios = []
    for name, robot in robots.items():
        config = icrtool.load_config(robot=robot)
        run = icrtool.fit(icrtool.read_log(shared_logs / "simulated" / name, config), config)
        p95 = {
            one.name: float(one.column("p95_m")[0]) for one in icrtool.dropout_report(run, horizons_m=[10.0]).results
        }
        ratios.append(p95["icr"] / p95["recommended"])
    assert np.median(ratios) > 1.5
