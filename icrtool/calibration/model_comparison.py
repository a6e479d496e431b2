"""The ladder of models, each judged on way it was not fitted to, all on the same trials.

A run is cut by path length into contiguous blocks. What is fitted is fitted on windows that keep clear of the block
held out, and judged on the trials that lie entirely within it; extended models are also *chosen* without it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from icrtool.calibration.held_out_fits import BlockFits, clear_of, fit_blocks
from icrtool.calibration.model_trials import Along, Trials, calibrate_gyro, cut_trials, predict
from icrtool.errors import DataError
from icrtool.kernels.error_statistics import summarise
from icrtool.kernels.open_loop_fast import open_loop_errors
from icrtool.kernels.trials import FrozenIcrs
from icrtool.kernels.window_errors import NEUTRAL
from icrtool.motion.window_fit import WindowFit, Windows, cut_windows, window_spacing_m
from icrtool.records.dropout import CHOICE_HORIZON_M, MeasuredHeading, Rung
from icrtool.records.run import Run
from icrtool.records.tables import Bools, Floats

HORIZONS_M = (5.0, 10.0, 20.0)
SHORTEST_BLOCK_M = 25.0
MOST_BLOCKS = 5

FEWEST_WINDOWS = 10

JUDGED_AT_ONCE = 2

MODELS = ("no_slip", "multiplier", "icr", "icr_final", "window", "extended")
"""In the order of the table. Each may come again with a measured heading, ``_gyro`` or ``_heading`` behind its name."""

LABELS = {
    "no_slip": "no slip", "multiplier": "best multiplier", "icr": "ICR, momentary", "icr_final": "ICR, final",
    "window": "window fit", "extended": "extended",
}  # fmt: skip
FITTED_TO = {
    "no_slip": "never", "multiplier": "others", "icr": "before", "icr_final": "all", "window": "others",
    "extended": "others",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Ladder:
    """The table.

    Attributes
    ----------
    blocks : held out one after the other
    starts : trials are judged from so many states
    chosen : name of the extended model chosen for each block
    fits : of all windows, by model name: what to paste, not what was judged
    best : the model cross-validation prefers for the whole log
    held_out : by model name, the parameters (blocks, 8) fitted without each block
    heading : what the rows with a measured heading go by, ``gyro`` or ``heading``; empty without
    notes : what was left out of the table and why, and what was put right
    """

    horizons_m: tuple[float, ...]
    blocks: int
    starts: int
    rungs: tuple[Rung, ...]
    chosen: tuple[str, ...]
    fits: dict[str, WindowFit]
    best: str
    held_out: dict[str, Floats]
    heading: str
    notes: tuple[str, ...]

    def rung(self, name: str) -> Rung:
        """Return a rung by name."""
        return next(rung for rung in self.rungs if rung.name == name)


def count_blocks(distance_m: float) -> int:
    """Return into how many blocks a drive of this length is cut."""
    return int(np.clip(distance_m // SHORTEST_BLOCK_M, 2, MOST_BLOCKS))


def judge_ladder(
    run: Run, headings: Sequence[MeasuredHeading] = (), *, horizons_m: Sequence[float] = HORIZONS_M
) -> Ladder:
    """Judge every model on way it was not fitted to.

    Parameters
    ----------
    run : a finished run, or one read back
    headings : measured headings, best first, for the models that need not turn by wheels alone
    horizons_m : ascending

    Raises
    ------
    DataError
        The drive is too short to hold anything out.

    Notes
    -----
    Stone (1974), cross-validation, here over contiguous blocks since neighbouring trials share their way. Nothing of
    a block reaches the parameters it is judged with, nor the choice of its extended model. The filter's momentary ICRs
    know the way up to the start, its final ones all.
    """
    total = float(run.table.distance_m[-1])
    if total < 2.0 * CHOICE_HORIZON_M:
        raise DataError(run.name, f"{total:.1f} m of way", "too short to fit on one part and judge on another")
    windows, blocks = cut_windows(run, every_m=window_spacing_m(run)), count_blocks(total)
    edges = np.linspace(0.0, total, blocks + 1)[1:-1]
    clear = [clear_of(windows, edges, block) for block in range(blocks)]
    if (fewest := min(np.count_nonzero(kept) for kept in clear)) < FEWEST_WINDOWS:
        raise DataError(run.name, f"{fewest} windows beside a block", "too few to fit on one part and judge on another")
    trials = cut_trials(run, edges, horizons_m)
    fits = fit_blocks(windows, edges)
    with ThreadPoolExecutor(JUDGED_AT_ONCE) as pool:
        jobs = [pool.submit(_judge_plain, run, trials, fits, name) for name in MODELS]
        heading, notes = _usable_heading(headings, trials, windows, clear)
        more = tuple(_judge_along(run, trials, fits, heading)) if heading is not None else ()
        rungs = (*(rung for job in jobs if (rung := job.result()) is not None), *more)
    return Ladder(
        horizons_m=tuple(horizons_m),
        blocks=blocks,
        starts=len(trials.starts),
        rungs=rungs,
        chosen=fits.chosen,
        fits=fits.whole,
        best=fits.best,
        held_out=fits.held_out,
        heading=heading.kind if heading is not None else "",
        notes=notes,
    )


def _icrs_of(run: Run, name: str) -> FrozenIcrs | None:
    """Return the ICRs of a model that is not fitted here; None for no slip where b is not known."""
    table, width = run.table, run.track_width_m
    if name == "no_slip":
        return FrozenIcrs.constant(width / 2, -width / 2, 0.0) if width is not None else None
    if name == "icr":
        return FrozenIcrs(table.y_icr_right_m, table.y_icr_left_m, table.x_icr_m)
    return FrozenIcrs(table.y_icr_right_m[-1:], table.y_icr_left_m[-1:], table.x_icr_m[-1:])


def _judge_plain(run: Run, trials: Trials, fits: BlockFits, name: str) -> Rung | None:
    if name in fits.held_out:
        errors = predict(trials, fits.held_out[name])
    elif (icrs := _icrs_of(run, name)) is not None:
        errors = open_loop_errors(trials.drive, icrs, trials.ends)
    else:
        return None
    return Rung(name, LABELS[name], FITTED_TO[name], False, summarise(errors[trials.starts]))


def _judge_along(run: Run, trials: Trials, fits: BlockFits, heading: MeasuredHeading) -> Iterator[Rung]:
    """Judge the models along a measured heading; a multiplier says nothing of the way along one."""
    along = Along(trials, heading.angle_rad, from_reference=heading.kind == "gyro")
    neutral = np.tile([*NEUTRAL, 0.0], (len(fits.chosen), 1))
    plain = along.place(neutral)
    for name in MODELS:
        if name == "multiplier":
            continue
        if name in fits.held_out:
            p = fits.held_out[name]
            place = plain if np.array_equal(p[:, 3:], neutral[:, 3:]) else along.place(p)
            icrs: FrozenIcrs | None = FrozenIcrs(*np.ascontiguousarray(p[trials.block, :3].T))
        else:
            place, icrs = plain, _icrs_of(run, name)
        if icrs is not None:
            summary = summarise(along.errors(place, icrs)[trials.starts])
            yield Rung(f"{name}_{heading.kind}", f"{LABELS[name]} + {heading.kind}", FITTED_TO[name], True, summary)


def _usable_heading(
    headings: Sequence[MeasuredHeading], trials: Trials, windows: Windows, clear: Sequence[Bools]
) -> tuple[MeasuredHeading | None, tuple[str, ...]]:
    """Return the first heading that can be used, a gyro with scale and bias from outside each block; and notes."""
    notes: list[str] = []
    for heading in headings:
        if heading.kind == "heading":
            return heading, tuple(notes)
        found = calibrate_gyro(heading.angle_rad, trials.drive, trials.t, windows, clear)
        if found is not None:
            if found[0, 0] < 0.0:
                notes.append("the gyro counts turns the other way: its sign was turned")
            scale, bias = found[trials.block].T
            # turns within a block are all that counts: the angle may jump where blocks meet
            return MeasuredHeading("gyro", scale * heading.angle_rad + bias * trials.t), tuple(notes)
        notes.append("the gyro does not turn with the robot: rows with it are left out")
    if not headings:
        notes.append("the run holds no heading measured apart from the position: no rows with one")
    return None, tuple(notes)
