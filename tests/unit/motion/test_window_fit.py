"""Window fits recover constants, with an honest doubt, and predict."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from icrtool.config import parse_config
from icrtool.errors import DataError
from icrtool.estimation.fit import fit
from icrtool.motion.window_fit import cut_windows, fit_windows, thin_windows
from icrtool.motion.window_models import CONSTANT, EXTENDED, MULTIPLIER, WindowModel
from icrtool.motion.window_solve import drop_windows, fit_of, solve_windows
from icrtool.records.run import Run
from support.drives import ICRS, make_log

CONFIG = parse_config({"robot": {"track_width_m": 0.6}})
SEEDS = range(4)
LARGEST_MISS_M = 0.01
"""The fit may not hide behind its doubt: constants known to a centimetre after 100 m."""


@cache
def made(seed: int, seconds: float = 200.0) -> Run:
    """A drive by Euler steps, as the windows drive too: their x_icr is what makes the dropout's steps right."""
    return fit(make_log(seed, seconds, step_heading=0.0), CONFIG)


@pytest.mark.parametrize("seed", SEEDS)
def test_constants_are_recovered_within_their_doubt(seed: int) -> None:
    found = fit_windows(cut_windows(made(seed)), CONSTANT)
    miss = np.abs(np.array(found.icrs_m) - ICRS)
    assert np.all(miss < 3 * np.array(found.icr_std_m) + 1e-3)
    assert np.all(miss < LARGEST_MISS_M)


def test_doubt_is_of_the_size_of_the_scatter_between_logs() -> None:
    fits = [fit_windows(cut_windows(made(seed))) for seed in SEEDS]
    normalised = np.array([(np.array(one.icrs_m) - ICRS) / one.icr_std_m for one in fits])
    rms = float(np.sqrt((normalised**2).mean()))
    assert 0.2 < rms < 2.5


def test_terms_that_do_not_pay_stay_neutral() -> None:
    windows = cut_windows(made(0))
    scaled = fit_windows(windows, EXTENDED[0])
    assert scaled.parameters[3:5] == pytest.approx([1.0, 1.0], abs=0.01)
    late = fit_windows(windows, EXTENDED[1])
    assert late.parameters[7] == pytest.approx(0.0, abs=0.03)


def test_scales_are_recovered() -> None:
    from dataclasses import replace

    log = make_log(2, 200.0)
    log = replace(log, wheels=replace(log.wheels, left=log.wheels.v_left_mps / 1.02))
    config = parse_config({"robot": {"track_width_m": 0.6}, "wheels": {"left_scale": 1.0}})
    found = fit_windows(cut_windows(fit(log, config)), EXTENDED[0])
    assert found.parameters[3] / found.parameters[4] == pytest.approx(1.02, abs=0.004)


def test_a_multiplier_has_no_x_and_no_asymmetry() -> None:
    right, left, x = fit_windows(cut_windows(made(1)), MULTIPLIER).icrs_m
    assert right == -left
    assert x == 0.0
    assert right - left == pytest.approx(ICRS[0] - ICRS[1], abs=0.06)


def test_a_fit_on_thinned_samples_is_near_the_full_one() -> None:
    windows = cut_windows(made(0))
    assert fit_windows(thin_windows(windows)).icrs_m == pytest.approx(fit_windows(windows).icrs_m, abs=0.001)


@pytest.mark.parametrize("model", [MULTIPLIER, CONSTANT, *EXTENDED], ids=lambda model: model.name)
def test_the_many_fits_of_the_ladder_find_what_levenberg_marquardt_finds(model: WindowModel) -> None:
    windows = thin_windows(cut_windows(made(1)))
    kept = windows.start_m > 30.0
    expected = fit_windows(windows.keep(kept), model)
    plain = solve_windows(windows, CONSTANT, kept)
    for start in (None, plain):
        found = fit_of(solve_windows(windows, model, kept, start if model in EXTENDED else None), windows)
        sigma = np.sqrt(np.diag(expected.covariance))
        assert np.all(np.abs(found.terms - expected.terms) < 0.1 * sigma + 1e-5)
        assert np.diag(found.covariance) == pytest.approx(np.diag(expected.covariance), rel=0.05)
        assert found.windows == expected.windows


def test_windows_taken_out_to_first_order_are_windows_not_fitted() -> None:
    windows = thin_windows(cut_windows(made(2)))
    everything = np.ones(len(windows.start), np.bool_)
    dropped = (windows.start_m > 20.0) & (windows.start_m < 45.0)
    whole = solve_windows(windows, CONSTANT, everything)
    rest = solve_windows(windows, CONSTANT, ~dropped)
    far = np.abs(whole.misses - rest.misses).max()
    assert np.abs(drop_windows(whole, dropped) - rest.misses).max() < 0.3 * far


def test_a_circle_leaves_the_icrs_outside_the_tracks() -> None:
    from support.exact_drives import simulate

    right, left, _ = fit_windows(cut_windows(fit(simulate(0, path="circle", seconds=120.0), CONFIG))).icrs_m
    assert right > 0 > left


def test_too_short_a_drive_is_refused() -> None:
    with pytest.raises(DataError, match="a window fit needs a longer drive"):
        cut_windows(fit(make_log(0, 12.0), CONFIG))
