"""Groups compared: a known difference is found, equal groups do not differ, no test on what was fitted."""

from __future__ import annotations

import csv
import io

import numpy as np
import pytest

from icrtool.calibration.pooled import calibrate
from icrtool.calibration.transfer import Transfer, compare_calibrations, compare_groups
from icrtool.errors import ConfigError
from icrtool.motion.models import MODELS
from icrtool.motion.recording import Recording
from icrtool.output.tables.transfer import format_transfer, transfer_csv, transfer_document
from support.recordings import make_recording

FIVE = MODELS["five"]
OLD = np.array([0.96, -0.05, 0.60, 0.0, 0.10])
NEW = np.array([0.96, -0.05, 0.66, 0.0, 0.10])


def group(parameters: np.ndarray, seeds: range, length_m: float = 150.0) -> list[Recording]:
    return [make_recording(FIVE, parameters, seed, length_m, name=f"log {seed}") for seed in seeds]


@pytest.fixture(scope="module")
def transfer() -> Transfer:
    groups = {"old": group(OLD, range(3)), "new": group(NEW, range(3, 6)), "again": group(OLD, range(6, 7), 250.0)}
    return compare_calibrations({name: calibrate(logs) for name, logs in groups.items()}, groups)


def test_a_known_difference_is_found_within_its_standard_deviation(transfer: Transfer) -> None:
    (multiplier,) = (one for one in transfer.pairs[0].parameters if one.quantity == "multiplier")
    truth = 0.96 / 0.66 - 0.96 / 0.60
    assert abs(multiplier.difference - truth) < 3.0 * multiplier.std
    assert multiplier.significant
    (same,) = (one for one in transfer.pairs[1].parameters if one.quantity == "multiplier")
    assert abs(same.difference) < 3.0 * same.std


def test_the_wrong_calibration_costs_and_an_equal_one_does_not(transfer: Transfer) -> None:
    own, foreign = transfer.cell("new", "new", 10.0), transfer.cell("old", "new", 10.0)
    assert foreign.p95_low_m > own.p95_high_m
    assert transfer.cell("old", "again", 10.0).expected_m < 1.5 * transfer.cell("again", "again", 10.0).expected_m
    assert all(one.p95_low_m <= one.p95_m <= one.p95_high_m for one in transfer.cells if one.p95_low_m > 0.0)


def test_the_diagonal_is_the_held_out_score(transfer: Transfer) -> None:
    groups = group(OLD, range(3))
    table = calibrate(groups).wheels
    together = table.score("recommended").together
    for h, horizon in enumerate(table.horizons_m):
        assert transfer.cell("old", "old", horizon).p95_m == pytest.approx(together.p95[h], rel=1e-6)


def test_text_csv_and_json_hold_the_same(transfer: Transfer) -> None:
    text, document = format_transfer(transfer), transfer_document(transfer)
    assert document["pairs"][0]["verdict"].split(";")[0] in " ".join(text.split())
    rows = list(csv.DictReader(io.StringIO(transfer_csv(transfer).decode())))
    assert len(rows) == len(document["transfer"]) == 9 * 4
    assert float(rows[0]["p95_m"]) == transfer.cells[0].p95_m


def test_one_group_is_refused() -> None:
    with pytest.raises(ConfigError):
        compare_groups({"one": []})
