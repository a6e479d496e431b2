"""Compared groups of runs as text, as rows of CSV and as plain data."""

from __future__ import annotations

import math
from typing import Any

from icrtool.calibration.transfer import Cell, Pair, Transfer
from icrtool.output.files.csv_file import csv_bytes
from icrtool.output.text_blocks import Block, Table, Text
from icrtool.output.text_format import with_interval, with_std
from icrtool.records.dropout import CHOICE_HORIZON_M
from icrtool.records.plain_data import plain

TRANSFER_SCHEMA = "icrtool/compare/1"

MOST_VERDICTS = 4
"""Sentences that are printed unless -v is given."""


def transfer_document(transfer: Transfer) -> dict[str, Any]:
    """Return plain data."""
    return {
        "schema": TRANSFER_SCHEMA,
        "groups": {
            name: {
                "model": one.recommended,
                "logs": plain(one.logs),
                "geometry": one.geometry()[0]._asdict(),
            }
            for name, one in transfer.calibrations.items()
        },
        "pairs": [
            {
                "first": pair.first,
                "second": pair.second,
                "parameters": [one._asdict() | {"significant": one.significant} for one in pair.parameters],
                "errors": [
                    {"horizon_m": horizon, **one._asdict(), "paired": pair.paired}
                    for horizon, one in pair.errors.items()
                ],
                "verdict": verdict(transfer, pair),
            }
            for pair in transfer.pairs
        ],
        "transfer": [_row(cell) for cell in transfer.cells],
        "costs": [{**_place(cell), **cell.cost._asdict()} for cell in transfer.cells if cell.cost is not None],
    }


def _place(cell: Cell) -> dict[str, Any]:
    return dict(zip(Cell._fields[:3], cell[:3], strict=True))


def _row(cell: Cell) -> dict[str, Any]:
    return {**_place(cell), "trials": cell.trials, **cell.errors._asdict()}


def transfer_csv(transfer: Transfer) -> bytes:
    """Return the transfer matrix as CSV, a row and column of it and a horizon each."""
    return csv_bytes(_row(transfer.cells[0]), (_row(cell).values() for cell in transfer.cells))


def format_transfer(transfer: Transfer) -> Text:
    """Return verdicts, differences and the transfer matrix, no line end."""
    blocks: list[Block] = []
    for pair in transfer.pairs:
        rows = [
            (one.quantity, f"{one.first:+.3f}", f"{one.second:+.3f}", with_std(one.difference, one.std, 3))
            for one in pair.parameters
        ]
        table = Table("lr", rows, ("", pair.first, pair.second, "difference ± std"))
        blocks += [verdict(transfer, pair), "", table]
        for horizon, change in pair.errors.items():
            if math.isfinite(change.p95_m):
                route = ", the same route" if pair.paired else ""
                p95, expected = with_interval(*change[:3]), with_interval(*change[3:])
                what = f"error of a fit to other trials after {horizon:g} m{route}"
                blocks.append(f"{what}: 95 % {p95}; expected {expected}")
        blocks.append("")
    return Text([*blocks, *_matrix_blocks(transfer)])


def brief_transfer(transfer: Transfer) -> Text:
    """Return the verdicts, a sentence each, and the transfer matrix, no line end."""
    sentences = [verdict(transfer, pair) for pair in transfer.pairs]
    more = [f"and {len(sentences) - MOST_VERDICTS} more: -v"] if len(sentences) > MOST_VERDICTS else []
    return Text([*sentences[:MOST_VERDICTS], *more, "", *_matrix_blocks(transfer)])


def _matrix_blocks(transfer: Transfer) -> list[Block]:
    """Return the errors of each calibration in each group."""
    names = list(transfer.calibrations)
    cells = [[transfer.cell(row, column, CHOICE_HORIZON_M) for column in names] for row in names]
    matrix = [(row[0].calibrated_on, *(_errors(cell) for cell in row)) for row in cells]
    return [
        f"95 % / expected error [m] after {CHOICE_HORIZON_M:g} m, calibrated on row, tested on column",
        Table("lr", matrix, ("", *names)),
        "on the diagonal each trial is predicted by a fit that does not contain it",
    ]


def _errors(cell: Cell) -> str:
    return f"{cell.errors.p95_m:.2f} / {cell.errors.expected_m:.2f}" if math.isfinite(cell.errors.p95_m) else "-"


def verdict(transfer: Transfer, pair: Pair) -> str:
    """Return one sentence: how the multiplier differs, and what the calibration of the first costs on the second."""
    one = next(one for one in pair.parameters if one.quantity == "multiplier")
    change = f"by {with_std(one.difference, one.std)}"
    if not one.significant:
        change += ", which may be chance"
    cost = transfer.cell(pair.first, pair.second, CHOICE_HORIZON_M).cost
    if cost is None or not math.isfinite(cost.p95_m):
        return f"The multiplier of {pair.second} differs from that of {pair.first} {change}."
    sentence = f"costs {with_interval(*cost[:3])} at 95 % after {CHOICE_HORIZON_M:g} m on {pair.second}"
    if cost.p95_low_m <= 0.0 <= cost.p95_high_m:
        sentence += ", which may be chance"
    return (
        f"The multiplier of {pair.second} differs from that of {pair.first} {change}; a calibration of {pair.first} "
        f"{sentence}."
    )
