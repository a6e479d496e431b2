"""Groups compared: a known difference is found, equal groups do not differ, no test on what was fitted."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from icrtool.calibration.pooled import calibrate_recordings
from icrtool.calibration.transfer import compare_calibrations, compare_groups
from icrtool.errors import ConfigError
from icrtool.motion.models import MODELS
from icrtool.motion.recording import Recording
from icrtool.output.files.formats import json_bytes
from icrtool.output.tables.calibration import transfer_blocks, transfer_csv
from icrtool.output.text_blocks import format_blocks
from icrtool.records.calibration_document import GroupComparison, TransferCell, TransferCost
from support.recordings import make_recording

FIVE = MODELS["five"]
OLD = np.array([0.96, -0.05, 0.60, 0.0, 0.10])
NEW = np.array([0.96, -0.05, 0.66, 0.0, 0.10])


def group(parameters: np.ndarray, seeds: range, length_m: float = 150.0) -> list[Recording]:
    return [make_recording(FIVE, parameters, seed, length_m, name=f"log {seed}") for seed in seeds]


def cell_of(found: GroupComparison, calibrated_on: str, tested_on: str, horizon_m: float) -> TransferCell:
    place = (calibrated_on, tested_on, horizon_m)
    return next(one for one in found.transfer if (one.calibrated_on, one.tested_on, one.horizon_m) == place)


def cost_of(found: GroupComparison, calibrated_on: str, tested_on: str, horizon_m: float) -> TransferCost | None:
    """The cost of a cell; None on the diagonal."""
    place = (calibrated_on, tested_on, horizon_m)
    return next((one for one in found.costs if (one.calibrated_on, one.tested_on, one.horizon_m) == place), None)


@pytest.fixture(scope="module")
def transfer() -> GroupComparison:
    groups = {"old": group(OLD, range(3)), "new": group(NEW, range(3, 6)), "again": group(OLD, range(6, 7), 250.0)}
    return compare_calibrations({name: calibrate_recordings(logs) for name, logs in groups.items()}, groups)


def test_a_known_difference_is_found_within_its_standard_deviation(transfer: GroupComparison) -> None:
    (multiplier,) = (one for one in transfer.pairs[0].parameters if one.quantity == "multiplier")
    truth = 0.96 / 0.66 - 0.96 / 0.60
    assert abs(multiplier.difference - truth) < 3.0 * multiplier.std
    assert multiplier.significant
    (same,) = (one for one in transfer.pairs[1].parameters if one.quantity == "multiplier")
    assert abs(same.difference) < 3.0 * same.std


def test_the_wrong_calibration_costs_and_an_equal_one_does_not(transfer: GroupComparison) -> None:
    own, foreign = cell_of(transfer, "new", "new", 10.0), cell_of(transfer, "old", "new", 10.0)
    assert foreign.p95_low_m > own.p95_high_m
    on_again = [cell_of(transfer, name, "again", 10.0).expected_m for name in ("old", "again")]
    assert on_again[0] < 1.5 * on_again[1]
    errors = transfer.transfer
    assert all(one.p95_low_m <= one.p95_m <= one.p95_high_m for one in errors if one.p95_low_m is not None)


def test_the_diagonal_is_the_held_out_score(transfer: GroupComparison) -> None:
    groups = group(OLD, range(3))
    table = calibrate_recordings(groups).table
    together = table.score("recommended").together
    for h, horizon in enumerate(table.horizons_m):
        assert cell_of(transfer, "old", "old", horizon).p95_m == pytest.approx(together.p95[h], rel=1e-6)


def test_text_csv_and_json_hold_the_same(transfer: GroupComparison) -> None:
    text, document = format_blocks(transfer_blocks(transfer)), json.loads(json_bytes(transfer))
    assert msgspec.convert(document, GroupComparison) == transfer
    assert document["pairs"][0]["verdict"].split(";")[0] in " ".join(text.split())
    rows = list(csv.DictReader(io.StringIO(transfer_csv(transfer).decode())))
    assert len(rows) == len(document["transfer"]) == 9 * 4
    assert float(rows[0]["p95_m"]) == transfer.transfer[0].p95_m


def test_one_group_is_refused() -> None:
    with pytest.raises(ConfigError):
        compare_groups({"one": []})


def test_a_calibration_is_not_tested_on_another_robot() -> None:
    groups = {"small": group(OLD, range(1)), "again": group(OLD, range(1, 2)), "large": group(OLD, range(2, 3))}
    groups["large"] = [replace(groups["large"][0], width_m=2.0 * groups["small"][0].width_m)]
    found = compare_calibrations({name: calibrate_recordings(logs) for name, logs in groups.items()}, groups)
    assert cell_of(found, "small", "large", 10.0).p95_m is None
    assert cell_of(found, "large", "again", 10.0).p95_m is None
    assert all(cell_of(found, name, name, 10.0).p95_m > 0.0 for name in groups)
    assert cell_of(found, "small", "again", 10.0).p95_m > 0.0
    assert [pair.second for pair in found.pairs] == ["again", "large"]


def test_costs_are_differences_in_the_same_trials(transfer: GroupComparison) -> None:
    cell, own = cell_of(transfer, "old", "new", 10.0), cell_of(transfer, "new", "new", 10.0)
    assert cost_of(transfer, "new", "new", 10.0) is None
    cost = cost_of(transfer, "old", "new", 10.0)
    assert cost is not None
    assert cost.p95_m == pytest.approx(cell.p95_m - own.p95_m, rel=1e-9)
    assert 0.0 < cost.p95_low_m < cost.p95_m < cost.p95_high_m
    same = cost_of(transfer, "old", "again", 10.0)
    assert same is not None
    assert same.expected_low_m < 0.1


def test_the_same_route_driven_twice_is_paired() -> None:
    first, second = (make_recording(FIVE, OLD, 1, 150.0, name=name) for name in ("one", "two"))
    second = replace(second, track=second.track._replace(north=second.track.north + 0.2))
    groups = {"one": [first], "two": [second]}
    found = compare_calibrations({name: calibrate_recordings(logs) for name, logs in groups.items()}, groups)
    assert found.pairs[0].errors[0].paired
    assert "the same route" in format_blocks(transfer_blocks(found))
