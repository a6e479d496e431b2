"""Documents that earlier states of icrtool wrote are still read: tests/data holds those before they became records."""

from __future__ import annotations

import json
from pathlib import Path

import icrtool
from icrtool.output.files.formats import json_bytes, logs_of_fleet
from icrtool.output.page.pages import read_report, run_page

DATA = Path(__file__).parent / "data"


def test_a_run_is_read_and_written_again_as_it_was(tmp_path: Path) -> None:
    run = icrtool.open_run(DATA / "run")
    assert len(run.document.segments) == 2
    run.write(tmp_path / "run", plots=())
    for name in ("run.json", "events.csv"):
        assert (tmp_path / "run" / name).read_bytes() == (DATA / "run" / name).read_bytes()


def test_a_run_that_lacks_later_keys_has_their_defaults_and_unknown_keys_are_ignored(tmp_path: Path) -> None:
    run = icrtool.open_run(DATA / "run")
    stored = json.loads((DATA / "run" / "run.json").read_bytes())
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
    from hashlib import blake2b

    before = (directory / "run.json").read_bytes()
    after = json_bytes(stored)
    (directory / "run.json").write_bytes(after)
    sums = (directory / "B2SUMS").read_text()
    (directory / "B2SUMS").write_text(sums.replace(blake2b(before).hexdigest(), blake2b(after).hexdigest()))


def test_a_report_is_shown_on_the_page_of_its_run() -> None:
    report = read_report(DATA / "run")
    assert report is not None
    page = run_page(icrtool.open_run(DATA / "run"), report, {})
    assert "icr.p95@5m &lt;= 5" in page


def test_a_calibration_is_read_and_written_again_as_it_was(tmp_path: Path) -> None:
    calibration = icrtool.open_calibration(DATA / "calibration.json")
    assert [log.name for log in calibration.logs] == ["drive", "other"]
    assert calibration.write(tmp_path / "again.json").read_bytes() == (DATA / "calibration.json").read_bytes()


def test_the_logs_of_a_batch_are_read() -> None:
    assert [log.run for log in logs_of_fleet(DATA)] == ["runs/drive", "runs/other"]
