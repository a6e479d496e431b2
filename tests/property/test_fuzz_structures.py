"""The fuzzer of ``make fuzz``: a short run finds nothing."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LOGS = 1000


@pytest.mark.stress
def test_a_short_run_of_the_fuzzer_finds_nothing() -> None:
    command = [sys.executable, "scripts/fuzz.py", "--logs", str(LOGS), "--fitted", "10"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "reported" in done.stdout
    assert "functions of the packages under test" in done.stdout
