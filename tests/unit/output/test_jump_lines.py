"""Jumps of the reference as they are printed: in order of time, of many the largest that are decided."""

from __future__ import annotations

from icrtool.output.text_format import MOST_LINES, jump_lines
from icrtool.records.run_document import ReferenceJumpDocument


def jump(begin_s: float, size_m: float, *, undecided: bool = False) -> ReferenceJumpDocument:
    begin_ns = round(begin_s * 1e9)
    return ReferenceJumpDocument(
        "position", begin_ns, begin_ns + 10**8, 0.0, 0.0, size_m, 0.0, 0.0, 0.0, "a reason", undecided,
        begin_s, begin_s + 0.1,
    )  # fmt: skip


def test_each_jump_has_a_line_in_order_of_time_with_what_follows() -> None:
    first, second = jump_lines([jump(3.0, 1.5), jump(9.0, 7.0, undecided=True)])
    assert "3.0" in first
    assert "1.5" in first
    assert "no trial crosses it" in first
    assert "trials cross it" in second


def test_of_many_jumps_the_largest_decided_ones_are_printed_and_the_rest_counted() -> None:
    large = [jump(float(second), 5.0) for second in range(MOST_LINES)]
    small = [jump(100.0 + second, 90.0, undecided=True) for second in range(7)]
    lines = jump_lines([*large, *small])
    assert len(lines) == MOST_LINES + 1
    assert all("no trial crosses it" in line for line in lines[:-1])
    assert "7" in lines[-1]
