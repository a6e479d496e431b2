"""The smoother as the reference: nearer to where the robot was, and nothing else changes."""

from __future__ import annotations

import numpy as np
import pytest

from icrtool.calibration.run_models import models_of
from icrtool.config import parse_config
from icrtool.dropout_analysis.dropout_report import dropout
from icrtool.dropout_analysis.starts import with_smoothed_reference
from icrtool.pipeline import fit
from icrtool.records.presets import FIELD
from icrtool.records.run import Run
from support.drives import ICRS, make_log
from support.matrix_filter import step_state

CONFIG = parse_config({"robot": {"track_width_m": 0.6}})
NOISY_M = 0.3


@pytest.fixture(scope="module")
def noisy() -> Run:
    return fit(make_log(3, 120.0, gnss_std=NOISY_M), CONFIG, smooth=True)


def true_places(run: Run) -> np.ndarray:
    """Drive the log's wheel speeds with its true ICRs from its true start, in steps as the log was made."""
    wheels = run.sensors.wheels
    x = np.array([10.0, -5.0, 0.3, *ICRS])
    places = [x[:2]]
    for k, dt in enumerate(np.diff(wheels.stamp_ns) / 1e9):
        x = step_state(x, wheels.v_left_mps[k], wheels.v_right_mps[k], dt, FIELD.step_heading)
        places.append(x[:2])
    first = len(places) - len(run.table)
    return np.array(places[first:])


def test_with_poor_fixes_the_smoother_is_nearer_to_the_truth_than_the_filter(noisy: Run) -> None:
    run = noisy
    truth, judged = true_places(run), with_smoothed_reference(run)
    misses = [
        float(np.sqrt(((np.column_stack([table.north_m, table.east_m]) - truth) ** 2).sum(axis=1).mean()))
        for table in (judged.table, run.table)
    ]
    assert misses[0] < 0.7 * misses[1]
    assert misses[1] < NOISY_M


def test_models_starts_and_trials_stay_the_filters(noisy: Run) -> None:
    run = noisy
    judged = with_smoothed_reference(run)
    for one, other in zip(models_of(judged), models_of(run), strict=True):
        assert all(np.array_equal(a, b) for a, b in zip(one.icrs, other.icrs, strict=True))
    held, plain = (dropout(one, [5.0]) for one in (judged, run))
    assert np.array_equal(held.counts.trials, plain.counts.trials)
    # with constants near the true ones the miss is the reference's own: less of it with the smoother
    assert (
        held.result("icr_final").column("expected_error_m")[0] < plain.result("icr_final").column("expected_error_m")[0]
    )
