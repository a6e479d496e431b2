"""What is learned from windows that have just ended, compared with the same in matrices."""

from __future__ import annotations

import numpy as np
import pytest

from icrtool.kernels.arrays import Floats, Ints
from icrtool.kernels.elimination import normal_equations
from icrtool.kernels.learning import Belief, LearnedWindows, learn, prepare, take_windows
from icrtool.kernels.robust import robust_weights
from icrtool.kernels.track import Track
from icrtool.kernels.window_residuals import path_at, turn_residuals, window_residuals

TOLERANCE = 1e-9
K, WANDER, STEPS = 4, 2e-3, 3
AXES = np.array([0, 1, 2, 2, 2, 2])
"""The axis of K terms of a model, and of two constants that turn, too."""


def made(rng: np.random.Generator, n: int = 300, m: int = 30, offset: float = 0.02) -> LearnedWindows:
    """Draw wheel samples with two gaps, and windows of them; the first knot precedes them and the last follows."""
    held = np.where(np.isin(np.arange(n), [70, 71, 200]), 0.0, rng.uniform(0.05, 0.15, n))
    t = np.cumsum(np.append(0.0, np.where(held > 0.0, held, 0.4)[:-1]))
    fixed, columns = 0.1 * rng.normal(size=(3, n)), rng.normal(size=(len(AXES), n))
    begin = rng.integers(0, m - 6, 50)
    return LearnedWindows(
        t, held, 0.3, fixed, AXES, columns, 0.3 * rng.normal(size=len(AXES)), np.linspace(-0.5, t[-1] + 1.0, m),
        begin, begin + rng.integers(1, 6, 50), rng.normal(size=50) + 1j * rng.normal(size=50),
        0.4 * rng.normal(size=50), rng.choice([1.0, 2.0, 5.0], 50), offset, WANDER,
    )  # fmt: skip


def believed(rng: np.random.Generator, of: LearnedWindows, largest_delay_s: float = 10.0) -> Belief:
    """Draw what was known before windows."""
    q = len(AXES) + 2
    root = rng.normal(size=(q, q + 3))
    x = np.concatenate([of.values[:K], [of.offset, 0.03], of.values[K:]])
    return Belief(
        x, np.diag(rng.uniform(0.5, 4.0, q)), rng.normal(size=q), root @ root.T, rng.normal(size=q),
        np.array([0.3, 0.2]), 80.0, largest_delay_s,
    )  # fmt: skip


def linearised(of: LearnedWindows) -> tuple[Floats, Floats, Ints]:
    """Return residuals and derivatives of windows, and the kind of each residual, by the sums of pooled fits."""
    none, flags = np.zeros(len(of.t)), np.zeros(len(of.t), np.bool_)
    track = Track(of.t, of.held, none, none, of.t, none, none, of.t, none, none, flags, flags, flags, into=of.into)
    path = path_at(track, lambda some: (of.fixed[:, some], of.axis, of.columns[:, some]), of.values, of.knot_t)
    root = np.sqrt(of.length_m)
    share = np.exp(-of.wander * of.length_m / 4.0)
    moved, moved_by = window_residuals(path, of.begin, of.end, of.moved, of.offset, root, share)
    turned, turned_by = turn_residuals(path, of.begin, of.end, of.turned, root)
    p = len(of.values)
    jacobian = np.concatenate([moved_by, turned_by])[:, [*range(K), p, p + 1, *range(K, p)]]
    return np.concatenate([moved, turned]), jacobian, np.repeat([0, 0, 1], len(of.begin))


def learned_in_matrices(of: LearnedWindows, belief: Belief) -> Belief:
    """Return what `learn` returns, with NumPy's products and its solver."""
    residuals, jacobian, kind = linearised(of)
    x = at = belief.x

    def equations() -> tuple[Floats, Floats]:
        weights = robust_weights(residuals + jacobian @ (x - at), belief.scale[kind], belief.overlap)
        return normal_equations(jacobian @ at - residuals, jacobian, weights)

    for _ in range(STEPS):
        matrix, vector = equations()
        x = np.linalg.solve(belief.information + belief.matrix + matrix, belief.pull + belief.vector + vector)
        x[K + 1] = np.clip(x[K + 1], -belief.largest_delay_s, belief.largest_delay_s)
    matrix, vector = equations()
    return belief._replace(x=x, matrix=belief.matrix + matrix, vector=belief.vector + vector)


@pytest.mark.parametrize("largest_delay_s", [10.0, 1e-3])
@pytest.mark.parametrize("seed", range(6))
def test_steps_and_sums_are_those_in_matrices(seed: int, largest_delay_s: float) -> None:
    rng = np.random.default_rng(seed)
    of = made(rng)
    before = believed(rng, of, largest_delay_s)
    found, expected = learn(of, before, K, STEPS), learned_in_matrices(of, before)
    assert np.abs(expected.x - before.x).max() > 0.01
    for name in ("x", "matrix", "vector"):
        one, other = getattr(found, name), getattr(expected, name)
        np.testing.assert_allclose(one, other, rtol=0.0, atol=TOLERANCE * np.abs(other).max())


def test_equations_without_a_solution_leave_the_parameters() -> None:
    """The windows that make them so are added all the same, as the sums of a drive are."""
    rng = np.random.default_rng(1)
    of = made(rng)
    before = believed(rng, of)._replace(information=np.full((8, 8), np.nan))
    found = learn(of, before, K, STEPS)
    np.testing.assert_array_equal(found.x, before.x)
    assert np.isfinite(found.matrix).all()


def test_what_was_known_before_is_not_changed() -> None:
    rng = np.random.default_rng(2)
    of = made(rng)
    before = believed(rng, of)
    copies = [one.copy() for one in before[:6]]
    learn(of, before, K, STEPS)
    for one, copy in zip(before[:6], copies, strict=True):
        np.testing.assert_array_equal(one, copy)


def test_a_model_that_is_made_has_loaded_what_it_learns_with() -> None:
    """So that no callback of a robot waits for a compiler."""
    prepare()
    rng = np.random.default_rng(3)
    of = made(rng)
    functions = dict(take_windows._functions)  # type: ignore[attr-defined]  # of a `Kernel`
    learn(of, believed(rng, of), K, STEPS)
    assert take_windows._functions == functions  # type: ignore[attr-defined]
