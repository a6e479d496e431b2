"""Compared groups of runs as text and as rows of CSV."""

from __future__ import annotations

from icrtool.output.files.formats import csv_bytes
from icrtool.output.text_blocks import Block, Table, Text
from icrtool.records.calibration_document import ErrorsAt, GroupComparison, TransferCell
from icrtool.records.dropout import CHOICE_HORIZON_M
from icrtool.records.text import with_interval, with_std

MOST_VERDICTS = 4
"""Sentences that are printed unless -v is given."""


def transfer_csv(found: GroupComparison) -> bytes:
    """Return the transfer matrix as CSV, a row and column of it and a horizon each."""
    columns = ("calibrated_on", "tested_on", "horizon_m", "trials", *ErrorsAt.__struct_fields__[1:])
    return csv_bytes(columns, ([getattr(cell, name) for name in columns] for cell in found.transfer))


def format_transfer(found: GroupComparison) -> Text:
    """Return verdicts, differences and the transfer matrix, no line end."""
    blocks: list[Block] = []
    for pair in found.pairs:
        rows = [
            (one.quantity, f"{one.first:+.3f}", f"{one.second:+.3f}", with_std(one.difference, one.std, 3))
            for one in pair.parameters
        ]
        table = Table("lr", rows, ("", pair.first, pair.second, "difference ± std"))
        blocks += [pair.verdict, "", table]
        for change in pair.errors:
            if change.p95_m is not None and change.expected_m is not None:
                route = ", the same route" if change.paired else ""
                p95 = with_interval(change.p95_m, change.p95_low_m, change.p95_high_m)
                expected = with_interval(change.expected_m, change.expected_low_m, change.expected_high_m)
                what = f"error of a fit to other trials after {change.horizon_m:g} m{route}"
                blocks.append(f"{what}: 95 % {p95}; expected {expected}")
        blocks.append("")
    return Text([*blocks, *_matrix_blocks(found)])


def brief_transfer(found: GroupComparison) -> Text:
    """Return the verdicts, a sentence each, and the transfer matrix, no line end."""
    sentences = [pair.verdict for pair in found.pairs]
    more = [f"and {len(sentences) - MOST_VERDICTS} more: -v"] if len(sentences) > MOST_VERDICTS else []
    return Text([*sentences[:MOST_VERDICTS], *more, "", *_matrix_blocks(found)])


def _matrix_blocks(found: GroupComparison) -> list[Block]:
    """Return the errors of each calibration in each group."""
    names = list(found.groups)
    cells = [[found.cell(row, column, CHOICE_HORIZON_M) for column in names] for row in names]
    matrix = [(row[0].calibrated_on, *(_errors(cell) for cell in row)) for row in cells]
    return [
        f"95 % / expected error [m] after {CHOICE_HORIZON_M:g} m, calibrated on row, tested on column",
        Table("lr", matrix, ("", *names)),
        "on the diagonal each trial is predicted by a fit that does not contain it",
    ]


def _errors(cell: TransferCell) -> str:
    if cell.p95_m is None or cell.expected_m is None:
        return "-"
    return f"{cell.p95_m:.2f} / {cell.expected_m:.2f}"
