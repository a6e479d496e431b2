"""Pooled fits: derivatives against differences, parameters within their covariance, the downdate against a new fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from icrtool.calibration.held_out import hold_out
from icrtool.errors import DataError
from icrtool.kernels.arrays import Floats
from icrtool.kernels.robust import LOSS_SIGMAS
from icrtool.kernels.track import Track
from icrtool.motion.models import MODELS, TERMS, FittedModel, MotionModel, find_model, wheel_motion
from icrtool.motion.recording import LogConstants, Recording, cut_trials, cut_windows, predicted_path
from icrtool.motion.window_fit import (
    LAST_DELAY_STEP_SIGMAS,
    Fold,
    Pool,
    PooledFit,
    heading_wander,
    own_constants,
    residuals_of,
    shortening_by_wander,
)
from support.recordings import (
    FAMILY,
    WIDTH_M,
    draw_parameters,
    first_order,
    make_recording,
    table_errors,
    trials_from_all,
    twist,
)

EIGHT = MODELS["recommended"]
SEEDS = range(8)
STEP = 1e-6
ROUNDING_M = 1e-9
FREE = [model for model in FAMILY.values() if model.terms]


def fitted(model: MotionModel, parameters: Floats) -> FittedModel:
    return FittedModel(model, parameters, np.eye(len(parameters)))


def fit_to(model: MotionModel, *recordings: Recording) -> PooledFit:
    return Pool([cut_windows(one) for one in recordings], [WIDTH_M] * len(recordings)).fit(model)


@pytest.mark.parametrize(("gain", "widened"), [(0.0, False), (-0.25, True)])
def test_a_prior_is_wide_where_the_drive_shows_more_than_it(gain: float, widened: bool) -> None:
    """A narrow prior of 0.03 alone would pull a change of the turn gain of -0.25 to half of it."""
    whole = FAMILY["recommended"]
    place = whole.terms.index("omega_sw")
    truth = whole.prior_mean
    truth[place] = gain
    found = fit_to(whole, make_recording(whole, truth, seconds=300.0))
    assert (found.model.prior_std[place] > 3.0 * TERMS["omega_sw"].std) == widened
    assert abs(found.parameters[place] - gain) < max(3.0 * found.std[place], 0.03)
    assert not (widened and "omega_sw" in found.not_shown)
    narrow = fit_to(replace(whole, stds=tuple(whole.prior_std)), make_recording(whole, truth, seconds=300.0))
    assert (abs(narrow.parameters[place] - gain) > 2.0 * abs(found.parameters[place] - gain)) == widened


@pytest.mark.parametrize("name", ["recommended", "five_gyro"])
def test_derivatives_are_those_of_differences(name: str) -> None:
    """Windows of one length: what slip shortens is held, as the scale of residuals is."""
    model = find_model(name)
    recording = make_recording(EIGHT, EIGHT.prior_mean, seconds=60.0, gyro=True)
    wheels = fitted(EIGHT, EIGHT.prior_mean + 0.01) if model.uses_gyro else None
    residuals = residuals_of(cut_windows(recording, (5.0,)), model, WIDTH_M, wheels)
    x = np.concatenate(
        [draw_parameters(model, np.random.default_rng(1)), [0.02, 0.033, *([0.01, 0.027] if model.uses_gyro else [])]]
    )
    k = len(model.terms)
    _, slopes = residuals(x[:k], x[k:])
    for column in range(len(x)):
        low, high = x.copy(), x.copy()
        low[column] -= STEP
        high[column] += STEP
        by = (residuals(high[:k], high[k:])[0] - residuals(low[:k], low[k:])[0]) / (2 * STEP)
        np.testing.assert_allclose(
            slopes[:, column], by, atol=1e-5, err_msg=str((*model.terms, *LogConstants._fields)[column])
        )


def test_window_ends_equal_the_direct_integration() -> None:
    parameters = draw_parameters(EIGHT, np.random.default_rng(2))
    recording = make_recording(EIGHT, parameters, seconds=60.0)
    trials = trials_from_all(recording, (5.0, 10.0))
    path, drive = predicted_path(recording, fitted(EIGHT, parameters)), recording.track
    errors = table_errors(recording, trials, path)
    rates = twist(EIGHT, parameters, wheel_motion(drive.v_left, drive.v_right, WIDTH_M))
    for start in range(0, 300, 50):
        end, north, east, psi = trials.ends[start, 1], 0.0, 0.0, drive.heading[start]
        for i in range(start, end):
            north += drive.held[i] * (rates[0, i] * np.cos(psi) - rates[1, i] * np.sin(psi))
            east += drive.held[i] * (rates[0, i] * np.sin(psi) + rates[1, i] * np.cos(psi))
            psi += drive.held[i] * rates[2, i]
        miss = np.hypot(north - drive.north[end] + drive.north[start], east - drive.east[end] + drive.east[start])
        assert errors[start, 1] == pytest.approx(miss, abs=ROUNDING_M)


def count_within(model: MotionModel, seeds: range, *, gyro: bool = False) -> tuple[int, int]:
    """Return how many parameters drawn from the prior come back within two standard deviations, and of how many."""
    inside = total = 0
    for seed in seeds:
        rng = np.random.default_rng([seed, 1])
        parameters = draw_parameters(model, rng)
        made = make_recording(model, parameters, seed, gyro=gyro)
        found, truth = fit_to(model, made), dict(zip(model.terms, parameters, strict=True))
        if made.track.gyro is not None:
            truth["gyro_scale"] = rng.normal(0.0, TERMS["gyro_scale"].std)
            scaled = replace(made, track=made.track._replace(gyro=made.track.gyro / (1.0 + truth["gyro_scale"])))
            pool = Pool([cut_windows(scaled)], [WIDTH_M])
            found = pool.fit(model.with_gyro(), pool.fit(model))
        # the weight of the wheels is no property of the robot
        rows = [k for k, name in enumerate(found.model.terms) if name in truth]
        off = found.parameters[rows] - [truth[found.model.terms[k]] for k in rows]
        inside, total = inside + int(np.count_nonzero(np.abs(off) < 2.0 * found.std[rows])), total + len(rows)
    return inside, total


@pytest.mark.parametrize("gyro", [False, True])
def test_parameters_drawn_from_the_prior_come_back_within_two_standard_deviations(gyro: bool) -> None:
    """Slip that wanders makes the errors of neighbouring windows alike."""
    models, seeds = (FREE[-4:-2], range(6)) if gyro else (FREE, SEEDS)
    inside, total = np.sum([count_within(model, seeds, gyro=gyro) for model in models], axis=0)
    assert 0.88 <= inside / total <= 0.99


@pytest.mark.stress
@pytest.mark.parametrize("gyro", [False, True])
@pytest.mark.parametrize("model", FREE, ids=lambda model: model.name)
def test_two_hundred_robots_of_each_model_come_back(model: MotionModel, gyro: bool) -> None:
    inside, total = count_within(model, range(200), gyro=gyro)
    print(f"{model.name}, gyro {gyro}: {inside} of {total} within two standard deviations, {inside / total:.3f}")
    assert 0.90 <= inside / total <= 0.98


FEW = [4, *(pytest.param(count, marks=pytest.mark.stress) for count in (2, 3, 8))]


@pytest.mark.parametrize("scatter", [0.0, 1.0])
@pytest.mark.parametrize("count", FEW)
def test_two_standard_deviations_hold_where_the_robot_changes_between_recordings(count: int, scatter: float) -> None:
    model, between = FAMILY["five"], scatter * np.array([0.01, 0.03, 0.02, 0.01, 0.05])
    off = []
    for seed in range(16):
        rng = np.random.default_rng([seed, 5])
        parameters = draw_parameters(model, rng)
        of_recordings = parameters + between * rng.standard_normal((count, len(between)))
        found = fit_to(model, *(make_recording(model, x, 10 * seed + i, 120.0) for i, x in enumerate(of_recordings)))
        off.append((found.parameters - parameters) / found.std)
    inside = np.mean(np.abs(off) < 2.0)
    print(f"{count} recordings, scatter {scatter:g}: {inside:.2f} within two standard deviations")
    assert 0.80 <= inside <= 0.99


def test_pooled_recordings_have_constants_of_their_own() -> None:
    parameters = FAMILY["five"].prior_mean
    one, two = make_recording(FAMILY["five"], parameters, 1), make_recording(FAMILY["five"], parameters, 2)
    turned = two.track._replace(heading=two.track.heading + 0.03)
    late = Recording("late", turned, WIDTH_M)
    found = fit_to(FAMILY["five"], one, late)
    assert found.constants(0).heading_offset_rad == pytest.approx(0.0, abs=0.01)
    # the reference's heading is too large: what is added to it is negative
    assert found.constants(1).heading_offset_rad == pytest.approx(-0.03, abs=0.01)
    alone = fit_to(FAMILY["five"], one)
    # Student's t doubles the standard deviation of two recordings
    assert np.all(found.std < 2.0 * alone.std)
    assert np.all(np.abs(found.parameters - parameters) < 3.0 * np.sqrt(np.diag(found.covariance)))


@pytest.mark.parametrize(("count", "grown"), [(2, 3.0), (5, 1.4)])
def test_leaving_a_recording_out_is_near_a_fit_to_the_others(count: int, grown: float) -> None:
    """Of few recordings it is a fit to the others; of many the recording is subtracted.

    Its variance is grown as that of all recordings; a single one does not show how recordings differ.
    """
    model = replace(EIGHT, stds=tuple(EIGHT.prior_std))
    recordings = [make_recording(model, model.prior_mean, seed) for seed in range(count)]
    whole, new = fit_to(model, *recordings), fit_to(model, *recordings[:-1])
    found = whole.fit_without(Fold("", count - 1, count - 1, -np.inf, np.inf))
    assert found is not None
    quick, own = found
    away, moved = (np.abs(one.parameters - new.parameters) / new.std for one in (quick, whole))
    assert away.max() < 0.1 * max(moved.max(), 0.3)
    assert np.all((quick.std > new.std / 1.4) & (quick.std < new.std * grown))
    alone = own_constants(cut_windows(recordings[-1]), new, WIDTH_M)
    assert own.heading_offset_rad == pytest.approx(alone.heading_offset_rad, abs=1e-3)
    assert own.wheels_later_s == pytest.approx(alone.wheels_later_s, abs=2e-3)


def test_priors_are_as_wide_as_the_other_recordings_show() -> None:
    """Witness: fits to the other recordings alone, with the priors that these show; what is left out is one step."""
    place, truth = EIGHT.terms.index("omega_sw"), EIGHT.prior_mean
    truth[place] = -0.06
    recordings = [make_recording(EIGHT, truth, seed, 120.0) for seed in range(5)]
    whole, widths = fit_to(EIGHT, *recordings), []
    for i in range(5):
        found = whole.fit_without(Fold("", i, i, -np.inf, np.inf))
        assert found is not None
        model = found[0].model
        new = fit_to(model, *(one for one in recordings if one is not recordings[i]))
        assert np.all(np.abs(found[0].parameters - new.parameters) < 0.5 * new.std)
        widths.append(model.prior_std[place])
    assert min(widths) == TERMS["omega_sw"].std < whole.model.prior_std[place] < max(widths)


def test_a_pooled_fit_is_that_of_the_dense_least_squares() -> None:
    """Witness: scipy on the roots of the loss and of the prior, over all parameters at once."""
    model = find_model("five_gyro")
    recordings = [make_recording(EIGHT, EIGHT.prior_mean, seed, 90.0, gyro=True, rate=50.0) for seed in range(3)]
    pool = Pool([cut_windows(one) for one in recordings], [WIDTH_M] * 3)
    wheels = pool.fit(FAMILY["five"])
    found = pool.fit(model, wheels)
    parts = [residuals_of(w, model, WIDTH_M, wheels) for w in pool.windows]
    mean, std = pool.prior(model)
    k, scale = len(model.terms), np.split(found.solution.scale, pool.first[1:-1])

    def roots(x: Floats) -> Floats:
        own = zip(parts, x[k:].reshape(3, -1), scale, strict=True)
        z = np.concatenate([part(x[:k], constants)[0] / spread for part, constants, spread in own])
        loss = 2.0 * LOSS_SIGMAS**2 * (np.sqrt(1.0 + (z / LOSS_SIGMAS) ** 2) - 1.0)
        return np.concatenate([np.sqrt(loss / pool.overlap), (x - mean) / std])

    theirs = least_squares(roots, mean, x_scale=std).x
    assert np.all(np.abs(found.parameters - theirs[:k]) < LAST_DELAY_STEP_SIGMAS * found.std)


def test_what_is_left_beside_a_fold_is_not_enough() -> None:
    short = make_recording(EIGHT, EIGHT.prior_mean, seconds=60.0)
    found = fit_to(EIGHT, short)
    assert found.fit_without(Fold("", 0, 0, 5.0, float(short.track.distance[-1]))) is None


def test_joined_steps_give_the_parameters_of_single_samples() -> None:
    fine = make_recording(EIGHT, EIGHT.prior_mean, 3, 120.0, rate=50.0)
    found = fit_to(EIGHT, fine)
    assert np.all(np.abs(found.parameters - EIGHT.prior_mean) < 3.0 * np.sqrt(np.diag(found.covariance)))


def test_a_drive_too_short_is_an_error() -> None:
    with pytest.raises(DataError, match="windows"):
        cut_windows(make_recording(EIGHT, EIGHT.prior_mean, seconds=4.0))


def test_a_heading_that_wanders_shortens_windows() -> None:
    """Against displacements along headings of random steps, 0.02 rad^2 a metre, with noise of the reference."""
    rng, step_m, variance = np.random.default_rng(3), 0.05, 0.02
    turned, moved, length_m = [], [], np.repeat([5.0, 10.0], 4000)
    for length in length_m:
        heading = np.cumsum(rng.normal(0.0, np.sqrt(variance * step_m), int(length / step_m)))
        turned.append(heading[-1] + rng.normal(0.0, 0.05))
        moved.append(np.exp(1j * heading).mean())
    found = shortening_by_wander(heading_wander(np.array(turned), length_m), length_m)
    for length in (5.0, 10.0):
        mine = length_m == length
        assert found[mine] == pytest.approx(np.mean(moved, where=mine).real, abs=0.004)


def test_a_delay_of_the_wheels_is_found_and_used() -> None:
    model = FAMILY["five"]
    made = make_recording(model, model.prior_mean, 5, slip=0.0, noise_rad=0.0)
    shift, d = 2, made.track
    # the poses are those of 0.2 s later: the wheels are to be read later
    pose = (getattr(d, name)[shift:] for name in ("north", "east", "heading", "distance"))
    wheels = (getattr(d, name)[:-shift] for name in ("t", "held", "v_left", "v_right"))
    moved = Recording("late", Track.of_states(*wheels, *pose), WIDTH_M)
    found = fit_to(model, moved)
    assert found.constants(0).wheels_later_s == pytest.approx(0.2, abs=0.02)
    trials = cut_trials(moved, (10.0,))
    with_delay, without = (
        table_errors(moved, trials, predicted_path(moved, found, LogConstants(wheels_later_s=later)))
        for later in (0.2, 0.0)
    )
    assert np.nanmean(with_delay) < 0.5 * np.nanmean(without)


def test_a_gyro_read_at_another_time_than_the_wheels_is_found() -> None:
    """Without its own time, the heading of a gyro 0.15 s apart is off by that time's turn at every start and end."""
    model = FAMILY["five"]
    made = make_recording(model, model.prior_mean, 6, gyro=True, rate=20.0)
    assert made.track.gyro is not None
    shift = 3
    late = replace(made, track=made.track._replace(gyro=np.roll(made.track.gyro, shift)))
    pool = Pool([cut_windows(late)], [WIDTH_M])
    found = pool.fit(model.with_gyro(), pool.fit(model))
    trials, own = cut_trials(late, (10.0,)), found.constants(0)
    # turns show it against the poses; what of it is the wheels' own delay, only displacements show
    assert own.wheels_later_s + own.gyro_later_s == pytest.approx(shift / 20.0, abs=0.01)
    assert own.gyro_later_s > 2.0 * own.wheels_later_s
    at_its_time, at_the_wheels = (
        table_errors(late, trials, predicted_path(late, found, one)) for one in (own, own._replace(gyro_later_s=0.0))
    )
    assert np.nanmean(at_its_time) < 0.8 * np.nanmean(at_the_wheels)


def test_a_poor_gyro_gives_way_to_the_wheels() -> None:
    """Held out over distance, both together are not worse than the better of the two by more than 5 %."""
    model = FAMILY["five"]
    rng = np.random.default_rng(5)
    logs = [make_recording(model, model.prior_mean, seed, gyro=True, slip=0.02, name=f"{seed}") for seed in range(3)]
    keep = np.exp(-0.1 / 5.0)
    poor = []
    for one in logs:
        assert one.track.gyro is not None
        push = rng.normal(0.0, 0.05 * np.sqrt(1.0 - keep**2), len(one.track.t) - 1)
        drift = first_order(keep, np.append(0.0, push))
        poor.append(replace(one, track=one.track._replace(gyro=one.track.gyro + drift)))
    table = hold_out(poor)
    weight = table.fits["five_gyro"].parameters[-1]
    assert 0.5 < weight < 1.2
    ratio = table.score("recommended_gyro").together.expected / table.score("recommended").together.expected
    assert np.all(ratio < 1.05)
