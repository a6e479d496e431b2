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

from icrtool.calibration.transfer import Difference, ErrorEstimate
from icrtool.fleet.roll_up import PooledCalibration
from icrtool.fleet.row import Row
from icrtool.motion.models import TrackGeometry
from icrtool.records.calibration_document import CalibrationDocument, CalibrationLog
from icrtool.records.dropout_document import DropoutDocument
from icrtool.records.run_document import RunDocument

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
