"""Records: short in a terminal, escaped in a notebook, never changed by what is made of them."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

from icrtool.alignment.align import sensors_as_sent
from icrtool.records.plain_data import plain_value
from icrtool.records.run import Run
from icrtool.records.samples import without_repeats
from support.barn import configured, simulate
from support.documents import with_summary


def test_a_log_and_a_run_are_one_line_each(run: Run) -> None:
    log = simulate()
    for one in (log, run):
        assert len(repr(one)) < 250
        assert "\n" not in repr(one)
        assert "barn" in repr(one)
    assert "2,900 wheels" in repr(log)


def test_names_are_escaped_in_html(run: Run) -> None:
    evil = "<script>alert(1)</script>"
    log = simulate()
    log = replace(log, name=evil, streams=tuple(replace(stream, topic=evil) for stream in log.streams))
    for html in (log._repr_html_(), with_summary(run, log=evil, warnings=[evil])._repr_html_()):
        assert "<script>" not in html
        assert "&lt;script&gt;" in html


def test_a_run_is_not_changed(run: Run) -> None:
    with pytest.raises(FrozenInstanceError):
        run.table = None  # type: ignore[misc]


def test_part_of_the_sensors_holds_the_measurements_of_that_time() -> None:
    sensors = sensors_as_sent(simulate(), configured())
    part = sensors.part(slice(500, 1000))
    begin, end = part.wheels.stamp_ns[[0, -1]]
    assert np.array_equal(part.wheels.v_left_mps, sensors.wheels.v_left_mps[500:1000])
    for stamps, whole in (
        (part.fixes.stamp_ns, sensors.fixes.stamp_ns), (part.headings.stamp_ns, sensors.headings.stamp_ns),
    ):  # fmt: skip
        assert stamps.tolist() == [stamp for stamp in whole.tolist() if begin <= stamp < end]
    assert len(part.fixes.north_m) == len(part.fixes.fix_class) == len(part.fixes.stamp_ns)


def test_alignment_tells_what_it_applied(run: Run) -> None:
    found = run.summary["alignment"]
    assert {"wheel_scale", "heading_offset_deg", "heading_delay_s", "position_delay_s"} <= found.keys()
    for finding in found.values():
        assert finding.keys() == {"value", "std", "applied", "why"}
        assert finding["why"]
    assert found["wheel_scale"]["applied"] == 1.0


def test_plain_data_is_what_json_gives_back() -> None:
    data = {"a": (1, np.float64(2.5)), "b": float("nan"), "c": np.arange(2), 3: None, "d": [np.int64(4), True]}
    assert plain_value(data) == {"a": [1, 2.5], "b": None, "c": [0, 1], "3": None, "d": [4, True]}


def test_a_thin_column_keeps_the_column_it_was_made_of_no_longer() -> None:
    column = np.full(1000, 2.0)
    found = without_repeats(column)
    assert np.array_equal(found, column)
    assert not np.shares_memory(found, column)
