"""States and twists in the frames of REP-103: the same drive, mirrored once."""

from __future__ import annotations

import numpy as np
import pytest

import icrtool
from icrtool.config import load_config
from icrtool.records.run import Run
from support.drives import make_log


def test_states_in_enu_are_those_of_the_drive_seen_from_above(run: Run) -> None:
    found, states = run.states_enu(), run.states
    assert list(found)[:5] == ["stamp_ns", "t_s", "x_m", "y_m", "yaw_rad"]
    assert len(found) == len(states)
    ahead = np.exp(1j * found["yaw_rad"])
    north_east = np.exp(1j * states["heading_rad"])
    np.testing.assert_allclose(ahead.to_numpy(), 1j * np.conj(north_east.to_numpy()), atol=1e-12)
    np.testing.assert_array_equal(found["x_m"], states["east_m"])
    np.testing.assert_array_equal(found["y_m"], states["north_m"])
    # the right ICR lies to the right, which is negative there; an ICR's place in the world is the same
    for side in ("right", "left"):
        column = f"y_icr_{side}_m"
        by_enu = (found["x_m"] + 1j * found["y_m"]) + ahead * (found["x_icr_m"] + 1j * found[column])
        by_ned = (states["north_m"] + 1j * states["east_m"]) + north_east * (states["x_icr_m"] + 1j * states[column])
        np.testing.assert_allclose(by_enu.to_numpy(), by_ned.to_numpy().imag + 1j * by_ned.to_numpy().real, atol=1e-9)
    assert {name.removeprefix("std_") for name in found if name.startswith("std_")} <= set(found)


def test_a_twist_in_enu_turns_left_where_the_right_side_is_faster() -> None:
    config = load_config(sets=["robot.track_width_m=0.6"])
    calibration = icrtool.calibrate([icrtool.fit(make_log(seed=1, seconds=120.0), config)])
    forward, left, omega = calibration.twist(0.5, 0.7, frame="enu")
    assert omega > 0
    np.testing.assert_allclose(calibration.twist(0.5, 0.7), [forward, -left, -omega])
    pairs = np.array([0.1, 0.4]), np.array([0.3, 0.2])
    assert calibration.twist(*pairs, frame="enu").shape == (3, 2)
    with pytest.raises(ValueError, match="neither ned nor enu"):
        calibration.twist(0.5, 0.7, frame="flu")  # type: ignore[arg-type]
