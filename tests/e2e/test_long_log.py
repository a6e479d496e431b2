"""A season in one log: ten hours at 100 Hz are fitted and reported in bounded memory."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
HOURS_S = 36_000
MOST_MB = 1250.0
ROBOT = ("--robot", "segway-rmp400")

BENCHMARKS = os.environ | {"PYTHONPATH": os.pathsep.join(str(ROOT / name) for name in ("", "benchmarks"))}

MAKE_LOG = """
import sys
from pathlib import Path
from make_log import WriteOptions, drive, write_log
options = WriteOptions(
    container="mcap", wheels="joint_states", heading="enu", compression="zstd", wheel_radius_m=0.27, track_width_m=0.61
)
write_log(Path("ten.mcap"), drive(float(sys.argv[1])), options)
"""

LAUNCH = """
import os, subprocess, sys
process = subprocess.Popen([sys.executable, "-P", "-m", "icrtool", *sys.argv[1:]])
_, status, usage = os.wait4(process.pid, 0)
print(usage.ru_maxrss * 1024 / 1e6)
sys.exit(os.waitstatus_to_exitcode(status))
"""
"""Started through a small process: a new process inherits the peak memory of the process that starts it."""


@pytest.mark.stress
@pytest.mark.skipif(sys.platform != "linux", reason="other systems count memory in other units")
def test_ten_hours_are_fitted_and_reported_in_bounded_memory(tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-c", MAKE_LOG, str(HOURS_S)], cwd=tmp_path, check=True, env=BENCHMARKS)
    for arguments in (("fit", "ten.mcap", *ROBOT, "-q", "-o", "run"), ("dropout-report", "run", "-q")):
        done = subprocess.run(
            [sys.executable, "-c", LAUNCH, *arguments], cwd=tmp_path, check=True, stdout=subprocess.PIPE, text=True
        )
        assert float(done.stdout.split()[-1]) <= MOST_MB, arguments[0]
