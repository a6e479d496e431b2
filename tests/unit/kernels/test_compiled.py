from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numba
import pytest

from icrtool.kernels import compiled
from icrtool.kernels.compiled import njit

CALL = """
import numpy as np
from icrtool.kernels.kinematics import lag
speed = np.array([1.0, 2.0, 2.0])
lag(speed, np.array([1.0, 0.5]))
print(speed[2], lag.stats.cache_path)
"""


def test_kernels_compile_where_no_cache_can_be_written() -> None:
    nowhere = {"NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator", "NUMBA_CACHE_DIR": os.devnull + "/cache"}
    done = subprocess.run(
        [sys.executable, "-c", CALL], env={**os.environ, **nowhere}, capture_output=True, text=True, check=False
    )
    assert done.stdout.split() == ["1.5", "None"], done.stderr


def double(x: float) -> float:
    return 2.0 * x


def compilations() -> int:
    """Return how often a kernel is compiled that an earlier process may have compiled."""
    kernel = njit(double)
    assert kernel(2.0) == 4.0
    return sum(kernel.stats.cache_misses.values())


def test_a_kernel_compiles_again_where_any_file_of_kernels_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # the machine code of a kernel holds that of those it calls; numba itself looks at the kernel's own file alone
    kernels = tmp_path / "kernels"
    shutil.copytree(Path(compiled.__file__).parent, kernels, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(compiled, "__file__", str(kernels / "compiled.py"))
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    found = []
    for changed in ("", "\n", ""):
        with (kernels / "open_loop.py").open("a", encoding="utf-8") as file:
            file.write(changed)
        compiled._stamp.cache_clear()
        found.append(compilations())
    compiled._stamp.cache_clear()
    assert found == [1, 1, 0]
