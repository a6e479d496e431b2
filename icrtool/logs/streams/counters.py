"""Counters and angles that begin again at a modulus: the modulus is found from the numbers, and they are continued."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from icrtool.kernels.arrays import Floats

TURN_MODULI = (360.0, 2 * np.pi)
"""Moduli of angles [deg, rad]."""

FEWEST_STEPS = 20
"""Smallest number of steps between samples with which a modulus is searched."""

LARGE_STEP = 0.5
"""Smallest size of a step that passes the modulus, as a share of the range of the numbers."""

CONSISTENT_SHARE = 0.9
"""Smallest share of the large steps that must agree with one modulus."""

BETWEEN_WRAPS = 0.4
"""Smallest mean travel of a counter between two passages of the modulus, as a share of its range."""

ROUND_STEPS = (1000.0, 500.0, 100.0, 360.0)
"""Numbers of which moduli of counters are often multiples; the first number that fits is used."""


TURN_TOLERANCE = 1e-3
"""Relative tolerance of a turn. The largest recorded angle may be a rounded turn."""

POWERS = 7, 33
"""Range of the exponents of powers of two that are known moduli: counters of 7 to 32 bits."""

FEWEST_PASSAGES = 2
"""Smallest number of passages of an unknown modulus. A single step back may be a restart of the robot."""


class Modulus(NamedTuple):
    """A number at which counters or angles begin again.

    Attributes
    ----------
    value : the modulus, in the unit of the numbers
    std : standard deviation of the modulus; 0 for a known modulus
    """

    value: float
    std: float = 0.0

    @property
    def text(self) -> str:
        """The modulus as text, with unit and standard deviation where known."""
        words = {360.0: "360 deg", 2 * np.pi: "2 pi rad"}
        return words.get(self.value, f"{self.value:.6g}") + (f" ± {self.std:.2g}" if self.std else "")


class _Wraps(NamedTuple):
    """Steps of a column that may pass a modulus.

    Attributes
    ----------
    moduli, spread : (w,) the modulus that each step shows, and the uncertainty of this modulus
    extent : range of the column
    between : sum of the travel between successive steps, each as a share of the range, at most 1
    """

    moduli: Floats
    spread: Floats
    extent: float
    between: float


def find_modulus(columns: Iterable[NDArray[Any]], given: float | None = None) -> Modulus | None:
    """Return the common modulus at which counters or angles begin again; None where the numbers do not show one.

    At a passage of the modulus a column steps by nearly all of its range, and the step minus the modulus is similar to
    the steps next to it. Between two passages the column runs through its range.

    Parameters
    ----------
    columns : one column (n,) for each wheel of a robot: whole numbers, or numbers that may be angles
    given : encoder counts of one turn, which are tried before powers of two
    """
    arrays = [np.asarray(column) for column in columns]
    wraps_of_columns = [wraps for column in arrays if (wraps := _find_wraps(column.astype(np.float64))) is not None]
    if not wraps_of_columns:
        return None
    moduli, spread = (
        np.concatenate([wraps.moduli for wraps in wraps_of_columns]),
        np.concatenate([wraps.spread for wraps in wraps_of_columns]),
    )
    modulus = float(np.median(moduli))
    whole = all(column.dtype.kind != "f" or not np.any(np.mod(column[np.isfinite(column)], 1.0)) for column in arrays)
    extent = max(wraps.extent for wraps in wraps_of_columns)
    margin = 2.0 * float(np.median(spread)) + (1.0 if whole else 1e-6 * modulus)
    if np.mean(np.abs(moduli - modulus) <= 2.0 * spread + margin) < CONSISTENT_SHARE:
        return None
    count, passages = len(moduli), max(len(wraps.moduli) for wraps in wraps_of_columns)
    if passages > 1 and sum(wraps.between for wraps in wraps_of_columns) < BETWEEN_WRAPS * sum(
        len(wraps.moduli) - 1 for wraps in wraps_of_columns
    ):
        return None
    std = float(np.median(np.abs(moduli - modulus))) * 1.5 / np.sqrt(count) + float(np.median(spread)) / count
    lowest = extent + (1.0 if whole else 0.0)
    least, most = max(lowest, modulus - 3 * std), max(lowest + margin, modulus + 3 * std)
    if (usual := _known_modulus(least, most, given, whole=whole)) is not None:
        return Modulus(usual)
    if passages < FEWEST_PASSAGES or not whole:
        return None
    rounded = (float(np.ceil(least / step) * step) for step in ROUND_STEPS)
    found_round = next((candidate for candidate in rounded if candidate <= most), None)
    return Modulus(max(modulus, least), std) if found_round is None else Modulus(found_round)


def _known_modulus(least: float, most: float, given: float | None, *, whole: bool) -> float | None:
    """Return the first known modulus in a range: a turn, the counts of the configured encoder, or a power of two.

    None is returned where the range contains no known modulus.
    """
    turn = next(
        (candidate for candidate in TURN_MODULI if least <= (1 + TURN_TOLERANCE) * candidate and candidate <= most),
        None,
    )
    if turn is not None or not whole:
        return turn
    counts = [*([] if given is None else [given]), *(float(1 << bits) for bits in range(*POWERS))]
    return next((candidate for candidate in counts if least <= candidate <= most), None)


def _find_wraps(values: Floats) -> _Wraps | None:
    """Return the large steps of a column (n,); None where they cannot be passages of a modulus."""
    values = values[np.isfinite(values)]
    if len(values) < FEWEST_STEPS:
        return None
    extent, steps = float(np.ptp(values)), np.diff(values)
    large = np.abs(steps) > LARGE_STEP * extent
    rows = np.flatnonzero(large)
    if not len(rows) or 2 * len(rows) > len(steps):
        return None
    small = np.where(large, np.nan, steps)
    before, after = (small[np.clip(rows + side, 0, len(steps) - 1)] for side in (-1, 1))
    neighbours = np.column_stack([before, after])
    has_neighbours = np.isfinite(neighbours).any(axis=1)
    rows, neighbours = rows[has_neighbours], neighbours[has_neighbours]
    if not len(rows):
        return None
    filled = np.where(np.isfinite(neighbours), neighbours, neighbours[:, ::-1])
    expected = filled.mean(axis=1)
    moduli = np.abs(steps[rows]) - np.sign(steps[rows]) * expected
    spread = np.abs(filled[:, 0] - filled[:, 1]) / 2 + 0.25 * np.abs(expected)
    travel = np.cumsum(np.abs(np.where(large, 0.0, steps)))
    between = float(np.clip(np.diff(travel[rows]) / max(extent, 1e-12), 0.0, 1.0).sum())
    return _Wraps(moduli, spread, extent, between)


def unwrap_counter(values: NDArray[Any], modulus: float) -> NDArray[Any]:
    """Return a counter (n,) continued beyond its modulus; numbers that are not finite stay in their places."""
    steps = np.diff(values[np.isfinite(values)]) if values.dtype.kind == "f" else np.diff(values)
    whole = values.dtype.kind != "f" and float(modulus).is_integer()
    size = int(modulus) if whole else modulus
    half = size // 2 if whole else size / 2
    steps = np.mod(steps + half, size) - half
    if values.dtype.kind != "f":
        return np.cumsum(np.concatenate([values[:1], steps]))
    result = values.copy()
    finite = np.isfinite(values)
    result[finite] = np.cumsum(np.concatenate([values[finite][:1], steps]))
    return result


def register_size(values: NDArray[Any]) -> float | None:
    """Return the modulus of a counter of 16 or 32 bits whose range contains all whole numbers (n,); None beyond both.

    The range may begin at 0, or be that of a signed number.
    """
    low, high = int(values.min()), int(values.max())
    for bits in (16, 32):
        half = 1 << (bits - 1)
        if (low >= 0 and high < 2 * half) or (low >= -half and high < half):
            return float(2 * half)
    return None
