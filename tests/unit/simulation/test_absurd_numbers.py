"""Numbers of no size: refused in one line, before anything is allocated."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from icrtool.errors import ConfigError
from icrtool.simulation.drives import DrivePlan, PathPlan, Sensors, check_drive


@pytest.mark.parametrize("value", [1e12, 1e300, math.inf, math.nan, 1e-300])
@pytest.mark.parametrize("field", ["gnss_rate_hz", "wheel_rate_hz", "heading_resolution_rad", "gnss_delay_s"])
def test_a_sensor_of_no_size_is_refused(field: str, value: float) -> None:
    with pytest.raises(ConfigError, match=field):
        check_drive(DrivePlan(), replace(Sensors(), **{field: value}))


@pytest.mark.parametrize(
    "drive",
    [
        DrivePlan(duration_s=1e12),
        DrivePlan(duration_s=30_000.0),
        DrivePlan(duration_s=math.nan),
        DrivePlan(icrs_m=(1e300, -1.0, 0.0)),
        DrivePlan(changes=((5.0, (1.0, -1e300, 0.0)),)),
        DrivePlan(path=PathPlan(speed_mps=1e300)),
    ],
)
def test_a_drive_of_no_size_is_refused(drive: DrivePlan) -> None:
    with pytest.raises(ConfigError):
        check_drive(drive, Sensors())


def test_the_papers_drive_is_taken() -> None:
    check_drive(DrivePlan(), Sensors())
