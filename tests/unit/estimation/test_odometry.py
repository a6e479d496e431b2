from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from icrtool.estimation.odometry import drive_wheels, momentary_icrs, odometry_icrs
from icrtool.kernels.track import FrozenIcrs
from icrtool.records.run import Run, no_slip_icrs

ROUNDING_M = 1e-9


def plain_path(run: Run, *icrs: float | np.ndarray) -> np.ndarray:
    """Eqs. 8-12, Euler, state by state; over a gap the filter's own motion, seen from the odometry's heading."""
    table = run.table
    place, psi = np.array([table.north_m[0], table.east_m[0]]), table.heading_rad[0]
    path = [place]
    each = np.broadcast_arrays(*icrs, table.t_s)[:3]
    for k in range(len(table) - 1):
        y_right, y_left, x = (float(column[k]) for column in each)
        if run.in_gap[k]:
            move = np.array([table.north_m[k + 1] - table.north_m[k], table.east_m[k + 1] - table.east_m[k]])
            turned = psi - table.heading_rad[k]
            psi += table.heading_rad[k + 1] - table.heading_rad[k]
        else:
            dt, separation = table.t_s[k + 1] - table.t_s[k], abs(y_right - y_left)
            omega = (table.v_left_mps[k] - table.v_right_mps[k]) / separation
            ahead = (table.v_left_mps[k] * y_right - table.v_right_mps[k] * y_left) / separation
            move, turned = dt * np.array([ahead, -omega * x]), psi
            psi += dt * omega
        c, s = np.cos(turned), np.sin(turned)
        place = place + np.array([[c, -s], [s, c]]) @ move
        path.append(place)
    return np.array(path).T


@pytest.mark.parametrize("every", [1, 7])
@pytest.mark.parametrize("gaps", [(), (700,), (0, 700, 701, 1500), (2000,)])
def test_odometry_is_the_plain_integration_gaps_included(run: Run, gaps: tuple[int, ...], every: int) -> None:
    in_gap = np.zeros(len(run.table), np.bool_)
    in_gap[list(gaps)] = True
    gappy = replace(run, in_gap=in_gap)
    table = run.table
    expected = plain_path(gappy, table.y_icr_right_m[-1], table.y_icr_left_m[-1], table.x_icr_m[-1])
    found = drive_wheels(table, in_gap, FrozenIcrs.constant(*table.icrs_at(-1)), every)
    kept = [*range(0, len(table) - 1, every), len(table) - 1]
    assert np.abs(found.north_m - expected[0, kept]).max() < ROUNDING_M
    assert np.abs(found.east_m - expected[1, kept]).max() < ROUNDING_M
    end = np.hypot(expected[0, -1] - table.north_m[-1], expected[1, -1] - table.east_m[-1])
    assert abs(found.end_error_m - end) < ROUNDING_M


def test_no_slip_drives_with_half_the_width_on_either_side(run: Run) -> None:
    expected = plain_path(run, 0.3, -0.3, 0.0)
    found = drive_wheels(run.table, run.in_gap, FrozenIcrs.constant(*no_slip_icrs(0.6)))
    assert np.abs(found.north_m - expected[0]).max() < ROUNDING_M
    assert np.abs(found.east_m - expected[1]).max() < ROUNDING_M


def test_learned_icrs_lead_closer_than_no_slip(run: Run) -> None:
    icrs = run.table.icrs_at(-1), no_slip_icrs(0.6)
    learned, no_slip = (drive_wheels(run.table, run.in_gap, FrozenIcrs.constant(*one)).end_error_m for one in icrs)
    assert learned < 0.5 * no_slip


def test_without_width_there_is_no_no_slip_path(make_run: Callable[..., Run]) -> None:
    assert make_run(track_width_m=None, duration_s=20.0).summary["odometry"]["no_slip"] is None


@pytest.mark.parametrize("gaps", [(), (700, 1500)])
def test_momentary_odometry_drives_each_step_with_the_icrs_estimated_at_its_state(
    run: Run, gaps: tuple[int, ...]
) -> None:
    in_gap = np.zeros(len(run.table), np.bool_)
    in_gap[list(gaps)] = True
    gappy, table = replace(run, in_gap=in_gap), run.table
    expected = plain_path(gappy, table.y_icr_right_m, table.y_icr_left_m, table.x_icr_m)
    found = drive_wheels(table, in_gap, momentary_icrs(table))
    assert np.abs(found.north_m - expected[0]).max() < ROUNDING_M
    assert np.abs(found.east_m - expected[1]).max() < ROUNDING_M
    away = np.hypot(expected[0] - table.north_m, expected[1] - table.east_m)
    assert abs(found.mean_error_m - away.mean()) < ROUNDING_M
    assert abs(found.max_error_m - away.max()) < ROUNDING_M
    assert np.ptp(table.y_icr_right_m) > 0.1  # constant ICRs would not tell the two odometries apart


def test_the_summary_holds_the_errors_of_each_odometry(run: Run) -> None:
    stored = run.summary["odometry"]
    odometries = odometry_icrs(run.table, 0.6)
    assert list(odometries) == ["icr", "icr_momentary", "no_slip"]
    for name, icrs in odometries.items():
        path = drive_wheels(run.table, run.in_gap, icrs)
        assert stored[name] == {
            "end_error_m": path.end_error_m, "mean_error_m": path.mean_error_m, "max_error_m": path.max_error_m,
        }  # fmt: skip
