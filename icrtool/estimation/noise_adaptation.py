"""Run the filter over the sensors of a log, and again while wheels and position reference contradict each other."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icrtool.config import Config
from icrtool.estimation.filter_setup import FilterSetup, configured_process_position_mps, set_up_filter
from icrtool.kernels.ekf import run_filter
from icrtool.kernels.filter_records import UNSEEN, FilterOutput
from icrtool.records.measurements import SensorData
from icrtool.records.run import WarmStart

TOLERATED_NIS = 2.5
"""Mean NIS of the fixes: 2 is expected where the noises are right."""

PROCESS_POSITION_STEP = 2.0
LARGEST_PROCESS_POSITION_MPS = 10.0
WORTHWHILE_SHARE = 0.9
"""Doubling the position noise is worth it when it brings the mean NIS below this part of what it was."""


class AdaptedRun(NamedTuple):
    """A filter run; `sensors` has the position reference `reference_delay_s` earlier, where such a delay was found."""

    sensors: SensorData
    setup: FilterSetup
    output: FilterOutput
    process_position_mps: float
    reference_delay_s: float


def run_adaptively(
    sensors: SensorData, config: Config, warm_start: WarmStart | None, changes_s: tuple[float, ...]
) -> AdaptedRun:
    """Run the filter; look for a delay, then raise the position noise, where the fixes contradict the wheels.

    A contradiction (NIS of fixes and headings, each counted up to its gate) that falls when the reference is shifted
    comes from the clocks; one that falls as the noise grows, from the wheels (held samples, slip) or from fixes that
    err together: the larger noise is the honest one. Bad fixes stay bad whatever is done. Preset ``field`` only.
    A delay that is configured is corrected before (`icrtool.alignment.stream_delays`), and none is looked for.
    """

    def run(one: SensorData, speed: float) -> tuple[FilterSetup, FilterOutput, float, float]:
        setup = set_up_filter(one, config, process_position_mps=speed, warm_start=warm_start, changes_s=changes_s)
        output = run_filter(setup.data, setup.t0, setup.x0, setup.P0, setup.parameters)
        nis, heading_nis = output.gnss_nis[output.gnss_code > UNSEEN], output.heading_nis[output.heading_code > UNSEEN]
        by_fixes = float(np.minimum(nis, setup.parameters.gnss_gate).mean()) if len(nis) else 0.0
        capped = np.minimum(heading_nis, setup.parameters.heading_gate)
        return setup, output, by_fixes, by_fixes + (float(capped.mean()) if len(capped) else 0.0)

    speed = configured_process_position_mps(config)
    field = config.filter.preset == "field"
    setup, output, contradiction, _ = run(sensors, speed)
    adapts = field and config.filter.process_position_mps == "auto"
    while adapts and contradiction > TOLERATED_NIS and speed < LARGEST_PROCESS_POSITION_MPS:
        next_setup, next_output, next_one, _ = run(sensors, speed * PROCESS_POSITION_STEP)
        if next_one > WORTHWHILE_SHARE * contradiction:
            break
        speed, setup, output, contradiction = speed * PROCESS_POSITION_STEP, next_setup, next_output, next_one
    return AdaptedRun(sensors, setup, output, speed, 0.0)
