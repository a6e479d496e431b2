"""Tests of what motion models are fitted to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.track import Track
from icrtool.kernels.window_residuals import path_at
from icrtool.motion import recording as recordings
from icrtool.motion.models import FULL_LINEAR, MODELS, RECOMMENDED, model_columns, parameters_of_icrs, wheel_motion
from icrtool.motion.recording import Recording, samples_a_step, steps_of
from support.open_loop_vector import HELD_S, ICRS_M, PATH, V_LEFT_MPS, V_RIGHT_MPS
from support.recordings import make_recording

SCALES = 0.96, 1.03


def scaled(recording: Recording) -> Recording:
    """Return a recording whose track holds other speeds, with the scales that take them back."""
    track, (left, right) = recording.track, SCALES
    return replace(
        recording, wheel_scales=SCALES, track=track._replace(v_left=left * track.v_left, v_right=right * track.v_right)
    )


@pytest.mark.parametrize("gyro", [False, True])
def test_steps_made_some_rows_at_a_time_are_those_of_the_whole_track(
    monkeypatch: pytest.MonkeyPatch, *, gyro: bool
) -> None:
    model = MODELS[RECOMMENDED]
    one = scaled(make_recording(model, np.array(model.prior_mean), rate=70.0, seconds=100.05, gyro=gyro))
    monkeypatch.setattr(recordings, "ROWS_AT_ONCE", 100)
    samples = samples_a_step(one)
    assert samples > 1
    assert len(one.track.t) % samples
    first, into = np.arange(0, len(one.track.t), samples), (samples - 1) / (2.0 * samples)
    whole: Track = one.wheels().joined(first, into)
    for name, column, expected in zip(Track._fields, steps_of(one), whole, strict=True):
        np.testing.assert_array_equal(column, expected, err_msg=name)


def test_speeds_are_those_at_the_configured_radius() -> None:
    model = MODELS[RECOMMENDED]
    plain = make_recording(model, np.array(model.prior_mean), seconds=60.0)
    some = slice(100, 200)
    for column, expected in zip(scaled(plain).wheels(some), plain.wheels(some), strict=True):
        if column is not None:
            np.testing.assert_allclose(column, expected, rtol=1e-15)
    assert samples_a_step(scaled(plain)) == samples_a_step(plain)


def test_the_path_of_a_motion_model_ends_where_the_shared_vector_states() -> None:
    width_m = 0.8
    t, none = np.concatenate([[0.0], np.cumsum(HELD_S)[:-1]]), np.zeros(len(PATH))
    track = Track.of_states(t, HELD_S, V_LEFT_MPS, V_RIGHT_MPS, none, none, none, none)
    parameters, _ = parameters_of_icrs(np.array(ICRS_M), width_m)

    def twists(some: slice) -> tuple[Floats, Ints, Floats]:
        return model_columns(FULL_LINEAR, wheel_motion(V_LEFT_MPS[some], V_RIGHT_MPS[some], width_m))

    path = path_at(track, twists, parameters, t)
    np.testing.assert_allclose(path.heading, PATH[:, 2] - PATH[0, 2], rtol=0, atol=1e-12)
    place = PATH[0, 0] + 1j * PATH[0, 1] + path.place * np.exp(1j * PATH[0, 2])
    np.testing.assert_allclose(np.column_stack([place.real, place.imag]), PATH[:, :2], rtol=0, atol=1e-12)
