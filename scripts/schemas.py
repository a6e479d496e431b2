"""JSON schemas of the documents that icrtool writes, from the types that the code uses, into docs/reference/schemas/.

Numbers that are not known are null. A document may hold more keys than its schema; none is renamed within a version.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, TypedDict, get_type_hints

import msgspec
import numpy as np

from icrtool.calibration.error_differences import ErrorEstimate
from icrtool.calibration.transfer import Difference
from icrtool.config import Config
from icrtool.fleet.roll_up import PooledCalibration
from icrtool.fleet.row import Row
from icrtool.kernels.open_loop.block_sums import BlockSums
from icrtool.motion.models import TrackGeometry
from icrtool.records.calibration_document import CalibrationDocument, CalibrationLog
from icrtool.records.dropout import BudgetDistance, Gate, UsedCalibration
from icrtool.records.run_document import DriveDocument, IcrDocument, RunDocument
from icrtool.records.samples import InputFile

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "reference" / "schemas"

Number = float | None
Numbers = list[Number]


def record(kind: type, name: str = "", **keys: object) -> type:
    """Return the type of a record as plain data; `keys` are further keys, or replace those of the record."""
    hints = {field: _nullable(hint) for field, hint in get_type_hints(kind).items()}
    return plain(name or kind.__name__, hints | keys)


def plain(name: str, keys: Mapping[str, Any], *, total: bool = True) -> type:
    """Return the type of a JSON object; with `total` every key is there."""
    return TypedDict(name, keys, total=total)  # type: ignore[operator] - the functional form


def _nullable(hint: object) -> object:
    if hint is float:
        return Number
    return Numbers if getattr(hint, "__origin__", None) is np.ndarray else hint


SUMMARY = {
    "horizon_m": float, "trials": int, "expected_error_m": Number, "p50_m": Number, "p95_m": Number, "max_m": Number,
}  # fmt: skip
Summary = plain("Summary", SUMMARY)
SummaryRow = plain("SummaryRow", SUMMARY | dict.fromkeys(
    ("expected_pct", "p95_pct", "expected_low_m", "expected_high_m", "p95_low_m", "p95_high_m",
     "heading_expected_deg", "heading_p95_deg"), Number
))  # fmt: skip
Blocks = record(BlockSums, "Blocks", horizon_m=float, errors_m=list[float], trials=list[int], above_p50=list[int],
                above_p95=list[int])  # fmt: skip
ModelRows = plain("ModelRows", {
    "name": str, "label": str, "knows": str | None, "by_horizon": list[SummaryRow], "blocks": list[Blocks],
})  # fmt: skip
NoTrial = plain("NoTrial", dict.fromkeys(
    ("too_little_way_left", "across_wheel_gap", "ends_in_gnss_outage", "from_standstill", "crosses_jump",
     "across_slip_event"), int
))  # fmt: skip
TrialCount = plain("TrialCount", {
    "horizon_m": float, "trials": int, "no_trial": NoTrial, "why_none": str | None,
})  # fmt: skip
OwnError = plain("OwnError", {
    "horizon_m": float, "std_m": Number, "expected_m": Number, "p95_m": Number,
})  # fmt: skip
Learned = plain("Learned", {
    "model": str, "learned_s": Number, "learned_at_distance_m": Number, "before": list[Summary], "after": list[Summary],
})  # fmt: skip
EventCost = plain("EventCost", {"events": int, "with_events": dict[str, list[Summary]]})
Used = record(UsedCalibration, fitted=str)
Split = plain("Split", {"straight": bool, "horizon_m": float, "trials": int, "expected_m": dict[str, Number]})
Score = plain("Score", {
    "name": str, "label": str, "fitted": str, "heading": str, "trials": list[int], "expected_error_m": Numbers,
    "p50_m": Numbers, "p95_m": Numbers, "max_m": Numbers,
})  # fmt: skip
Fit = plain("Fit", {"value": dict[str, Number], "std": dict[str, Number]})
Ladder = plain("Ladder", {
    "left_out": str, "horizons_m": list[float], "blocks": int, "starts": int, "heading": str | None,
    "notes": list[str], "models": list[Score], "width_m": float, "fits": dict[str, Fit],
}, total=False)  # fmt: skip
GateDocument = record(
    Gate, value_m=Number, value_bound_m=Number, baseline_m=Number, margin_m=Number, margin_low_m=Number,
    margin_high_m=Number, not_checked=str | None, unusable=str | None, passed=bool, verdict=str,
)  # fmt: skip
BaselineDocument = plain("BaselineDocument", {
    "path": str, "log": str, "tool_version": str, "same_recording": bool, "changes": list[str],
})  # fmt: skip
Outage = plain("Outage", {
    "kind": Literal["forced", "real"], "begin_s": float, "end_s": float, "distance_m": float, "end_error_m": Number,
    "max_error_m": Number,
})  # fmt: skip
Trial = plain("Trial", {
    "model": str,
    "stamp_ns": int, "t_s": float, "north_m": float, "east_m": float, "horizon_m": float, "heading_change_deg": float,
    "speed_mean_mps": float, "errors_m": dict[str, Number],
})  # fmt: skip
RunOfReport = plain("RunOfReport", {
    "schema": Literal["icrtool/run/1"], "tool_version": str, "log": str, "inputs": list[InputFile],
    "config": Config, "drive": DriveDocument, "icr": IcrDocument,
})  # fmt: skip
Bootstrap = plain("Bootstrap", {"method": str, "block": str, "resamples": int, "level": float, "seed": int})
Bootstrap.__doc__ = (
    "How the intervals of the errors were found: by `method` over `block`, at `level`. The key keeps the name of "
    "earlier versions; `resamples` is 0 where nothing was resampled. `seed` is that of the reference's own error."
)
DropoutDocument = plain("DropoutDocument", {
    "schema": Literal["icrtool/dropout/1"], "tool_version": str, "run": RunOfReport, "usable": bool,
    "unusable_because": str | None, "reference": str, "smoothed": bool, "starts": int,
    "starts_counted": Literal["moving", "all"], "starts_standing": int, "with_jumps": bool,
    "without_events": EventCost | None,
    "tolerance_m": float, "bootstrap": Bootstrap, "models": list[ModelRows], "trials": list[TrialCount],
    "reference_error": list[OwnError], "by_learning": Learned | None, "calibrations": list[Used],
    "recommended": CalibrationDocument | None, "budgets": list[record(BudgetDistance)], "by_turning": list[Split],
    "ladder": Ladder, "gates": list[GateDocument], "passed": bool, "baseline": BaselineDocument | None,
    "outages": list[Outage], "worst": list[Trial], "examples": list[Trial],
})  # fmt: skip

Group = plain("Group", {"model": str, "logs": list[CalibrationLog], "geometry": record(TrackGeometry)})
PLACE = {"calibrated_on": str, "tested_on": str, "horizon_m": float}
PairDocument = plain("PairDocument", {
    "first": str, "second": str, "parameters": list[record(Difference, significant=bool)],
    "errors": list[record(ErrorEstimate, "ErrorChange", horizon_m=float, paired=bool)], "verdict": str,
})  # fmt: skip
CompareDocument = plain("CompareDocument", {
    "schema": Literal["icrtool/compare/1"], "groups": dict[str, Group], "pairs": list[PairDocument],
    "transfer": list[record(ErrorEstimate, "Cell", **PLACE, trials=int)],
    "costs": list[record(ErrorEstimate, "Cost", **PLACE)],
})  # fmt: skip

Source = plain("Source", {"name": str, "model": str, "created": str})
Reach = plain("Reach", {"budget_m": float, "distance_m": float})
Along = plain("Along", dict.fromkeys(
    ("distance_m", "east_m", "north_m", "expected_error_m", "p95_error_m", "std_east_m", "std_north_m",
     "heading_std_deg"), Numbers
))  # fmt: skip
ForecastDocument = plain("ForecastDocument", {
    "schema": Literal["icrtool/forecast/1"], "calibration": Source, "measured_to_m": float, "budgets": list[Reach],
    "not_shown": list[str], "warnings": list[str], "along": Along,
})  # fmt: skip

FleetVerdict = plain("FleetVerdict", {
    "gate": str, "passed": bool, "line": str, "relative": bool, "not_checked": str, **dict.fromkeys(
        ("value_m", "margin_m", "bound_m", "baseline_m", "margin_low_m", "margin_high_m"), Number
    ),
})  # fmt: skip
Counts = plain("Counts", {"done": int, "failed": int, "skipped": int})
FleetDocument = plain("FleetDocument", {
    "schema": Literal["icrtool/fleet/1"], "tool_version": str, "counts": Counts, "gates_failed": int,
    "calibrations": list[PooledCalibration], "logs": list[record(Row, verdicts=list[FleetVerdict])],
})  # fmt: skip

DOCUMENTS: dict[str, type] = {
    "run": RunDocument,
    "dropout": DropoutDocument, "calibration": CalibrationDocument, "compare": CompareDocument,
    "forecast": ForecastDocument, "fleet": FleetDocument,
}  # fmt: skip
"""By the middle of the schema's name, ``icrtool/<name>/1``."""


def schemas() -> dict[str, str]:
    """Return each schema as JSON text, by the name of its file."""
    found = {}
    for name, kind in DOCUMENTS.items():
        schema = msgspec.json.schema(kind)
        if "Config" in schema["$defs"]:
            del schema["$defs"]["Config"]["properties"]["given"]  # which keys were set is not written
        head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": f"icrtool/{name}/1"}
        found[f"{name}-1.json"] = json.dumps(head | schema, indent=1, sort_keys=True) + "\n"
    return found


def main() -> None:
    """Write the files."""
    FOLDER.mkdir(exist_ok=True)
    for name, text in schemas().items():
        (FOLDER / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
