"""One answer: what a fit recommends is what a calibration of the run recommends, with the same deviations."""

from __future__ import annotations

from pathlib import Path

import pytest

import icrtool
from icrtool.config import parse_config
from icrtool.records.run import Run
from support.drives import make_log

SCORES = {"gyro", "models", "logs", "held_out", "warnings", "created"}
"""What a calibration holds beside the recommendation: it needs the other models, or their scores."""


@pytest.fixture(scope="module")
def run() -> Run:
    return icrtool.fit(make_log(0, 180.0, rate=20.0), parse_config({"robot": {"track_width_m": 0.6}}))


def test_a_fit_recommends_what_a_calibration_of_its_run_does(run: Run) -> None:
    found, calibration = run.summary["recommended"], icrtool.calibrate(run).summary()
    for key in ("model", "why", "terms", "parameters", "covariance", "geometry", "geometry_std", "not_shown"):
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
    assert report.calibration.controller_numbers()._asdict() == run.summary["recommended"]["controller"]


@pytest.mark.parametrize(("seconds", "width"), [(10.0, 0.6), (60.0, None)])
def test_without_enough_to_choose_by_nothing_is_recommended(seconds: float, width: float | None) -> None:
    config = parse_config({"robot": {} if width is None else {"track_width_m": width}})
    assert icrtool.fit(make_log(0, seconds, rate=20.0), config).summary["recommended"] is None
