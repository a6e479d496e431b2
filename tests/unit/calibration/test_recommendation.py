"""One answer: what a fit recommends is what a calibration of the run recommends, with the same deviations."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import icrtool
from icrtool.config import parse_config
from icrtool.records.run import Run
from support.drives import make_log

SCORES = {"gyro", "models", "logs", "held_out", "notes", "warnings", "created"}
"""What a calibration holds beside the recommendation: it needs the other models, or their scores."""


@pytest.fixture(scope="module")
def run() -> Run:
    return icrtool.fit(make_log(0, 180.0, rate=20.0), parse_config({"robot": {"track_width_m": 0.6}}))


def test_a_fit_recommends_what_a_calibration_of_its_run_does(run: Run) -> None:
    found, calibration = run.summary["recommended"], icrtool.calibrate(run).summary()
    for key in ("model", "terms", "parameters", "covariance", "geometry", "geometry_std", "not_shown"):
        assert found[key] == calibration[key], key
    assert found["controller"].items() <= calibration["controller"].items()
    assert not SCORES & set(found)


def test_it_is_in_the_run_directory_and_read_back(run: Run, tmp_path: Path) -> None:
    run.write(tmp_path / "run", plots=())
    assert icrtool.open_run(tmp_path / "run").summary["recommended"] == run.summary["recommended"]


def test_it_is_the_reports_first_line_too(run: Run) -> None:
    report = icrtool.dropout_report(run)
    assert report.calibration is not None
    assert report.calibration.recommended == run.summary["recommended"]["model"]
    assert report.calibration.controller.multiplier == run.document.recommended.controller.multiplier


@pytest.mark.parametrize(("seconds", "width"), [(4.0, 0.6), (60.0, None)])
def test_too_short_a_drive_and_an_unknown_width_have_no_model_for_a_controller(
    seconds: float, width: float | None
) -> None:
    config = parse_config({"robot": {} if width is None else {"track_width_m": width}})
    summary = icrtool.fit(make_log(0, seconds, rate=20.0), config).summary
    assert summary["recommended"] is None
    assert summary["controller"] is None
    assert (summary["geometry"] is None) == (width is not None)


def test_the_multiplier_belongs_to_the_icrs_beside_it(run: Run) -> None:
    """(right - left) / b, with a standard deviation that holds their covariance."""
    geometry, controller = run.summary["geometry"], run.summary["controller"]
    right, left = geometry["y_icr_right_m"], geometry["y_icr_left_m"]
    assert controller["multiplier"] == pytest.approx((right - left) / 0.6, rel=1e-12)
    by = np.array([1.0, -1.0, 0.0]) / 0.6
    variance = by @ np.array(geometry["covariance_m2"]) @ by
    assert controller["multiplier_std"] == pytest.approx(np.sqrt(variance), rel=1e-4)
    assert geometry["y_icr_right_m_std"] == pytest.approx(np.sqrt(geometry["covariance_m2"][0][0]))


def test_what_is_not_known_of_the_clocks_is_in_the_deviation_of_x(run: Run) -> None:
    unknown = run.summary["icr"]["x_clock_std_m"]
    assert 0.0 < unknown <= run.summary["geometry"]["x_icr_m_std"]
    assert unknown <= run.summary["icr"]["final_std"]["x_icr_m"]


def test_with_preset_paper_the_icrs_are_the_filters() -> None:
    config = parse_config({"robot": {"track_width_m": 0.6}, "filter": {"preset": "paper"}})
    summary = icrtool.fit(make_log(0, 180.0, rate=20.0), config).summary
    for name, value in summary["icr"]["final"].items():
        assert summary["geometry"][name] == pytest.approx(value)
    assert summary["controller"]["multiplier"] == pytest.approx(summary["icr"]["separation_multiplier"])
    assert (summary["controller"]["left_radius"], summary["controller"]["right_radius"]) == (1.0, 1.0)
