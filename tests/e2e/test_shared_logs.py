"""Logs that nobody here tuned, where they are present: recorded and simulated robots, foreign containers."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import icrtool
from icrtool.errors import IcrToolError, LogError, MissingStreamError
from support.shared_runs import run_of_log

RUNS = {
    "simulated/wheeled_lawnmower": ("segway-rmp400", (0.74, -0.73, 0.02)),
    "simulated/tracked_curved.bag": ("pentzer-tracked", (0.38, -0.38, 0.12)),
    "simulated/wheeled_circle": ("segway-rmp400", (0.79, -0.81, 0.0)),
    "real/warthog_grass.bag": ("warthog", (0.93, -0.93, 0.0)),
    "real/warthog_asphalt": ("warthog", (0.93, -0.93, 0.0)),
}
ICR_TOLERANCE_M = 0.1
"""The ICRs of a real robot differ by ground and manoeuvre; half a decimetre either way is what the runs show."""


@pytest.mark.parametrize("name", RUNS)
def test_the_learned_icrs_of_known_robots_are_where_they_should_be(shared_logs: Path, name: str) -> None:
    robot, expected = RUNS[name]
    run = run_of_log(shared_logs / name, robot)
    final = run.summary["icr"]["final"]
    assert [final["y_icr_right_m"], final["y_icr_left_m"]] == pytest.approx(expected[:2], abs=ICR_TOLERANCE_M)
    assert final["x_icr_m"] == pytest.approx(expected[2], abs=ICR_TOLERANCE_M)
    report = icrtool.dropout(run)
    icr, no_slip = report.result("icr"), report.result("no_slip")
    assert icr is not None
    assert no_slip is not None
    assert (icr.column("expected_error_m") < no_slip.column("expected_error_m")).all()


@pytest.mark.parametrize(
    ("name", "robot"), [("real/husky_wet_grass", "husky-a200"), ("real/husky_parking_lot.bag", "husky-a200")]
)
def test_recorded_logs_of_poor_quality_run_sanely_and_say_what_is_wrong(
    shared_logs: Path, name: str, robot: str
) -> None:
    run = run_of_log(shared_logs / name, robot)
    assert run.warnings
    assert run.table.y_icr_right_m[-1] > 0 > run.table.y_icr_left_m[-1]
    assert np.hypot(run.table.north_m, run.table.east_m).max() < 300.0
    json.dumps(run.summary, allow_nan=False)


def test_the_troubled_log_runs_finds_the_heading_offset_and_rejects_the_outliers(shared_logs: Path) -> None:
    run = run_of_log(shared_logs / "simulated/tracked_trouble", "pentzer-tracked")
    assert run.summary["heading"]["applied_offset_deg"] == pytest.approx(12.0, abs=0.5)
    assert 40 <= run.summary["gnss"]["rejected_by_gate"] <= 70
    assert len(run.outages_ns) == 1


@pytest.mark.parametrize("name", ["tracked_curved.bag", "wheeled_lawnmower", "wheeled_circle"])
def test_the_two_sigma_band_of_the_pose_holds_the_truth_nine_times_in_ten(shared_logs: Path, name: str) -> None:
    run = run_of_log(shared_logs / "simulated" / name, RUNS[f"simulated/{name}"][0])
    truth = np.load(shared_logs / "simulated" / f"{name}.truth.npz")
    t = (run.table.stamp_ns - 1_760_000_000_000_000_000) / 1e9
    settled = t > 30.0
    for column, key in (("north_m", "north"), ("east_m", "east"), ("heading_rad", "heading")):
        true = np.interp(t, truth["t"], np.unwrap(truth[key]) if key == "heading" else truth[key])
        error = getattr(run.table, column) - true
        if key == "heading":
            error = np.angle(np.exp(1j * error))
        inside = np.abs(error) < 2 * getattr(run.table, f"std_{column}")
        assert 0.88 <= inside[settled].mean() <= 1.0, column


FORMATS = {
    "empty-file.bag": (LogError, "empty file"),
    "example-bz2.bag": (MissingStreamError, "position"),
    "example-lz4.bag": (MissingStreamError, "position"),
    "example.bag": (MissingStreamError, "position"),
    "husky_imu_db3": (MissingStreamError, "wheels"),
    "no-messages.bag": (MissingStreamError, "no topic at all"),
    "rosbag2_mcap_cdr_test": (MissingStreamError, "test_msgs/BasicTypes"),
    "rosbag2_mcap_reindex_test_bags_multiple_files": (MissingStreamError, "std_msgs/String"),
    "rosbag2_mcap_wrong_rmw_test": (MissingStreamError, "wheels"),
    "rosbag2_sqlite3_wbag": (MissingStreamError, "std_msgs/String"),
    "turtlebot3.bag": (MissingStreamError, "dead reckoning"),
}


@pytest.mark.parametrize("name", FORMATS)
def test_logs_that_hold_less_are_refused_with_the_sentence_that_says_what_is_missing(
    shared_logs: Path, name: str
) -> None:
    error, words = FORMATS[name]
    with pytest.raises(IcrToolError, match=words) as caught:
        icrtool.read_log(shared_logs / "formats" / name)
    assert isinstance(caught.value, error)
    assert "\n" not in str(caught.value)
