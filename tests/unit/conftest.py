"""Runs of the drive in the barn."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import pytest

from icrtool.pipeline import fit
from icrtool.records.run import Run
from support.barn import TRACK_WIDTH_M, configured, simulate


@pytest.fixture(scope="session")
def run() -> Run:
    return fit(simulate(), configured())


@pytest.fixture(scope="session")
def make_run() -> Callable[..., Run]:
    """Fit a drive of another kind, each kind once: keywords of `simulate`, and `track_width_m`."""

    @functools.cache
    def make(*, track_width_m: float | None = TRACK_WIDTH_M, **drive: Any) -> Run:
        return fit(simulate(**drive), configured(track_width_m))

    return make
