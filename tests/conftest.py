from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared_logs() -> Path:
    """The folder of recorded and simulated logs that stands beside the checkout, where there is one."""
    logs = Path(__file__).resolve().parents[2] / "shared" / "logs"
    if not logs.is_dir():
        pytest.skip("shared logs not present: tests on them need the folder shared/logs beside the checkout")
    return logs
