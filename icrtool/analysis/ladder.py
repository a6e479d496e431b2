"""The ladder of models, each judged on way it was not fitted to, all on the same trials.

A run is cut by path length into contiguous blocks. What is fitted is fitted on windows that keep clear of the block
held out, and judged on the trials that lie entirely within it; extended models are also *chosen* without it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple, TypeVar

import numpy as np

from icrtool.analysis.dropout import DrivenRun, drive_of
from icrtool.analysis.window_fit import (
    CONSTANT,
    EXTENDED,
    MULTIPLIER,
    WindowFit,
    WindowModel,
    Windows,
    cut_windows,
    fit_windows,
    thin_windows,
)
from icrtool.core.kinematics import MIN_ICR_SEPARATION_M
from icrtool.core.open_loop import Drive, FrozenIcrs, trial_ends
from icrtool.core.open_loop_fast import open_loop_errors
from icrtool.core.statistics import Summary, summarise
from icrtool.core.window_fit import NEUTRAL, Complexes
from icrtool.errors import DataError
from icrtool.tables import Bools, Floats, HeadingSamples, Ints

HORIZONS_M = (5.0, 10.0, 20.0)
SHORTEST_BLOCK_M = 25.0
MOST_BLOCKS = 5
CHOICE_HORIZON_M = 10.0
FITS_AT_ONCE = 2
ALL = -1
"""Stands for no block: nothing is held out."""

Key = TypeVar("Key")

WORTHWHILE = 0.95
"""An extended model is chosen only where it brings the expected error below this part of the plain window fit's."""


@dataclass(frozen=True, slots=True)
class Rung:
    """One model's held-out errors.

    Attributes
    ----------
    name : ``no_slip``, ``multiplier``, ``icr``, ``icr_final``, ``window``, ``extended``, and each with ``_heading``
    fitted : ``never``, ``before`` (from the states up to the start), ``all`` (in sample), ``others`` (held out)
    """

    name: str
    label: str
    fitted: str
    measured_heading: bool
    summary: Summary


@dataclass(frozen=True, slots=True)
class Ladder:
    """The table.

    Attributes
    ----------
    blocks : held out one after the other
    chosen : name of the extended model chosen for each block
    fits : of all windows, by model name: what to paste, not what was judged
    best : the model cross-validation prefers for the whole log
    held_out : by model name, the fits of each block's complement
    heading_is_reference : the heading comes from the same topic as the position
    """

    horizons_m: tuple[float, ...]
    blocks: int
    rungs: tuple[Rung, ...]
    chosen: tuple[str, ...]
    fits: dict[str, WindowFit]
    best: str
    held_out: dict[str, tuple[WindowFit, ...]]
    heading_is_reference: bool

    def rung(self, name: str) -> Rung:
        """Return a rung by name."""
        return next(rung for rung in self.rungs if rung.name == name)


class _Trials(NamedTuple):
    """Trials that lie within one block.

    Attributes
    ----------
    drive : the run; t : (n,) [s]
    ends : int64 (n, h), negative where there is no trial, or one that leaves its block
    block : int64 (n,), block of each state
    psi : (n,) measured heading at the states [rad], None without
    """

    drive: Drive
    t: Floats
    ends: Ints
    block: Ints
    psi: Floats | None


def count_blocks(distance_m: float) -> int:
    """Return into how many blocks a drive of this length is cut."""
    return int(np.clip(distance_m // SHORTEST_BLOCK_M, 2, MOST_BLOCKS))


def judge_ladder(
    run: DrivenRun,
    heading: HeadingSamples | None = None,
    *,
    heading_offset_rad: float = 0.0,
    heading_is_reference: bool = False,
    horizons_m: Sequence[float] = HORIZONS_M,
) -> Ladder:
    """Judge every model on way it was not fitted to.

    Parameters
    ----------
    run : a finished run, or one read back
    heading : measured headings, for the models that need not turn by wheels alone; None: these are left out
    heading_offset_rad : subtracted from them
    heading_is_reference : they come from the position reference, and are as good as it is
    horizons_m : ascending, with 10 m among them

    Raises
    ------
    DataError
        The drive is too short to hold anything out.

    Notes
    -----
    Stone (1974), cross-validation, here over contiguous blocks since neighbouring trials share their way. The extended
    model of a block is chosen by a second cross-validation among the other blocks: nothing of the held-out block
    reaches its parameters or its choice. The filter's momentary ICRs know the way up to the start, its final ones all.
    """
    total = float(run.table.distance_m[-1])
    if total < 2.0 * CHOICE_HORIZON_M:
        raise DataError(run.name, f"{total:.1f} m of way", "too short to fit on one part and judge on another")
    windows, blocks = cut_windows(run), count_blocks(total)
    edges = np.linspace(0.0, total, blocks + 1)[1:-1]
    trials = _trials(run, edges, horizons_m, heading, heading_offset_rad)
    choice = list(horizons_m).index(CHOICE_HORIZON_M)
    clear = [clear_of(windows, edges, block) for block in range(blocks)]
    models = (MULTIPLIER, CONSTANT, *EXTENDED)
    fits = _fit_side_by_side(
        windows,
        {(model.name, block): (model, clear[block]) for model in models for block in range(blocks)}
        | {(model.name, ALL): (model, np.ones(len(windows.start), np.bool_)) for model in models},
    )
    held_out = {model.name: tuple(fits[model.name, block] for block in range(blocks)) for model in models}
    chosen = _choose(trials, windows, clear, choice)
    held_out["extended"] = tuple(held_out[name][block] for block, name in enumerate(chosen))
    judged = {name: _judge_held_out(trials, held_out[name]) for name in ("multiplier", "window", "extended")}
    scores = {
        model.name: _expected(trials, held_out[model.name], range(blocks), choice) for model in (CONSTANT, *EXTENDED)
    }
    return Ladder(
        horizons_m=tuple(horizons_m),
        blocks=blocks,
        rungs=_rungs(run, trials, judged, held_out),
        chosen=chosen,
        fits={model.name: fits[model.name, ALL] for model in models},
        best=_prefer(scores),
        held_out=held_out,
        heading_is_reference=heading_is_reference,
    )


def _fit_side_by_side(windows: Windows, wanted: Mapping[Key, tuple[WindowModel, Bools]]) -> dict[Key, WindowFit]:
    """Fit models to some of the windows each; the kernel lets two run at once."""
    with ThreadPoolExecutor(FITS_AT_ONCE) as pool:
        jobs = {key: pool.submit(fit_windows, windows.keep(kept), model) for key, (model, kept) in wanted.items()}
        return {key: job.result() for key, job in jobs.items()}


def clear_of(windows: Windows, edges_m: Floats, block: int) -> Bools:
    """Say which windows share no way with a block; `edges_m` are the inner borders of the blocks [m]."""
    borders = np.concatenate([[-math.inf], edges_m, [math.inf]])
    clear: Bools = (windows.end_m <= borders[block]) | (windows.start_m >= borders[block + 1])
    return clear


def _trials(
    run: DrivenRun, edges: Floats, horizons_m: Sequence[float], heading: HeadingSamples | None, offset_rad: float
) -> _Trials:
    table, drive = run.table, drive_of(run)
    block = np.searchsorted(edges, table.distance_m, side="right")
    ends = trial_ends(drive, np.array(horizons_m, np.float64))
    ends = np.where((ends >= 0) & (block[ends] == block[:, None]), ends, -1)
    psi = None
    if heading is not None and len(heading.stamp_ns) > 1:
        unwrapped = np.unwrap(heading.heading_rad) - offset_rad
        psi = np.interp(
            (table.stamp_ns - table.stamp_ns[0]) / 1e9, _since(table.stamp_ns[0], heading.stamp_ns), unwrapped
        )
    return _Trials(drive, table.t_s, ends, block, psi)


def _since(epoch_ns: int, stamp_ns: Ints) -> Floats:
    return (stamp_ns - epoch_ns) / 1e9


def _choose(trials: _Trials, windows: Windows, clear: Sequence[Bools], choice: int) -> tuple[str, ...]:
    """Choose a model for each block by cross-validation among the others; the plain one where there are only two."""
    blocks = len(clear)
    if blocks < 3:
        return (CONSTANT.name,) * blocks
    pairs = _fit_side_by_side(
        thin_windows(windows),
        {
            (model.name, pair): (model, clear[pair[0]] & clear[pair[1]])
            for model in (CONSTANT, *EXTENDED)
            for pair in combinations(range(blocks), 2)
        },
    )
    chosen = []
    for block in range(blocks):
        others = [other for other in range(blocks) if other != block]
        scores = {
            model.name: _expected(
                trials,
                {other: pairs[model.name, (min(block, other), max(block, other))] for other in others},
                others,
                choice,
            )
            for model in (CONSTANT, *EXTENDED)
        }
        chosen.append(_prefer(scores))
    return tuple(chosen)


def _prefer(scores: dict[str, float]) -> str:
    """Return the model of the least expected error, the plain one unless another is clearly better."""
    best = min(scores, key=lambda name: scores[name] if math.isfinite(scores[name]) else math.inf)
    return best if scores[best] < WORTHWHILE * scores[CONSTANT.name] else CONSTANT.name


def _expected(
    trials: _Trials, fits: Mapping[int, WindowFit] | Sequence[WindowFit], blocks: Iterable[int], choice: int
) -> float:
    """Return the mean error at horizon `choice` over blocks, each predicted with its own fit."""
    parts = [predict_block(trials, fits[block].parameters, block)[:, choice] for block in blocks]
    errors = np.concatenate(parts)
    errors = errors[~np.isnan(errors)]
    return float(errors.mean()) if len(errors) else math.inf


def _judge_held_out(trials: _Trials, fits: Sequence[WindowFit]) -> Floats:
    return np.concatenate([predict_block(trials, fit.parameters, block) for block, fit in enumerate(fits)])


def predict_block(trials: _Trials, p: Floats, block: int) -> Floats:
    """Return the errors (rows, h) [m] of a block's trials, driven with parameters p (8,) as `WindowFit` has them."""
    drive = trials.drive
    lo, hi = (int(row) for row in np.searchsorted(trials.block, [block, block + 1]))
    margin = abs(float(p[7])) + 1.0
    first = max(int(np.searchsorted(trials.t, trials.t[lo] - margin)), 0)
    last = min(int(np.searchsorted(trials.t, trials.t[hi - 1] + margin)) + 1, len(trials.t))
    near = slice(first, last)
    dt = np.where(drive.gap[near], 0.0, drive.dt_s[near])
    v_x, v_y, omega = velocities(drive.v_left[near], drive.v_right[near], p)
    theta = np.concatenate([[0.0], np.cumsum(dt * omega)[:-1]])
    place = np.concatenate([[0.0], np.cumsum(dt * (v_x + 1j * v_y) * np.exp(1j * theta))[:-1]])
    at = trials.t[lo:hi] + p[7]
    if p[7] != 0.0:
        theta = np.interp(at, trials.t[near], theta)
        place = np.interp(at, trials.t[near], place.real) + 1j * np.interp(at, trials.t[near], place.imag)
    else:
        theta, place = theta[lo - first : hi - first], place[lo - first : hi - first]
    return _errors(trials, lo, hi, place, lambda start: np.exp(1j * (drive.heading[lo + start] - theta[start])))


def velocities(v_left: Floats, v_right: Floats, p: Floats) -> tuple[Floats, Floats, Floats]:
    """Return v_x, v_y [m/s] and omega [rad/s], (n,) each: `icrtool.core.window_fit.rates` for columns."""
    left, right, both = p[3] * v_left, p[4] * v_right, np.abs(v_left) + np.abs(v_right)
    turning = np.divide(np.abs(v_left - v_right), both, out=np.zeros(len(both)), where=both > 0.0)
    w = max(abs(p[0] - p[1]), MIN_ICR_SEPARATION_M)
    omega = (left - right) / (w * (1.0 + p[5] * turning + p[6] * 0.5 * both))
    return (left * p[0] - right * p[1]) / w, -p[2] * omega, omega


def _errors(trials: _Trials, lo: int, hi: int, place: Complexes, turn: Callable[[Ints], Complexes]) -> Floats:
    """Return the misses of the rows [lo, hi); `turn` gives, by row, what brings displacements of `place` north up."""
    reference = trials.drive.north[lo:hi] + 1j * trials.drive.east[lo:hi]
    errors = np.full((hi - lo, trials.ends.shape[1]), np.nan)
    for h in range(errors.shape[1]):
        start = np.flatnonzero(trials.ends[lo:hi, h] >= 0)
        end = trials.ends[lo:hi, h][start] - lo
        moved = turn(start) * (place[end] - place[start])
        errors[start, h] = np.abs(moved - (reference[end] - reference[start]))
    return errors


def predict_with_heading(trials: _Trials, psi: Floats, icrs: FrozenIcrs, p: Sequence[Floats]) -> Floats:
    """Return the errors (n, h) [m] where heading is measured, and wheels and ICRs only tell the way along it.

    Parameters
    ----------
    psi : (n,) measured heading [rad]
    icrs : by start, or one triple
    p : parameters (8,) by block: scales and delay are used

    Notes
    -----
    With omega = d psi / dt the way is the sum of V e^{j psi}, V the mean track speed, and ((y_r + y_l) / 2 - j x)
    (e^{j psi_e} - e^{j psi_s}) / j: W drops out.
    """
    drive, t = trials.drive, trials.t
    dt = np.where(drive.gap, 0.0, drive.dt_s)
    middle = np.exp(1j * (psi[:-1] + psi[1:]) / 2.0)
    offset = (icrs.y_icr_right + icrs.y_icr_left) / 2.0 - 1j * icrs.x_icr
    lever = np.exp(1j * psi) / 1j
    reference = drive.north + 1j * drive.east
    errors = np.full(trials.ends.shape, np.nan)
    for block, parameters in enumerate(p):
        mean = (parameters[3] * drive.v_left + parameters[4] * drive.v_right) / 2.0
        way = np.concatenate([[0.0], np.cumsum(dt * mean)[:-1]])
        place = np.concatenate([[0.0], np.cumsum(np.diff(np.interp(t + parameters[7], t, way)) * middle)])
        for h in range(trials.ends.shape[1]):
            start = np.flatnonzero((trials.ends[:, h] >= 0) & (trials.block == block))
            end = trials.ends[start, h]
            arm = offset if len(offset) == 1 else offset[start]
            moved = place[end] - place[start] + arm * (lever[end] - lever[start])
            errors[start, h] = np.abs(moved - (reference[end] - reference[start]))
    return errors


def _rungs(
    run: DrivenRun, trials: _Trials, judged: dict[str, Floats], held_out: dict[str, tuple[WindowFit, ...]]
) -> tuple[Rung, ...]:
    """Judge the models that are not fitted here, put all in order, and repeat them with measured heading."""
    table, width, blocks = run.table, run.track_width_m, len(held_out[CONSTANT.name])
    momentary = FrozenIcrs(table.y_icr_right_m, table.y_icr_left_m, table.x_icr_m)
    final = FrozenIcrs(momentary.y_icr_right[-1:], momentary.y_icr_left[-1:], momentary.x_icr[-1:])
    neutral = [np.array([*NEUTRAL, 0.0])] * blocks
    plain: list[tuple[str, str, str, FrozenIcrs]] = []
    if width is not None:
        plain.append(("no_slip", "no slip", "never", FrozenIcrs.constant(width / 2, -width / 2, 0.0)))
    plain += [("icr", "ICR, momentary", "before", momentary), ("icr_final", "ICR, final", "all", final)]
    labels = {"multiplier": "best multiplier", "window": "window fit", "extended": "extended"}
    rungs = [Rung(n, l, f, False, summarise(open_loop_errors(trials.drive, i, trials.ends))) for n, l, f, i in plain]  # noqa: E741
    rungs += [Rung(name, labels[name], "others", False, summarise(errors)) for name, errors in judged.items()]
    if trials.psi is not None:
        for name, label, fitted, icrs in plain:
            errors = predict_with_heading(trials, trials.psi, icrs, neutral)
            rungs.append(Rung(f"{name}_heading", f"{label} + heading", fitted, True, summarise(errors)))
        for name in ("window", "extended"):
            errors = np.full(trials.ends.shape, np.nan)
            for block, fit in enumerate(held_out[name]):
                here = trials._replace(ends=np.where((trials.block == block)[:, None], trials.ends, -1))
                one = predict_with_heading(
                    here, trials.psi, FrozenIcrs.constant(*fit.icrs_m), [fit.parameters] * blocks
                )
                errors = np.where(np.isnan(one), errors, one)
            rungs.append(Rung(f"{name}_heading", f"{labels[name]} + heading", "others", True, summarise(errors)))
    order = ("no_slip", "multiplier", "icr", "icr_final", "window", "extended")
    return tuple(
        sorted(rungs, key=lambda rung: (rung.measured_heading, order.index(rung.name.removesuffix("_heading"))))
    )
