"""Fit: run the filter over a log and say what it learned (Pentzer 2014, Sections 3 and 6)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from icrtool.alignment.gnss_quality import FixQuality, judge_fixes
from icrtool.alignment.corrections import align_streams
from icrtool.alignment.heading_alignment import HeadingCheck
from icrtool.config import Config
from icrtool.estimation.filter_setup import WarmStart, check_start, wheel_gap_s
from icrtool.estimation.noise_adaptation import AdaptedRun, run_adaptively
from icrtool.estimation.observability import judge_excitation
from icrtool.estimation.run_warnings import adaptation_notes, antenna_doubt, doubts
from icrtool.estimation.summary import converge, run_summary
from icrtool.estimation.terrain_changes import TerrainTest, find_terrain_changes, given_changes
from icrtool.kernels.ekf import UNSEEN, Codes, FilterOutput
from icrtool.records.run import MeasurementOutcome
from icrtool.records.tables import Bools, Floats, Ints, RobotLog, States

if TYPE_CHECKING:
    import pandas as pd

STATE_COLUMNS = ("north_m", "east_m", "heading_rad", "y_icr_right_m", "y_icr_left_m", "x_icr_m")
"""The state's entries, in the kernel's order."""

OUTAGE_S = 2.0
"""Longer than this without a usable fix is a GNSS outage."""

OUTAGE_IN_INTERVALS = 5.0
"""... and at least this many times the usual interval between fixes."""


@dataclass(frozen=True, slots=True)
class FilterRun:
    """One finished run.

    Attributes
    ----------
    table : the recorded states; `states` is the same as a DataFrame
    in_gap : bool (n,), whether the interval after a state is a gap in the wheel data
    outages_ns : half-open spans without usable GNSS, (k, 2)
    gnss, heading : what became of the measurements
    covariance : (6, 6) at the end
    process_position_mps : position process noise the run ended with
    warm_start : what another run had learned, where this one began with it
    terrain : changes of the ICRs, given and detected
    convergence : by ICR column of the states, first and last second of the 10-90 % rise, or None; until the first
        terrain change
    """

    log: RobotLog
    config: Config
    table: States
    in_gap: Bools
    outages_ns: Ints
    gnss: MeasurementOutcome
    heading: MeasurementOutcome
    heading_check: HeadingCheck
    fix_quality: FixQuality
    covariance: Floats
    process_position_mps: float
    warm_start: WarmStart | None
    terrain: TerrainTest
    convergence: dict[str, tuple[float, float] | None]
    warnings: tuple[str, ...]
    summary: dict[str, Any] = field(repr=False)

    @property
    def name(self) -> str:
        """Name of the log."""
        return self.log.name

    @property
    def changes_s(self) -> tuple[float, ...]:
        """Terrain changes, seconds since the first recorded state."""
        return self.terrain.times_s

    @property
    def track_width_m(self) -> float | None:
        """Distance b between the track centre lines, None where not given."""
        return self.config.robot.track_width_m

    @property
    def states(self) -> pd.DataFrame:
        """The recorded states, equal to states.csv."""
        return self.table.frame()


def fit(
    log: RobotLog,
    config: Config | None = None,
    *,
    warm_start: WarmStart | None = None,
    changes_s: tuple[float, ...] = (),
    find_changes: bool = False,
) -> FilterRun:
    """Learn a robot's track ICRs from a log.

    Parameters
    ----------
    log : as `icrtool.read_log` returns it
    config : default: all defaults
    warm_start : ICRs and covariance that another run ended with (Fig. 18), in place of the preset's start
    changes_s : terrain changes, seconds since the first recorded state: the ICR covariance is inflated there (Fig. 9)
    find_changes : look for more of them, and run the filter again with those found

    Returns
    -------
    FilterRun
        No file is touched.

    Raises
    ------
    DataError
        Streams that cannot be used together, or hold values that are not finite numbers.
    ConfigError
        A start that preset ``field`` does not take.

    Notes
    -----
    The EKF of Pentzer 2014, Eqs. 13-25, event by event; ``filter.preset`` chooses between the paper's constants and
    start (``paper``) and those made for field logs (``field``).
    """
    config = config if config is not None else Config()
    check_start(config)
    aligned = align_streams(log, config)
    log, wheels, check, delays = aligned.log, aligned.wheels, aligned.heading, aligned.delays
    fixes = judge_fixes(log, config, check)
    done = _run(fixes, config, check, warm_start, given_changes(changes_s))
    if find_changes:
        terrain = _find_changes(done)
        again = len(terrain.changes) > len(done.terrain.changes)
        done = _run(fixes, config, check, warm_start, terrain) if again else done._replace(terrain=terrain)
    adapted, fixes, table, gnss, heading, in_gap, outages, terrain = done
    log, covariance = adapted.log, _square(adapted.output.P)
    terrain, beyond = terrain.within(float(table.t_s[-1]))
    convergence = converge(table, min(terrain.times_s, default=None))
    warnings = (
        *(warning for part in (log, wheels, check, delays, fixes) for warning in part.warnings),
        *doubts(log.name, table, gnss, config.robot.track_width_m),
        *antenna_doubt(log, config, table, covariance),
        *(f"{log.name}: no terrain change at {t:g} s: the drive lasts {table.t_s[-1]:.1f} s" for t in beyond),
        *adaptation_notes(log.name, config, adapted),
    )
    run = FilterRun(
        log=log, config=config, table=table, in_gap=in_gap, outages_ns=outages, gnss=gnss, heading=heading,
        heading_check=check, fix_quality=fixes, covariance=covariance, warm_start=warm_start, terrain=terrain,
        process_position_mps=adapted.process_position_mps, convergence=convergence, warnings=warnings, summary={},
    )  # fmt: skip
    excitation = judge_excitation(run)
    run = replace(run, warnings=(*warnings, *(f"{log.name}: {sentence}" for sentence in excitation.sentences)))
    delay_s = delays.applied_gnss_s + adapted.reference_delay_s
    return replace(run, summary=run_summary(run, wheels, delays, excitation, reference_delay_s=delay_s))


class _Done(NamedTuple):
    """A pass of the filter over a log, in the words of `FilterRun`."""

    adapted: AdaptedRun
    fixes: FixQuality
    table: States
    gnss: MeasurementOutcome
    heading: MeasurementOutcome
    in_gap: Bools
    outages_ns: Ints
    terrain: TerrainTest


def _run(
    fixes: FixQuality, config: Config, check: HeadingCheck, warm_start: WarmStart | None, terrain: TerrainTest
) -> _Done:
    adapted = run_adaptively(fixes.log, config, check, warm_start, terrain.times_s)
    log, setup, output = adapted.log, adapted.setup, adapted.output
    fixes = fixes.earlier(adapted.reference_delay_s)
    table = _states(log, output)
    gnss = _outcome(
        log.gnss.stamp_ns, setup.gnss_index, table, output.gnss_nis, output.gnss_code, np.hypot(*output.gnss_residual.T)
    )
    heading = _outcome(
        log.heading.stamp_ns, setup.heading_index, table, output.heading_nis, output.heading_code,
        output.heading_innovation,
    )  # fmt: skip
    in_gap = np.append(np.diff(table.t_s) > wheel_gap_s(config, setup.data.wheel_t), False)
    return _Done(adapted, fixes, table, gnss, heading, in_gap, _outages(table, gnss, fixes.losses_ns), terrain)


def _find_changes(done: _Done) -> TerrainTest:
    seen = done.heading.code > UNSEEN
    innovations = done.heading.t_s[seen], done.heading.difference[seen]
    return find_terrain_changes(done.table, done.in_gap, done.outages_ns, innovations, done.terrain.times_s)


def _states(log: RobotLog, output: FilterOutput) -> States:
    first = len(log.wheels.stamp_ns) - len(output.x)
    stamps = log.wheels.stamp_ns[first:]
    std = np.sqrt(np.maximum(output.variance, 0.0))
    means, deviations = ([np.ascontiguousarray(column) for column in values.T] for values in (output.x, std))
    return States(
        stamp_ns=stamps,
        t_s=(stamps - stamps[0]) / 1e9,
        **dict(zip(STATE_COLUMNS, means, strict=True)),
        **{f"std_{name}": column for name, column in zip(STATE_COLUMNS, deviations, strict=True)},
        v_left_mps=log.wheels.v_left_mps[first:],
        v_right_mps=log.wheels.v_right_mps[first:],
        distance_m=output.distance,
    )


def _outcome(
    stamps: Ints, index: Ints, table: States, nis: Floats, code: Codes, difference: Floats
) -> MeasurementOutcome:
    """Put what the kernel said of the measurements it was given back in the rows of the log."""
    all_nis, all_code, all_difference = (
        np.full(len(stamps), np.nan),
        np.zeros(len(stamps), np.uint8),
        np.full(len(stamps), np.nan),
    )
    all_nis[index], all_code[index], all_difference[index] = nis, code, difference
    return MeasurementOutcome(stamps, (stamps - table.stamp_ns[0]) / 1e9, all_nis, all_code, all_difference)


def _outages(table: States, gnss: MeasurementOutcome, rtk_losses_ns: Ints) -> Ints:
    """Return the spans between usable fixes that are long enough to be outages, (k, 2) [ns].

    Where RTK was lost, the fixes there do not count: the filter drove on with its wheels.
    """
    lost = np.zeros(len(gnss.stamp_ns), np.bool_)
    for begin, end in rtk_losses_ns:
        lost |= (gnss.stamp_ns > begin) & (gnss.stamp_ns < end)
    used = gnss.stamp_ns[(gnss.code > UNSEEN) & ~lost]
    if len(used) < 2:
        return np.empty((0, 2), np.int64)
    interval = np.diff(used)
    longest = max(OUTAGE_S * 1e9, OUTAGE_IN_INTERVALS * float(np.median(interval)))
    edges = np.flatnonzero(interval > longest)
    spans = [(int(used[i]), int(used[i + 1])) for i in edges]
    if used[0] - table.stamp_ns[0] > longest and lost[gnss.stamp_ns < used[0]].any():
        spans.insert(0, (int(table.stamp_ns[0]), int(used[0])))
    if table.stamp_ns[-1] - used[-1] > longest:
        spans.append((int(used[-1]), int(table.stamp_ns[-1]) + 1))
    return np.array(spans, np.int64).reshape(-1, 2)


def _square(upper: Floats) -> Floats:
    """Return the symmetric (6, 6) matrix of an upper triangle."""
    P = np.zeros((6, 6))
    P[np.triu_indices(6)] = upper
    return P + np.triu(P, 1).T
