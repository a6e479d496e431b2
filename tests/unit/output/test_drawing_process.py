"""The process that draws: it ends with its parent, and its own end is said."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
from pathlib import Path

import pytest

from icrtool.output.figures.drawing_process import DrawingProcess

KILLED = """
import os, signal
from icrtool.output.figures.drawing_process import DrawingProcess
with DrawingProcess(("png",)):
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="signals")
def test_it_ends_with_a_parent_that_is_killed() -> None:
    # Its copies of the pipes would keep this waiting.
    done = subprocess.run([sys.executable, "-c", KILLED], capture_output=True, timeout=20, check=False)
    assert done.returncode == -9


INTERRUPTED = """
import os, signal
from icrtool.output.figures import drawing_process
class Pool(drawing_process.ProcessPoolExecutor):
    def submit(self, *what):
        os.kill(os.getpid(), signal.SIGINT)
        return super().submit(*what)
drawing_process.ProcessPoolExecutor = Pool
try:
    with drawing_process.DrawingProcess(("png",)):
        print("drawn")
except KeyboardInterrupt:
    print("interrupted")
"""


@pytest.mark.skipif(sys.platform != "linux", reason="signals")
def test_an_interrupt_while_it_starts_leaves_no_process() -> None:
    done = subprocess.run([sys.executable, "-c", INTERRUPTED], capture_output=True, timeout=20, check=True)
    assert done.stdout == b"interrupted\n"
    assert not done.stderr


LOADED = """
from icrtool.output.figures.drawing_process import DrawingProcess
with DrawingProcess(("png",)):
    pass
"""


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a place that nobody can write to")
def test_it_leaves_no_folder_behind_where_there_is_no_home_to_write_to(tmp_path: Path) -> None:
    nowhere = dict.fromkeys(("HOME", "XDG_CONFIG_HOME", "XDG_CACHE_HOME"), "/proc/nowhere")
    environment = {key: value for key, value in os.environ.items() if key != "MPLCONFIGDIR"}
    environment |= {**nowhere, "TMPDIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", LOADED], env=environment, capture_output=True, timeout=60, check=True)
    assert not done.stderr
    assert list(tmp_path.iterdir()) == []


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
