"""What is reported of a clock that was set while recording, and of messages that are merely stored out of order."""

from __future__ import annotations

import numpy as np
import pytest

from icrtool.errors import DataError
from icrtool.kernels.arrays import Ints
from icrtool.logs.messages.topic_table import TopicTable, find_backward_step
from icrtool.logs.streams.assembly import clock_notes
from icrtool.logs.streams.sources import NEVER_SET, StampedRows, stamp_rows
from icrtool.records.text import LogText

TIMES = np.arange(0, 100_000_000_000, 20_000_000)


def notes_of(times: Ints) -> list[str]:
    rows = StampedRows(None, np.sort(times), "no header", 0, backward_step=find_backward_step(times))
    return list(clock_notes([("wheels", rows), ("gnss", rows)], "drive"))


def set_back(seconds: float) -> Ints:
    return TIMES - np.where(TIMES > 50_000_000_000, int(seconds * 1e9), 0)


@pytest.mark.parametrize("seconds", [0.3, 1.4])
def test_a_clock_set_back_by_little_is_reported_with_its_step(seconds: float) -> None:
    (note,) = notes_of(set_back(seconds))
    assert (
        f"goes back by {seconds - 0.02:.1f} s after 1970-01-01T00:00:50Z (wheels, gnss): the clock was set" in note.text
    )


def test_parts_of_a_drive_that_a_clock_set_back_exchanges_are_one_warning_with_time_and_step() -> None:
    (note,) = notes_of(TIMES + np.where(TIMES > 50_000_000_000, -60_000_000_000, 100_000_000_000))
    assert "goes back by 160.0 s after 1970-01-01T00:02:30Z (wheels, gnss)" in note.text
    assert "all are used, sorted by time" in note.text


def test_a_clock_set_back_by_more_is_refused() -> None:
    with pytest.raises(DataError, match="the same times occur twice"):
        notes_of(set_back(5.0))


def with_headers(header: Ints, log_ns: Ints) -> StampedRows:
    columns = {"header.stamp.sec": header // 10**9, "header.stamp.nanosec": header % 10**9}
    return stamp_rows(TopicTable(LogText("/wheels"), LogText("a/msg/B"), log_ns, columns, {}, 0))


def test_headers_of_a_clock_set_back_twice_are_moved_by_both_steps_as_log_time_shows_them() -> None:
    rng = np.random.default_rng(0)
    late = rng.exponential(5e6, len(TIMES)).astype(np.int64)  # 5 ms on the way to the recorder
    step = 700_000_000 * (TIMES > 30 * 10**9) + 90 * 10**9 * (TIMES > 60 * 10**9)
    rows = with_headers(TIMES + 10**12 - step, TIMES + 10**12 + late)
    assert rows.header_ns is not None
    assert rows.header_ns == pytest.approx(TIMES + 10**12, abs=5_000_000), "the median of 25 ways differs by 1.4 ms (σ)"
    assert rows.clock_set.size_ns == pytest.approx(90 * 10**9, abs=5_000_000)


@pytest.mark.parametrize("late_ns", [300_000_000, 1_500_000_000])
def test_single_headers_out_of_place_are_no_clock_that_was_set_back(late_ns: int) -> None:
    header = TIMES + 10**12
    header[200::500] -= late_ns
    rows = with_headers(header, TIMES + 10**12)
    assert rows.clock_set == NEVER_SET
    assert rows.header_ns is not None
    assert (rows.header_ns == header).all()


@pytest.mark.parametrize("late_s", [0.1, 1.0])
def test_single_messages_out_of_order_are_no_clock_that_was_set(late_s: float) -> None:
    times = TIMES.copy()
    times[100::100] -= int(late_s * 1e9)
    assert notes_of(times) == []


@pytest.mark.parametrize("ahead_s", [0.5, 1.5, 90.0])
def test_headers_of_a_clock_set_forward_are_moved_back_and_reported(ahead_s: float) -> None:
    late = np.random.default_rng(0).exponential(5e6, len(TIMES)).astype(np.int64)
    step = (ahead_s * 1e9 * (TIMES > 60 * 10**9)).astype(np.int64)
    rows = with_headers(TIMES + 10**12 + step, TIMES + 10**12 + late)
    assert rows.header_ns is not None
    assert rows.header_ns == pytest.approx(TIMES + 10**12, abs=5_000_000)
    (note,) = clock_notes([("gnss", rows)], "drive")
    assert f"go ahead by {ahead_s:.1f} s after 1970-01-01T00:17:40Z (gnss): their clock was set forward" in note.text


@pytest.mark.parametrize("slow_s", [3, 10])
def test_a_connection_that_is_slow_and_then_loses_messages_is_no_clock_that_was_set(slow_s: int) -> None:
    """Messages come later and later; then the queue is emptied, and they come at once again."""
    begin = 50 * 10**9
    behind = np.clip(TIMES - begin, 0, slow_s * 10**9) * (begin + 2 * slow_s * 10**9 > TIMES)
    lost = (begin + slow_s * 10**9 <= TIMES) & (begin + 2 * slow_s * 10**9 > TIMES)
    header = (TIMES + 10**12)[~lost]
    rows = with_headers(header, header + behind[~lost])
    assert rows.clock_set == NEVER_SET
    assert rows.header_ns is not None


def test_an_outage_is_no_clock_that_was_set() -> None:
    kept = (TIMES < 40 * 10**9) | (TIMES > 60 * 10**9)
    header = (TIMES + 10**12)[kept]
    assert with_headers(header, header + 3_000_000).clock_set == NEVER_SET
