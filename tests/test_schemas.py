"""The schemas of the documents: they are those of the code, documents keep to them, and no key is undocumented."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from icrtool.calibration.error_growth import forecast_drive
from icrtool.calibration.pooled import calibrate, recording_of
from icrtool.calibration.transfer import compare_groups
from icrtool.dropout_analysis.dropout_report import dropout_report
from icrtool.dropout_analysis.report import parse_gate, verdict_on
from icrtool.fleet.fleet_files import fleet_document
from icrtool.output.files.formats import json_bytes
from icrtool.output.tables.calibration import forecast_document
from icrtool.pipeline import fit
from icrtool.records.fleet_document import FleetCalibration, FleetFile, FleetLog, fleet_verdict
from icrtool.records.text import LogText
from support.barn import configured, simulate
from support.documents import with_summary
from support.scripts import load_script

ROOT = Path(__file__).resolve().parents[1]


SCRIPT = load_script("schemas")
schemas = functools.cache(SCRIPT.schemas)


@pytest.fixture(scope="module")
def documents() -> dict[str, Any]:
    """A document of every kind, read back from JSON."""
    run, twin = (fit(simulate(turn_mps=turn), configured()) for turn in (0.25, 0.3))
    other = with_summary(twin, inputs=[{"path": "b", "bytes": 1, "sha256": "b"}])
    calibration = calibrate(run)
    report = dropout_report(
        run, horizons_m=(1.0, 5.0), outage_s=(4.0,), gates=("icr.p95@5m <= 0.001",), calibrations=[calibration],
        without_events=True,
    )  # fmt: skip
    gate = verdict_on(parse_gate("icr.p95@5m <= 1"), "a", passed=True, value_m=0.5, margin_m=0.5)
    row = FleetLog(
        "a.bag", "runs/a", "done", verdicts=(fleet_verdict(gate, "a"),), inputs=(FleetFile("a.bag", 1, 2, "ab"),),
        icr={"x_icr_m": None},
    )  # fmt: skip
    pooled = FleetCalibration("jackal", "grass", ("a.bag",), ())
    found = {
        "run": run.summary,
        "dropout": report.document,
        "calibration": calibration.summary(),
        "compare": compare_groups({LogText("one"): [run], LogText("two"): [other]}),
        "forecast": forecast_document(forecast_drive(calibration, recording_of(run)), calibration, (0.5,)),
        "fleet": fleet_document([row], [pooled]),
    }
    return {name: json.loads(json_bytes(document)) for name, document in found.items()}


def test_the_schemas_in_the_documentation_are_those_of_the_code() -> None:
    stored = {file.name: file.read_text(encoding="utf-8") for file in SCRIPT.FOLDER.glob("*.json")}
    assert stored == schemas(), "run scripts/schemas.py"


@pytest.mark.parametrize("name", sorted(SCRIPT.DOCUMENTS))
def test_a_document_keeps_to_its_schema(documents: dict[str, Any], name: str) -> None:
    msgspec.convert(documents[name], SCRIPT.DOCUMENTS[name])
    damaged = {**documents[name], "schema": f"icrtool/{name}/2"}
    with pytest.raises(msgspec.ValidationError, match="schema"):
        msgspec.convert(damaged, SCRIPT.DOCUMENTS[name])


def undocumented(value: Any, schema: dict[str, Any], whole: dict[str, Any], place: str = "") -> Iterator[str]:
    """Yield the keys of a document that its schema does not have."""
    if "$ref" in schema:
        schema = whole["$defs"][schema["$ref"].rpartition("/")[2]]
    for choice in schema.get("anyOf", ()):
        if value is not None and choice.get("type") != "null":
            yield from undocumented(value, choice, whole, place)
    if isinstance(value, list):
        for one in value[:3]:
            yield from undocumented(one, schema.get("items", {}) or {}, whole, place)
    known, others = schema.get("properties"), schema.get("additionalProperties")
    for key, one in value.items() if isinstance(value, dict) else ():
        if known is not None and key in known:
            yield from undocumented(one, known[key], whole, f"{place}.{key}")
        elif isinstance(others, dict):
            yield from undocumented(one, others, whole, f"{place}.{key}")
        elif known is not None:
            yield f"{place}.{key}"


@pytest.mark.parametrize("name", sorted(SCRIPT.DOCUMENTS))
def test_no_key_is_undocumented(documents: dict[str, Any], name: str) -> None:
    schema = json.loads(schemas()[f"{name}-1.json"])
    assert not list(undocumented(documents[name], schema, schema))
