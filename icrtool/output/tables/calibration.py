"""Calibrations as blocks: a model from one log or many, its settings, a forecast, and groups of runs compared."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from itertools import product
from typing import NamedTuple

import numpy as np
from msgspec import UNSET

from icrtool import __version__
from icrtool.calibration.error_growth import Forecast
from icrtool.calibration.held_out import HeldOut
from icrtool.calibration.held_sensors import CONSTANT_WORDS, constant_text, constants_document, pooled_constants
from icrtool.calibration.pooled import CalibrationResult
from icrtool.calibration.record import Calibration, unfit_reasons
from icrtool.calibration.sensor_findings import LABELS
from icrtool.errors import DataError
from icrtool.kernels.arrays import Floats
from icrtool.kernels.error_statistics import within_budget
from icrtool.motion.models import TERMS
from icrtool.output.files.formats import csv_bytes
from icrtool.output.tables.dropout import WITH_GYRO, configuration_blocks, parameter_table, reach_row
from icrtool.output.tables.run import blocks_of_numbers
from icrtool.output.text_blocks import PAGE, VERBOSE, Block, Chart, Facts, Figure, Items, Line, Section, Table, Title
from icrtool.output.text_format import controller_error_text, error_text, model_text, plus_minus
from icrtool.records import calibration_document as documents
from icrtool.records.acceptance import CHOICE_HORIZON_M, BudgetDistance
from icrtool.records.fleet_document import BUDGET_M
from icrtool.records.plain_data import finite_or_none
from icrtool.records.rows import MAIN_ROW, in_order, shown_rows
from icrtool.records.run import ICR_COLUMNS, ICR_WORDS
from icrtool.records.text import counted, distance_text, with_interval, with_std


def calibration_blocks(result: CalibrationResult | None, sensors: documents.SensorDocument | None) -> list[Block]:
    """Return the output of `icrtool calibrate`: numbers, distances within a budget (held out), settings of one log."""
    blocks = _result_blocks(result) if result is not None else []
    return [*blocks, *_sensor_blocks(sensors)] if sensors is not None else blocks


def _result_blocks(result: CalibrationResult) -> list[Block]:
    """Return the numbers for a controller, the held-out distances and the motion model of a result."""
    calibration, table = result.calibration, result.table
    icrs = [(calibration.geometry[name], calibration.geometry_std[name]) for name in ICR_COLUMNS]
    driven = distance_text(sum(log.distance_m for log in calibration.logs))
    part = "log" if table.folds[0].whole else "block of distance"
    rows = [
        _held_out_distance(reached)
        for name in shown_rows(table.rows)
        if (reached := table.score(name).within(table.horizons_m, BUDGET_M)) is not None
    ]
    unknown = "; ".join(TERMS[name].meaning for name in calibration.fitted.not_shown)
    model = [
        parameter_table(calibration.fitted, calibration.fitted_with_gyro),
        *held_out_blocks(table),
        *sensor_tables(calibration),
        *(finding.sentence for finding in result.notes),
    ]
    return [
        Title(calibration.robot.name or "robot", f"{counted(len(calibration.logs), 'log')}, {driven}"),
        *blocks_of_numbers(calibration.controller, calibration.width_m, icrs),
        Table("lrl", rows, caption=f"How far within {BUDGET_M:g} m (95 %), each {part} left out in turn?"),
        Facts([("not shown", unknown and f"too small for these drives; the usual values are used: {unknown}")]),
        Section(f"Motion model: {model_text(calibration.fitted)}", model, VERBOSE),
    ]


def _held_out_distance(reached: BudgetDistance) -> tuple[str, str, str]:
    """Return name, distance and note of a row; held-out errors have no interval for the next drive."""
    name, distance, _, note = reach_row(reached)
    return name, distance, note


def calibration_file_blocks(calibration: Calibration, title: str) -> list[Block]:
    """Return the page of a calibration file as blocks: numbers, held-out errors, parameters, logs."""
    icrs = [(calibration.geometry[name], calibration.geometry_std[name]) for name in ICR_COLUMNS]
    driven = distance_text(sum(log.distance_m for log in calibration.logs))
    robot, model = calibration.robot.name or "robot", model_text(calibration.fitted)
    about = f"{robot}: {counted(len(calibration.logs), 'log')}, {driven}, {model}"
    day = calibration.created[:10] if calibration.created else "at an unknown time"
    made_with = f"Made {day} with icrtool {calibration.tool_version or 'unknown'}."
    configuration: list[Block] = []
    with suppress(DataError):
        configuration = configuration_blocks(calibration, "CAL.json")
    unknown = "; ".join(TERMS[name].meaning for name in calibration.fitted.not_shown)
    table = parameter_table(calibration.fitted, calibration.fitted_with_gyro)
    # A page names a parameter by its meaning; the key in the file is the last column.
    named = [
        (f"{WITH_GYRO}{meaning}" if term.startswith(WITH_GYRO) else meaning, *middle, term.removeprefix(WITH_GYRO))
        for term, *middle, meaning in (map(str, row) for row in table.rows)
    ]
    term, *middle, meaning = table.head
    parameters: list[Block] = [
        table._replace(rows=named, head=(meaning, *middle, term)),
        Facts([("not shown", unknown and f"too small for these drives; the usual values are used: {unknown}")]),
        *sensor_tables(calibration),
    ]
    unfit = [reason.text for reason in unfit_reasons(calibration)]
    head = ("log", "distance", "begins", "heading offset", "poses lag")
    logs = [
        (log.name, distance_text(log.distance_m), _date_text(log.begin_ns), *_log_constants(log))
        for log in calibration.logs
    ]
    return [
        Line(f"Not fit for use: {'; '.join(unfit)}" if unfit else "", "bad"),
        Title(title, f"{about}.", made_with),
        Section("Answer", _calibration_cards(calibration, icrs), name="answer"),
        Section("Configuration to copy", configuration, name="controller"),
        Section(
            "Errors of each log that was not fitted",
            [_held_out_table(calibration), _left_out_table(calibration)],
            name="held-out",
        ),
        Section("Parameters of the motion model", parameters, name="parameters"),
        Section("Logs", [Table("lr", logs, head)], name="logs"),
        Section("Warnings", [Items(calibration.warnings) if calibration.warnings else "None."], name="warnings"),
    ]


def _log_constants(log: documents.CalibrationLog) -> tuple[str, str]:
    """Return heading offset and delay of a log, corrections before the fit included where the file has them."""
    if log.sensors is None:
        return f"{log.heading_offset_deg:+z.2f}°", f"{log.wheels_delay_s:+z.3f} s"
    texts = [constant_text(log.sensors.wheels, name) for name in ("heading_offset_deg", "reference_delay_s")]
    return texts[0], texts[1]


def sensor_tables(calibration: Calibration) -> list[Block]:
    """Return a table of the sensors' constants that a calibration uses in a further drive; none for an old file."""
    constants = constants_document(pooled_constants(calibration.logs, with_gyro=calibration.gyro is not None))
    texts = [(words, constant_text(constants, name)) for name, (words, *_) in CONSTANT_WORDS.items()]
    rows = [row for row in texts if row[1]]
    return [Table("lr", rows, ("sensors, in a further drive", "value ± std"))] if rows else []


def _calibration_cards(calibration: Calibration, icrs: Sequence[tuple[float, float]]) -> list[Section]:
    """Return distance and errors, numbers and a drawing of the ICRs as cards."""
    numbers = blocks_of_numbers(calibration.controller, calibration.width_m, icrs)
    if alone := controller_error_text(calibration.controller_errors):
        numbers.append(alone)
    title = "The ICRs of the tracks from above, forward up"
    drawing = Figure((), "geometry", (Chart("geometry", title, f"{title}; bars: ±σ; boxes: the tracks."),))
    return [
        _reach_card(calibration),
        Section("Which numbers into the controller?", numbers, name="factors"),
        Section("Where are the ICRs?", [drawing], name="worst-case"),
    ]


def _reach_card(calibration: Calibration) -> Section:
    """Return the distance within the budget and the errors, both held out of the fit, as a card."""
    horizons = sorted({score.horizon_m for score in calibration.held_out_pooled})
    pooled = {(score.model, score.horizon_m): score for score in calibration.held_out_pooled}
    names = in_order({score.model for score in calibration.held_out_pooled})
    test_words = "each log left out in turn" if len(calibration.logs) > 1 else "each block of distance left out in turn"
    reached: dict[str, BudgetDistance] = {}
    for name in names:
        errors = np.array([pooled[name, h].p95_m if (name, h) in pooled else math.nan for h in horizons])
        if (distance := within_budget(np.array(horizons), errors, BUDGET_M)) is not None:
            reached[name] = BudgetDistance(name, BUDGET_M, *distance)
    lead, text = "not known", "no distance was left out"
    if (main_reach := reached.get(MAIN_ROW)) is not None:
        _, lead, _, between = reach_row(main_reach)
        text = f"within {BUDGET_M:g} m (95 %), by wheel speeds alone with {MAIN_ROW}, {test_words}"
        if between:
            text += f": the errors were measured at {', '.join(f'{h:g}' for h in horizons)} m, so it is {between}"
    # The table of distances is that of `icrtool calibrate`.
    rows = [_held_out_distance(reached[name]) for name in shown_rows(names) if name in reached]
    table = Table("lrl", rows, (f"within {BUDGET_M:g} m (95 %)", "distance", ""))
    return Section("How far without GNSS?", [table], lead=lead, text=text, name="reach")


def _held_out_table(calibration: Calibration) -> Table:
    """Return p95 and expected error by horizon of each row, over all held-out trials."""
    horizons = sorted({score.horizon_m for score in calibration.held_out_pooled})
    pooled = {(score.model, score.horizon_m): score for score in calibration.held_out_pooled}
    names = in_order({score.model for score in calibration.held_out_pooled})
    rows = [(name, *(_errors_text(pooled.get((name, horizon))) for horizon in horizons)) for name in names]
    caption = "95 % / expected error [m] of each row, over all that was left out"
    return Table("lr", rows, ("row", *(f"{horizon:g} m" for horizon in horizons)), caption)


def _left_out_table(calibration: Calibration) -> Table:
    """Return p95 and expected error by horizon of each log or block, predicted by a fit without it."""
    horizons = sorted({score.horizon_m for score in calibration.held_out_pooled})
    score_of = {(score.log, score.horizon_m): score for score in calibration.held_out if score.model == MAIN_ROW}
    names = dict.fromkeys(score.log for score in calibration.held_out)
    rows = [(name, *(_errors_text(score_of.get((name, horizon))) for horizon in horizons)) for name in names]
    caption = f"95 % / expected error [m] of {MAIN_ROW}, each log or block of distance predicted without itself"
    return Table("lr", rows, ("left out", *(f"{horizon:g} m" for horizon in horizons)), caption)


def _date_text(stamp_ns: int) -> str:
    """Return date and time of a stamp, ``not known`` for stamp 0."""
    return f"{datetime.fromtimestamp(stamp_ns // 10**9, UTC):%Y-%m-%d %H:%M:%S} UTC" if stamp_ns else "not known"


def _errors_text(score: documents.PooledScore | None) -> str:
    """Return p95 and expected error [m], as ``0.52 / 0.21``; ``–`` without a score."""
    return "–" if score is None else f"{score.p95_m:.2f} / {score.expected_m:.2f}"


def held_out_blocks(table: HeldOut) -> list[Block]:
    """Return the leave-one-out table: p95 / expected error by horizon, of all trials together and of the worst fold."""
    part, tested = "block", "each trial predicted by a fit to the rest of the drive"
    if table.folds[0].whole:
        part, tested = "log", "each log left out in turn"
    rows = []
    for row in table.scores:
        cells, together = [], row.together
        for h, trials in enumerate(together.trials):
            worst = f"{row.worst('p95', h):.2f}/{row.worst('expected', h):.2f}" if trials else ""
            cells.append(f"{together.p95[h]:.2f}/{together.expected[h]:.2f} ({worst})" if trials else "–")
        rows.append((row.name, *cells))
    return [
        f"{tested} ({len(table.folds)} {part}s): 95 % / expected error [m] of all trials (of the worst {part})",
        Table("lr", rows, ("model", *(f"{horizon:g} m" for horizon in table.horizons_m))),
    ]


MEANINGS = "shown: found well enough to set; weak: found roughly; not shown, not separable: this drive cannot find it"
"""Meanings of the verdicts on parameters."""

OPTIONS_WIDTH = 76
"""Number of characters of options in a line of a terminal of 80 columns, without indent and backslash."""

FORMS = {"_deg": (2, "+", " °"), "_m": (3, "+", " m"), "_s": (3, "+", " s"), "scale": (4, "", "")}
"""Number of decimals, sign and unit of a value, by the end of its key."""


def _sensor_blocks(calibration: documents.SensorDocument) -> list[Block]:
    """Return the settings that one log proposes, and the estimates that they come from."""
    facts = calibration.drive
    right_deg, left_deg = facts.turned_right_deg, facts.turned_left_deg
    speed = f"{plus_minus(facts.speed_mean_mps, facts.speed_std_mps, 2, '')} m/s"
    stretches = f"{calibration.independent_stretches} independent stretches"
    head = [
        ("drive", f"{facts.distance_m:.0f} m at {speed}, turned {right_deg:.0f}° right and {left_deg:.0f}° left"),
        ("compared", f"{calibration.windows} windows of driven distance, {stretches}"),
    ]
    rows = []
    for key, parameter in calibration.parameters.items():
        digits, sign, unit = next(form for ending, form in FORMS.items() if key.endswith(ending))
        value = plus_minus(parameter.value, parameter.std if parameter.verdict != "given" else None, digits, sign)
        value += unit if parameter.value is not None else ""
        rows.append((LABELS[key], value, parameter.verdict + (f": {parameter.note}" if parameter.note else "")))
    table = Table("lrl", rows, ("parameter", "value ± std", "verdict"))
    estimates = Section(calibration.log, [Facts(head), table, MEANINGS, ""], VERBOSE)
    if not calibration.settings:
        shown = any(parameter.verdict == "shown" for parameter in calibration.parameters.values())
        why = "the drive confirms the configuration" if shown else "the drive showed nothing well enough"
        return [estimates, f"nothing to configure: {why}"]
    # An option and its value stay on one line.
    options = " ".join(f"--set\u00a0{key}={value:g}" for key, value in calibration.settings.items())
    lines = textwrap.wrap(options, OPTIONS_WIDTH, break_long_words=False, break_on_hyphens=False)
    # A shell joins the lines again.
    joined = " \\\n  ".join(lines).replace("\u00a0", " ")
    return [estimates, Line(f"to configure:\n  {joined}", "as is")]


SHOWN_M = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)
"""Distances of the rows of a forecast [m]."""


def forecast_csv(forecast: Forecast, gyro: Forecast | None = None) -> str:
    """Return a forecast as CSV, with a row for each metre."""
    columns = _columns(forecast, gyro)
    lines = [",".join(columns)]
    lines += [",".join(f"{value:.6g}" for value in row) for row in zip(*columns.values(), strict=True)]
    return "\n".join(lines) + "\n"


def _columns(forecast: Forecast, gyro: Forecast | None) -> dict[str, Floats]:
    """Return the columns of a forecast; the last columns are the errors with a gyro."""
    error = {"expected_m": "expected_error_m", "p95_m": "p95_error_m"}
    columns = {error.get(name, name): column for name, column in forecast._asdict().items()}
    if gyro is not None:
        columns |= {"expected_error_gyro_m": gyro.expected_m, "p95_error_gyro_m": gyro.p95_m}
    return columns


def forecast_document(
    forecast: Forecast, calibration: Calibration, budgets_m: tuple[float, ...], gyro: Forecast | None = None
) -> documents.ForecastDocument:
    """Return the document that ``icrtool forecast --json`` prints."""
    columns = {name: column.tolist() for name, column in _columns(forecast, gyro).items()}
    reaches = [
        (
            budget_m,
            finite_or_none(distance_within(forecast, budget_m)),
            UNSET if gyro is None else finite_or_none(distance_within(gyro, budget_m)),
        )
        for budget_m in budgets_m
    ]
    return documents.ForecastDocument(
        schema="icrtool/forecast/1",
        tool_version=__version__,
        calibration=documents.ForecastSource(
            calibration.name or "", calibration.recommended, calibration.created or ""
        ),
        measured_to_m=measured_to_m(calibration),
        budgets=tuple(documents.ForecastBudget(*reached) for reached in reaches),
        not_shown=calibration.fitted.not_shown,
        notes=calibration.notes,
        warnings=calibration.warnings,
        along=documents.ForecastColumns(**columns),
    )


def measured_to_m(calibration: Calibration) -> float:
    """Return the length [m] of the longest held-out windows; beyond it a forecast extrapolates."""
    return 0.0 if calibration.error_sources is None else calibration.error_sources.measured_to_m


def distance_within(forecast: Forecast, budget_m: float) -> float:
    """Return the distance [m] up to which 95 % of the errors stay within a budget."""
    reached = within_budget(forecast.distance_m, forecast.p95_m, budget_m)
    return math.nan if reached is None else reached[0]


def forecast_blocks(
    forecast: Forecast, calibration: Calibration, budgets_m: tuple[float, ...], gyro: Forecast | None = None
) -> list[Block]:
    """Return the table of a forecast, and the distance within each budget."""
    total = float(forecast.distance_m[-1])
    model = f"{model_text(calibration.fitted)} from {counted(len(calibration.logs), 'log')}"
    kinds = [("", forecast)] if gyro is None else [("", forecast), (", with gyro", gyro)]
    rows = []
    for distance_m in sorted({*(distance_m for distance_m in SHOWN_M if distance_m < total), math.floor(total)}):
        k = int(distance_m) - 1
        errors = [f"{column[k]:.2f}" for _, along in kinds for column in (along.expected_m, along.p95_m)]
        rows.append((f"{distance_m:g}", *errors, f"{forecast.heading_std_deg[k]:.1f}"))
    head = [f"{name}{suffix} [m]" for suffix, _ in kinds for name in ("expected", "95 %")]
    blocks: list[Block] = [
        f"{distance_text(total)} without GNSS from the start, wheels alone; {model}",
        "",
        Table("r", rows, ("distance [m]", *head, "heading ± [deg]")),
        "",
    ]
    for budget in budgets_m:
        distances = [(suffix, distance_within(along, budget)) for suffix, along in kinds]
        reached = [
            f"{'the whole path' if distance_m >= total else f'{distance_m:.1f} m'}{suffix}"
            for suffix, distance_m in distances
        ]
        blocks.append(f"within {budget:g} m (95 %): {'; '.join(reached)}")
    if total > (longest := measured_to_m(calibration)):
        blocks.append(f"errors were measured up to {longest:g} m; errors beyond are extrapolated")
    if unknown := "; ".join(TERMS[name].meaning for name in calibration.fitted.not_shown):
        blocks.append(f"not found by the calibration, too small or not driven: {unknown}")
    return [*blocks, *(finding.sentence for finding in calibration.notes)]


def transfer_csv(comparison: documents.GroupComparison) -> bytes:
    """Return the transfer matrix as CSV: one line for each element and horizon."""
    columns = ("calibrated_on", "tested_on", "horizon_m", "trials", *documents.ErrorsAt.__struct_fields__[1:])
    return csv_bytes(columns, ([getattr(cell, name) for name in columns] for cell in comparison.transfer))


def transfer_blocks(comparison: documents.GroupComparison) -> list[Block]:
    """Return the output of `icrtool compare`: verdicts, the transfer matrix, differences of each pair, the logs."""
    names = list(comparison.groups)
    cells = dict.fromkeys(product(names, names), "-")
    for cell in comparison.transfer:
        if cell.horizon_m == CHOICE_HORIZON_M and cell.p95_m is not None and cell.expected_m is not None:
            cells[cell.calibrated_on, cell.tested_on] = f"{cell.p95_m:.2f} / {cell.expected_m:.2f}"
    matrix = [(row, *(cells[row, column] for column in names)) for row in names]
    caption = f"95 % / expected error [m] after {CHOICE_HORIZON_M:g} m, calibrated on row, tested on column"
    chart = (
        "A curve for each calibration, tested in the runs of one group. A calibration of the same group is tested on "
        "what it was not fitted to. Where the bands (95 % interval) of two curves lie apart, the calibrations differ "
        "in use."
    )
    cost: list[Block] = [
        Figure((), "errors", (Chart("error-chart", "Error over distance", chart),)),
        Figure(("transfer",), folded=False),
        Table("lr", matrix, ("", *names), caption),
        "on the diagonal each trial is predicted by a fit that does not contain it",
    ]
    logs = [
        f"{name}: {log.name}, {distance_text(log.distance_m)}" for name in names for log in comparison.groups[name].logs
    ]
    return [
        *(change_sentence(pair, comparison) for pair in comparison.pairs),
        Section("Do they differ?", [Items([pair.verdict for pair in comparison.pairs])], name="verdict"),
        Section("What a calibration costs elsewhere", cost, name="cost"),
        *(_pair_section(pair, f"pair-{number}") for number, pair in enumerate(comparison.pairs, start=1)),
        Section("Logs", [Items(logs)], PAGE, name="logs"),
    ]


class Change(NamedTuple):
    """The difference of the errors of two groups, in words.

    Attributes
    ----------
    found, power : the finding, and the smallest change that would have been seen
    differs : None where it is not known
    """

    found: str
    power: str
    differs: bool | None


def change_sentence(pair: documents.ComparedPair, comparison: documents.GroupComparison) -> str:
    """Return in a sentence whether the errors of two groups differ, and the smallest change that would be seen."""
    change = change_of(pair, comparison)
    return f"{change.found}; {change.power}." if change.power else f"{change.found}."


def change_of(pair: documents.ComparedPair, comparison: documents.GroupComparison) -> Change:
    """Return whether the errors of two groups differ, and the smallest change that would be seen.

    Notes
    -----
    A change is seen where its 95 % interval does not contain zero. A true change of one half width of the interval is
    seen in one of two comparisons, a change of `SEEN_HALF_WIDTHS` half widths in four of five (power of a normal test).
    """
    drives = sum(len(comparison.groups[name].logs) for name in (pair.first, pair.second))
    drives_text = f"with these {counted(drives, 'drive')}"
    measured = (error for error in pair.errors if None not in (error.p95_m, error.p95_low_m, error.p95_high_m))
    row = min(measured, key=lambda error: abs(error.horizon_m - CHOICE_HORIZON_M), default=None)
    names = f"{pair.second} against {pair.first}"
    if row is None or row.p95_m is None or row.p95_low_m is None or row.p95_high_m is None:
        why = "the drives are too short for an interval of the difference"
        return Change(f"{names}: not known: {why}", "", None)
    visible_m = SEEN_HALF_WIDTHS * (row.p95_high_m - row.p95_low_m) / 2.0
    horizon_text = f"(95 % at {row.horizon_m:g} m)"
    power = f"{drives_text} a change below {error_text(visible_m)} {horizon_text} would not have been seen"
    if row.p95_low_m <= 0.0 <= row.p95_high_m:
        return Change(f"{names}: no difference of the error found", power, differs=False)
    word = "larger" if row.p95_m > 0.0 else "smaller"
    size = f"{with_interval(row.p95_m, row.p95_low_m, row.p95_high_m)} {horizon_text}"
    return Change(f"{names}: the error is {word}: {size}", power, differs=True)


def comparison_title(comparison: documents.GroupComparison) -> Title:
    """Return the verdict of a comparison as the heading of its page."""
    changes = [change_of(pair, comparison) for pair in comparison.pairs]
    if len(changes) == 1:
        (change,) = changes
        return Title(_capital(change.found), f"{_capital(change.power)}." if change.power else "")
    differing = sum(change.differs is True for change in changes)
    first = next(iter(comparison.groups))
    return Title(f"{differing} of {counted(len(changes), 'group')} differ from {first} in their error", "")


def _capital(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}"


SEEN_HALF_WIDTHS = (1.96 + 0.84) / 1.96
"""Change that is seen in 80 % of comparisons, in half widths of a 95 % interval: from quantiles of 97.5 and 80 %."""


QUANTITY_WORDS = {
    **{name: f"ICR {word} [m]" for name, word in ICR_WORDS.items()},
    "multiplier": "multiplier", "radius_left": "left wheel radius / configured",
    "radius_right": "right wheel radius / configured",
}  # fmt: skip
"""Words for the quantities of a comparison."""


def _pair_section(pair: documents.ComparedPair, anchor: str) -> Section:
    """Return how parameters and held-out errors of two groups differ; `anchor`: name of its place on a page."""
    rows, errors = [], []
    for parameter in pair.parameters:
        values = (f"{value:+z.3f}" for value in (parameter.first, parameter.second))
        word = QUANTITY_WORDS.get(parameter.quantity, parameter.quantity)
        shown = "yes" if parameter.significant else "no"
        rows.append((word, *values, with_std(parameter.difference, parameter.std, 3), shown))
    for row in pair.errors:
        if row.p95_m is not None and row.expected_m is not None:
            p95 = with_interval(row.p95_m, row.p95_low_m, row.p95_high_m)
            expected = with_interval(row.expected_m, row.expected_low_m, row.expected_high_m)
            errors.append((f"{row.horizon_m:g} m", p95, expected))
    route = ", the same route" if any(error.paired for error in pair.errors) else ""
    caption = f"Error of a fit to other trials, {pair.second} minus {pair.first}{route}, with its 95 % interval"
    head = ("quantity", pair.first, pair.second, "difference ± σ", "shown")
    by_chance = "Parameters; a difference that is not shown may be chance (zero lies in its 95 % interval)"
    tables = [Table("lrrrl", rows, head, by_chance), Table("lr", errors, ("after", "95 %", "expected"), caption)]
    return Section(f"{pair.second} compared with {pair.first}", tables, VERBOSE, name=anchor)
