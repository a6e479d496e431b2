"""Finished runs as sources: the newest one, its log, and whether both are still what they were."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from icrtool.errors import RunError
from icrtool.estimation.fit import FilterRun
from icrtool.output.run_directory import StoredRun, read_run, write_run
from icrtool.output.run_source import (
    check_same_log,
    check_same_states,
    log_of,
    newest_run,
    stored_config,
    terrain_changes_s,
)


@pytest.fixture
def stored(tmp_path: Path, run: FilterRun) -> StoredRun:
    write_run(run, tmp_path / "runs" / "barn", plots=())
    return read_run(tmp_path / "runs" / "barn")


def with_inputs(run: StoredRun, *paths: Path) -> StoredRun:
    inputs: list[dict[str, Any]] = [{"path": str(path), "bytes": 1, "sha256": "0"} for path in paths]
    return replace(run, summary={**run.summary, "inputs": inputs})


def test_the_newest_run_is_that_of_the_youngest_run_json(tmp_path: Path, run: FilterRun) -> None:
    runs = tmp_path / "runs"
    for age, name in enumerate(("a", "c", "b")):
        write_run(run, runs / name, plots=())
        os.utime(runs / name / "run.json", ns=(age, 10**18 - age))
    (runs / "other").mkdir()
    (runs / "other" / "run.json").write_text("{}", encoding="utf-8")
    assert newest_run(runs) == runs / "a"


def test_no_run_is_an_error_that_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="no run in it; name a run directory or a log, or make a run with icrtool fit"):
        newest_run(tmp_path / "icrtool-runs")


def test_the_configuration_comes_back_as_it_was(stored: StoredRun, run: FilterRun) -> None:
    assert stored_config(stored) == run.config
    strange = replace(stored, summary={**stored.summary, "config": {"robot": {"wings": 2}}})
    with pytest.raises(RunError, match=r"its configuration is not ours \(robot.wings\)"):
        stored_config(strange)


def test_a_log_is_its_file_or_its_bag_directory(stored: StoredRun, tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    bag.mkdir()
    first, second, packed = bag / "bag_0.db3", bag / "bag_1.db3", bag / "bag_0.mcap.zstd"
    for file in (first, second, packed):
        file.touch()
    assert log_of(with_inputs(stored, first)) == first
    assert log_of(with_inputs(stored, first, second)) == bag
    assert log_of(with_inputs(stored, packed)) == bag
    (bag / "metadata.yaml").touch()
    assert log_of(with_inputs(stored, first)) == bag


def test_a_log_that_is_gone_or_changed_is_told(stored: StoredRun, run: FilterRun, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="the log it was made from is gone"):
        log_of(with_inputs(stored, tmp_path / "nowhere.mcap"))
    with pytest.raises(RunError, match="is gone"):
        log_of(with_inputs(stored))
    check_same_log(stored, run.log)
    edited = replace(run.log, inputs=(replace(run.log.inputs[0], sha256="cd" * 32),))
    with pytest.raises(RunError, match="has changed since"):
        check_same_log(stored, edited)


def test_states_that_come_out_otherwise_are_told(stored: StoredRun, run: FilterRun) -> None:
    check_same_states(stored, run)
    other = replace(run, table=replace(run.table, north_m=run.table.north_m + 1e-3))
    with pytest.raises(RunError, match="gives other states now"):
        check_same_states(stored, other)


def test_terrain_changes_are_the_begins_of_all_segments_but_the_first(stored: StoredRun) -> None:
    assert terrain_changes_s(stored) == ()
    segments = [{"begin_s": 0.0}, {"begin_s": 12.5}, {"begin_s": 30.0}]
    assert terrain_changes_s(replace(stored, summary={**stored.summary, "segments": segments})) == (12.5, 30.0)
