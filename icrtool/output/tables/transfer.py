"""Compared groups of runs as blocks and as rows of CSV."""

from __future__ import annotations

from icrtool.output.files.formats import csv_bytes
from icrtool.output.text_blocks import PAGE, VERBOSE, Block, Figure, Items, Section, Table
from icrtool.output.text_format import distance_text
from icrtool.records.calibration_document import ComparedPair, ErrorsAt, GroupComparison, TransferCell
from icrtool.records.dropout import CHOICE_HORIZON_M
from icrtool.records.text import with_interval, with_std


def transfer_csv(found: GroupComparison) -> bytes:
    """Return the transfer matrix as CSV, a row and column of it and a horizon each."""
    columns = ("calibrated_on", "tested_on", "horizon_m", "trials", *ErrorsAt.__struct_fields__[1:])
    return csv_bytes(columns, ([getattr(cell, name) for name in columns] for cell in found.transfer))


def transfer_blocks(found: GroupComparison) -> list[Block]:
    """Return what `icrtool compare` prints: verdicts, the transfer matrix, differences of each pair, the logs."""
    names = list(found.groups)
    cells = {(one.calibrated_on, one.tested_on): one for one in found.transfer if one.horizon_m == CHOICE_HORIZON_M}
    matrix = [(row, *(_errors(cells.get((row, column))) for column in names)) for row in names]
    caption = f"95 % / expected error [m] after {CHOICE_HORIZON_M:g} m, calibrated on row, tested on column"
    cost: list[Block] = [
        Figure((), "comparison"),
        Figure(("transfer",), folded=False),
        Table("lr", matrix, ("", *names), caption),
        "on the diagonal each trial is predicted by a fit that does not contain it",
    ]
    logs = [f"{name}: {one.name}, {distance_text(one.distance_m)}" for name in names for one in found.groups[name].logs]
    return [
        Section("Do they differ?", [Items([pair.verdict for pair in found.pairs])]),
        Section("What a calibration costs elsewhere", cost),
        *(Section(f"{pair.second} compared with {pair.first}", _pair_tables(pair), VERBOSE) for pair in found.pairs),
        Section("Logs", [Items(logs)], PAGE),
    ]


def _pair_tables(pair: ComparedPair) -> list[Table]:
    """Return how parameters and held-out errors of two groups differ."""
    rows = [
        (one.quantity, *(f"{round(value, 3) + 0.0:+.3f}" for value in (one.first, one.second)),
         with_std(one.difference, one.std, 3), "yes" if one.significant else "no, may be chance")
        for one in pair.parameters
    ]  # fmt: skip
    head = ("quantity", pair.first, pair.second, "difference ± std", "significant")
    errors = [
        (
            f"{one.horizon_m:g} m", with_interval(one.p95_m, one.p95_low_m, one.p95_high_m),
            with_interval(one.expected_m, one.expected_low_m, one.expected_high_m),
        )
        for one in pair.errors if one.p95_m is not None and one.expected_m is not None
    ]  # fmt: skip
    route = ", the same route" if any(one.paired for one in pair.errors) else ""
    caption = f"Error of a fit to other trials, {pair.second} minus {pair.first}{route}, with its 95 % interval"
    return [Table("lrrrl", rows, head), Table("lr", errors, ("after", "95 %", "expected"), caption)]


def _errors(cell: TransferCell | None) -> str:
    if cell is None or cell.p95_m is None or cell.expected_m is None:
        return "-"
    return f"{cell.p95_m:.2f} / {cell.expected_m:.2f}"
