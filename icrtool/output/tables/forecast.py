"""A forecast of errors along a path as text, as rows of CSV and as a document."""

from __future__ import annotations

import math

from msgspec import UNSET

from icrtool import __version__
from icrtool.calibration.forecast import Forecast
from icrtool.calibration.record import Calibration
from icrtool.kernels.arrays import Floats
from icrtool.kernels.error_statistics import within_budget
from icrtool.motion.models import TERMS
from icrtool.output.text_blocks import Block, Table, Text, printed
from icrtool.output.text_format import distance_text, model_text
from icrtool.records.calibration_document import ForecastBudget, ForecastColumns, ForecastDocument, ForecastSource
from icrtool.records.plain_data import known
from icrtool.records.text import counted

SHOWN_M = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)


def forecast_csv(forecast: Forecast, gyro: Forecast | None = None) -> str:
    """Return a row for each metre."""
    columns = _columns(forecast, gyro)
    lines = [",".join(columns)]
    lines += [",".join(f"{value:.6g}" for value in row) for row in zip(*columns.values(), strict=True)]
    return "\n".join(lines) + "\n"


def _columns(forecast: Forecast, gyro: Forecast | None) -> dict[str, Floats]:
    """Return the columns of a forecast, last the errors with a gyro."""
    error = {"expected_m": "expected_error_m", "p95_m": "p95_error_m"}
    columns = {error.get(name, name): column for name, column in forecast._asdict().items()}
    if gyro is not None:
        columns |= {"expected_error_gyro_m": gyro.expected_m, "p95_error_gyro_m": gyro.p95_m}
    return columns


def forecast_document(
    forecast: Forecast, calibration: Calibration, budgets_m: tuple[float, ...], gyro: Forecast | None = None
) -> ForecastDocument:
    """Return what ``icrtool forecast --json`` prints."""
    columns = {name: column.tolist() for name, column in _columns(forecast, gyro).items()}
    return ForecastDocument(
        schema="icrtool/forecast/1",
        tool_version=__version__,
        calibration=ForecastSource(calibration.name or "", calibration.recommended, calibration.created or ""),
        measured_to_m=measured_to_m(calibration),
        budgets=tuple(
            ForecastBudget(
                budget, known(reach(forecast, budget)), UNSET if gyro is None else known(reach(gyro, budget))
            )
            for budget in budgets_m
        ),
        not_shown=calibration.fitted.not_shown,
        warnings=calibration.warnings,
        along=ForecastColumns(**columns),
    )


def measured_to_m(calibration: Calibration) -> float:
    """Return the length [m] of the longest held-out windows; beyond it a forecast extrapolates."""
    return 0.0 if calibration.error_sources is None else calibration.error_sources.measured_to_m


def reach(forecast: Forecast, budget_m: float) -> float:
    """Return the distance [m] up to which 95 % of the errors stay within a budget."""
    found = within_budget(forecast.distance_m, forecast.p95_m, budget_m)
    return math.nan if found is None else found[0]


def format_forecast(
    forecast: Forecast, calibration: Calibration, budgets_m: tuple[float, ...], gyro: Forecast | None = None
) -> Text:
    """Return the table of a forecast, no line end."""
    total = float(forecast.distance_m[-1])
    fitted, logs = calibration.fitted, counted(len(calibration.logs), "log")
    model = f"{model_text(fitted)} from {logs}"
    kinds = [("", forecast)] if gyro is None else [("", forecast), (", with gyro", gyro)]
    rows = []
    for metres in sorted({*(metres for metres in SHOWN_M if metres < total), math.floor(total)}):
        k = int(metres) - 1
        errors = [f"{column[k]:.2f}" for _, one in kinds for column in (one.expected_m, one.p95_m)]
        rows.append((f"{metres:g}", *errors, f"{forecast.heading_std_deg[k]:.1f}"))
    head = [f"{name}{kind} [m]" for kind, _ in kinds for name in ("expected", "95 %")]
    blocks: list[Block] = [
        f"{distance_text(total)} without GNSS from the start, wheels alone; {model}",
        "",
        Table("r", rows, ("distance [m]", *head, "heading ± [deg]")),
        "",
    ]
    for budget in budgets_m:
        far = [(kind, reach(one, budget)) for kind, one in kinds]
        reached = [f"{'all of it' if metres >= total else f'{metres:.1f} m'}{kind}" for kind, metres in far]
        blocks.append(f"within {budget:g} m (95 %): {'; '.join(reached)}")
    if total > (longest := measured_to_m(calibration)):
        blocks.append(f"errors were measured up to {longest:g} m; what is beyond is extrapolated")
    if unknown := "; ".join(TERMS[name].meaning for name in calibration.fitted.not_shown):
        blocks.append(f"not found by the calibration, too small or not driven: {unknown}")
    return printed([*blocks, *calibration.warnings], verbose=True)
