"""A forecast of errors along a path as text, as rows of CSV and as plain data; a planned path from a file."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from icrtool.calibration.forecast import Forecast
from icrtool.calibration.record import Calibration
from icrtool.errors import RunError
from icrtool.logs.table_file import csv_frame
from icrtool.output.text_blocks import Block, Table, Text
from icrtool.output.text_format import distance_text
from icrtool.records.tables import Floats

PLAN_COLUMNS = ("east_m", "north_m")

SHOWN_M = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)

MEASURED_TO_M = 20.0
"""Held-out windows are this long at most; beyond it the forecast extrapolates."""

LARGEST_PLAN_BYTES = 50_000_000


def read_plan(file: Path) -> tuple[Floats, Floats, Floats | None]:
    """Read a planned path: columns ``east_m``, ``north_m`` and, optional, ``speed_mps``.

    Raises
    ------
    RunError
        The file cannot be read, or a column is missing or holds text.
    """
    import pandas as pd

    advice = "write a CSV file with the columns east_m, north_m and, if you like, speed_mps"
    try:
        if file.stat().st_size > LARGEST_PLAN_BYTES:
            raise RunError(file, f"larger than {LARGEST_PLAN_BYTES / 1e6:g} MB", "thin out its points")
        table = csv_frame(file)
    except OSError as err:
        raise RunError(file, "cannot be read", err.strerror or str(err)) from err
    except ValueError as err:
        raise RunError(file, "not a CSV table", advice) from err
    missing = [name for name in PLAN_COLUMNS if name not in table]
    if missing:
        raise RunError(file, f"no column {missing[0]}", advice)
    columns = [pd.to_numeric(table[name], errors="coerce") for name in (*PLAN_COLUMNS, "speed_mps") if name in table]
    east, north, *speed = (column.to_numpy(np.float64) for column in columns)
    if len(east) < 2:
        raise RunError(file, f"{len(east)} points", "a path has two at least")
    return east, north, speed[0] if speed else None


def forecast_csv(forecast: Forecast) -> str:
    """Return a row for each metre."""
    names = [f"{name}_error_m" if name in {"expected", "p95"} else name for name in _names(forecast)]
    lines = [",".join(names)]
    lines += [",".join(f"{value:.6g}" for value in row) for row in zip(*forecast, strict=True)]
    return "\n".join(lines) + "\n"


def _names(forecast: Forecast) -> list[str]:
    return [name.removesuffix("_m") if name in {"expected_m", "p95_m"} else name for name in forecast._fields]


def forecast_document(forecast: Forecast, calibration: Calibration, budgets_m: tuple[float, ...]) -> dict[str, Any]:
    """Return plain data."""
    columns = dict(zip(forecast_csv(forecast).split("\n", 1)[0].split(","), forecast, strict=True))
    return {
        "schema": "icrtool/forecast/1",
        "calibration": {"name": calibration.name, "model": calibration.recommended, "created": calibration.created},
        "measured_to_m": MEASURED_TO_M,
        "budgets": [{"budget_m": budget, "distance_m": reach(forecast, budget)} for budget in budgets_m],
        "not_shown": list(calibration.fitted.not_shown),
        "warnings": list(calibration.warnings),
        "along": {name: column.tolist() for name, column in columns.items()},
    }


def reach(forecast: Forecast, budget_m: float) -> float:
    """Return the distance [m] up to which 95 % of the errors stay within a budget, interpolated from 0 m at 0 m."""
    p95, distance = np.concatenate([[0.0], forecast.p95_m]), np.concatenate([[0.0], forecast.distance_m])
    beyond = np.flatnonzero(p95 > budget_m)
    if not len(beyond):
        return float(distance[-1])
    k = int(beyond[0])
    share = (budget_m - p95[k - 1]) / (p95[k] - p95[k - 1])
    return float(distance[k - 1] + share * (distance[k] - distance[k - 1]))


def format_forecast(forecast: Forecast, calibration: Calibration, budgets_m: tuple[float, ...]) -> Text:
    """Return the table of a forecast, no line end."""
    total = float(forecast.distance_m[-1])
    logs = "1 log" if len(calibration.logs) == 1 else f"{len(calibration.logs)} logs"
    model = f"{calibration.fitted.model.label} (model {calibration.recommended}) from {logs}"
    rows = []
    for metres in sorted({*(metres for metres in SHOWN_M if metres < total), math.floor(total)}):
        k = int(metres) - 1
        row = (forecast.expected_m[k], forecast.p95_m[k], forecast.heading_std_deg[k])
        rows.append((f"{metres:g}", f"{row[0]:.2f}", f"{row[1]:.2f}", f"{row[2]:.1f}"))
    blocks: list[Block] = [
        f"{distance_text(total)} without GNSS from the start, wheels alone; {model}",
        "",
        Table("r", rows, ("distance [m]", "expected [m]", "95 % [m]", "heading ± [deg]")),
        "",
    ]
    for budget in budgets_m:
        distance = reach(forecast, budget)
        far = "all of it" if distance >= total else f"{distance:.1f} m"
        blocks.append(f"within {budget:g} m (95 %): {far}")
    if total > MEASURED_TO_M:
        blocks.append(f"errors were measured up to {MEASURED_TO_M:g} m; what is beyond is extrapolated")
    blocks += [f"not shown by the calibration's driving: {name}" for name in calibration.fitted.not_shown]
    return Text([*blocks, *calibration.warnings])
