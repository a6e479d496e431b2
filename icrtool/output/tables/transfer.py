"""Compared groups of runs as text, as rows of CSV and as plain data."""

from __future__ import annotations

import csv
import io
import math
from typing import Any

from icrtool.calibration.transfer import Cell, Pair, Transfer
from icrtool.output.text_blocks import Block, Table, Text
from icrtool.records.dropout import CHOICE_HORIZON_M
from icrtool.records.text import table_cell

TRANSFER_SCHEMA = "icrtool/compare/1"


def transfer_document(transfer: Transfer) -> dict[str, Any]:
    """Return plain data."""
    return {
        "schema": TRANSFER_SCHEMA,
        "groups": {
            name: {
                "model": one.recommended,
                "logs": [log._asdict() for log in one.logs],
                "geometry": one.geometry()[0]._asdict(),
            }
            for name, one in transfer.calibrations.items()
        },
        "pairs": [
            {
                "first": pair.first,
                "second": pair.second,
                "parameters": [one._asdict() | {"significant": one.significant} for one in pair.parameters],
                "errors": [one._asdict() for one in pair.errors],
                "verdict": verdict(transfer, pair),
            }
            for pair in transfer.pairs
        ],
        "transfer": [cell._asdict() for cell in transfer.cells],
        "costs": [cost._asdict() for cost in transfer.costs],
    }


def transfer_csv(transfer: Transfer) -> bytes:
    """Return the transfer matrix as CSV, a row and column of it and a horizon each."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(Cell._fields)
    writer.writerows(
        [table_cell(value) if isinstance(value, str) else value if math.isfinite(value) else "" for value in cell]
        for cell in transfer.cells
    )
    return text.getvalue().encode()


def format_transfer(transfer: Transfer) -> Text:
    """Return verdicts, differences and the transfer matrix, no line end."""
    blocks: list[Block] = []
    for pair in transfer.pairs:
        rows = [
            (one.quantity, f"{one.first:+.3f}", f"{one.second:+.3f}", f"{one.difference:+.3f} ± {one.std:.3f}")
            for one in pair.parameters
        ]
        table = Table("lr", rows, ("", pair.first, pair.second, "difference ± std"))
        blocks += [verdict(transfer, pair), "", table]
        for change in pair.errors:
            if math.isfinite(change.p95_m):
                route = ", the same route" if change.paired else ""
                blocks.append(f"held-out error after {change.horizon_m:g} m{route}: 95 % {_change(change[1:4])}; "
                              f"expected {_change(change[4:7])}")  # fmt: skip
        blocks.append("")
    names = list(transfer.calibrations)
    cells = [[transfer.cell(row, column, CHOICE_HORIZON_M) for column in names] for row in names]
    matrix = [(row[0].calibrated_on, *(f"{one.p95_m:.2f} / {one.expected_m:.2f}" for one in row)) for row in cells]
    blocks += [
        f"95 % / expected error [m] after {CHOICE_HORIZON_M:g} m, calibrated on row, tested on column",
        Table("lr", matrix, ("", *names)),
        "on the diagonal each trial is predicted by what was not fitted to it",
    ]
    return Text(blocks)


def verdict(transfer: Transfer, pair: Pair) -> str:
    """Return one sentence: how the multiplier differs, and what the calibration of the first costs on the second."""
    one = next(one for one in pair.parameters if one.quantity == "multiplier")
    change = f"by {one.difference:+.2f} ± {one.std:.2f}"
    if not one.significant:
        change += ", which may be chance"
    cost = transfer.cost(pair.first, pair.second, CHOICE_HORIZON_M)
    if not math.isfinite(cost.p95_m):
        return f"The multiplier of {pair.second} differs from that of {pair.first} {change}."
    sentence = f"costs {_change(cost[3:6])} at 95 % after {CHOICE_HORIZON_M:g} m on {pair.second}"
    if cost.p95_low_m <= 0.0 <= cost.p95_high_m:
        sentence += ", which may be chance"
    return (
        f"The multiplier of {pair.second} differs from that of {pair.first} {change}; a calibration of {pair.first} "
        f"{sentence}."
    )


def _change(values: tuple[float, ...]) -> str:
    value, low, high = values
    if not math.isfinite(low + high):
        return f"{value:+.2f} m (too short for an interval)"
    return f"{value:+.2f} m ({low:+.2f} to {high:+.2f})"
