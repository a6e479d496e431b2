"""Slip events in the filter: it follows the fixes through them and learns nothing there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icrtool.alignment.align import align, sensors_as_sent
from icrtool.alignment.slip_events import Disagreements
from icrtool.calibration.pooled import recording_of
from icrtool.config import Config, parse_config
from icrtool.estimation.filter_setup import EVENT_MARGIN_S, set_up_filter
from icrtool.kernels.ekf import run_ekf, run_smoother
from icrtool.kernels.filter_records import GATED, FilterInputs
from icrtool.motion.recording import cut_windows
from icrtool.pipeline import fit
from icrtool.records.measurements import SensorData, SlipEvent
from icrtool.records.tables import RobotLog
from support.drives import EPOCH_NS, ICRS, make_log
from support.matrix_filter import run_ekf_plain

CONFIG = parse_config({"robot": {"track_width_m": 0.6}})
BEGIN_S, END_S = 30.0, 36.0


def held_sensors(config: Config = CONFIG) -> SensorData:
    """Sensors of a robot that stands from `BEGIN_S` to `END_S` while its wheels turn on."""
    log = make_log(seed=3, seconds=80.0)
    sensors = sensors_as_sent(log, config)
    t = (sensors.fixes.stamp_ns - EPOCH_NS) / 1e9
    t_heading = (sensors.headings.stamp_ns - EPOCH_NS) / 1e9
    # the robot's own clock stops, the wheels' does not: their speeds are those of a clock that goes on
    stopped, stopped_heading = (
        np.where(x < BEGIN_S, x, np.maximum(x - (END_S - BEGIN_S), BEGIN_S)) for x in (t, t_heading)
    )
    psi = np.unwrap(sensors.headings.heading_rad)
    wheel_t = (sensors.wheels.stamp_ns - EPOCH_NS) / 1e9
    source = np.where(wheel_t < BEGIN_S, wheel_t, np.maximum(wheel_t - (END_S - BEGIN_S), BEGIN_S))
    return replace(
        sensors,
        wheels=replace(
            sensors.wheels,
            left=np.interp(source, wheel_t, sensors.wheels.left),
            right=np.interp(source, wheel_t, sensors.wheels.right),
        ),
        fixes=replace(
            sensors.fixes,
            north_m=np.interp(stopped, t, sensors.fixes.north_m),
            east_m=np.interp(stopped, t, sensors.fixes.east_m),
        ),
        headings=replace(
            sensors.headings, heading_rad=np.angle(np.exp(1j * np.interp(stopped_heading, t_heading, psi)))
        ),
    )  # fmt: skip


def with_event(sensors: SensorData) -> SensorData:
    begin, end = (EPOCH_NS + round(s * 1e9) for s in (BEGIN_S, END_S))
    return replace(sensors, events=(SlipEvent("immobilised", begin, end, 0.0, 0.0, 0.0, 1.0, 1.0),))


def test_fixes_in_an_event_are_followed_and_the_icrs_stay() -> None:
    sensors = held_sensors()
    plain, told = (set_up_filter(one, CONFIG) for one in (sensors, with_event(sensors)))
    unaware, aware = (run_ekf(s.data, s.t0, s.x0, s.P0, s.parameters) for s in (plain, told))
    assert np.count_nonzero(aware.gnss_code == GATED) == 0
    t = told.data.wheel_t[-len(aware.x) :]
    before, after = np.searchsorted(t, [BEGIN_S - EVENT_MARGIN_S, END_S + EVENT_MARGIN_S])
    assert np.abs(aware.x[after, 3:] - aware.x[before, 3:]).max() < 0.01
    assert np.abs(unaware.x[after, 3:] - unaware.x[before, 3:]).max() > 0.05


def test_an_outage_that_is_made_knows_no_event() -> None:
    sensors = with_event(held_sensors())
    outage = (EPOCH_NS + 32_000_000_000, EPOCH_NS + 34_000_000_000)
    data = set_up_filter(sensors, CONFIG, outages_ns=(outage,)).data
    inside = (data.wheel_t >= 32.0) & (data.wheel_t < 34.0)
    assert not data.slipping[inside].any()
    assert data.slipping[(data.wheel_t > 30.0) & (data.wheel_t < 31.9)].all()


def test_the_filter_through_slip_equals_the_matrix_form() -> None:
    setup = set_up_filter(with_event(held_sensors()), CONFIG)
    out, plain = run_ekf(*setup), run_ekf_plain(*setup)
    for name in ("x", "variance", "distance", "P"):
        assert getattr(out, name) == pytest.approx(getattr(plain, name), abs=1e-9)


def test_smoothing_ends_at_the_state_of_the_filter_through_slip() -> None:
    setup = set_up_filter(with_event(held_sensors()), CONFIG)
    assert run_smoother(*setup).x[-1] == pytest.approx(run_ekf(*setup).x[-1], abs=1e-12)


def test_measurements_without_flags_have_no_slip() -> None:
    assert len(FilterInputs(*(np.empty(0) for _ in range(10))).slipping) == 0


def log_with_spin() -> RobotLog:
    """A drive whose left side turns three times as fast as it rolls, from 40 to 46 s."""
    log = make_log(seed=3, seconds=120.0)
    t = (log.wheels.stamp_ns - EPOCH_NS) / 1e9
    spins = (t >= 40.0) & (t < 46.0)
    return replace(log, wheels=replace(log.wheels, left=np.where(spins, 3.0, 1.0) * log.wheels.left))


def test_an_event_is_left_out_of_the_calibration() -> None:
    run = fit(log_with_spin(), CONFIG)
    (event,) = run.sensors.events
    recording = recording_of(run)
    windows = cut_windows(recording)
    begin, end = (recording.begin_ns + 1e9 * windows.track.place_t[one] for one in (windows.begin, windows.end))
    assert not ((begin < event.end_ns) & (end > event.begin_ns)).any()
    assert ((begin < event.end_ns) & (end > event.begin_ns - 2e9)).any()
    track = recording.track._replace(slipping=np.zeros_like(recording.track.slipping))
    assert len(cut_windows(replace(recording, track=track)).begin) > len(windows.begin)


def test_an_event_is_left_out_of_the_alignment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the second alignment the spinning left side is taken for a scale and for an ICR further out."""
    log = log_with_spin()
    found = align(log, CONFIG)
    assert [event.kind for event in found.sensors.events] == ["spin"]
    monkeypatch.setattr("icrtool.alignment.align.find_disagreements", lambda sensors, width_m: Disagreements())
    once = align(log, CONFIG)
    true = ICRS[0] - ICRS[1]
    errors = [abs((one.estimates["icr_separation_m"].value or 0.0) - true) for one in (found, once)]
    assert errors[0] < 0.01 * true
    assert errors[1] > 3.0 * errors[0]
