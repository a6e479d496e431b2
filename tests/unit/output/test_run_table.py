from __future__ import annotations

from collections.abc import Callable

import pytest

from icrtool.output.tables.run import format_run, run_checks
from icrtool.output.text_blocks import TEXT_WIDTH
from icrtool.output.text_format import duration_text, error_text, signed_text
from icrtool.records.run import Run
from icrtool.records.text import distance_text
from support.documents import with_summary


def line_of(text: str, begin: str) -> str:
    return next(line for line in text.splitlines() if line.startswith(begin))


def check_of(text: str, what: str) -> str:
    return next(line for line in text.splitlines() if line[16:].startswith(what))


def test_the_table_says_what_was_read_and_learned(run: Run) -> None:
    text = format_run(run)
    icr, drive, geometry = run.summary["icr"], run.summary["drive"], run.summary["geometry"]
    lines = text.splitlines()
    assert lines[0].startswith("barn  (segway-rmp400)   ")
    assert line_of(text, "wheels").split() == [
        "wheels",
        "/joint_states",
        "sensor_msgs/JointState",
        "50.0",
        "Hz",
        "3,000",
        "header",
    ]
    assert next(line for line in lines if "/imu" in line and line.startswith("heading")).endswith("log")
    assert f"{drive['distance_m']:.1f} m, {duration_text(drive['duration_s'])}" in lines[0]
    assert f"{drive['speed_mean_mps']:.2f} ± {drive['speed_std_mps']:.2f} m/s" in text
    for label, column in (("y right", "y_icr_right_m"), ("y left", "y_icr_left_m"), ("x ", "x_icr_m")):
        line = line_of(text, label)
        assert f"{geometry[column]:+.3f} ± {geometry[f'{column}_std']:.3f}" in line
        assert f"{icr['mean'][column]:+.3f} ± {icr['std'][column]:.3f}" in line
        rise = icr["convergence_s"][column]
        assert (f"{rise:.1f} s" if rise is not None else "none") in line
    multiplier = (geometry["y_icr_right_m"] - geometry["y_icr_left_m"]) / 0.6
    assert f"{multiplier:.3f} ± " in line_of(text, "controller  wheel_separation_multiplier")
    assert f"right {icr['final']['y_icr_right_m']:+.3f}" in check_of(text, "EKF")
    used = run.summary["gnss"]["used"]
    assert check_of(text, "fixes").endswith(f"7 of {used + 7:,} rejected")
    assert "rejected: gate 4, no fix 3" in text
    assert check_of(text, "outages").endswith(" in all")
    assert "filter to GNSS fixes: mean " in text
    assert "course over ground" in check_of(text, "heading")
    heading = run.summary["heading"]
    assert heading["used"] > 1000
    assert f"{heading['used']:,} of {heading['used'] + heading['rejected']:,} used" in text


def test_no_line_is_too_wide_coloured_or_ends_in_blanks(run: Run) -> None:
    long_names = [
        {**stream, "topic": "/robot/namespace" * 9, "message_type": "some_vendor_msgs/msg/VeryLongNameOfAMessageIndeed"}
        for stream in run.summary["streams"]
    ]
    wide = with_summary(run, streams=long_names)
    for text in (format_run(run), format_run(wide)):
        assert max(map(len, text.splitlines())) <= TEXT_WIDTH
        assert "\x1b" not in text
        assert not any(line != line.rstrip() for line in text.splitlines())
        assert not text.endswith("\n")
    (topic,) = line_of(format_run(wide), "wheels").split()[1:2]
    assert topic.startswith("/robot")
    assert topic.endswith("/namespace")


def test_without_width_the_table_says_what_is_left_out(make_run: Callable[..., Run]) -> None:
    text = format_run(make_run(track_width_m=None, datum=False, troubles=False, duration_s=20.0))
    assert "robot.track_width_m is not known" in line_of(text, "controller")
    assert "filter to position reference" in text
    assert "outage" not in text
    assert "0 of " in check_of(text, "positions")


def test_turns_to_one_side_that_show_all_icrs_are_noted_with_the_other_side(make_run: Callable[..., Run]) -> None:
    run = make_run()
    assert [one.grade for one in run_checks(run.document) if one.name == "excitation"] == ["good"]
    excitation = run.summary["excitation"] | {"turned_right_deg": 29.0, "turned_left_deg": 904.0}
    excitation["verdict"] = dict.fromkeys(excitation["verdict"], "shown")
    checks = run_checks(with_summary(run, excitation=excitation).document)
    ((grade, text),) = ((one.grade, one.text) for one in checks if one.name == "excitation")
    assert grade == "care"
    assert text.startswith("shown, but turned in one direction only: ")
    assert text.endswith("to the right")


def test_a_parked_robot_has_a_table_too(make_run: Callable[..., Run]) -> None:
    text = format_run(make_run(speed_mps=0.01, duration_s=20.0))
    assert line_of(text, "y right").split() == ["y", "right", "not", "shown"]
    assert text.startswith("Do not use: this drive does not show y right, y left, x: ")
    assert "too little straight driving" in " ".join(text.split())


def test_warnings_are_not_in_the_table(run: Run) -> None:
    assert run.warnings
    assert not any(warning in format_run(run) for warning in run.warnings)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (12.34, "12.3 s"),
        (59.99, "60.0 s"),
        (60.0, "1:00 min"),
        (899.99, "15:00 min"),
        (3599.9, "1:00:00 h"),
        (36000, "10:00:00 h"),
    ],
)
def test_durations_read_well(seconds: float, text: str) -> None:
    assert duration_text(seconds) == text


def test_lengths_read_well() -> None:
    texts = [error_text(metres) for metres in (0.0031, 0.0123, 0.999, 3.456, float("nan"))]
    assert texts == ["0.0031 m", "0.012 m", "0.999 m", "3.46 m", "-"]
    assert [distance_text(metres) for metres in (398.46, 36_004.6)] == ["398.5 m", "36.00 km"]
    assert [signed_text(metres) for metres in (0.3, -0.3, -0.0001)] == ["+0.300", "−0.300", "0.000"]


def test_fixes_whose_delay_no_change_of_speed_shows_are_said_with_what_a_delay_would_do(run: Run) -> None:
    steady = with_summary(run, gnss={"delay_s": None, "delay_std_s": None})
    speed = run.summary["drive"]["speed_mean_mps"]
    said = f"this drive does not show their delay; a lag of 0.1 s would move x by {error_text(0.1 * speed)}"
    assert said in " ".join(format_run(steady).split())
    known = with_summary(run, gnss={"delay_s": 0.02, "delay_std_s": 0.01})
    assert said not in " ".join(format_run(known).split())
