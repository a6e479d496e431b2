"""The tables that pass from package to package: a robot's log, and the states of a run."""

from __future__ import annotations

from dataclasses import dataclass, fields
from html import escape
from typing import TYPE_CHECKING

from icrtool.kernels.arrays import Floats, Ints
from icrtool.records.frames import parts_from_frames
from icrtool.records.samples import (
    Datum,
    GyroAxes,
    GyroSamples,
    HeadingSamples,
    InputFile,
    OtherReceiver,
    PositionFixes,
    Role,
    StreamChoice,
    WheelSamples,
)
from icrtool.records.text import LogText

if TYPE_CHECKING:
    import pandas as pd

Icrs = tuple[float, float, float]
"""y_icr_right, y_icr_left, x_icr [m]."""

LARGEST = 1e30
"""Of a state or a measurement: squares of larger numbers overflow."""


@dataclass(frozen=True, slots=True, repr=False)
class RobotLog:
    """What a robot measured on one drive: the tables the filter needs, and where they came from.

    Attributes
    ----------
    datum : None where the position reference was metric already (total station, lidar, motion capture)
    rejected_fixes : number of fixes dropped while reading, by reason (``no fix``, ``not finite`` ...)
    warnings : sentences for the user, in the order they were found
    antenna_m : the antenna from the body origin by the log's own transforms, forward and right; None without one
    gyro : turn rates of an inertial unit, None without one; the filter does not use them
    heading : without a row where no topic states one
    gyros : all inertial units with turn rates, all axes
    other_receivers : further GNSS receivers
    other_references : the same log with another position reference and its heading, where it holds one
    slipping_ns : (k, 2) begins and ends of the slip events found in it: its wheels show nothing there
    """

    name: str
    wheels: WheelSamples
    gnss: PositionFixes
    heading: HeadingSamples
    datum: Datum | None
    streams: tuple[StreamChoice, ...]
    inputs: tuple[InputFile, ...]
    rejected_fixes: dict[str, int]
    warnings: tuple[str, ...]
    antenna_m: tuple[float, float] | None = None
    gyro: GyroSamples | None = None
    gyros: tuple[GyroAxes, ...] = ()
    other_receivers: tuple[OtherReceiver, ...] = ()
    other_references: tuple[RobotLog, ...] = ()
    slipping_ns: tuple[tuple[int, int], ...] = ()

    @classmethod
    def from_frames(
        cls, wheels: pd.DataFrame, position: pd.DataFrame, heading: pd.DataFrame, gyro: pd.DataFrame | None = None,
        name: str = "table",
    ) -> RobotLog:  # fmt: skip
        """Return a log from data frames; `icrtool.records.frames` lists the columns.

        Raises
        ------
        DataError
            A column is missing, holds a value that is not a number, or has fewer than two samples; the column is named.
        """
        parts = parts_from_frames(wheels, position, heading, gyro, name)
        return cls(
            LogText(name), parts.wheels, parts.gnss, parts.heading, parts.datum, parts.streams, (), {}, parts.warnings,
            gyro=parts.gyro,
        )  # fmt: skip

    def topic(self, role: Role, unknown: str = "") -> str:
        """Return the topic that a stream came from."""
        return next((stream.topic for stream in self.streams if stream.role == role), unknown)

    @property
    def heading_is_of_position(self) -> bool:
        """Whether heading and position are fields of the same messages."""
        return self.topic("heading") == self.topic("gnss") != ""

    def __repr__(self) -> str:
        spans = [samples.stamp_ns[[0, -1]] for samples in self._by_role().values() if len(samples.stamp_ns)]
        duration_s = (max(int(span[1]) for span in spans) - min(int(span[0]) for span in spans)) / 1e9 if spans else 0.0
        counts = ", ".join(f"{len(samples.stamp_ns):,} {role}" for role, samples in self._by_role().items())
        return f"<RobotLog {self.name!r}: {duration_s:.1f} s, {counts}, {len(self.warnings)} warnings>"

    def _by_role(self) -> dict[str, WheelSamples | PositionFixes | HeadingSamples]:
        return {"wheels": self.wheels, "gnss": self.gnss, "heading": self.heading}

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><td>{escape(stream.role)}</td><td>{escape(stream.topic)}</td><td>{escape(stream.message_type)}</td>"
            f"<td>{stream.count:,}</td><td>{'' if stream.rate_hz is None else f'{stream.rate_hz:.1f} Hz'}</td></tr>"
            for stream in self.streams
        )
        heads = "".join(f"<th>{head}</th>" for head in ("stream", "topic", "type", "samples", "rate"))
        return f"<p>{escape(repr(self))}</p><table><tr>{heads}</tr>{rows}</table>"


@dataclass(frozen=True, slots=True)
class States:
    """Recorded filter states, one per wheel sample. The columns of states.csv, in its order; all of shape (n,).

    Attributes
    ----------
    heading_rad : unwrapped
    std_* : one standard deviation, the square root of the diagonal of P
    v_left_mps, v_right_mps : held until the next state
    distance_m : path length since the first state
    """

    stamp_ns: Ints
    t_s: Floats
    north_m: Floats
    east_m: Floats
    heading_rad: Floats
    y_icr_right_m: Floats
    y_icr_left_m: Floats
    x_icr_m: Floats
    std_north_m: Floats
    std_east_m: Floats
    std_heading_rad: Floats
    std_y_icr_right_m: Floats
    std_y_icr_left_m: Floats
    std_x_icr_m: Floats
    v_left_mps: Floats
    v_right_mps: Floats
    distance_m: Floats

    def columns(self) -> dict[str, Floats | Ints]:
        """Return the columns by name, in the order of states.csv."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def icrs_at(self, row: int) -> Icrs:
        """Return the ICRs at a state."""
        return float(self.y_icr_right_m[row]), float(self.y_icr_left_m[row]), float(self.x_icr_m[row])

    def frame(self) -> pd.DataFrame:
        """Return the columns as a DataFrame equal to states.csv."""
        import pandas as pd

        return pd.DataFrame(self.columns())

    @property
    def fault(self) -> str:
        """What no filter's states can be: none, not in order, not finite; empty where nothing is wrong."""
        import numpy as np

        if not len(self):
            return "there are no states"
        if np.any(self.stamp_ns[1:] <= self.stamp_ns[:-1]):
            return "its states are not in the order of time"
        if np.any(self.distance_m[1:] < self.distance_m[:-1]):
            return "the distance of its states decreases"
        for name, values in self.columns().items():
            possible = np.abs(values) < LARGEST
            if name != "stamp_ns" and not possible.all():
                return f"row {possible.argmin()} of its states has {name} that is not a finite number below {LARGEST:g}"
        return ""

    def __len__(self) -> int:
        return len(self.stamp_ns)
