"""Every mixture of swapped, reversed and mirrored streams is recognised, up to the two exact symmetries."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from icrtool.alignment.conventions import AS_NAMED, StreamSigns, decide_conventions, senses_by_distance
from icrtool.alignment.corrections import align_streams
from icrtool.alignment.log_track import cut_drive_windows, track_of_log
from icrtool.kernels.track import Track
from icrtool.records.notes import warnings_of
from icrtool.records.samples import GyroSamples
from support.exact_drives import CONFIG, simulate


def spoilt(track: Track, one: StreamSigns) -> Track:
    """Return the drive as a log would hold it whose convention is `one`."""
    left, right = (track.v_right, track.v_left) if one.swapped else (track.v_left, track.v_right)
    return track._replace(
        v_left=one.sign_left * left,
        v_right=one.sign_right * right,
        heading=one.heading * track.heading,
        east=one.position * track.east,
    )


def equivalents(one: StreamSigns) -> set[StreamSigns]:
    """Return the conventions that no residual tells from this one."""
    mirrored = one._replace(swapped=not one.swapped, heading=-one.heading, position=-one.position)
    return {
        same
        for each in (one, mirrored)
        for same in (
            each,
            each._replace(swapped=not each.swapped, sign_left=-each.sign_left, sign_right=-each.sign_right),
        )
    }


@pytest.fixture(scope="module")
def track() -> Track:
    return track_of_log(simulate(3, lever=(0.0, 0.0), offset_deg=0.0, scales=(1.0, 1.0), seconds=120.0))


@pytest.mark.parametrize(
    "one", [StreamSigns(*parts) for parts in product((False, True), (1, -1), (1, -1), (1, -1), (1, -1))]
)
def test_a_spoilt_log_is_recognised(track: Track, one: StreamSigns) -> None:
    found = decide_conventions(cut_drive_windows(spoilt(track, one)), metric=True)
    assert found.convention in equivalents(one)


@pytest.mark.parametrize(
    "one",
    [
        AS_NAMED,
        AS_NAMED._replace(swapped=True),
        AS_NAMED._replace(sign_left=-1),
        AS_NAMED._replace(sign_right=-1),
        AS_NAMED._replace(sign_left=-1, sign_right=-1),
        AS_NAMED._replace(heading=-1),
        AS_NAMED._replace(position=-1),
    ],
)
def test_a_single_fault_is_named_itself(track: Track, one: StreamSigns) -> None:
    found = decide_conventions(cut_drive_windows(spoilt(track, one)), metric=True, gyro_sense=one.heading)
    assert found.convention == one


@pytest.mark.parametrize("swapped", [True, False])
def test_what_drives_forward_is_likelier_than_what_drives_backwards(track: Track, swapped: bool) -> None:
    """Swapped sides with a heading of the other handedness, as ENU yaw taken for NED gives it."""
    one = AS_NAMED._replace(swapped=swapped, heading=-1)
    log = spoilt(track, one)
    log = log._replace(heading=log.heading + np.pi / 2)
    found = decide_conventions(cut_drive_windows(log), metric=False)
    assert found.convention == one
    assert found.as_likely is None


def test_a_mirrored_pose_is_likelier_than_swapped_sides(track: Track) -> None:
    one = AS_NAMED._replace(heading=-1, position=-1)
    found = decide_conventions(cut_drive_windows(spoilt(track, one)._replace(same_clock=True)), metric=True)
    assert found.convention == one
    assert found.as_likely == AS_NAMED._replace(swapped=True)


@pytest.mark.parametrize("sense", [1, -1])
def test_a_gyro_tells_swapped_sides_from_a_mirrored_pose(sense: int) -> None:
    """One explains the log as well as the other; a gyro turns as the pose does, or in the opposite sense."""
    log = simulate(3, lever=(0.0, 0.0), offset_deg=0.0, scales=(1.0, 1.0), seconds=120.0)
    t, heading = log.heading.stamp_ns / 1e9, np.unwrap(log.heading.heading_rad)
    every = slice(None, None, 20)
    gyro = GyroSamples("/imu", log.heading.stamp_ns[every], sense * np.gradient(heading[every], t[every]))
    spoilt_log = replace(
        log,
        wheels=replace(log.wheels, left=log.wheels.right, right=log.wheels.left),
        streams=tuple(replace(one, topic="/pose") for one in log.streams),
        gyro=gyro,
    )
    found = align_streams(spoilt_log, CONFIG)
    assert found.heading.applied_mirror == (sense < 0)
    assert any("wheels are swapped" in warning for warning in warnings_of(found.notes)) == (sense > 0)


def test_geodetic_positions_are_never_mirrored(track: Track) -> None:
    mirrored = spoilt(track, AS_NAMED._replace(position=-1))
    assert decide_conventions(cut_drive_windows(mirrored), metric=False).convention.position == 1


def test_a_straight_drive_decides_nothing() -> None:
    track = track_of_log(simulate(1, path="straight", seconds=80.0))
    swapped = spoilt(track, AS_NAMED._replace(swapped=True))
    assert decide_conventions(cut_drive_windows(swapped), metric=True).convention == AS_NAMED


@pytest.mark.parametrize("one", [AS_NAMED, AS_NAMED._replace(sign_left=-1), AS_NAMED._replace(sign_right=-1)])
def test_a_reversed_side_shows_without_a_heading(track: Track, one: StreamSigns) -> None:
    assert senses_by_distance(spoilt(track, one)) == one
