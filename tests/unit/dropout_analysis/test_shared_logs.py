"""The fast analysis against direct integration on logs that nobody here tuned."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from icrtool.calibration.run_models import models_of
from icrtool.dropout_analysis.dropout_report import dropout
from icrtool.kernels.open_loop import open_loop_errors_direct
from icrtool.kernels.track import SHORT, trial_ends
from icrtool.records.run import track_of
from support.shared_runs import run_of_log

LOGS = {
    "real/warthog_grass.bag": "warthog",
    "real/warthog_asphalt": "warthog",
    "real/husky_parking_lot.bag": "husky-a200",
    "real/husky_wet_grass": "husky-a200",
    "simulated/tracked_curved.bag": "pentzer-tracked",
    "simulated/tracked_trouble": "pentzer-tracked",
    "simulated/wheeled_circle": "segway-rmp400",
    "simulated/wheeled_lawnmower": "segway-rmp400",
}
EQUAL_M = 1e-9
"""What the fast algorithm promises."""

LIDAR_JUMPS, CLEAN = (
    "real/husky_wet_grass",
    ("real/warthog_grass.bag", "real/warthog_asphalt", "simulated/tracked_trouble"),
)
WITHIN_M = 2.5
"""At 10 m (95 %), of a robot whose wheels stand for its motion; two paths of 10 m cannot end more than 20 m apart."""

MOST_STEPS = 1e6
"""Steps of direct integration a model and log: above, every so many-th start is tried."""


@pytest.mark.parametrize("name", LOGS)
def test_every_error_equals_brute_force(shared_logs: Path, name: str) -> None:
    run = run_of_log(shared_logs / name, LOGS[name])
    fast: dict[str, list[np.ndarray]] = {}
    report = dropout(run, starts="all", sink=lambda model, _, errors: fast.setdefault(model, []).append(errors.copy()))
    drive = track_of(run)
    ends = np.array(trial_ends(drive, report.horizons_m), order="F")
    furthest = ends.max(axis=1)
    steps = float((furthest - np.arange(len(ends)))[furthest >= 0].sum())
    stride = max(1, int(np.ceil(steps / MOST_STEPS)))
    left_out = np.arange(len(ends)) % stride > 0
    ends[left_out] = SHORT
    assert (ends >= 0).any()
    for model in models_of(run):
        errors = np.concatenate(fast[model.name], axis=1)
        errors[left_out] = np.nan
        np.testing.assert_allclose(
            errors, open_loop_errors_direct(drive, model.icrs, ends), rtol=0, atol=EQUAL_M, err_msg=model.name
        )


def test_lidar_poses_that_jump_by_metres_are_not_charged_to_the_robot(shared_logs: Path) -> None:
    run = run_of_log(shared_logs / LIDAR_JUMPS, LOGS[LIDAR_JUMPS])
    decided = [jump for jump in run.sensors.jumps if not jump.undecided]
    assert max(jump.size_m for jump in decided) > 10.0
    report = dropout(run, [10.0])
    for name in ("icr", "icr_final"):
        result = report.result(name)
        assert result is not None
        assert result.column("p95_m")[0] < WITHIN_M
    assert report.counts.trials[0] > report.counts.crosses_jump[0]


@pytest.mark.parametrize("name", CLEAN)
def test_references_without_jumps_keep_every_trial(shared_logs: Path, name: str) -> None:
    run = run_of_log(shared_logs / name, LOGS[name])
    assert not run.jumping.any()
