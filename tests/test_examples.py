"""The notebooks in examples/ run as they are."""

from __future__ import annotations

import ast
import json
import os
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOK = ROOT / "examples" / "from_log_to_calibration.ipynb"


def code_cells(notebook: Path) -> list[str]:
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def test_the_notebook_runs_and_its_calibration_predicts_the_other_log(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(NOTEBOOK.parent)
    names: dict[str, Any] = {}
    with mpl.rc_context({"figure.max_open_warning": 0}):
        mpl.use("agg")
        for cell in code_cells(NOTEBOOK):
            exec(compile(cell, str(NOTEBOOK), "exec"), names)
        names["plt"].close("all")
    rows = names["rows"]
    assert np.isfinite(rows[["calibration", "no_slip", "icr"]].to_numpy()).all()
    assert (rows["calibration"] < 0.5 * rows["no_slip"]).all()
    # The stored table and its explanation have these numbers.
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    place = next(i for i, cell in enumerate(cells) if cell["source"][-1] == "rows.round(3)")
    lines = "".join(cells[place]["outputs"][0]["data"]["text/plain"]).splitlines()
    stored = np.array([line.split()[1:] for line in lines[2:]], float)
    assert lines[0].split()[1:] == list(rows.columns)
    assert stored == pytest.approx(rows.to_numpy(), rel=0.02, abs=0.003)
    explained = "".join(cells[place + 1]["source"])
    assert all(
        f"{stored[2, list(rows.columns).index(name)]:.3f} m" in explained
        for name in ("calibration", "calibration_gyro", "icr_final")
    )
    # The two ways to predict the other log agree on what the calibration is worth there.
    states = names["other"].states
    off = np.hypot(names["north"][-1] - states["north_m"].iloc[-1], names["east"][-1] - states["east_m"].iloc[-1])
    assert off < 0.1 * states["distance_m"].iloc[-1]


def test_the_notebook_is_stored_with_results_and_no_warnings() -> None:
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    outputs = [one for cell in cells if cell["cell_type"] == "code" for one in cell["outputs"]]
    assert sum("image/png" in one.get("data", {}) for one in outputs) >= 5
    assert {one["output_type"] for one in outputs} <= {"stream", "display_data", "execute_result"}
    assert all(one.get("name", "stdout") == "stdout" for one in outputs)
    assert all(ast.parse(cell) for cell in code_cells(NOTEBOOK))


def test_elsewhere_the_notebook_states_where_it_runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileNotFoundError, match="checkout of icrtool"):
        exec(compile(code_cells(NOTEBOOK)[0], str(NOTEBOOK), "exec"), {})


@pytest.mark.stress
def test_jupyter_runs_the_notebook() -> None:
    nbclient = pytest.importorskip("nbclient", reason="Jupyter is not installed: pip install nbclient ipykernel")
    nbformat = pytest.importorskip("nbformat")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(notebook)
    client = nbclient.NotebookClient(
        notebook, timeout=300, resources={"metadata": {"path": os.fspath(NOTEBOOK.parent)}}
    )
    client.execute()
    shown = [kind for cell in notebook.cells for out in cell.get("outputs", []) for kind in out.get("data", {})]
    assert shown.count("image/png") >= 5
