"""JSON schemas of the documents that icrtool writes, from the types that the code uses, into docs/reference/schemas/.

Numbers that are not known are null. A document may hold more keys than its schema; none is renamed within a version.
"""

from __future__ import annotations

import inspect
import json
from pathlib import Path

import msgspec

from icrtool.records.calibration_document import CalibrationDocument, ForecastDocument, GroupComparison
from icrtool.records.dropout_document import DropoutDocument
from icrtool.records.fleet_document import FleetDocument
from icrtool.records.run_document import RunDocument

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "reference" / "schemas"

DOCUMENTS: dict[str, type] = {
    "run": RunDocument,
    "dropout": DropoutDocument, "calibration": CalibrationDocument, "compare": GroupComparison,
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
        for record in schema["$defs"].values():
            if "description" in record:
                # A docstring, which Python 3.13 and later keep without its indentation.
                record["description"] = inspect.cleandoc(record["description"])
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
