"""Late headings and late fixes: found each alone, taken out when clear, and never where there is none."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from icrtool.alignment.conventions import AS_NAMED, decide_conventions
from icrtool.alignment.corrections import DelayEstimate, StreamDelays, _clear_delays
from icrtool.alignment.estimator import estimate_alignment
from icrtool.alignment.log_track import cut_drive_windows, track_of_log
from icrtool.config import load_config
from icrtool.pipeline import fit
from icrtool.records.run import Run
from icrtool.records.samples import Datum, HeadingSamples, PositionFixes, StreamChoice, WheelSamples
from icrtool.records.tables import RobotLog
from support.matrix_filter import drive_states

START_NS = 1_760_000_000_000_000_000
ICRS = (0.5, -0.6, 0.1)
WIDTH = "robot.track_width_m=0.8"
DELAY_TOLERANCE_S = 0.03
ICR_TOLERANCE_M = 0.02


def stop_and_go(seed: int = 1, *, heading_late_s: float = 0.0, fixes_late_s: float = 0.0) -> RobotLog:
    """Drive curves with changing speed for three minutes at 50 Hz; fixes at 10 Hz."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 180.0, 0.02)
    speed = 0.6 + 0.25 * np.sign(np.sin(0.8 * t)) * np.minimum(1.0, 3.0 * np.abs(np.sin(0.8 * t)))
    turn = 0.3 * np.sin(0.45 * t) + 0.1 * np.sin(1.7 * t)
    v_left, v_right = speed + turn / 2, speed - turn / 2
    x = drive_states(np.array([0.0, 0.0, 0.3, *ICRS]), v_left, v_right, 0.02)
    stamps = START_NS + np.round(t * 1e9).astype(np.int64)
    fix = slice(0, None, 5)
    count = len(t[fix])
    place = x[fix, :2] + rng.normal(0, 0.01, (count, 2))
    psi = x[:, 2] + rng.normal(0, np.radians(0.5), len(t))
    known = np.full(count, 1e-4)
    streams = tuple(
        StreamChoice(role, topic, "x/Y", 1, 1.0, "header", 0.0, "")
        for role, topic in (("wheels", "/wheels"), ("gnss", "/fix"), ("heading", "/imu"))
    )
    return RobotLog(
        "late",
        WheelSamples(stamps, v_left, v_right),
        PositionFixes(stamps[fix] + round(fixes_late_s * 1e9), *place.T, known, known, np.zeros(count)),
        HeadingSamples(
            stamps + round(heading_late_s * 1e9), np.angle(np.exp(1j * psi)), np.full(len(t), np.radians(0.5) ** 2)
        ),
        Datum(40.8, -77.9, 350.0),
        streams,
        (),
        {},
        (),
    )


def icr_error(run: Run) -> float:
    final = run.summary["icr"]["final"]
    found = [final[name] for name in ("y_icr_right_m", "y_icr_left_m", "x_icr_m")]
    return float(np.abs(np.array(found) - ICRS).max())


def test_streams_on_time_are_left_alone() -> None:
    run = fit(stop_and_go(), load_config(sets=[WIDTH]))
    assert run.warnings == ()
    assert run.summary["heading"]["delay_s"] == pytest.approx(0.0, abs=DELAY_TOLERANCE_S)
    assert run.summary["gnss"]["delay_s"] == pytest.approx(0.0, abs=DELAY_TOLERANCE_S)
    assert run.summary["heading"]["applied_delay_s"] == run.summary["filter"]["reference_delay_s"] == 0.0


@pytest.mark.parametrize(
    ("stream", "delay"), [("heading", 0.12), ("heading", 0.3), ("heading", 0.9), ("fixes", 0.25), ("fixes", 0.9)]
)
def test_a_late_stream_is_found_and_taken_out_alone(stream: str, delay: float) -> None:
    late = {"heading_late_s": delay} if stream == "heading" else {"fixes_late_s": delay}
    run = fit(stop_and_go(**late), load_config(sets=[WIDTH]))
    heading, fixes = run.summary["heading"]["applied_delay_s"], run.summary["filter"]["reference_delay_s"]
    found, other = (heading, fixes) if stream == "heading" else (fixes, heading)
    assert found == pytest.approx(delay, abs=DELAY_TOLERANCE_S)
    assert other == 0.0
    name = "heading" if stream == "heading" else "position"
    assert any(f"the {name} lags the wheels by" in w for w in run.warnings)
    # Left in, it moves x by speed times delay, 7 cm and more.
    assert icr_error(run) < ICR_TOLERANCE_M


def test_configured_delays_are_used_as_they_are() -> None:
    sets = [WIDTH, "frames.heading_delay_s=0.2", "frames.reference_delay_s=0.3"]
    run = fit(stop_and_go(heading_late_s=0.2, fixes_late_s=0.3), load_config(sets=sets))
    assert run.summary["heading"]["applied_delay_s"] == 0.2
    assert run.summary["filter"]["reference_delay_s"] == 0.3
    assert icr_error(run) < ICR_TOLERANCE_M
    assert run.warnings == ()


def test_preset_paper_and_one_topic_for_both_take_nothing_out() -> None:
    log = stop_and_go(heading_late_s=0.3)
    paper = fit(log, load_config(sets=[WIDTH, "filter.preset=paper"])).sensors.headings
    assert np.array_equal(paper.stamp_ns, log.heading.stamp_ns)
    together = replace(log, streams=tuple(replace(stream, topic="/pose") for stream in log.streams))
    assert fit(together, load_config(sets=[WIDTH])).summary["heading"]["applied_delay_s"] == 0.0


def exact_circle() -> RobotLog:
    """Drive a circle at constant speed, without noise."""
    log = stop_and_go(fixes_late_s=0.3)
    even = np.full(len(log.wheels.stamp_ns), 0.6)
    turning = replace(log, wheels=replace(log.wheels, left=even + 0.1, right=even - 0.1))
    x = drive_states(np.array([0.0, 0.0, 0.3, *ICRS]), even + 0.1, even - 0.1, 0.02)
    return replace(
        turning,
        gnss=replace(log.gnss, north_m=x[::5, 0], east_m=x[::5, 1]),
        heading=replace(log.heading, heading_rad=np.angle(np.exp(1j * x[:, 2]))),
    )


def test_a_constant_speed_shows_no_delay_of_the_fixes() -> None:
    summary = fit(exact_circle(), load_config(sets=[WIDTH])).summary
    assert summary["filter"]["reference_delay_s"] == 0.0
    assert summary["heading"]["applied_delay_s"] == 0.0


@pytest.mark.parametrize("relative", [1e-16, 1e-15, 1e-12, 1e-8])
def test_last_bits_of_an_exact_circle_name_no_side_reversed(relative: float) -> None:
    """It shows only sums of the parameters: their covariance is singular but for the prior."""
    log, rng = exact_circle(), np.random.default_rng(0)
    for _ in range(10):
        north, east, psi = (
            values * (1.0 + relative * rng.normal(size=len(values)))
            for values in (log.gnss.north_m, log.gnss.east_m, log.heading.heading_rad)
        )
        moved = replace(log.gnss, north_m=north, east_m=east)
        track = track_of_log(replace(log, gnss=moved, heading=replace(log.heading, heading_rad=psi)))
        assert decide_conventions(cut_drive_windows(track), metric=False).convention == AS_NAMED


@pytest.mark.parametrize("row", [0, -1])
def test_a_stamp_decades_away_neither_fills_the_memory_nor_changes_the_delay(row: int) -> None:
    log = stop_and_go(heading_late_s=0.3)
    stray = [stream.stamp_ns.copy() for stream in (log.wheels, log.heading)]
    for stamps in stray:
        stamps[row] += -START_NS if row == 0 else START_NS
    wheels, heading = replace(log.wheels, stamp_ns=stray[0]), replace(log.heading, stamp_ns=stray[1])
    tracemalloc.start()
    try:
        track = track_of_log(replace(log, wheels=wheels, heading=heading))
        found = estimate_alignment(cut_drive_windows(track), 0.8)
        most = tracemalloc.get_traced_memory()[1]
    except MemoryError:
        pytest.fail("an array over the time between first and last stamp")
    finally:
        tracemalloc.stop()
    assert found is not None
    assert found.estimate("heading_delay")[0] == pytest.approx(0.3, abs=DELAY_TOLERANCE_S)
    assert most < 50e6


@pytest.mark.parametrize(
    ("heading", "after", "expected"),
    [
        (0.01, 0.02, (0.0, 0.0)),
        (0.01, 0.2, (0.0, 0.2)),
        (0.2, -0.2, (0.2, 0.0)),
        (0.2, 0.02, (0.2, 0.2)),
        (0.3, 0.3, (0.3, 0.6)),
        # the robot's own turn leads its wheels': no clock
        (-0.1, 0.12, (0.0, 0.0)),
        (0.08, 0.0, (0.0, 0.0)),
    ],
)
def test_the_likeliest_delays_are_corrected(heading: float, after: float, expected: tuple[float, float]) -> None:
    found = _clear_delays(
        DelayEstimate(heading, 0.03), DelayEstimate(heading + after, 0.06), DelayEstimate(after, 0.05), together=False
    )
    assert found == pytest.approx(expected)


def test_clocks_that_show_no_difference_are_known_better_than_the_drive_shows() -> None:
    nothing = DelayEstimate(0.0, 0.03)

    def unknown(after: float, std: float) -> float:
        return StreamDelays(nothing, nothing, DelayEstimate(after, std), False, 0.0, 0.0).clock_std_s

    assert unknown(0.0, 0.05) == pytest.approx(0.05 / 2.0)
    assert unknown(0.12, 0.05) > 0.1
    # a drive that shows nothing leaves half of the prior
    assert unknown(0.0, 0.15) == pytest.approx(0.15 / np.sqrt(2.0))
    corrected = StreamDelays(nothing, nothing, DelayEstimate(0.2, 0.05), False, 0.0, 0.2)
    assert corrected.clock_std_s == 0.05
