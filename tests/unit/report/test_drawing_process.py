"""The process that draws: it ends with its parent, and its own end is said."""

from __future__ import annotations

import multiprocessing
import subprocess
import sys
from pathlib import Path

import pytest

from icrtool.report.drawing_process import DrawingProcess

KILLED = """
import os, signal
from icrtool.report.drawing_process import DrawingProcess
with DrawingProcess(("png",)):
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="signals")
def test_it_ends_with_a_parent_that_is_killed() -> None:
    # Its copies of the pipes would keep this waiting.
    done = subprocess.run([sys.executable, "-c", KILLED], capture_output=True, timeout=20, check=False)
    assert done.returncode == -9


@pytest.mark.skipif(sys.platform != "linux", reason="forks from a process with threads, as pytest's is, only there")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_its_end_from_outside_is_an_error_of_the_directory(tmp_path: Path) -> None:
    def draw_all() -> None:
        others = multiprocessing.active_children()
        with DrawingProcess(("png",)) as process, process.into(tmp_path / "plots") as draw:
            for child in set(multiprocessing.active_children()) - set(others):
                child.kill()
                child.join()
            draw(print)

    with pytest.raises(OSError, match="process that draws was ended"):
        draw_all()
