"""Run the filter over a log, and again while wheels and position reference contradict each other."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icrtool.alignment.heading_alignment import HeadingCheck
from icrtool.alignment.reference_delay import delayed, find_delay
from icrtool.config import Config
from icrtool.estimation.filter_setup import FilterSetup, WarmStart, configured_process_position_mps, set_up_filter
from icrtool.kernels.ekf import UNSEEN, FilterOutput, run_filter
from icrtool.records.tables import RobotLog

TOLERATED_NIS = 2.5
"""Mean NIS of the fixes: 2 is expected where the noises are right."""

PROCESS_POSITION_STEP = 2.0
LARGEST_PROCESS_POSITION_MPS = 10.0
WORTHWHILE_SHARE = 0.9
"""Doubling the position noise is worth it when it brings the mean NIS below this part of what it was."""


class AdaptedRun(NamedTuple):
    """A run, and what was done to the log for it: `log` has the reference's delay, where one was found, taken out."""

    log: RobotLog
    setup: FilterSetup
    output: FilterOutput
    process_position_mps: float
    reference_delay_s: float


def run_adaptively(
    log: RobotLog, config: Config, check: HeadingCheck, warm_start: WarmStart | None, changes_s: tuple[float, ...]
) -> AdaptedRun:
    """Run the filter; look for a delay, then raise the position noise, where the fixes contradict the wheels.

    A contradiction (NIS of fixes and headings, each counted up to its gate) that falls when the reference is shifted
    comes from the clocks; one that falls as the noise grows, from the wheels (held samples, slip) or from fixes that
    err together: the larger noise is the honest one. Bad fixes stay bad whatever is done. Preset ``field`` only.
    A delay that is configured is taken out before (`icrtool.alignment.stream_delays`), and none is looked for.
    """

    def run(one: RobotLog, speed: float) -> tuple[FilterSetup, FilterOutput, float, float]:
        setup = set_up_filter(
            one,
            config,
            heading_mirrored=check.applied_mirror,
            heading_offset_rad=check.applied_offset_rad,
            heading_std_at_least_rad=check.applied_std_rad,
            heading_correlation_at_least_s=check.applied_correlation_s,
            process_position_mps=speed,
            warm_start=warm_start,
            changes_s=changes_s,
        )
        output = run_filter(setup.data, setup.t0, setup.x0, setup.P0, setup.parameters)
        nis, heading_nis = output.gnss_nis[output.gnss_code > UNSEEN], output.heading_nis[output.heading_code > UNSEEN]
        by_fixes = float(np.minimum(nis, setup.parameters.gnss_gate).mean()) if len(nis) else 0.0
        capped = np.minimum(heading_nis, setup.parameters.heading_gate)
        return setup, output, by_fixes, by_fixes + (float(capped.mean()) if len(capped) else 0.0)

    speed = configured_process_position_mps(config)
    field, delay = config.filter.preset == "field", 0.0
    setup, output, contradiction, _ = run(log, speed)
    if field and config.frames.reference_delay_s == "auto" and contradiction > TOLERATED_NIS:
        delay = find_delay(log, lambda one: run(one, speed)[3])
        log = delayed(log, delay)
        setup, output, contradiction, _ = run(log, speed)
    adapts = field and config.filter.process_position_mps == "auto"
    while adapts and contradiction > TOLERATED_NIS and speed < LARGEST_PROCESS_POSITION_MPS:
        next_setup, next_output, next_one, _ = run(log, speed * PROCESS_POSITION_STEP)
        if next_one > WORTHWHILE_SHARE * contradiction:
            break
        speed, setup, output, contradiction = speed * PROCESS_POSITION_STEP, next_setup, next_output, next_one
    return AdaptedRun(log, setup, output, speed, delay)
