"""``icrtool forecast``: a table, a file, a picture, JSON; and its errors."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from icrtool.calibration.pooled import calibrate_recordings
from icrtool.motion.models import MODELS
from support.recordings import make_recording

PLAN = "east_m,north_m\n0,0\n12,0\n12,8\n"
MODEL = MODELS["five"]


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    logs = [make_recording(MODEL, MODEL.prior_mean, seed, 120.0, name=f"log {seed}") for seed in range(2)]
    return calibrate_recordings(logs).calibration.write(tmp_path_factory.mktemp("calibration") / "cal.json")


@pytest.fixture
def plan(tmp_path: Path) -> Path:
    file = tmp_path / "plan.csv"
    file.write_text(PLAN)
    return file


def test_a_plan_is_forecast_printed_drawn_and_written(icrtool, calibration: Path, plan: Path, tmp_path: Path) -> None:
    rows, picture = tmp_path / "errors.csv", tmp_path / "errors.png"
    status, out, err = icrtool(
        "forecast", "--calibration", calibration, "--path", plan, "-o", rows, "--plot", picture, "--budget", "0.3"
    )
    assert (status, err) == (0, "")
    assert "within 0.3 m (95 %): " in out
    assert len(rows.read_text().splitlines()) == 21
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_json_is_one_document_with_a_row_for_each_metre(icrtool, calibration: Path, plan: Path) -> None:
    status, out, _ = icrtool("forecast", "--calibration", calibration, "--path", plan, "--json")
    document = json.loads(out)
    assert (status, document["schema"]) == (0, "icrtool/forecast/1")
    assert {len(column) for column in document["along"].values()} == {20}


def test_what_is_no_calibration_is_one_error(icrtool, plan: Path) -> None:
    status, out, err = icrtool("forecast", "--calibration", plan, "--path", plan)
    assert (status, out) == (1, "")
    assert err.startswith("Error: ")
    assert "is a log, not a run or a calibration" in err
