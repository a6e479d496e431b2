"""The filter stage: from aligned sensors to recorded states (Pentzer 2014, Section 3)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icrtool.config import Config
from icrtool.estimation.filter_setup import FilterSetup, check_start, set_up_filter, wheel_gap_s
from icrtool.estimation.noise_adaptation import run_adaptively
from icrtool.estimation.terrain_changes import TerrainTest, find_terrain_changes, given_changes
from icrtool.kernels.filter_records import RECOVERED, UNSEEN, USED, Codes, FilterOutput
from icrtool.records.measurements import SensorData
from icrtool.records.run import STATE_COLUMNS, MeasurementOutcome, Run, WarmStart
from icrtool.records.tables import Bools, Floats, Ints, States, WheelSamples

OUTAGE_S = 2.0
"""Longer than this without a usable fix is a GNSS outage."""

OUTAGE_IN_INTERVALS = 5.0
"""... and at least this many times the usual interval between fixes."""


class Filtered(NamedTuple):
    """What the filter made of the sensors; the names are those of `icrtool.records.run.Run`.

    Attributes
    ----------
    sensors : with `reference_delay_s` corrected, where such a delay was found
    covariance : (6, 6) at the end
    process_position_mps : position process noise the run ended with
    began_with : ICRs and covariance of the warm start, None without one
    terrain : changes of the ICRs, given and detected
    """

    sensors: SensorData
    table: States
    in_gap: Bools
    outages_ns: Ints
    gnss: MeasurementOutcome
    heading: MeasurementOutcome
    covariance: Floats
    process_position_mps: float
    reference_delay_s: float
    began_with: WarmStart | None
    terrain: TerrainTest

    @property
    def changes_s(self) -> tuple[float, ...]:
        """Terrain changes within the drive, seconds since the first recorded state."""
        return self.terrain.within(float(self.table.t_s[-1]))[0].times_s


def run_filter(
    sensors: SensorData,
    config: Config,
    *,
    warm_start: WarmStart | None = None,
    changes_s: tuple[float, ...] = (),
    find_changes: bool = False,
) -> Filtered:
    """Run the filter over the sensors of a log; parameters as in `icrtool.estimation.fit.fit`.

    Raises
    ------
    DataError
        No wheel sample after the first fix and the first heading.
    ConfigError
        A start that preset ``field`` does not take.
    """
    check_start(config)
    filtered = _run_once(sensors, config, warm_start, given_changes(changes_s))
    if not find_changes:
        return filtered
    terrain = _find_changes(filtered)
    if len(terrain.changes) == len(filtered.terrain.changes):
        return filtered._replace(terrain=terrain)
    return _run_once(sensors, config, warm_start, terrain)


def set_up_again(run: Run | Filtered, config: Config, outages_ns: tuple[tuple[int, int], ...] = ()) -> FilterSetup:
    """Prepare the filter run that gave `run`, to smooth it, or to take GNSS and heading away in some spans."""
    return set_up_filter(
        run.sensors,
        config,
        process_position_mps=run.process_position_mps,
        changes_s=run.changes_s,
        warm_start=run.began_with,
        outages_ns=outages_ns,
    )


def _run_once(sensors: SensorData, config: Config, warm_start: WarmStart | None, terrain: TerrainTest) -> Filtered:
    adapted = run_adaptively(sensors, config, warm_start, terrain.times_s)
    sensors, setup, output = adapted.sensors, adapted.setup, adapted.output
    table = _states(sensors.wheels, output)
    gnss = _outcome(
        sensors.fixes.stamp_ns, setup.gnss_index, table, output.gnss_nis, output.gnss_code,
        np.hypot(*output.gnss_residual.T),
    )  # fmt: skip
    heading = _outcome(
        sensors.headings.stamp_ns, setup.heading_index, table, output.heading_nis, output.heading_code,
        output.heading_innovation,
    )  # fmt: skip
    return Filtered(
        sensors=sensors,
        table=table,
        in_gap=np.append(np.diff(table.t_s) > wheel_gap_s(config, setup.data.wheel_t), False),
        outages_ns=_outages(table, gnss, sensors.losses_ns),
        gnss=gnss,
        heading=heading,
        covariance=_square(output.P),
        process_position_mps=adapted.process_position_mps,
        reference_delay_s=adapted.reference_delay_s,
        began_with=warm_start,
        terrain=terrain,
    )


def _find_changes(filtered: Filtered) -> TerrainTest:
    seen = filtered.heading.code > UNSEEN
    innovations = filtered.heading.t_s[seen], filtered.heading.difference[seen]
    return find_terrain_changes(
        filtered.table, filtered.in_gap, filtered.outages_ns, innovations, filtered.terrain.times_s
    )


def _states(wheels: WheelSamples, output: FilterOutput) -> States:
    first = len(wheels.stamp_ns) - len(output.x)
    stamps = wheels.stamp_ns[first:]
    std = np.sqrt(np.maximum(output.variance, 0.0))
    means, deviations = ([np.ascontiguousarray(column) for column in values.T] for values in (output.x, std))
    return States(
        stamp_ns=stamps,
        t_s=(stamps - stamps[0]) / 1e9,
        **dict(zip(STATE_COLUMNS, means, strict=True)),
        **{f"std_{name}": column for name, column in zip(STATE_COLUMNS, deviations, strict=True)},
        v_left_mps=wheels.v_left_mps[first:],
        v_right_mps=wheels.v_right_mps[first:],
        distance_m=output.distance,
    )


def _outcome(
    stamps: Ints, index: Ints, table: States, nis: Floats, code: Codes, difference: Floats
) -> MeasurementOutcome:
    """Put what the kernel said of the measurements it was given back in the rows of the stream."""
    all_nis, all_code, all_difference = (
        np.full(len(stamps), np.nan),
        np.zeros(len(stamps), np.uint8),
        np.full(len(stamps), np.nan),
    )
    all_nis[index], all_code[index], all_difference[index] = nis, code, difference
    return MeasurementOutcome(stamps, (stamps - table.stamp_ns[0]) / 1e9, all_nis, all_code, all_difference)


def _outages(table: States, gnss: MeasurementOutcome, rtk_losses_ns: Ints) -> Ints:
    """Return the spans between usable fixes that are long enough to be outages, (k, 2) [ns].

    A fix that the gate rejected moves no filter and ends no outage. Where RTK was lost, the fixes there do not count:
    the filter drove on with its wheels.
    """
    lost = np.zeros(len(gnss.stamp_ns), np.bool_)
    for begin, end in rtk_losses_ns:
        lost |= (gnss.stamp_ns > begin) & (gnss.stamp_ns < end)
    used = gnss.stamp_ns[((gnss.code == USED) | (gnss.code == RECOVERED)) & ~lost]
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
