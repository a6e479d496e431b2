"""Small logs after public bug reports, where they are present: each gives the answer of the log without the fault."""

from __future__ import annotations

from pathlib import Path

import pytest

import icrtool
from icrtool.records.run import Run

TRUTH = {"y_icr_right_m": 0.520, "y_icr_left_m": -0.500, "x_icr_m": 0.060}
MULTIPLIER, DISTANCE_M = 1.855, 51.0

LOGS = {
    "00_clean": (),
    "01_bursts_of_two": ("wheel_bursts",),
    "03_base_restarts": (),
    "07_definition_crlf": (),
    "08_counts_modulo_4096": (),
    "09_two_publishers": (),
    "13_sides_in_own_messages": (),
}
"""Logs of known truth, and findings that name what is wrong with them."""


def run_of(shared_logs: Path, name: str, width_m: float) -> Run:
    path = shared_logs / "reports" / f"{name}.mcap"
    if not path.exists():
        pytest.skip(f"{path.name} is not among the shared logs")
    counts = ["robot.encoder_counts_per_rev=4096"] if "4096" in name else []
    sets = [f"robot.track_width_m={width_m}", "robot.wheel_radius_m=0.165", *counts]
    config = icrtool.load_config(sets=sets)
    return icrtool.fit(icrtool.read_log(path, config), config)


@pytest.mark.parametrize("name", LOGS)
def test_a_fault_of_the_recording_does_not_change_the_answer(shared_logs: Path, name: str) -> None:
    run = run_of(shared_logs, name, 0.55)
    assert run.usable, run.summary["unusable_because"]
    assert run.document.drive.distance_m == pytest.approx(DISTANCE_M, rel=0.02)
    icr = run.summary["icr"]
    for key, true in TRUTH.items():
        assert abs(icr["final"][key] - true) < 3.0 * icr["final_std"][key], key
    controller = run.document.controller
    assert controller is not None
    assert abs(controller.multiplier - MULTIPLIER) < 3.0 * controller.multiplier_std
    assert controller.multiplier == pytest.approx(MULTIPLIER, rel=0.02)
    assert set(LOGS[name]) <= {one.code for one in run.document.notes}
    best = icrtool.dropout_report(run, horizons_m=(10.0,)).result("recommended")
    assert best is not None
    # the clean log has 0.37 m
    assert best.column("p95_m")[0] < 0.6


@pytest.mark.parametrize(("name", "multipliers"), [("ground0.8", (1.5, 1.2)), ("lawn0.6", (1.5, 0.9))])
def test_a_change_of_ground_is_two_stretches(shared_logs: Path, name: str, multipliers: tuple[float, ...]) -> None:
    run = run_of(shared_logs, name, 1.0)
    assert "wheels_filtered" not in {one.code for one in run.document.notes}
    stretches = run.document.wheels.ground_stretches
    assert [one.multiplier for one in stretches] == pytest.approx(multipliers, rel=0.03)
    assert run.document.partly_because is not None
    assert "--terrain-change" in run.document.partly_because
    if name == "ground0.8":
        assert stretches[1].begin_s == pytest.approx(100.0, abs=5.0)


def test_a_jump_of_the_datum_is_no_distance_that_was_driven(shared_logs: Path) -> None:
    run = run_of(shared_logs, "jump100m", 1.0)
    assert run.document.drive.distance_m == pytest.approx(139.9, rel=0.01)
    (jump,) = run.document.reference_jumps
    # with the motion between two fixes that the filter follows
    assert jump.size_m == pytest.approx(100.0, rel=0.15)
