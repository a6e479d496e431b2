"""Terrain: where on a drive the ICRs changed, told from the way between the filter's poses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from icrtool.estimation.step_detection import Step, find_steps
from icrtool.kernels.equal_steps import rows_at_steps
from icrtool.records.run import ICR_COLUMNS
from icrtool.records.tables import Bools, Complexes, Floats, Ints, States

FALSE_ALARMS_PER_HOUR = 0.1
"""Stated for a robot on one terrain: one change in ten hours of driving that is none."""

BLOCK_TURN_RAD = 0.5
"""Turn of a block: only turning shows an ICR. One value of each ICR a block."""

WINDOW_TURN_RAD, WINDOW_WAY_M = 0.5, 1.5
"""A window ends with so much turn, or way, or a mixture of both: a block's straight parts are windows of their own."""

SLIP_SHARE = 0.03
"""Part of way and of turn that slips differently from one window to the next, on any ground."""

LEAST_STEP_SHARE = 0.05
"""Changes of an ICR by less than this part of y_r - y_l are not worth forgetting what was learned."""

SETTLED_S = 2.0
"""The pose settles for so long after the start and after an outage."""

MOST_WIDER = 3.0
"""Blocks whose ICRs no ground gives a robot (W so many times its usual or a part of it, a y ICR on the other side, x
further out than W) tell of errors of the pose: they are left out."""

MOMENT_S = 0.5
STANDING_MPS = 0.02
LEAST_WIDTH_M = 0.1

REFINED_BLOCKS = 2
LARGEST_MISFIT = 9.0
SURE_MISFIT = 1.0
"""The last place at which a change fits nearly as well as at the best: on a straight any place does, and what is
inflated there has nothing to learn from before the next turn."""

Number = TypeVar("Number", np.float64, np.complex128)
Source = Literal["given", "detected"]


@dataclass(frozen=True, slots=True)
class TerrainChange:
    """One change of the ICRs.

    Attributes
    ----------
    t_s : seconds since the first recorded state; a given change has nothing else
    statistic : its score, in standard deviations
    step_m : (3,) median of the ICRs after, minus before
    """

    t_s: float
    source: Source
    statistic: float | None = None
    step_m: tuple[float, float, float] | None = None


@dataclass(frozen=True, slots=True)
class TerrainTest:
    """What the search for changes found, and how it judged; `changes` has the given ones too, by time.

    Attributes
    ----------
    threshold : what a statistic had to exceed; inf where there was too little turning to test
    blocks : stretches of turning that were compared; driven_h : hours of driving
    searched : whether changes were looked for
    """

    changes: tuple[TerrainChange, ...]
    searched: bool = False
    threshold: float = float("inf")
    blocks: int = 0
    driven_h: float = 0.0

    @property
    def times_s(self) -> tuple[float, ...]:
        """Seconds of the changes since the first recorded state."""
        return tuple(change.t_s for change in self.changes)

    def within(self, duration_s: float) -> tuple[TerrainTest, tuple[float, ...]]:
        """Return this without the changes that lie beyond the drive, and when those would have been [s]."""
        kept = tuple(change for change in self.changes if 0.0 < change.t_s < duration_s)
        beyond = tuple(change.t_s for change in self.changes if change not in kept)
        return replace(self, changes=kept), beyond

    def summary(self) -> dict[str, Any]:
        """Return plain data for run.json."""
        return {
            "searched": self.searched,
            "false_alarms_per_hour": FALSE_ALARMS_PER_HOUR if self.searched else None,
            "threshold": self.threshold if np.isfinite(self.threshold) else None,
            "blocks": self.blocks,
            "driven_h": self.driven_h,
            "changes": [
                {
                    "t_s": change.t_s,
                    "source": change.source,
                    "statistic": change.statistic,
                    "step": dict(zip(ICR_COLUMNS, change.step_m, strict=True)) if change.step_m else None,
                }
                for change in self.changes
            ],
        }


class _Windows(NamedTuple):
    """Windows of way and turn, (w,) each.

    Attributes
    ----------
    begin_s, end_s : [s]
    turn, turn_std : turn of the heading [rad]
    ahead : left ahead of right by the wheels [m]
    off, off_std : complex [m], displacement less the way of the wheels' mean speed along the heading, north + j east
    arm : complex [m], left ahead of right along the heading: `off` is (y_r + y_l)/2 - j x, over W, of it
    """

    begin_s: Floats
    end_s: Floats
    turn: Floats
    turn_std: Floats
    ahead: Floats
    off: Complexes
    off_std: Floats
    arm: Complexes


class _Blocks(NamedTuple):
    """Blocks of turning: first (b,) and end row of `_Windows`; 1/W, middle/W, x/W and their std (b, 3)."""

    first: Ints
    end: Ints
    shares: Floats
    std: Floats


def given_changes(changes_s: tuple[float, ...]) -> TerrainTest:
    """Return given changes alone, each time once."""
    return TerrainTest(tuple(TerrainChange(t, "given") for t in sorted(set(changes_s))))


def find_terrain_changes(
    table: States,
    in_gap: Bools,
    outages_ns: Ints,
    innovations: tuple[Floats, Floats],
    given_s: tuple[float, ...] = (),
) -> TerrainTest:
    """Find changes of the ICRs.

    Parameters
    ----------
    table, in_gap, outages_ns : a finished run, see `icrtool.records.run.Run`
    innovations : times (h,) [s] and innovations (h,) [rad] of all headings, those rejected too: wrong ICRs reject them
    given_s : changes that are known, seconds since the first recorded state

    Notes
    -----
    Way and turn between the filter's poses against those of the wheels with constant ICRs are the innovations of whole
    windows. Blocks of them, half a radian of turning each, give one value of each ICR; `find_steps` compares them
    before and after every place. The stated rate assumes that on one terrain the values scatter as their neighbours do
    (as a first-order autoregression), or as `SLIP_SHARE` makes them: a lasting change of driving style that moves the
    ICRs is a change too.
    """
    given = given_changes(given_s)
    windows = _windows(table, _heading(table, *innovations), in_gap, outages_ns)
    driven_h = float((windows.end_s - windows.begin_s).sum()) / 3600
    blocks = _blocks(windows)
    if len(blocks.first) < 2:
        return TerrainTest(given.changes, searched=True, blocks=len(blocks.first), driven_h=driven_h)
    begins = windows.begin_s[blocks.first]
    # 1/W in parts of its usual value; middle/W and x/W are parts of the width already
    usual = np.array([max(abs(float(np.median(blocks.shares[:, 0]))), 1e-3), 1.0, 1.0])
    tested = find_steps(
        blocks.shares / usual,
        np.maximum(np.median(blocks.std, axis=0) / usual, SLIP_SHARE),
        LEAST_STEP_SHARE,
        FALSE_ALARMS_PER_HOUR * driven_h,
        tuple(int(np.searchsorted(begins, t)) for t in given.times_s),
    )
    found = []
    for step in tested.steps:
        before, after = step.before * usual, step.after * usual
        moved = tuple(float(value) for value in _icrs(after) - _icrs(before))
        when = _place(step, windows, blocks, before, after)
        found.append(TerrainChange(when, "detected", step.score, (moved[0], moved[1], moved[2])))
    changes = tuple(sorted([*given.changes, *found], key=lambda change: change.t_s))
    return TerrainTest(changes, True, tested.threshold, len(blocks.first), driven_h)


def _icrs(shares: Floats) -> Floats:
    """Return y_r, y_l, x (3,) [m] of 1/W, middle/W, x/W (3,)."""
    width, middle, x = np.array([1.0, shares[1], shares[2]]) / shares[0]
    return np.array([middle + width / 2, middle - width / 2, x])


def _between(parts: NDArray[Number], rows: Ints) -> NDArray[Number]:
    """Return the sums of parts (n,) from each row to the next (w,)."""
    return np.add.reduceat(parts, rows)[:-1] if len(rows) else parts[:0]


def _some(windows: _Windows, rows: Bools | slice) -> _Windows:
    return windows._replace(**{name: column[rows] for name, column in windows._asdict().items()})


def _heading(table: States, times_s: Floats, innovations: Floats) -> Floats:
    """Return the heading (n,) [rad] that the sensor saw, averaged for a moment.

    The filter's own lags behind as long as its ICRs are wrong, and would hide what is looked for.
    """
    if not len(times_s):
        return table.heading_rad
    low, high = (np.searchsorted(times_s, times_s + side * MOMENT_S / 2) for side in (-1.0, 1.0))
    total = np.concatenate([[0.0], np.cumsum(innovations)])
    off = (total[high] - total[low]) / np.maximum(high - low, 1)
    heading: Floats = table.heading_rad + np.interp(table.t_s, times_s, off)
    return heading


def _windows(table: States, psi: Floats, in_gap: Bools, outages_ns: Ints) -> _Windows:
    """Cut a run into windows; those in outages, gaps and just after them are left out.

    Notes
    -----
    Eqs. 8-12 along the heading psi (n,) that was seen, not the one that wheels predict: 1/W, (y_r + y_l)/2W and x/W
    are then linear in turn and displacement, however large a change is.
    """
    t, left, right = table.t_s, table.v_left_mps, table.v_right_mps
    moving = (np.abs(left) + np.abs(right)) / 2 > STANDING_MPS
    # noise of standing encoders is no way
    dt = np.where(in_gap | ~moving, 0.0, np.append(np.diff(t), 0.0))
    along: Complexes = np.exp(1j * np.append(psi[:-1] + np.diff(psi) / 2, psi[-1]))
    width = max(abs(float(np.median(table.y_icr_right_m - table.y_icr_left_m))), LEAST_WIDTH_M)
    ahead, way = dt * (left - right), dt * (np.abs(left) + np.abs(right)) / 2
    progress = np.cumsum(way / WINDOW_WAY_M + np.abs(ahead) / width / WINDOW_TURN_RAD)
    progress = np.concatenate([[0.0], progress[:-1]])
    rows = rows_at_steps(progress, 1.0)
    start, end = rows[:-1], rows[1:]
    turn, gone = np.diff(psi[rows]), _between(way, rows)
    driven = _between(dt * (left + right) / 2 * along, rows)
    position = np.hypot(table.std_north_m, table.std_east_m)
    heading = table.std_heading_rad
    gaps = np.concatenate([[0], np.cumsum(in_gap)])
    good = (gaps[end] == gaps[start]) & (t[start] >= SETTLED_S)
    for begin, until in (outages_ns - table.stamp_ns[0]) / 1e9:
        good &= (t[end] <= begin) | (t[start] >= until + SETTLED_S)
    columns = _Windows(
        t[start],
        t[end],
        turn,
        np.sqrt(heading[start] ** 2 + heading[end] ** 2 + (SLIP_SHARE * turn) ** 2 + 1e-12),
        _between(ahead, rows),
        np.diff(table.north_m[rows]) + 1j * np.diff(table.east_m[rows]) - driven,
        np.sqrt(position[start] ** 2 + position[end] ** 2 + (SLIP_SHARE**2 + heading[start] ** 2) * gone**2 + 1e-12),
        _between(ahead * along, rows),
    )
    return _some(columns, good)


def _blocks(windows: _Windows) -> _Blocks:
    """Estimate 1/W, middle/W and x/W of every block by least squares; noise of the pose tells how well."""
    turned = np.concatenate([[0.0], np.cumsum(np.abs(windows.turn))])
    ends = rows_at_steps(turned, BLOCK_TURN_RAD)[1:]
    first = np.concatenate([[0], ends[:-1]]).astype(np.int64)[: len(ends)]

    def total(values: Floats) -> Floats:
        sums = np.concatenate([[0.0], np.cumsum(values)])
        part: Floats = sums[ends] - sums[first]
        return part

    turning, placing = windows.turn_std**-2.0, windows.off_std**-2.0
    by_turn = total(turning * windows.ahead**2) + 1e-12
    by_place = total(placing * np.abs(windows.arm) ** 2) + 1e-12
    back = placing * np.conj(windows.arm) * windows.off
    shares = np.column_stack(
        [
            total(turning * windows.ahead * windows.turn) / by_turn,
            total(back.real) / by_place,
            -total(back.imag) / by_place,
        ]
    )
    std = np.column_stack([by_turn**-0.5, by_place**-0.5, by_place**-0.5])
    usual = float(np.median(shares[:, 0])) if len(shares) else 1.0
    width = shares[:, 0] / (usual if usual != 0.0 else 1.0)
    able = (width > 1 / MOST_WIDER) & (width < MOST_WIDER) & (np.abs(shares[:, 1]) < 0.5) & (np.abs(shares[:, 2]) < 1.0)
    return _Blocks(first[able], ends[able].astype(np.int64), shares[able], std[able])


def _place(step: Step, windows: _Windows, blocks: _Blocks, before: Floats, after: Floats) -> float:
    """Return the time of a step [s], by the windows around it."""
    low = int(blocks.first[max(step.place - REFINED_BLOCKS, 0)])
    high = int(blocks.end[min(step.place + REFINED_BLOCKS, len(blocks.end)) - 1])
    near = _some(windows, slice(low, high))
    cost = []
    for shares in (before, after):
        turn = (near.turn - shares[0] * near.ahead) / near.turn_std
        off = np.abs(near.off - complex(shares[1], -shares[2]) * near.arm) / near.off_std
        cost.append(np.minimum(turn**2 + off**2, LARGEST_MISFIT))
    # the sum of misfits when the first i windows lie before the change
    total = np.concatenate([[0.0], np.cumsum(cost[0] - cost[1])])
    last = int(np.flatnonzero(total <= total.min() + SURE_MISFIT)[-1])
    return float(near.begin_s[min(last, high - low - 1)])
