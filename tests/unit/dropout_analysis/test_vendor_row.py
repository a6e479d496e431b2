"""The row `vendor`: a robot driven with the skid factor that is published for it."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from icrtool.config import load_config, parse_config
from icrtool.dropout_analysis.dropout_report import dropout, dropout_report
from icrtool.kernels.open_loop import open_loop_errors_direct
from icrtool.kernels.track import FrozenIcrs, trial_ends
from icrtool.output.tables.dropout import format_dropout
from icrtool.pipeline import fit
from icrtool.records.run import Run, track_of, vendor_icrs, why_no_vendor
from icrtool.records.run_document import RunDocument
from support.barn import ICRS_M, TRACK_WIDTH_M, simulate

RIGHT_M, LEFT_M, _ = ICRS_M
TRUE_FACTOR = (RIGHT_M - LEFT_M) / TRACK_WIDTH_M


def fitted(skid_factor: float | None, track_width_m: float | None = TRACK_WIDTH_M) -> Run:
    robot = {"name": "segway-rmp400", "track_width_m": track_width_m, "skid_factor": skid_factor}
    return fit(simulate(), parse_config({"robot": robot}))


@pytest.fixture(scope="module")
def run() -> Run:
    return fitted(TRUE_FACTOR)


def test_it_drives_with_the_factor_times_the_track_width(run: Run) -> None:
    errors: dict[str, np.ndarray] = {}
    dropout(run, [5.0], sink=lambda model, _, table: errors.update({model: table[:, 0].copy()}))
    track = track_of(run)
    half_m = TRUE_FACTOR * TRACK_WIDTH_M / 2
    ends = trial_ends(track, np.array([5.0]))
    expected = open_loop_errors_direct(track, FrozenIcrs.constant(half_m, -half_m, 0.0), ends)[:, 0]
    np.testing.assert_allclose(errors["vendor"], expected, rtol=0, atol=1e-9)
    # the robot turns as this factor states: what is left is the place of its ICRs off the middle
    assert np.nanpercentile(errors["vendor"], 95) < 0.5 * np.nanpercentile(errors["no_slip"], 95)


def test_a_factor_of_one_is_no_slip() -> None:
    report = dropout(fitted(1.0), [1.0, 5.0])
    vendor, no_slip = report.result("vendor"), report.result("no_slip")
    assert vendor is not None
    assert no_slip is not None
    np.testing.assert_array_equal(vendor.column("p95_m"), no_slip.column("p95_m"))
    assert (vendor.document.words, vendor.document.knows) == (
        "published skid factor, not fitted", "the published factor"
    )  # fmt: skip


def test_it_changes_no_other_row(run: Run) -> None:
    with_it, without = (dropout(one, [1.0, 5.0]) for one in (run, fitted(None)))
    assert without.result("vendor") is None
    # The filter starts at the published factor: its own rows differ, and its states, by 1 %.
    for result in (one for one in without.results if not one.name.startswith(("icr", "adaptive"))):
        other = with_it.result(result.name)
        assert other is not None
        np.testing.assert_allclose(other.column("p95_m"), result.column("p95_m"), rtol=0.03)


def test_it_stands_in_the_report_and_bounds_and_in_the_worst_trials(run: Run) -> None:
    report = dropout_report(run, horizons_m=[1.0, 5.0, 10.0], gates=["vendor.p95@5m <= 100"])
    assert report.passed
    names = [one.name for one in report.results]
    assert "vendor" in names
    assert not [name for name in names if name.startswith("vendor_")]
    assert set(report.document.worst[0].errors_m) >= {"vendor", "no_slip"}
    lines = format_dropout(report).splitlines()
    assert sum(line.split()[:1] == ["vendor"] for line in lines) == 2


def twist_document(document: RunDocument) -> RunDocument:
    streams = tuple(
        replace(one, topic="/cmd_vel", message_type="geometry_msgs/TwistStamped") if one.role == "wheels" else one
        for one in document.streams
    )
    return msgspec.structs.replace(document, streams=streams)


def test_wheels_made_of_twists_hold_the_factor_already(run: Run) -> None:
    assert why_no_vendor(run.document) == ""
    document = twist_document(run.document)
    assert vendor_icrs(document) is None
    assert "wheels.twist_width_m" in why_no_vendor(document)


@pytest.mark.parametrize(
    ("factor", "width", "why"), [(None, TRACK_WIDTH_M, "robot.skid_factor"), (1.5, None, "track_width_m")]
)
def test_without_factor_or_width_the_row_is_left_out(factor: float | None, width: float | None, why: str) -> None:
    run = fitted(factor, width)
    assert vendor_icrs(run.document) is None
    assert why in why_no_vendor(run.document)
    stated = "vendor is left out: robot.track_width_m is not known" in format_dropout(
        dropout_report(run, horizons_m=[5.0], ladder=False)
    )
    assert stated == (factor is not None)


@pytest.mark.parametrize(
    ("robot", "turns_as_m"), [("husky-a200", 1.875 * 0.555), ("jackal", 1.5 * 0.37559), ("warthog", 1.125 * 1.5)]
)
def test_a_built_in_robot_turns_as_wide_as_its_maker_has_it(robot: str, turns_as_m: float) -> None:
    known = load_config(robot=robot).robot
    assert known.skid_factor is not None
    assert known.track_width_m is not None
    assert known.skid_factor * known.track_width_m == pytest.approx(turns_as_m, rel=1e-9)
