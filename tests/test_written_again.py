"""Documents that are read and written again have the same bytes; keys that are lacking or unknown do no harm."""

from __future__ import annotations

import json
from hashlib import blake2b
from pathlib import Path

import pytest

import icrtool
from icrtool.fleet.fleet_files import fleet_document
from icrtool.output.files.formats import json_bytes, logs_of_fleet
from icrtool.output.page.pages import read_report, run_page
from icrtool.pipeline import fit
from icrtool.records.fleet_document import FleetLog
from support.barn import configured, simulate
from support.documents import with_summary


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run of two terrains and its report, a calibration of two logs, and the list of a batch."""
    folder = tmp_path_factory.mktemp("written")
    run = fit(simulate(), configured(), changes_s=(25.0,))
    other = with_summary(run, log="other", inputs=[{"path": "other", "bytes": 1, "sha256": "other"}])
    run.write(folder / "run", plots=())
    gates = ("icr.p95@5m <= 5",)
    icrtool.dropout_report(run, horizons_m=(1.0, 5.0), gates=gates).write(folder / "run" / "dropout", plots=())
    icrtool.calibrate([run, other]).write(folder / "calibration.json")
    logs = [FleetLog("drive.bag", "runs/drive", "done"), FleetLog("other.bag", "runs/other", "failed")]
    (folder / "fleet.json").write_bytes(json_bytes(fleet_document(logs)))
    return folder


def test_a_run_is_read_and_written_again_as_it_was(written: Path, tmp_path: Path) -> None:
    run = icrtool.open_run(written / "run")
    assert len(run.document.segments) == 2
    run.write(tmp_path / "run", plots=())
    names = {file.name for file in (tmp_path / "run").iterdir()} - {"B2SUMS"}  # it names the report too
    assert names >= {"run.json", "events.csv"}
    for name in names:
        assert (tmp_path / "run" / name).read_bytes() == (written / "run" / name).read_bytes(), name


def test_a_run_that_lacks_later_keys_has_their_defaults_and_unknown_keys_are_ignored(
    written: Path, tmp_path: Path
) -> None:
    run = icrtool.open_run(written / "run")
    stored = json.loads((written / "run" / "run.json").read_bytes())
    for key in ("heading_is_measured", "turn_wander_rad", "antenna_is_known"):
        del stored["facts"][key]
    del stored["reference_jumps"], stored["icr"]["x_clock_std_m"]
    stored["gnss"]["later"] = stored["later"] = [1]
    run.write(tmp_path / "run", plots=())
    rewrite(tmp_path / "run", stored)
    found = icrtool.open_run(tmp_path / "run").document
    assert found.reference_jumps == ()
    assert found.icr.x_clock_std_m == 0.0
    assert "later" not in icrtool.open_run(tmp_path / "run").summary


def rewrite(directory: Path, stored: dict[str, object]) -> None:
    """Replace run.json, with its checksum."""
    before = (directory / "run.json").read_bytes()
    after = json_bytes(stored)
    (directory / "run.json").write_bytes(after)
    sums = (directory / "B2SUMS").read_text()
    (directory / "B2SUMS").write_text(sums.replace(blake2b(before).hexdigest(), blake2b(after).hexdigest()))


def test_a_report_is_shown_on_the_page_of_its_run(written: Path) -> None:
    report = read_report(written / "run")
    assert report is not None
    page = run_page(icrtool.open_run(written / "run"), report, {})
    assert "icr.p95@5m &lt;= 5" in page


def test_a_calibration_is_read_and_written_again_as_it_was(written: Path, tmp_path: Path) -> None:
    calibration = icrtool.open_calibration(written / "calibration.json")
    assert [log.name for log in calibration.logs] == ["barn", "other"]
    assert calibration.write(tmp_path / "again.json").read_bytes() == (written / "calibration.json").read_bytes()


def test_the_logs_of_a_batch_are_read(written: Path) -> None:
    assert [log.run for log in logs_of_fleet(written)] == ["runs/drive"]
