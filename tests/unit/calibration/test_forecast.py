"""Forecasts along a path: coverage on drives that the calibration never saw, closed forms, plans."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.optimize import nnls

from icrtool.calibration.error_growth import (
    SOURCES,
    ErrorMoments,
    forecast_drive,
    forecast_errors,
    forecast_plan,
    mean_error,
    radius_of_share,
    solve_nonnegative,
    wheel_speeds,
)
from icrtool.calibration.pooled import calibrate_recordings, predictor
from icrtool.calibration.record import Calibration, parameter_documents
from icrtool.errors import DataError, IcrToolError
from icrtool.kernels.track import Windows
from icrtool.motion.models import FittedModel, wheel_motion
from icrtool.motion.recording import Recording, Trials, cut_trials, steps_of
from icrtool.output.files.formats import read_numbers
from icrtool.output.tables.calibration import distance_within, forecast_csv
from icrtool.records.calibration_document import ErrorSources
from support.recordings import FAMILY, SIX, WIDTH_M, draw_parameters, make_recording, trials_from_all

SEEDS = range(5)
HORIZONS_M = (5.0, 10.0, 20.0)
ROUNDING = 1e-6


def stored(document: dict[str, object]) -> Calibration:
    """The calibration of plain data of a file."""
    return msgspec.convert(document, Calibration)


def calibrated(seed: int) -> Calibration:
    parameters = draw_parameters(SIX, np.random.default_rng([seed, 3]))
    logs = [make_recording(SIX, parameters, 10 * seed + k, 150.0, name=f"log {k}") for k in range(3)]
    return calibrate_recordings(logs).calibration


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return calibrated(0)


def only(calibration: Calibration, **variances: float) -> Calibration:
    """Return a calibration with exact parameters and the given sources of error alone."""
    exact = replace(calibration.fitted, covariance=0.0 * calibration.fitted.covariance)
    sources = msgspec.structs.replace(ErrorSources(*[0.0] * SOURCES, 1.0, 1.0), **variances)
    terms, parameters, covariance = parameter_documents(exact)
    return msgspec.structs.replace(
        calibration, terms=terms, parameters=parameters, covariance=covariance, error_sources=sources
    )


def forecast_trials(
    calibration: Calibration, recording: Recording, trials: Trials, *, with_gyro: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Expected and 95 % error (k, h) [m] forecast for trials of a recording, NaN where there is none."""
    some = trials.ends >= 0
    begin, end = np.broadcast_to(trials.starts[:, None], some.shape)[some], trials.ends[some]
    windows = Windows(steps_of(recording), begin, end, recording.track.distance[end] - recording.track.distance[begin])
    _, *forecast = forecast_errors(calibration, windows, with_gyro=with_gyro)
    found = np.full((2, *trials.ends.shape), np.nan)
    found[:, some] = forecast
    return found[0], found[1]


def test_the_95_percent_error_holds_on_drives_that_were_not_calibrated_with() -> None:
    inside, ratio = [], []
    for seed in SEEDS:
        parameters = draw_parameters(SIX, np.random.default_rng([seed, 3]))
        new = make_recording(SIX, parameters, 10 * seed + 9, 200.0, name="new")
        found, trials = calibrated(seed), cut_trials(new, HORIZONS_M)
        errors, (expected, p95) = predictor(found, new)(trials).position, forecast_trials(found, new, trials)
        inside.append(np.nanmean(np.where(np.isfinite(errors), errors <= p95, np.nan), axis=0))
        ratio.append(np.nanmean(errors, axis=0) / np.nanmean(expected, axis=0))
    print("within the 95 % forecast after 5, 10 and 20 m:", np.mean(inside, axis=0).round(2))
    assert np.all(np.mean(inside, axis=0) > 0.90)
    assert np.all(np.mean(inside, axis=0) < 0.995)
    assert np.all(np.abs(np.mean(ratio, axis=0) - 1.0) < 0.3)


def test_quantiles_and_means_are_those_of_drawn_errors() -> None:
    rng = np.random.default_rng(1)
    for covariance in (np.diag([1.0, 1.0]), np.array([[2.0, 0.7], [0.7, 0.5]]), np.diag([1.0, 0.0])):
        size = np.linalg.norm(rng.multivariate_normal([0.0, 0.0], covariance, 200_000), axis=1)
        xx, xy, yy = (np.array([[covariance[i, j]]]) for i, j in ((0, 0), (0, 1), (1, 1)))
        spread = ErrorMoments(0 * xx, xx, xy, yy)
        assert radius_of_share(spread, 0.95)[0] == pytest.approx(np.percentile(size, 95.0), rel=0.01)
        assert mean_error(spread)[0] == pytest.approx(size.mean(), rel=0.01)


@pytest.mark.parametrize(
    ("source", "error_m"),
    [
        ("heading_start_rad2", 10.0),
        ("heading_rate_rad2pm2", 50.0),
        ("heading_wander_rad2pm", np.sqrt(1000.0 / 3.0)),
        ("speed_share", 10.0),
        ("distance_wander_m2pm", np.sqrt(10.0)),
    ],
)
def test_each_source_grows_on_a_straight_path_as_its_integral_does(
    calibration: Calibration, source: str, error_m: float
) -> None:
    """One standard deviation after 10 m for a unit variance; along or across, 95 % lie within 1.96 of them."""
    found = forecast_plan(only(calibration, **{source: 1.0}), np.zeros(2), np.array([0.0, 10.0]))
    assert found.distance_m[-1] == pytest.approx(10.0)
    assert found.p95_m[-1] == pytest.approx(1.96 * error_m, rel=0.02)
    aside = source.startswith("heading")
    assert (found.std_east_m if aside else found.std_north_m)[-1] == pytest.approx(error_m, rel=0.02)


def test_a_plan_and_its_turned_and_shifted_copy_have_equal_errors(calibration: Calibration) -> None:
    bend = np.linspace(0.0, 2.0, 60)
    path = 8.0 * np.exp(1j * bend)
    one, other = path, (path + 30.0) * np.exp(1.1j)
    first, second = (forecast_plan(calibration, p.imag, p.real) for p in (one, other))
    np.testing.assert_allclose(second.p95_m, first.p95_m, rtol=1e-6)
    np.testing.assert_allclose(np.hypot(second.std_east_m, second.std_north_m),
                               np.hypot(first.std_east_m, first.std_north_m), rtol=1e-6)  # fmt: skip


@pytest.mark.parametrize("name", ["icr", "six", "recommended"])
def test_wheel_speeds_make_the_motion_asked_for(name: str) -> None:
    model = FAMILY[name]
    parameters = draw_parameters(model, np.random.default_rng(4))
    speed, turn = np.array([0.5, 1.0, 0.8]), np.array([0.3, -0.4, 0.0])
    fitted = FittedModel(model, parameters, np.eye(len(parameters)))
    v_x, _, omega = fitted.twist(wheel_motion(*wheel_speeds(fitted, WIDTH_M, speed, turn), WIDTH_M))
    np.testing.assert_allclose([v_x, omega], [speed, turn], atol=ROUNDING)


def test_a_drive_is_forecast_as_its_trials_from_the_start_are(calibration: Calibration) -> None:
    recording = make_recording(SIX, SIX.prior_mean, 4, 60.0)
    trials = trials_from_all(recording, (5.0, 10.0))
    _, p95 = forecast_trials(calibration, recording, trials)
    np.testing.assert_allclose(forecast_drive(calibration, recording).p95_m[[4, 9]], p95[0], rtol=1e-9)


def test_a_budget_is_reached_between_metres(calibration: Calibration) -> None:
    found = forecast_plan(only(calibration, speed_share=0.01), np.zeros(2), np.array([0.0, 12.0]))
    assert distance_within(found, 1.0) == pytest.approx(1.0 / 0.196, rel=0.01)
    assert distance_within(found, 99.0) == 12.0


def test_the_sources_come_back_from_a_file_and_without_them_nothing_is_forecast(calibration: Calibration) -> None:
    document = calibration.summary()
    assert stored(document).error_sources == calibration.error_sources
    short = stored(document | {"error_sources": None})
    with pytest.raises(DataError, match="calibrate again"):
        forecast_plan(short, np.zeros(2), np.array([0.0, 9.0]))


def read_plan(file: Path) -> dict[str, np.ndarray]:
    return read_numbers(file, ("east_m", "north_m"), ("speed_mps",))


def test_a_plan_is_read_from_a_table(tmp_path: Path, calibration: Calibration) -> None:
    file = tmp_path / "plan.csv"
    file.write_text("east_m,north_m,speed_mps\n0,0,0.4\n6,0,0.8\n6,5,0.8\n")
    found = forecast_plan(calibration, **read_plan(file))
    assert found.distance_m[-1] == 11.0
    assert (found.east_m[-1], found.north_m[-1]) == pytest.approx((6.0, 5.0), abs=0.2)
    assert np.all(np.diff(found.p95_m) > 0.0)
    assert forecast_csv(found).splitlines()[0].startswith("distance_m,east_m,north_m,expected_error_m,p95_error_m")


@pytest.mark.parametrize("text", ["north_m\n1\n", "east_m,north_m\n1,2\n", ""])
def test_a_table_that_is_no_plan_is_one_error(tmp_path: Path, text: str) -> None:
    file = tmp_path / "plan.csv"
    file.write_text(text)
    with pytest.raises(DataError):
        read_plan(file)


@pytest.mark.parametrize(
    ("north", "speed"),
    [
        ([0.0, 0.3], None),
        ([0.0, 9.0], [0.0, 0.0]),
        *[([0.0, wrong], None) for wrong in (np.nan, np.inf, -np.inf, 1e300, -1e155)],
        *[([0.0, 9.0], [wrong, 0.5]) for wrong in (np.nan, np.inf, -np.inf, 1e300)],
    ],
)
def test_a_plan_that_cannot_be_driven_is_one_error(
    calibration: Calibration, north: list[float], speed: list[float] | None
) -> None:
    with pytest.raises(DataError, match="plan"):
        forecast_plan(calibration, np.zeros(2), np.array(north), None if speed is None else np.array(speed))


@pytest.mark.parametrize("cell", ["inf", "-inf", "1e400", "nan", "", "x", "1e300", "0x10", "True", "9" * 400, '"'])
@pytest.mark.parametrize("column", [0, 1, 2])
def test_a_plan_with_an_edited_cell_is_one_error_or_a_forecast(
    tmp_path: Path, calibration: Calibration, cell: str, column: int
) -> None:
    row = ["6", "5", "0.8"]
    row[column] = cell
    file = tmp_path / "plan.csv"
    file.write_text(f"east_m,north_m,speed_mps\n0,0,0.4\n{','.join(row)}\n12,0,0.4\n")
    with suppress(IcrToolError):
        assert np.isfinite(forecast_plan(calibration, **read_plan(file)).p95_m).all()


def test_reverse_along_a_path_is_as_uncertain_as_forward(calibration: Calibration) -> None:
    """Out and back in one line: the robot keeps its heading where it changes direction."""
    east = np.array([0.0, 10.0, 0.0])
    there_and_back = forecast_plan(calibration, east, 0.0 * east, np.array([0.5, -0.5, -0.5]))
    assert np.isfinite(there_and_back.p95_m).all()
    # a turn on the spot would add the error of a turn by 180 degrees
    turned = forecast_plan(calibration, east, 0.0 * east, np.array([0.5, 0.5, 0.5]))
    assert there_and_back.heading_std_deg[-1] < turned.heading_std_deg[-1]
    with pytest.raises(DataError, match="speed"):
        forecast_plan(calibration, east, 0.0 * east, np.zeros(3))


def test_a_gyro_narrows_the_forecast_and_holds() -> None:
    parameters = draw_parameters(SIX, np.random.default_rng([1, 3]))
    logs = [make_recording(SIX, parameters, k, 150.0, gyro=True, name=f"log {k}") for k in range(3)]
    found = calibrate_recordings(logs).calibration
    assert found.gyro is not None
    assert found.gyro.error_sources is not None
    assert stored(json.loads(json.dumps(found.summary()))).gyro == found.gyro
    new = make_recording(SIX, parameters, 9, 300.0, gyro=True, name="new")
    trials = cut_trials(new, HORIZONS_M)
    errors = predictor(found, new, with_gyro=True)(trials).position
    expected, p95 = forecast_trials(found, new, trials, with_gyro=True)
    wheels, _ = forecast_trials(found, new, trials)
    inside = np.nanmean(np.where(np.isfinite(errors), errors <= p95, np.nan), axis=0)
    assert np.all(inside > 0.85)
    assert np.nanmean(expected[:, 2]) < np.nanmean(wheels[:, 2])


def test_long_drives_measure_errors_further_than_short_ones(calibration: Calibration) -> None:
    assert calibration.error_sources is not None
    assert calibration.error_sources.measured_to_m == 20.0
    longer = calibrate_recordings(
        [make_recording(SIX, SIX.prior_mean, k, 700.0, name=f"log {k}") for k in range(2)]
    ).calibration
    assert longer.error_sources is not None
    assert longer.error_sources.measured_to_m >= 50.0


@pytest.mark.parametrize("columns", [2, 8])
def test_non_negative_least_squares_are_those_of_scipy(columns: int) -> None:
    """Units that differ by decades, columns without any effect, and two that are alike."""
    rng = np.random.default_rng(columns)
    for case in range(30):
        design = np.abs(rng.normal(size=(60, columns))) * 10.0 ** rng.uniform(-6.0, 3.0, columns)
        design[:, 0] *= case % 3 > 0
        if case % 5 == 0:
            design[:, -1] = 2.0 * design[:, -2]
        target = (design / np.maximum(design.max(axis=0), 1e-9)) @ np.maximum(rng.normal(size=columns), 0.0)
        target += rng.normal(0.0, 0.3, 60)
        found = solve_nonnegative(design.T @ design, design.T @ target)
        assert (found >= 0.0).all()
        assert np.linalg.norm(design @ found - target) == pytest.approx(nnls(design, target)[1], rel=1e-12)
