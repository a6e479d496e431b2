"""Recordings made by a motion model: wheel speeds of a varied drive, a noisy reference, slip that wanders."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate

import numpy as np

from icrtool.kernels.arrays import Floats
from icrtool.kernels.track import Track, ends_from
from icrtool.motion.models import FULL_LINEAR, MODELS, FittedModel, MotionModel, WheelMotion, wheel_motion
from icrtool.motion.recording import PathAt, Recording, Trials, trial_errors

WIDTH_M = 0.6
SLOWEST_TURN = 0.15
"""A robot whose turn gain is less, or negative, is none."""

THREE_ICRS = MotionModel("icr", "three ICRs", ("vx_w", "omega_w", "vy_w"), "Pentzer 2014, Eqs. 8-12; Martinez 2005")
SIX = MotionModel("six", "ICRs, scales, side slip", (*MODELS["five"].terms, "vy_vw"), "with Seegmiller 2014")
FAMILY = MODELS | {model.name: model for model in (FULL_LINEAR, THREE_ICRS, SIX)}
"""The models that are fitted, and others that are linear in the same terms, by name."""


def twist(model: MotionModel, parameters: Floats, motion: WheelMotion) -> Floats:
    """Return the body twist of a model with some parameters (3, n)."""
    return FittedModel(model, parameters, np.eye(len(parameters))).twist(motion)


def draw_parameters(model: MotionModel, rng: np.random.Generator) -> Floats:
    """Draw a model's parameters from their prior."""
    while True:
        parameters = rng.normal(model.prior_mean, model.prior_std)
        if "omega_w" not in model.terms or parameters[model.terms.index("omega_w")] > SLOWEST_TURN:
            return parameters


def first_order(kept: float, push: Floats) -> Floats:
    """Return errors (n,) of which a share is kept from sample to sample, from what is added to each (n,)."""
    return np.array(list(accumulate(push.tolist(), lambda before, one: kept * before + one)))


def make_recording(
    model: MotionModel, parameters: Floats, seed: int = 0, seconds: float = 300.0, *, rate: float = 10.0,
    slip: float = 0.05, noise_m: float = 0.01, noise_rad: float = 0.003, gyro: bool = False, name: str = "made",
) -> Recording:  # fmt: skip
    """Drive with stops, spins and bends.

    Parameters
    ----------
    slip : standard deviation of the share by which speed and turn wander, over about a second
    noise_m, noise_rad : white noise of the reference
    """
    rng = np.random.default_rng([seed, 7])
    t = np.arange(0.0, seconds, 1.0 / rate)
    n, dt = len(t), 1.0 / rate
    phase = rng.uniform(0.0, 6.3, 4)
    mean = 0.8 + 0.5 * np.sin(0.21 * t + phase[0]) + 0.3 * np.sin(0.67 * t + phase[1])
    turn = 0.7 * np.sin(0.33 * t + phase[2]) + 0.6 * np.sin(0.83 * t + phase[3])
    v_left, v_right = mean + turn * WIDTH_M / 2, mean - turn * WIDTH_M / 2
    v_x, v_y, omega = twist(model, parameters, wheel_motion(v_left, v_right, WIDTH_M))
    keep = np.exp(-dt)
    push = rng.normal(0.0, slip * np.sqrt(1.0 - keep**2), (n - 1, 3))
    wander = np.array([first_order(keep, np.append(0.0, one)) for one in push.T])
    v_x, v_y, omega = v_x * (1 + wander[0]), v_y + v_x * wander[1] / 3, omega * (1 + wander[2])
    heading = np.concatenate([[0.3], 0.3 + np.cumsum(dt * omega)[:-1]])
    place = np.concatenate([[0.0], np.cumsum(dt * (v_x + 1j * v_y) * np.exp(1j * heading))[:-1]])
    track = Track.of_states(
        t, np.append(np.full(n - 1, dt), 0.0), v_left, v_right,
        place.real + rng.normal(0.0, noise_m, n), place.imag + rng.normal(0.0, noise_m, n),
        heading + rng.normal(0.0, noise_rad, n),
        np.concatenate([[0.0], np.cumsum(dt * np.hypot(v_x, v_y))[:-1]]),
    )  # fmt: skip
    if gyro:
        track = track._replace(gyro=omega + rng.normal(0.0, 0.005, n) + 0.002)
    return Recording(name, track, WIDTH_M, f"/logs/{name}", name)


def table_errors(recording: Recording, trials: Trials, path: PathAt) -> Floats:
    """Return the errors (k, h) [m] of trials along one path, NaN where there is none."""
    errors: Floats = np.full(trials.ends.shape, np.nan)
    row, column = np.nonzero(trials.ends >= 0)
    errors[row, column] = trial_errors(recording, trials.starts[row], trials.ends[row, column], path).position
    return errors


def trials_from_all(recording: Recording, horizons_m: Sequence[float]) -> Trials:
    """Return the trials from every recorded state."""
    starts = np.arange(len(recording.track.t))
    return Trials(starts, ends_from(recording.track, np.array(horizons_m), starts))
