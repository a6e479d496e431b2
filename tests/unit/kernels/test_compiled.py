from __future__ import annotations

import os
import subprocess
import sys

CALL = """
from icrtool.kernels.kinematics import icr_separation
print(icr_separation(0.4, -0.5), icr_separation.stats.cache_path)
"""


def test_kernels_compile_where_no_cache_can_be_written() -> None:
    nowhere = {"NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator", "NUMBA_CACHE_DIR": os.devnull + "/cache"}
    done = subprocess.run(
        [sys.executable, "-c", CALL], env={**os.environ, **nowhere}, capture_output=True, text=True, check=False
    )
    assert done.stdout.split() == ["0.9", "None"], done.stderr
