"""Round trips: what `icrtool simulate` records, `icrtool fit` reads like any log, and finds the ICRs it was made of."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import get_args

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

from icrtool.cli.simulate import simulate_command as command
from icrtool.config import load_config
from icrtool.logs.read_log import read_log
from icrtool.pipeline import fit
from icrtool.records.choices import PathKind, WheelMessages
from icrtool.records.run import Run

SIGMAS = 3.0
ICRS = ("y_icr_right_m", "y_icr_left_m", "x_icr_m")
ROBOTS = ("husky-a200", "jackal", "warthog", "segway-rmp400", "pentzer-tracked")
LOGS = ("drive.mcap", "drive.bag", "drive")


def round_trip(
    folder: Path, *options: object, robot: str = "pentzer-tracked", log: str = "drive.mcap", sets: tuple[str, ...] = ()
) -> tuple[Run, pd.DataFrame]:
    """Simulate by the command, fit, and return the run with the truth."""
    arguments = ["-o", str(folder / log), "--robot", robot, "-q", *map(str, options)]
    done = CliRunner().invoke(command, arguments, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    config = load_config(robot=robot, sets=sets)
    run = fit(read_log(folder / log, config), config)
    return run, pd.read_csv(folder / f"{log}.truth.csv")


def off_by(run: Run, truth: pd.DataFrame) -> dict[str, float]:
    """Return how far each final ICR is from the truth, in its own standard deviations."""
    icr = run.summary["icr"]
    return {name: (icr["final"][name] - truth[name].iloc[-1]) / icr["final_std"][name] for name in ICRS}


def assert_found(run: Run, truth: pd.DataFrame) -> None:
    off = off_by(run, truth)
    assert max(map(abs, off.values())) < SIGMAS, off


EVERY_OPTION = [
    (),
    ("--path", "circle"),
    ("--path", "lawnmower", "--leg", 5),
    ("--path", "figure-eight"),
    ("--path", "spins"),
    ("--icrs", "0.5,-0.75,-0.25"),
    ("--change", "20:0.45,-0.34,0.03"),
    ("--duration", 30),
    ("--speed", 0.8, "--radius", 2),
    ("--start-heading", 175),
    ("--wheels", "commanded"),
    ("--wheels", "commanded", "--motor-lag", 0.1),
    # The unit of a bare Float64 is told by straight driving against the fixes.
    *(("--wheel-messages", kind, "--path", "lawnmower", "--leg", 8) for kind in get_args(WheelMessages)[1:]),
    ("--wheel-rate", 20),
    ("--input-noise", 0.05),
    ("--input-bias", 0.02),
    ("--gnss", "waas"),
    ("--gnss", 0.1, "--gnss-rate", 5),
    ("--outage", "20:30", "--outage", "40:45"),
    ("--gnss-delay", 0.05),
    ("--heading", "ned"),
    ("--heading-offset", 12),
    ("--heading-offset", -90),
    ("--heading-delay", -0.05),
    ("--heading-std", 3, "--heading-resolution", 1, "--heading-rate", 50),
]


@pytest.mark.parametrize("options", EVERY_OPTION, ids=lambda options: " ".join(map(str, options)) or "defaults")
def test_every_option_reads_back_to_the_icrs_it_was_made_with(tmp_path: Path, options: tuple[object, ...]) -> None:
    usual = {"--duration": 60, "--wheel-rate": 50, "--heading-rate": 50, "--gnss-rate": 10}
    if "commanded" in options:
        del usual["--wheel-rate"]
    further = [word for name, value in usual.items() if name not in options for word in (name, value)]
    assert_found(*round_trip(tmp_path, *further, *options))


def test_a_straight_drive_shows_no_icr_and_its_sigma_covers_the_truth(tmp_path: Path) -> None:
    run, truth = round_trip(tmp_path, "--path", "straight", "--duration", 60)
    icr, last = run.summary["icr"], run.states.iloc[-1]
    assert not run.summary["usable"]
    for name in ICRS:
        assert icr["final"][name] is None
        assert icr["final_std"][name] is None
        assert abs(last[name] - truth[name].iloc[-1]) < SIGMAS * last[f"std_{name}"]


def test_an_antenna_off_centre_is_read_back_when_its_place_is_told(tmp_path: Path) -> None:
    sets = ("frames.antenna_forward_m=0.3", "frames.antenna_right_m=-0.2")
    assert_found(*round_trip(tmp_path, "--antenna", "0.3,-0.2", "--duration", 60, sets=sets))


def test_coarse_encoders_are_read_back_when_their_counts_are_told(tmp_path: Path) -> None:
    options = ("--encoder-counts", 64, "--wheel-messages", "ticks", "--duration", 60)
    assert_found(*round_trip(tmp_path, *options, sets=("robot.encoder_counts_per_rev=64",)))


def test_given_track_speeds_are_read_back(tmp_path: Path) -> None:
    t = np.arange(0, 60, 0.5)
    speeds = pd.DataFrame({"t_s": t, "v_left_mps": 0.4 + 0.2 * np.sin(t / 3), "v_right_mps": 0.4 - 0.2 * np.sin(t / 3)})
    speeds.to_csv(tmp_path / "speeds.csv", index=False)
    run, truth = round_trip(tmp_path, "--speeds", tmp_path / "speeds.csv")
    assert_found(run, truth)
    assert truth["t_s"].iloc[-1] == pytest.approx(59.5, abs=0.02)


@pytest.mark.parametrize("log", LOGS)
def test_every_container_gives_the_same_run(tmp_path: Path, log: str) -> None:
    options = ("--duration", 20, "--path", "circle")
    run, truth = round_trip(tmp_path, *options, log=log)
    other, _ = round_trip(tmp_path / "..", *options, log=f"other_{tmp_path.name}.mcap")
    assert_found(run, truth)
    for column, values in run.table.columns().items():
        np.testing.assert_array_equal(values, other.table.columns()[column], err_msg=column)


def test_the_truth_stands_beside_the_states_of_the_fit(tmp_path: Path) -> None:
    run, truth = round_trip(tmp_path, "--duration", 30, sets=("frames.datum=[40.7934, -77.86]",))
    both = run.states.merge(truth, on="stamp_ns", suffixes=("", "_true"))
    assert len(both) == len(run.states)
    assert np.hypot(both.north_m - both.north_m_true, both.east_m - both.east_m_true).max() < 0.1
    assert np.abs(both.v_left_mps - both.v_left_mps_true).median() < 0.01


def test_a_steady_circle_with_rough_sensors_shows_no_delay(tmp_path: Path) -> None:
    """At a constant turn rate any delay fits: noise of the wheels must not be matched with noise of the heading."""
    sensors = ("--gnss", "waas", "--input-noise", 0.03, "--seed", 10)
    path = ("--path", "circle", "--radius", 3.0, "--speed", 0.8, "--duration", 90)
    run, truth = round_trip(tmp_path, *sensors, *path, robot="warthog")
    assert run.summary["heading"]["applied_delay_s"] == 0.0
    assert max(map(abs, off_by(run, truth).values())) < SIGMAS


def test_wobbly_wheels_on_an_even_winding_way_show_no_delay(tmp_path: Path) -> None:
    sensors = ("--gnss", "waas", "--input-noise", 0.03, "--seed", 10)
    path = ("--path", "curved", "--radius", 1.5, "--speed", 0.4, "--duration", 90)
    run, truth = round_trip(tmp_path, *sensors, *path, robot="segway-rmp400")
    assert run.summary["heading"]["applied_delay_s"] == 0.0
    assert_found(run, truth)


@pytest.mark.stress
@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("path", [path for path in get_args(PathKind) if path != "straight"])
def test_the_grid_of_robots_paths_sensors_and_containers(tmp_path: Path, robot: str, path: str) -> None:
    size = 2.0 if robot == "warthog" else 1.0
    sensors = [
        ("--gnss", gnss, "--wheels", wheels, "--input-noise", noise, "--heading", heading)
        for gnss, wheels, noise, heading in itertools.product(
            ("rtk", "waas"), ("encoder", "commanded"), (0.0, 0.03), ("enu", "ned")
        )
    ]
    off = {}
    for number, options in enumerate(sensors):
        folder = tmp_path / str(number)
        folder.mkdir()
        run, truth = round_trip(
            folder, *options, "--path", path, "--radius", 1.5 * size, "--speed", 0.4 * size, "--seed", number,
            "--duration", 90, robot=robot, log=LOGS[number % 3],
        )  # fmt: skip
        off[options] = max(map(abs, off_by(run, truth).values()))
    assert max(off.values()) < SIGMAS, {options: round(value, 1) for options, value in off.items() if value >= SIGMAS}
