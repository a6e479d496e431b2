"""A run: the result of the filter on a log. A run read from its directory is equal to the run that was written."""

from __future__ import annotations

import math
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from icrtool.config import Config
from icrtool.kernels.arrays import Bools, Bytes, Floats, Ints
from icrtool.kernels.filter_records import GATED, RECOVERED, USED
from icrtool.kernels.track import Track
from icrtool.records.choices import FigureSet, StatesFormat
from icrtool.records.measurements import SensorData, intervals_in
from icrtool.records.notes import Note
from icrtool.records.plain_data import plain_value
from icrtool.records.samples import are_twist
from icrtool.records.tables import Icrs, States

if TYPE_CHECKING:
    import pandas as pd

    from icrtool.records.run_document import IcrColumn, RunDocument

ICR_COLUMNS: tuple[IcrColumn, ...] = ("y_icr_right_m", "y_icr_left_m", "x_icr_m")
ICR_WORDS: dict[str, str] = dict(zip(ICR_COLUMNS, ("y right", "y left", "x"), strict=True))

STATE_COLUMNS = ("north_m", "east_m", "heading_rad", *ICR_COLUMNS)
"""Columns of the entries of the state, in the order of the kernels."""

ROLLING_SCALE = 0.15
"""Largest share by which tyres and soil change the distance of a wheel revolution."""

USUAL_WIDTH_M = 0.6
"""Track width of a small field robot [m], used where the robot's track width is not known."""

MAKE_RUN = "icrtool.fit(log) makes one, icrtool.open_run(directory) reads one"
"""Advice in the error about an argument that is not a run."""


def check_type(value: object, kind: type, advice: str) -> None:
    """Refuse an argument of another type, for example the path of a file.

    Raises
    ------
    TypeError
        The argument has another type; `advice` names the function to call.
    """
    if not isinstance(value, kind):
        raise TypeError(f"a {kind.__name__} is needed, not {type(value).__name__}; {advice}")


@dataclass(frozen=True, slots=True)
class MeasurementOutcome:
    """How the filter used each fix or heading of a log.

    Attributes
    ----------
    stamp_ns : int64 (m,) stamps of the measurements [ns]
    start_ns : stamp of the first recorded state [ns]
    nis : (m,) normalised innovation squared; NaN where the filter did not get the measurement
    code : uint8 (m,), see `icrtool.kernels.filter_records`
    difference : (m,) fix minus estimate after the update [m], or heading innovation [rad]
    """

    stamp_ns: Ints
    start_ns: int
    nis: Floats
    code: Bytes
    difference: Floats

    @property
    def t_s(self) -> Floats:
        """Seconds since the first recorded state (m,)."""
        return np.asarray((self.stamp_ns - self.start_ns) / 1e9)

    @property
    def used(self) -> Bools:
        """Whether the filter was updated with each measurement (m,)."""
        moved: Bools = (self.code == USED) | (self.code == RECOVERED)
        return moved

    @property
    def rejected(self) -> Bools:
        """Whether the innovation gate rejected each measurement (m,)."""
        gated: Bools = self.code == GATED
        return gated


@dataclass(frozen=True, slots=True)
class WarmStart:
    """ICRs (3,) [m], right, left, x, and their covariance (3, 3) [m^2] to start from (Pentzer 2014, Fig. 18).

    `track_width_m` is b of the robot that the ICRs were learned on, None where it was not given. `source` is the name
    of the run or file that the ICRs come from, empty without a name.
    """

    icrs_m: Floats
    covariance_m2: Floats
    track_width_m: float | None = None
    source: str = ""


@dataclass(frozen=True, slots=True, repr=False, eq=False)
class Run:
    """One finished run. `icrtool.fit` makes a run, `icrtool.open_run` reads an equal run from its directory.

    Attributes
    ----------
    document : content of run.json
    table : the recorded states; `states` is the same as a DataFrame
    in_gap : bool (n,), whether the interval after a state is a gap in the wheel data
    outages_ns : half-open spans without usable GNSS, (k, 2)
    sensors : the streams as the filter used them
    gnss, heading : how the filter used each fix and heading
    smoothed : states of the RTS smoother at the same stamps, None where they were not asked for
    directory : directory that the run was read from, None for a run that was just made
    """

    document: RunDocument
    table: States
    in_gap: Bools
    outages_ns: Ints
    sensors: SensorData
    gnss: MeasurementOutcome
    heading: MeasurementOutcome
    smoothed: States | None
    directory: Path | None = None

    @property
    def states(self) -> pd.DataFrame:
        """The recorded states, equal to states.csv."""
        return self.table.frame()

    def states_enu(self) -> pd.DataFrame:
        """Return the recorded states in the frames of REP-103, with the same rows as `states`.

        Returns
        -------
        ``stamp_ns``, ``t_s``; ``x_m`` east and ``y_m`` north of the datum; ``yaw_rad`` counter-clockwise from east,
        unwrapped; ICRs in the body frame with y to the left (the right one is negative); ``std_`` of each; wheel speeds
        and distance as in `states`.
        """
        table, turned = self.table.frame(), {"y_icr_right_m", "y_icr_left_m"}
        names = {"north_m": "y_m", "east_m": "x_m", "heading_rad": "yaw_rad"}
        columns = {}
        for name in table:
            plain_name = str(name).removeprefix("std_")
            values = table[name]
            if name == "heading_rad":
                values = math.pi / 2 - values
            elif name in turned:
                values = -values
            columns[str(name).replace(plain_name, names.get(plain_name, plain_name))] = values
        first = ("stamp_ns", "t_s", "x_m", "y_m")
        return type(table)({name: columns[name] for name in (*first, *(name for name in columns if name not in first))})

    @property
    def name(self) -> str:
        """Name of the log."""
        return self.document.log

    @property
    def config(self) -> Config:
        """The configuration that the run was made with."""
        return self.document.config

    @property
    def summary(self) -> dict[str, Any]:
        """The content of run.json, as plain data."""
        content: dict[str, Any] = plain_value(self.document)
        return content

    @property
    def notes(self) -> tuple[Note, ...]:
        """The findings in the order in which they were made; each has a code, a grade and a text."""
        return self.document.notes

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences for the user, in the order they were found."""
        return self.document.warnings

    @property
    def track_width_m(self) -> float | None:
        """Distance b between the centre lines of the tracks [m], None where it was not given."""
        return self.config.robot.track_width_m

    @property
    def changes_s(self) -> tuple[float, ...]:
        """Times of the terrain changes since the first recorded state [s]."""
        return tuple(change.t_s for change in self.document.terrain.changes)

    @property
    def slipping(self) -> Bools:
        """Whether the interval after a state lies in a slip event (n,)."""
        return intervals_in(self.table.stamp_ns, ((event.begin_ns, event.end_ns) for event in self.sensors.events))

    @property
    def jumping(self) -> Bools:
        """Whether the reference jumps in the interval after a state (n,); undecided jumps do not count."""
        decided = (jump for jump in self.sensors.jumps if not jump.undecided)
        return intervals_in(self.table.stamp_ns, ((jump.begin_ns, jump.end_ns) for jump in decided))

    @property
    def convergence_s(self) -> dict[IcrColumn, tuple[float, float] | None]:
        """Begin and end of the 10-90 % convergence [s] by ICR column; None without convergence."""
        spans = self.document.icr.convergence_span_s
        return {name: spans[name] for name in ICR_COLUMNS}

    @property
    def settled_s(self) -> float:
        """Time at which the last ICR had converged, since the first recorded state [s]; 0 where no ICR converged."""
        return max((span[1] for span in self.convergence_s.values() if span is not None), default=0.0)

    @property
    def began_with(self) -> WarmStart | None:
        """The warm start of the run, None for a run without a warm start."""
        stored = self.document.filter.warm_start
        if stored is None:
            return None
        return WarmStart(np.array(stored.icrs_m), np.array(stored.covariance_m2), source=stored.source)

    @property
    def ended_with(self) -> WarmStart:
        """Warm start for another run: the filter's last ICRs and their covariance, large where an ICR is not shown."""
        covariance = np.array(self.document.icr.final_covariance_m2, np.float64)
        return WarmStart(np.array(self.table.icrs_at(-1)), covariance, self.track_width_m, self.name)

    @property
    def wheel_scales(self) -> tuple[float, float]:
        """Ratios of the recorded speeds to the speeds at the nominal wheel radius, left and right.

        The ratios include configured and estimated scales. A recorded speed divided by its ratio is the speed that the
        wheels reported.
        """
        return self.document.wheels.applied_left_scale, self.document.wheels.applied_right_scale

    @property
    def radius_errors(self) -> tuple[float, float]:
        """Factors of `wheel_scales`, left and right, that correct a wrong radius or resolution, not tyres and soil.

        Scales within `ROLLING_SCALE` of 1 come from tyres and soil, and are no error of the radius. Motion models are
        fitted to speeds with the factors of this function, and estimate the scales of tyres and soil.
        """
        left, right = (
            1.0 if not scale or abs(abs(scale) - 1.0) <= ROLLING_SCALE else abs(scale) for scale in self.wheel_scales
        )
        return left, right

    @property
    def usable(self) -> bool:
        """Whether the ICRs may be used; ``unusable_because`` of `document` is the reason where not."""
        return self.document.usable

    def write(
        self,
        path: str | Path,
        *,
        states: StatesFormat | None = None,
        plots: tuple[str, ...] = ("png",),
        figures: FigureSet = "default",
    ) -> None:
        """Write the run directory, whole or not at all, in place of an older run at `path`.

        Parameters
        ----------
        path : the run directory
        states : format of the states; default: ``csv``, or ``parquet`` for over a million states
        plots : formats of the figures, of ``png``, ``svg`` and ``pdf``; none: no figures
        figures : ``all``: the figures of the paper too

        Raises
        ------
        OutputError
            A file or a directory of another program exists at `path`, or the disk cannot be written.
        """
        from icrtool.output.run_directory import write_run

        write_run(self, Path(path), states=states, plots=plots, figures=figures)

    def __repr__(self) -> str:
        drive = self.document.drive
        found = ((column, self.document.icr_of_drive(column)) for column in ICR_COLUMNS)
        icrs = ", ".join(f"{column} {icr_text(*(icr or (None, None)))}" for column, icr in found)
        return (
            f"<Run {self.name!r}: {drive.distance_m:.1f} m in {drive.duration_s:.1f} s, "
            f"{len(self.table):,} states, {icrs}, {len(self.warnings)} warnings>"
        )

    def _repr_html_(self) -> str:
        from icrtool.output.tables.run import format_run

        warnings = "".join(f"<li>{escape(warning)}</li>" for warning in self.warnings)
        text = escape(format_run(self))
        return f"<pre>{text}</pre>" + (
            f"<details><summary>Warnings</summary><ul>{warnings}</ul></details>" if warnings else ""
        )


def icr_text(value: float | None, std: float | None) -> str:
    """Return an ICR with its standard deviation as text; ``not shown`` for an ICR that is not shown."""
    return f"{value:+z.3f} ± {std:.3f}" if value is not None else "not shown"


def width_or_usual_m(track_width_m: float | None) -> float:
    """Return the track width b [m]; `USUAL_WIDTH_M` where the track width is not known."""
    return track_width_m if track_width_m is not None else USUAL_WIDTH_M


def no_slip_icrs(track_width_m: float) -> Icrs:
    """Return the ICRs of a robot that does not slip (Pentzer 2014, Eqs. 38-39): in the middle of its tracks."""
    return track_width_m / 2, -track_width_m / 2, 0.0


def why_no_vendor(document: RunDocument) -> str:
    """Return why a run has no row ``vendor``; empty where it has this row."""
    robot = document.config.robot
    if robot.skid_factor is None:
        return "no skid factor is published for the robot (robot.skid_factor)"
    if robot.track_width_m is None:
        return "robot.track_width_m is not known"
    if are_twist(document.streams) and document.config.wheels.twist_width_m is None:
        return (
            "the wheels were read from body twists, in which the robot's controller has used the factor already: "
            "set wheels.twist_width_m"
        )
    return ""


def vendor_icrs(document: RunDocument) -> Icrs | None:
    """Return the ICRs of the skid factor m that is published for a robot; None as `why_no_vendor` states.

    Notes
    -----
    The robot turns as a robot of track width m b without slip: these are its no-slip ICRs.
    """
    robot = document.config.robot
    if robot.skid_factor is None or robot.track_width_m is None or why_no_vendor(document):
        return None
    return no_slip_icrs(robot.skid_factor * robot.track_width_m)


def track_of(run: Run) -> Track:
    """Return the states of a run as a track; no trial crosses a gap or the uncertain states after a gap."""
    unknown = run.in_gap | _unrecovered(run.table, run.in_gap)
    return track_of_states(run.table, unknown, run.outages_ns, jumping=run.jumping, slipping=run.slipping)


RECOVERED_RATIO = 2.0
"""Largest ratio of a state's standard deviation to the usual standard deviation of the run at which the filter has
recovered from a gap in the wheel data."""


def _unrecovered(table: States, in_gap: Bools) -> Bools:
    """Return whether each state (n,) follows a gap in the wheel data and is still more uncertain than usual.

    The motion in a gap is not known: states stay uncertain until the first fix and the first heading after the gap.
    """
    uncertain = np.zeros(len(table), np.bool_)
    if not in_gap.any():
        return uncertain
    poor = np.zeros(len(table), np.bool_)
    for std in (np.hypot(table.std_north_m, table.std_east_m), table.std_heading_rad):
        poor |= std > RECOVERED_RATIO * float(np.median(std))
    good = np.flatnonzero(~poor)
    for begin in np.flatnonzero(in_gap).tolist():
        row = int(np.searchsorted(good, begin + 1))
        uncertain[begin + 1 : good[row] if row < len(good) else len(uncertain)] = True
    return uncertain


def track_of_states(
    table: States, in_gap: Bools, outages_ns: Ints, *, jumping: Bools | None = None, slipping: Bools | None = None
) -> Track:
    """Return states as a track; `jumping` and `slipping` as in `Run`, None without jumps or slip events."""
    in_outage = np.zeros(len(table), np.bool_)
    for begin, end in outages_ns:
        # The last fix is still good at `begin`, and the first one again at `end`.
        in_outage |= (table.stamp_ns > begin) & (table.stamp_ns < end)
    held = np.zeros(len(table))
    np.divide(np.diff(table.stamp_ns), 1e9, out=held[:-1])
    held[in_gap] = 0.0
    return Track.of_states(
        table.t_s, held, table.v_left_mps, table.v_right_mps, table.north_m, table.east_m, table.heading_rad,
        table.distance_m, in_outage=in_outage, jump=jumping, slipping=slipping,
    )  # fmt: skip
