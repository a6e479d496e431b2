"""What every analysis needs of a filter run, whether it was just made or read back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from icrtool.kernels.trials import Drive
from icrtool.records.tables import Bools, Bytes, Floats, Ints, States

RUN_SCHEMA = "icrtool/run/1"
"""Version of what the summary of a run holds."""

DEFAULT_HALF_WIDTH_M = 0.3
"""Half of a small field robot, where the width is not known."""


@dataclass(frozen=True, slots=True)
class MeasurementOutcome:
    """What became of the fixes or headings of a log.

    Attributes
    ----------
    stamp_ns : int64 (m,); t_s : (m,) seconds since the first recorded state
    nis : (m,) normalised innovation squared, NaN where unseen
    code : uint8 (m,), see `icrtool.kernels.ekf`: UNSEEN, USED, GATED, RECOVERED
    difference : (m,) fix minus estimate after the update [m], or heading innovation [rad]
    """

    stamp_ns: Ints
    t_s: Floats
    nis: Floats
    code: Bytes
    difference: Floats


class DrivenRun(Protocol):
    """A filter run, just made or read back: what the analysis needs of it."""

    @property
    def name(self) -> str:
        """Name of the log."""
        ...

    @property
    def table(self) -> States:
        """The recorded states."""
        ...

    @property
    def in_gap(self) -> Bools:
        """Whether the interval after a state is a gap in the wheel data (n,)."""
        ...

    @property
    def outages_ns(self) -> Ints:
        """Half-open spans without usable GNSS (k, 2)."""
        ...

    @property
    def track_width_m(self) -> float | None:
        """Distance b between the track centre lines, None where not given."""
        ...

    @property
    def summary(self) -> dict[str, Any]:
        """What run.json holds, the effective configuration among it."""
        ...


def half_width_m(track_width_m: float | None) -> float:
    """Return b/2, or what stands for it when the width is not known."""
    return track_width_m / 2 if track_width_m is not None else DEFAULT_HALF_WIDTH_M


def drive_of(run: DrivenRun) -> Drive:
    """Return the run's states as the kernels want them."""
    table = run.table
    in_outage = np.zeros(len(table), np.bool_)
    for begin, end in run.outages_ns:
        # The last fix is still good at `begin`, and the first one again at `end`.
        in_outage |= (table.stamp_ns > begin) & (table.stamp_ns < end)
    return drive_through(table, run.in_gap, in_outage)


def toy_drive() -> Drive:
    """Return a drive of twenty states straight on, to load compiled kernels with."""
    way = np.arange(20.0)
    no = np.zeros(len(way), np.bool_)
    return Drive(np.ones_like(way), np.ones_like(way), np.ones_like(way), way, 0 * way, 0 * way, way, no, no.copy())


def drive_through(table: States, in_gap: Bools, in_outage: Bools) -> Drive:
    """Return states as the kernels want them."""
    return Drive(
        dt_s=np.append(np.diff(table.stamp_ns) / 1e9, 0.0),
        v_left=table.v_left_mps,
        v_right=table.v_right_mps,
        north=table.north_m,
        east=table.east_m,
        heading=table.heading_rad,
        distance=table.distance_m,
        gap=in_gap,
        in_outage=in_outage,
    )
