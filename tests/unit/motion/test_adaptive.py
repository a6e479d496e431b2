"""A model that learns while it drives: against a plain transcription, from the past alone, by samples or at once."""

from __future__ import annotations

import math

import numpy as np
import pytest

from icrtool.calibration.adaptive_rows import adapt, samples_of
from icrtool.kernels.arrays import Complexes, Floats
from icrtool.kernels.track import Track
from icrtool.motion import adaptive
from icrtool.motion.adaptive import WHEELS_MODEL, AdaptiveModel, Learned, TermsPrior
from icrtool.motion.models import TERMS
from icrtool.motion.recording import Recording, cut_trials
from icrtool.motion.robot_prior import between_drives, known_robots, prior_of_robots

WIDTH_M = 0.6
TRUE = np.array([0.97, 0.05, 0.55, 0.004, -0.1, 0.0, 0.0, 0.0])
BIAS_RADPS, GYRO_SCALE = 0.004, 1.01


def made_drive(
    seconds: float = 120.0, hz: float = 20.0, seed: int = 0, terms: Floats = TRUE, *, gyro: bool = False
) -> Recording:
    """Drive curves with known terms by Euler steps; poses of 1 cm and 0.2 degrees."""
    rng = np.random.default_rng(seed)
    n = int(seconds * hz)
    t = np.arange(n) / hz
    left, right = 0.6 + 0.35 * np.sin(0.5 * t), 0.6 + 0.3 * np.sin(0.31 * t + 1.0)
    v, w = (left + right) / 2.0, (left - right) / WIDTH_M
    omega = terms[2] * w + terms[3] * v / WIDTH_M
    psi = np.cumsum(np.append(0.3, omega[:-1] / hz))
    moved = (terms[0] * v + (terms[1] + 1j * terms[4]) * w * WIDTH_M / 2.0) * np.exp(1j * psi) / hz
    place = np.cumsum(np.append(0.0, moved[:-1])) + 0.01 * (rng.normal(size=n) + 1j * rng.normal(size=n))
    held = np.full(n, 1.0 / hz)
    held[-1] = 0.0
    distance = np.cumsum(np.append(0.0, np.abs(v[:-1]) / hz))
    heading = psi + math.radians(0.2) * rng.normal(size=n)
    track = Track.of_states(t, held, left, right, place.real.copy(), place.imag.copy(), heading, distance)
    if gyro:
        rate = GYRO_SCALE * omega + BIAS_RADPS + 0.002 * rng.normal(size=n)
        track = track._replace(gyro=rate)
    return Recording("made", track, WIDTH_M)


def observed(recording: Recording, model: AdaptiveModel) -> list[Learned]:
    """Return what a model learned that observes a recording sample by sample."""
    return [
        model.now
        for *sample, gyro, known, broken, gap in samples_of(recording).T.tolist()
        if model.observe(*sample[:3], sample[3:] if known else None, gyro, broken=bool(broken), gap=bool(gap))
    ]


def same(one: Learned, other: Learned) -> bool:
    """Return whether two solutions are the same number by number."""
    return (
        one.t_s == other.t_s
        and np.array_equal(one.fitted.parameters, other.fitted.parameters)
        and one.constants == other.constants
        and one.turned_constants == other.turned_constants
    )


class Transcription:
    """The estimate in a few lines: every window driven by itself, derivatives by complex steps, no sums kept."""

    def __init__(self, recording: Recording, prior: TermsPrior) -> None:
        self.track, self.prior = recording.track, prior
        distance, self.knots = 0.0, [0]
        for i in range(1, len(self.track.t)):
            before = distance
            distance += (
                abs(self.track.v_left[i - 1] + self.track.v_right[i - 1])
                / 2.0
                * (self.track.t[i] - self.track.t[i - 1])
            )
            self.knots += [i] * (math.floor(distance / 0.5) - math.floor(before / 0.5))

    def residuals(self, begin: int, end: int, length: float, x: Complexes) -> Complexes:
        """Drive one window from knot to knot with some parameters and constants x (10, p); return residuals (3, p)."""
        tr, offset, later = self.track, x[8], x[9]
        since, until = tr.t[self.knots[begin]] + later, tr.t[self.knots[end]] + later
        # the wheels are not known before the first sample
        since = np.maximum(since.real, tr.t[0]) + 1j * since.imag
        theta, ahead, aside = np.zeros((3, x.shape[1]), np.complex128)
        i = first = max(int(np.searchsorted(tr.t, since[0].real, side="right")) - 1, 0)
        while i == first or tr.t[i] <= until[0].real:
            lo = since if i == first else tr.t[i]
            hi = tr.t[i + 1] if tr.t[i + 1] <= until[0].real else until
            left, right = tr.v_left[i], tr.v_right[i]
            v, w = (left + right) / 2.0, (left - right) / WIDTH_M
            spin = abs(left - right) / (abs(left) + abs(right))
            v_x = x[0] * v + x[1] * w * WIDTH_M / 2.0
            v_y = x[4] * w * WIDTH_M / 2.0 + x[5] * v * w
            omega = x[2] * w + x[3] * v / WIDTH_M + x[6] * spin * w + x[7] * abs(v) * w
            # Euler: all of a sample moves along the heading at its begin
            along = theta - omega * (lo - tr.t[i])
            ahead = ahead + (v_x * np.cos(along) - v_y * np.sin(along)) * (hi - lo)
            aside = aside + (v_x * np.sin(along) + v_y * np.cos(along)) * (hi - lo)
            theta = theta + omega * (hi - lo)
            i += 1
        b, e = self.knots[begin], self.knots[end]
        north, east, turn = tr.north[e] - tr.north[b], tr.east[e] - tr.east[b], -(tr.heading[b] + offset)
        seen_ahead = north * np.cos(turn) - east * np.sin(turn)
        seen_aside = north * np.sin(turn) + east * np.cos(turn)
        off = [ahead - seen_ahead, aside - seen_aside, theta - tr.heading[e] + tr.heading[b]]
        return np.array(off) / math.sqrt(length)

    def linearised(self, windows: list[tuple[int, int, float]], x: Floats) -> tuple[Floats, Floats]:
        """Return residuals (3, w) and derivatives (3, w, 10), by complex steps (Squire and Trapp 1998)."""
        moved = x[:, None] + 1e-20j * np.eye(len(x))
        found = np.array([self.residuals(*window, moved) for window in windows])
        return found[:, :, 0].real.T, found.imag.transpose(1, 0, 2) / 1e-20

    def solutions(self) -> list[tuple[float, Floats]]:
        """All solutions: time [s] and parameters with constants."""
        std = np.array([np.radians(3.0), 0.1])
        inverse = np.zeros((10, 10))
        inverse[:8, :8] = np.linalg.inv(self.prior.covariance)
        inverse[8:, 8:] = np.diag(std**-2)
        mean = np.append(self.prior.mean, [0.0, 0.0])
        x, matrix, vector = mean, np.zeros((10, 10)), np.zeros(10)
        used, due, anew_at, found = 0, 0.5, 0.0, []
        for knot, row in enumerate(self.knots):
            if knot * 0.5 < due:
                continue
            due = knot * 0.5 + min(max(0.02 * knot * 0.5, 0.5), 6.0)
            last = max(k for k, one in enumerate(self.knots) if self.track.t[one] <= self.track.t[row] - 0.5)
            anew = knot * 0.5 >= anew_at
            windows = [(e - n, e, n / 2.0) for n in (2, 4, 10) for e in range(max(0 if anew else used, n), last + 1)]
            if not windows:
                continue
            used = last + 1
            if anew:
                anew_at, matrix, vector = 1.3 * knot * 0.5, np.zeros((10, 10)), np.zeros(10)
            at, scale = x, getattr(self, "scale", None)
            values, by = self.linearised(windows, at)
            for step in range(3):
                if anew:
                    at = x
                    values, by = (values, by) if step == 0 else self.linearised(windows, at)
                    mad = [1.4826 * np.median(np.abs(values[rows])) for rows in ([0, 1], [2])]
                    count = len(windows) / 80.0
                    scale = [math.sqrt((count * one**2 + 4.0 * 0.02**2) / (count + 4.0)) for one in mad]
                added = self.equations(values, by, scale, at, x)
                x = np.linalg.solve(inverse + matrix + added[0], inverse @ mean + vector + added[1])
            added = self.equations(values, by, scale, at, x)
            matrix, vector, self.scale = matrix + added[0], vector + added[1], scale
            found.append((float(self.track.t[row]), x))
        return found

    def equations(self, values: Floats, by: Floats, scale: list[float], at: Floats, x: Floats) -> tuple[Floats, Floats]:
        """Sum over the windows and directions one by one."""
        matrix, vector = np.zeros((10, 10)), np.zeros(10)
        for direction in range(3):
            s = scale[0] if direction < 2 else scale[1]
            for value, row in zip(values[direction], by[direction], strict=True):
                z = (value + row @ (x - at)) / s
                weight = 1.0 / math.sqrt(1.0 + (z / 2.0) ** 2) / 80.0 / s**2
                matrix += weight * np.outer(row, row)
                vector += weight * row * (row @ at - value)
        return matrix, vector


def test_the_estimate_equals_a_plain_transcription(monkeypatch: pytest.MonkeyPatch) -> None:
    """At 10 Hz a step is one sample; the wander of the heading, an estimate of its own, is left out of both."""
    monkeypatch.setattr(adaptive, "FEWEST_FOR_WANDER", 10**9)
    recording, prior = made_drive(40.0, hz=10.0), prior_of_robots(WIDTH_M)
    expected = Transcription(recording, prior).solutions()
    found = AdaptiveModel(prior).observe_all(samples_of(recording))
    assert len(found) == len(expected) > 8
    for one, (t_s, x) in zip(found, expected, strict=True):
        assert one.t_s == pytest.approx(t_s, abs=1e-12)
        assert np.abs(np.append(one.fitted.parameters, one.constants[:2]) - x).max() < 1e-9


@pytest.mark.parametrize("gyro", [False, True])
def test_samples_one_by_one_give_what_all_at_once_give(gyro: bool) -> None:
    """Over 200 m, so that the model has begun to forget."""
    recording, prior = made_drive(350.0, gyro=gyro), prior_of_robots(WIDTH_M)
    at_once = AdaptiveModel(prior, with_gyro=gyro).observe_all(samples_of(recording))
    pieces, model = [], AdaptiveModel(prior, with_gyro=gyro)
    for lo in range(0, len(recording.track.t), 777):
        pieces += model.observe_all(samples_of(recording, slice(lo, lo + 777)))
    one_by_one = observed(recording, AdaptiveModel(prior, with_gyro=gyro))
    assert len(at_once) == len(pieces) == len(one_by_one) > 50
    assert all(map(same, at_once, pieces))
    for one, other in zip(at_once, one_by_one, strict=True):
        assert same(one, other._replace(t_s=one.t_s))
        assert other.t_s == one.t_s


def test_what_comes_after_the_end_of_a_trial_does_not_change_its_error() -> None:
    recording, prior = made_drive(400.0, gyro=True), prior_of_robots(WIDTH_M)
    trials = cut_trials(recording, (5.0, 10.0))
    whole = adapt(recording, prior)
    for rows in (1500, 7000):
        track = recording.track
        names = ("t", "held", "v_left", "v_right", "place_t", "north", "east", "heading_t", "heading", "distance",
                 "in_outage", "jump", "slipping", "gyro")  # fmt: skip
        cut = Recording("cut", track._replace(**{name: getattr(track, name)[:rows] for name in names}), WIDTH_M)
        within = trials.starts < rows - 1
        some = trials._replace(
            starts=trials.starts[within], ends=np.where(trials.ends < rows - 1, trials.ends, -1)[within]
        )
        assert np.count_nonzero(some.ends >= 0) > 100
        drives = whole, adapt(cut, prior)
        for turned in (False, True):
            errors = [one.errors(some, turned=turned).position for one in drives]
            assert np.nanmax(np.abs(errors[0] - errors[1])) < 1e-9


def test_the_true_terms_are_learned_within_their_deviations() -> None:
    off = []
    for seed in range(8):
        model = AdaptiveModel(prior_of_robots(WIDTH_M))
        model.observe_all(samples_of(made_drive(250.0, seed=seed)))
        fitted = model.now.fitted
        off.append((fitted.parameters - TRUE)[:5] / fitted.std[:5])
        turn = WHEELS_MODEL.terms.index("omega_w")
        assert abs(fitted.parameters[turn] - TRUE[turn]) < 0.02
    assert np.sqrt(np.mean(np.square(off))) < 1.5


def test_a_gyro_is_scaled_and_its_bias_found_from_the_past() -> None:
    model = AdaptiveModel(prior_of_robots(WIDTH_M), with_gyro=True)
    model.observe_all(samples_of(made_drive(300.0, gyro=True)))
    found = model.now
    assert found.turned is not None
    of = dict(zip(found.turned.model.terms, found.turned.parameters.tolist(), strict=True))
    assert found.turned_constants.gyro_bias_radps == pytest.approx(-BIAS_RADPS * (1 + of["gyro_scale"]), abs=1e-3)
    assert of["gyro_scale"] + 1.0 == pytest.approx(1.0 / GYRO_SCALE, abs=0.006)


def test_the_twist_is_that_of_what_was_learned_last() -> None:
    model, speeds = AdaptiveModel(prior_of_robots(WIDTH_M)), np.array([0.4, 1.0, -0.3])
    model.observe_all(samples_of(made_drive(60.0)))
    found = model.twist(speeds, 0.5 * speeds)
    assert found.shape == (3, 3)
    assert model.twist(0.4, 0.2) == pytest.approx(found[:, 0], abs=1e-15)
    terms = model.now.fitted.parameters
    v, w = 0.3, 0.2 / WIDTH_M
    assert found[0, 0] == pytest.approx(terms[0] * v + terms[1] * w * WIDTH_M / 2.0, abs=1e-12)


def test_nothing_is_learned_without_a_pose_or_across_a_break() -> None:
    recording, prior = made_drive(120.0), prior_of_robots(WIDTH_M)
    usual = AdaptiveModel(prior).observe_all(samples_of(recording))
    blind = samples_of(recording)
    blind[7, 600:] = 0.0
    blind[3:6, 600:] = np.nan
    found = AdaptiveModel(prior).observe_all(blind)
    assert found[-1].t_s < recording.track.t[600] + 8.0
    assert all(map(same, usual[: len(found) - 3], found))
    # a pose 50 m off from one sample on: harmless where the jump is known
    broken = samples_of(recording)
    broken[3, 1000:] += 50.0
    broken[8, 999] = 1.0
    jumped = AdaptiveModel(prior).observe_all(broken)
    assert jumped[-1].fitted.parameters == pytest.approx(usual[-1].fitted.parameters, abs=0.02)


def test_speeds_that_no_robot_drives_are_a_gap() -> None:
    damaged = samples_of(made_drive(120.0))
    damaged[1, 700] = 1e12
    model = AdaptiveModel(prior_of_robots(WIDTH_M))
    found = model.observe_all(damaged)
    assert model.distance_m < 100.0
    assert np.isfinite(found[-1].fitted.parameters).all()


def test_a_robot_that_parks_for_hours_and_drives_for_kilometres_keeps_little() -> None:
    recording, prior = made_drive(1500.0), prior_of_robots(WIDTH_M)
    model = AdaptiveModel(prior)
    model.observe_all(samples_of(recording))
    for hour in range(5):
        parked = np.zeros((10, 36_000))
        parked[0] = recording.track.t[-1] + 0.1 + 3600.0 * hour + 0.1 * np.arange(36_000)
        parked[3:6] = np.array([[recording.track.north[-1]], [recording.track.east[-1]], [recording.track.heading[-1]]])
        parked[7] = 1.0
        model.observe_all(parked)
    drive = model._drive
    assert drive._steps.shape[1] < 3000
    assert drive._knots.shape[1] < 60
    assert drive._open.shape[1] < 200


def test_a_wrapped_heading_is_the_same_heading() -> None:
    recording, prior = made_drive(120.0), prior_of_robots(WIDTH_M)
    wrapped = samples_of(recording)
    wrapped[5] = np.angle(np.exp(1j * wrapped[5]))
    usual, found = (AdaptiveModel(prior).observe_all(one) for one in (samples_of(recording), wrapped))
    assert found[-1].fitted.parameters == pytest.approx(usual[-1].fitted.parameters, abs=1e-9)


def test_every_known_robot_states_terms_and_their_source() -> None:
    for name, terms in known_robots().items():
        assert len(str(terms["source"])) > 20, name
        assert set(terms) - {"source"} <= set(WHEELS_MODEL.terms), name
        assert 0.4 < float(terms["omega_w"]) < 1.0, name


def test_a_robot_that_is_left_out_does_not_enter_its_prior() -> None:
    every, others = prior_of_robots(1.0), prior_of_robots(1.0, without="warthog")
    scale = WHEELS_MODEL.terms.index("vx_v")
    assert every.mean[scale] == pytest.approx(0.969)
    assert others.mean[scale] == pytest.approx((0.969 + 1.0) / 2)
    turn = WHEELS_MODEL.terms.index("omega_w")
    assert 0.1 < math.sqrt(others.covariance[turn, turn]) < TERMS["omega_w"].std


def test_drives_of_one_robot_differ_less_than_robots() -> None:
    std = np.sqrt(np.diag(between_drives(WHEELS_MODEL.terms)))
    assert (std <= [TERMS[name].std for name in WHEELS_MODEL.terms]).all()
