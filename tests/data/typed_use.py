"""A user's script: `scripts/check-wheel.sh` checks its types against the built wheel."""

from __future__ import annotations

from typing import assert_type

import icrtool

config = icrtool.load_config(robot="segway-rmp400")
assert_type(config, icrtool.Config)
log = icrtool.read_log("sample_logs/wheeled_lawnmower.mcap", config)
assert_type(log, icrtool.RobotLog)
run = icrtool.fit(log, config)
assert_type(run, icrtool.Run)
report = icrtool.dropout(run)
assert_type(report, icrtool.DropoutReport)
calibration = icrtool.calibrate([run])
assert_type(calibration, icrtool.Calibration)
