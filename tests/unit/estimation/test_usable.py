"""Usable or not, and why: in the summary, on stdout, in the dropout report, and for controllers."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from icrtool.config import load_config
from icrtool.dropout_analysis.dropout_report import dropout
from icrtool.estimation.run_filter import LARGEST_POSITION_MPS
from icrtool.estimation.run_warnings import rejected_share, unusable_reasons
from icrtool.kernels.filter_records import GATED, UNSEEN, USED
from icrtool.output.tables.dropout import format_dropout
from icrtool.output.tables.run import format_run
from icrtool.pipeline import fit
from icrtool.records.notes import unusable_because
from icrtool.records.presets import FIELD, ProcessNoise
from icrtool.records.run import Run
from icrtool.records.run_document import ExcitationDocument, VerdictByIcr
from icrtool.records.tables import RobotLog
from support.drives import make_log

WIDTH = "robot.track_width_m=0.6"


def with_wrong(share: float, stream: str) -> Run:
    """A run of a drive with so many gross errors in a stream."""
    log, rng = make_log(seed=1), np.random.default_rng(2)
    if stream == "fixes":
        # in blocks of 20 s: single ones would show in the scatter from fix to fix, and be taken as the fixes' noise
        wrong = (np.arange(len(log.gnss.stamp_ns)) / 400) % 1.0 < share
        log = replace(log, gnss=replace(log.gnss, north_m=log.gnss.north_m + wrong * rng.normal(0.0, 50.0, len(wrong))))
    else:
        wrong = rng.random(len(log.heading.stamp_ns)) < share
        turned = log.heading.heading_rad + wrong * rng.uniform(0.5, 2.5, len(wrong))
        log = replace(log, heading=replace(log.heading, heading_rad=turned))
    return fit(log, load_config(sets=[WIDTH, "frames.heading_offset_deg=0"]))


@pytest.mark.parametrize("stream", ["fixes", "headings"])
def test_a_run_that_rejected_a_third_of_a_stream_is_not_usable(stream: str) -> None:
    run = with_wrong(0.4, stream)
    outcome = run.gnss if stream == "fixes" else run.heading
    assert rejected_share(outcome.code) > 0.3
    assert not run.usable
    assert f"% of the {stream} rejected" in run.summary["unusable_because"]
    assert format_run(run).startswith("Do not use: ")
    assert any(f"of the {stream} were rejected" in warning for warning in run.warnings)
    report = dropout(run, [5.0])
    assert format_dropout(report).startswith("Do not use: ")
    document = report.document
    assert document.usable is False
    assert document.unusable_because == run.summary["unusable_because"]


@pytest.mark.parametrize("stream", ["fixes", "headings"])
def test_a_run_that_rejected_a_tenth_is_usable(stream: str) -> None:
    run = with_wrong(0.12, stream)
    assert run.usable
    assert run.summary["unusable_because"] is None
    assert "Do not use" not in format_run(run) + format_dropout(dropout(run, [5.0]))


@pytest.mark.parametrize(
    ("noise", "words"),
    [
        (ProcessNoise(LARGEST_POSITION_MPS, FIELD.process_noise.heading_degps), "of the motion"),
        (ProcessNoise(FIELD.process_noise.position_mps, 8 * FIELD.process_noise.heading_degps), "of the turns"),
        (ProcessNoise(LARGEST_POSITION_MPS / 4, 4 * FIELD.process_noise.heading_degps), ""),
    ],
)
def test_wheels_that_explain_nothing_make_a_run_unusable(noise: ProcessNoise, words: str) -> None:
    excitation = SimpleNamespace(verdict=VerdictByIcr("shown", "shown", "shown"))
    reasons = unusable_reasons(cast(ExcitationDocument, excitation), {}, noise)
    assert bool(reasons) is bool(words)
    assert words in " ".join(one.text for one in reasons)
    assert unusable_because(reasons) == ("; ".join(one.text for one in reasons) or None)


def test_a_body_twist_that_turns_as_the_robot_does_makes_a_run_unusable() -> None:
    """Its controller multiplies the width: the ICRs are those of the assumed width.

    ICRs that are further apart than the width by more than their deviation are those of a robot that slips a little.
    """
    log = make_log(seed=1)
    of_twist = tuple(replace(one, message_type="nav_msgs/Odometry") for one in log.streams)
    v, turn = (log.wheels.left + log.wheels.right) / 2, (log.wheels.left - log.wheels.right) / 2

    def turning(share: float) -> RobotLog:
        """The twist of a robot whose ICRs are as far apart as its width, over a share."""
        factor = 0.6 / 1.1 / share
        return replace(
            log, streams=of_twist, wheels=replace(log.wheels, left=v + turn * factor, right=v - turn * factor)
        )

    known = turning(1.0)
    run = fit(known, load_config(sets=[WIDTH]))
    assert not run.usable
    (text,) = [one.text for one in run.document.notes if one.code == "twist_holds_multiplier"]
    share = re.search(r"turns of the body twist are ([\d.]+) ± ([\d.]+) of the robot's", text)
    assert share is not None
    assert abs(float(share[1]) - 1.0) <= 3.0 * float(share[2]) + 0.01
    assert "wheels.twist_width_m" in run.summary["unusable_because"]
    assert fit(known, load_config(sets=[WIDTH, "wheels.twist_width_m=1.05"])).usable
    for share in (1 / 1.05, 1 / 1.09):
        assert fit(turning(share), load_config(sets=[WIDTH])).usable
    assert not fit(turning(1 / 0.95), load_config(sets=[WIDTH])).usable
    assert fit(replace(log, streams=of_twist), load_config(sets=[WIDTH])).usable


def test_the_rejected_share_counts_what_the_filter_saw() -> None:
    code = np.array([UNSEEN, UNSEEN, USED, GATED], np.uint8)
    assert rejected_share(code) == 0.5
    assert rejected_share(0 * code) == 0.0


def test_icrs_that_ended_inverted_are_not_usable() -> None:
    """Preset ``paper`` from a certain start on the wrong sides."""
    start = ("initial_y_icr_right_m=-0.5", "initial_y_icr_left_m=0.5", "initial_icr_std_m=0.001", "preset=paper")
    run = fit(make_log(0, 10.0), load_config(sets=[WIDTH, *(f"filter.{one}" for one in start)]))
    assert run.table.y_icr_right_m[-1] < run.table.y_icr_left_m[-1]
    assert not run.usable
