"""Words near points of a drawn path, where they cover neither the path nor one another."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from icrtool.kernels.arrays import Bools, Floats
from icrtool.output.figures import style
from icrtool.output.series import rows_entering_cells

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MARK_PT, LINE_PT, CHARACTER_PT = 4.5, 11.0, 5.3
"""Half the size of a mark, height of a line of text, usual width of a character [points], at `SIZE_PT`."""

SIZE_PT = 8.0
"""Size of a label [points]."""

OFFSETS_PT = tuple(
    (sign * dx, dy)
    for dx in (7.0, 16.0, 32.0, 56.0)
    for dy in (9.0, -9.0, 0.0, 18.0, -18.0, 32.0, -32.0, 48.0, -48.0)
    for sign in (1, -1)
)
"""Places of a label relative to its point [points], the nearest first."""

LINE_FROM_PT = 20.0
"""Distance between a label and its point from which on a line joins them [points]."""

PATH_STEP_PT = 3.0
"""Distance between the points of a path that a label keeps clear of [points]."""


MOST_BETWEEN = 500
"""Largest number of points between two points of a path."""


class Label(NamedTuple):
    """A text, its place in the coordinates of the axes, and its colour."""

    text: str
    x: float
    y: float
    color: str = "black"


def write_labels(
    axes: Axes, labels: Sequence[Label], paths: Sequence[tuple[Floats, Floats]], *, crossing: bool = False,
    marks: Sequence[tuple[float, float]] = (), size_pt: float = SIZE_PT, farthest_pt: float = math.inf, **look: Any,
) -> list[Label]:  # fmt: skip
    """Write each label at the nearest place within the axes that covers no path, no mark and no other label.

    Return the labels that were written.

    Parameters
    ----------
    paths : x and y (n,) of lines that are drawn
    crossing : write a label over a path where no place is free; else the label is left out
    marks : x and y of further marks; each label's own point is one
    farthest_pt : largest distance between a label and its point [points]
    """
    axes.apply_aspect()
    point_px, frame = axes.figure.dpi / 72.0, axes.bbox
    step = PATH_STEP_PT * point_px
    # one path after the other: the pixels of all points of a long path are as large as two columns of the log
    drawn = (axes.transData.transform(np.column_stack([x, y])) for x, y in paths)
    crossed = np.concatenate([np.empty((0, 2)), *(_along(path, step) for path in drawn)])
    spots = axes.transData.transform(
        np.array([*((label.x, label.y) for label in labels), *marks], np.float64).reshape(-1, 2)
    )
    half, written = MARK_PT * point_px, []
    occupied = np.concatenate([spots - half, spots + half], axis=1)
    for label, spot in zip(labels, spots, strict=False):
        width, height = (size_pt / SIZE_PT * point_px * part for part in (CHARACTER_PT * len(label.text), LINE_PT))
        second_spot, free_spot = None, None
        for dx, dy in (offset for offset in OFFSETS_PT if math.hypot(*offset) <= farthest_pt):
            x, y = spot + point_px * np.array([dx, dy]) - (width if dx <= 0 else 0.0, height / 2)
            box = np.array([x, y, x + width, y + height])
            inside = frame.x0 < box[0] and frame.y0 < box[1] and box[2] < frame.x1 and box[3] < frame.y1
            if not inside or _overlaps(box, occupied).any():
                continue
            if not _overlaps(box, np.tile(crossed, 2)).any():
                free_spot = dx, dy, box
                break
            second_spot = second_spot or (dx, dy, box)
        free_spot = free_spot or (second_spot if crossing else None)
        if free_spot is None:
            continue
        dx, dy, box = free_spot
        written.append(label)
        occupied = np.concatenate([occupied, box[None]])
        line = {"arrowstyle": "-", "color": "0.5", "linewidth": 0.6} if math.hypot(dx, dy) > LINE_FROM_PT else None
        near: style.Look = {"ha": "left" if dx > 0 else "right", "va": "center", "fontsize": size_pt, "zorder": 6}
        near["color"] = label.color
        style.write_near(axes, label.text, (label.x, label.y), (dx, dy), **near | {"arrowprops": line} | look)
    return written


def _along(path: Floats, step: float) -> Floats:
    """Return points of a line (n, 2) at most about `step` apart."""
    path = path[np.isfinite(path).all(axis=1)]
    kept = path[rows_entering_cells(path[:, 1], path[:, 0], step)]
    if len(kept) < 2:
        return kept
    lengths = np.hypot(*np.diff(kept, axis=0).T)
    count = np.minimum(np.ceil(lengths / step), MOST_BETWEEN).astype(np.int64)
    begins, share = (
        np.repeat(np.arange(len(count)), count),
        np.concatenate([np.arange(parts) / parts for parts in count]),
    )
    between = kept[begins] + share[:, None] * (kept[begins + 1] - kept[begins])
    return np.concatenate([between, kept[-1:]])


def _overlaps(box: Floats, others: Floats) -> Bools:
    """Return which of other boxes (n, 4), each left, low, right, high, a box (4,) overlaps."""
    overlapping: Bools = (
        (others[:, 0] < box[2]) & (others[:, 2] > box[0]) & (others[:, 1] < box[3]) & (others[:, 3] > box[1])
    )
    return overlapping
