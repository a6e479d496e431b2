"""Poses that the robot's own localisation published, in the trials of the report; the errors are those of evo."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import icrtool
from icrtool.cli.commands import icrtool as command
from icrtool.config import load_config
from icrtool.dropout_analysis.dropout_report import dropout_report
from icrtool.dropout_analysis.report import DropoutReport
from icrtool.dropout_analysis.topic_rows import GROWS, NOT_OPEN_LOOP, topic_rows
from icrtool.errors import ConfigError
from icrtool.logs.read_log import survey_document, survey_log
from icrtool.logs.topic_poses import read_topic_poses, scorable_topics
from icrtool.motion.recording import Trials
from icrtool.output.tables.dropout import format_dropout
from icrtool.records.dropout_document import ModelResult
from icrtool.records.run import Run, track_of
from support.pose_topics import SETS, dead_reckoned, measured, pose_plan, transforms, true_poses, write_pose_log

ODOMETRY, FUSED, SLAM, AMCL, SPARSE = "/odom", "/odometry/filtered", "/visual/pose", "/amcl_pose", "/slow_heading"
HORIZONS = (1.0, 5.0, 10.0, 20.0)
GAP_S = (60.0, 75.0)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    true = true_poses()
    drifting = dead_reckoned(true, 1.03, 0.01)
    since = (true.stamp_ns - true.stamp_ns[0]) / 1e9
    kept = np.flatnonzero((since < GAP_S[0]) | (since >= GAP_S[1]))
    fixed = measured(true, 0.01, 0.002)
    in_map = dead_reckoned(true, 1.0, 0.0)
    return write_pose_log(
        tmp_path_factory.mktemp("scored") / "drive.mcap",
        [
            pose_plan(ODOMETRY, "nav_msgs/msg/Odometry", drifting),
            pose_plan(FUSED, "nav_msgs/msg/Odometry", fixed),
            pose_plan(SLAM, "geometry_msgs/msg/PoseStamped", drifting.some(kept), "vodom"),
            pose_plan(AMCL, "geometry_msgs/msg/PoseWithCovarianceStamped", in_map, "odom"),
            pose_plan(SPARSE, "geometry_msgs/msg/PoseStamped", in_map.some(slice(None, None, 10)), "vodom"),
        ],
        [transforms("/tf", [("odom", "base_link", drifting)])],
    )


@pytest.fixture(scope="module")
def run(log: Path) -> Run:
    config = load_config(sets=SETS)
    return icrtool.fit(icrtool.read_log(log, config), config)


def result_of(report: DropoutReport, name: str) -> ModelResult:
    result = report.result(name)
    assert result is not None
    return result


@pytest.fixture(scope="module")
def report(run: Run, log: Path) -> DropoutReport:
    topics = [ODOMETRY, FUSED, SLAM, AMCL, SPARSE, "/tf"]
    return dropout_report(
        run, horizons_m=HORIZONS, score=topics, log=log, gates=[f"topic:{ODOMETRY}.p95@10m <= 0.01"], outage_s=()
    )


def test_the_errors_of_a_scored_topic_are_those_of_evo(run: Run, log: Path) -> None:
    metrics = pytest.importorskip("evo.core.metrics")
    track, (poses,) = track_of(run), read_topic_poses(log, [ODOMETRY])
    (row,), _ = topic_rows(run, track, [poses])
    starts = np.arange(50, 6000, 37)
    ends = np.column_stack([starts + 100, starts + 1200]).astype(np.int32)
    errors = row.errors_of(Trials(starts, ends))
    assert np.isfinite(errors.position).all()
    # In REP-103, as evo has it: poses of messages and states as 4 x 4 matrices, interpolated at the same stamps.
    true = true_poses()
    drifting = dead_reckoned(true, 1.03, 0.01)
    estimate = _matrices(
        *(np.interp(run.table.stamp_ns, drifting.stamp_ns, one) for one in (drifting.x, drifting.y, drifting.yaw))
    )
    reference = _matrices(run.table.east_m, run.table.north_m, np.pi / 2 - run.table.heading_rad)
    rpe = metrics.RPE(metrics.PoseRelation.translation_part)
    turn = metrics.RPE(metrics.PoseRelation.rotation_angle_rad)
    for h in range(2):
        relative = [
            metrics.RPE.rpe_base(reference[s], reference[e], estimate[s], estimate[e])
            for s, e in zip(starts, ends[:, h], strict=True)
        ]
        rpe.E = turn.E = relative
        assert errors.position[:, h] == pytest.approx([np.linalg.norm(one[:3, 3]) for one in relative], abs=1e-6)
        angles = [np.arccos(np.clip((np.trace(one[:3, :3]) - 1) / 2, -1, 1)) for one in relative]
        assert np.abs(np.angle(np.exp(1j * errors.heading[:, h]))) == pytest.approx(angles, abs=1e-6)


def _matrices(x: np.ndarray, y: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    found = np.tile(np.eye(4), (len(x), 1, 1))
    found[:, 0, 0] = found[:, 1, 1] = np.cos(yaw)
    found[:, 1, 0], found[:, 0, 1] = np.sin(yaw), -np.sin(yaw)
    found[:, 0, 3], found[:, 1, 3] = x, y
    return found


def test_a_scored_topic_is_a_row_of_the_report_its_files_and_its_limits(report: DropoutReport, tmp_path: Path) -> None:
    name = f"topic:{ODOMETRY}"
    result = result_of(report, name)
    assert (result.column("trials") > 100).all()
    assert (np.diff(result.column("p95_m")) > 0).all()
    report.write(tmp_path / "dropout", plots=("png",))
    with (tmp_path / "dropout" / "summary.csv").open(encoding="utf-8") as stream:
        assert {row["model"] for row in csv.DictReader(stream)} >= {name, f"topic:{FUSED}", "icr"}
    (verdict,) = report.document.gates
    assert not verdict.passed
    assert verdict.value_m == pytest.approx(result.column("p95_m")[2])
    assert report.document.request.score[0] == ODOMETRY
    assert name in format_dropout(report)
    # what the robot computed itself, with GNSS or a camera, is not what it can drive with by wheels
    assert report.document.best is not None
    assert report.document.best.model == "recommended"


def test_poses_of_every_kind_of_message_give_the_same_errors(report: DropoutReport) -> None:
    odometry, tf = (result_of(report, f"topic:{name}").column("p95_m") for name in (ODOMETRY, "/tf"))
    assert tf == pytest.approx(odometry, abs=1e-9)
    # what is known exactly errs as far as the reference does, also where it is interpolated over 0.5 s
    exact, sparse = (result_of(report, f"topic:{name}").column("p95_m") for name in (AMCL, SPARSE))
    assert (exact < 0.02 * np.array(HORIZONS) + 0.01).all()
    assert sparse == pytest.approx(exact, abs=0.01)


def test_a_trial_across_a_gap_of_the_topic_is_none(run: Run, log: Path, report: DropoutReport) -> None:
    whole, gap = (result_of(report, f"topic:{name}").column("trials") for name in (ODOMETRY, SLAM))
    assert (gap < whole).all()
    assert (gap > whole / 2).all()
    track, (poses,) = track_of(run), read_topic_poses(log, [SLAM])
    (row,), _ = topic_rows(run, track, [poses])
    before, inside, after = (int(np.searchsorted(track.t, t)) for t in (GAP_S[0] - 5, GAP_S[0] + 5, GAP_S[1] + 5))
    trials = Trials(np.array([before - 100, before, inside]), np.array([[before], [after], [after]], np.int32))
    assert np.isfinite(row.errors_of(trials).position[:, 0]).tolist() == [True, False, False]
    assert row.path is not None
    assert row.path(before, after) is None


def test_a_row_with_gnss_in_it_says_that_it_is_not_open_loop(report: DropoutReport) -> None:
    knows = {one.name: one.knows for one in report.document.models}
    assert knows[f"topic:{FUSED}"] == NOT_OPEN_LOOP
    assert knows[f"topic:{ODOMETRY}"] == knows["topic:/tf"] == GROWS
    (found,) = [one for one in report.document.notes if one.code == "topic_not_open_loop" and FUSED in one.text]
    assert "not grow" in found.text
    assert not [one for one in report.document.notes if one.code == found.code and f"topic:{ODOMETRY}:" in one.text]
    assert "not open loop" in format_dropout(report)


def test_a_topic_that_ends_in_a_word_of_rows_keeps_its_name(report: DropoutReport) -> None:
    assert [one.words for one in report.document.models if one.name == f"topic:{SPARSE}"] == [
        "pose or odometry recorded in the log"
    ]


def test_what_cannot_be_scored_is_refused_by_name(run: Run, log: Path) -> None:
    with pytest.raises(ConfigError, match=r"opens no log by itself.*give the log"):
        dropout_report(run, score=[ODOMETRY])
    with pytest.raises(ConfigError, match=r"no topic /odomm.*did you mean.*/odom"):
        dropout_report(run, score=["/odomm"], log=log)
    with pytest.raises(ConfigError, match="/gps/fix is a sensor_msgs/NavSatFix, which holds no pose"):
        dropout_report(run, score=["/gps/fix"], log=log)


def test_info_proposes_the_topics_that_can_be_scored(log: Path) -> None:
    survey = survey_document(survey_log(log, load_config(sets=SETS)))
    assert set(scorable_topics(survey, ["/gps/fix"])) == {ODOMETRY, FUSED, SLAM, AMCL, SPARSE}
    assert SLAM not in scorable_topics(survey, [SLAM])


def test_the_command_scores_topics_of_a_log_and_refuses_those_of_a_run(log: Path, tmp_path: Path) -> None:
    options = [part for one in SETS for part in ("--set", one)]
    base = ["dropout-report", str(log), "-o", str(tmp_path / "run"), "--plots", "none", *options]
    done = CliRunner().invoke(command, [*base, "--score", ODOMETRY, "--score", FUSED])
    assert done.exit_code == 0, done.stderr
    assert f"topic:{ODOMETRY}" in done.stdout
    assert f"topic:{ODOMETRY}" in (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    refused = CliRunner().invoke(command, ["dropout-report", str(tmp_path / "run"), "--score", ODOMETRY])
    assert refused.exit_code == 1
    assert "name its LOG in place of the run" in refused.stderr + str(refused.exception)
    proposed = CliRunner().invoke(command, ["info", str(log), *options])
    assert ODOMETRY in proposed.stdout
    assert "--score" in proposed.stdout
