"""What a batch leaves: groups, pooled calibrations, figures."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from msgspec.structs import replace

from icrtool.cli.batch import line_of, summary_of
from icrtool.cli.inputs import groups_of, runs_or_logs
from icrtool.errors import RunError
from icrtool.fleet.fleet_files import (
    calibrations_text,
    fleet_blocks,
    pooled_calibrations,
    runs_of_fleet,
    write_fleet,
)
from icrtool.output.files.formats import open_calibration
from icrtool.output.text_blocks import format_markdown
from icrtool.records.fleet_document import FleetCalibration, FleetFile, FleetLog
from icrtool.records.run import Run
from support.documents import with_summary


def write(run: Run, directory: Path, sha: str) -> None:
    """Write a run as that of another file."""
    named = with_summary(run, inputs=[{"path": sha, "bytes": 1, "sha256": sha}])
    named.write(directory, plots=())


@pytest.fixture(scope="module")
def place(run: Run, make_run: Callable[..., Run], tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("fleet")
    for name, one, sha in (("a", run, "1"), ("b", make_run(duration_s=70.0), "2"), ("copy", run, "1")):
        write(one, place / "runs" / name, sha)
    return place


CONTENT = {"a": "1", "b": "2", "copy": "1", "c": "3"}


def rows(*names: str, group: str = "grass", **values: object) -> list[FleetLog]:
    """Return rows of logs; "c" is not usable, and no run of it is there to be read."""
    return [
        FleetLog(name, f"runs/{name}", "done", robot="barn", group=group, key="k",
            inputs=(FleetFile(name, 1, 1, CONTENT.get(name, name)),), **{"usable": name != "c"} | values)
        for name in names
    ]  # fmt: skip


def test_a_summary_in_markdown_has_every_log_beside_the_baseline_and_escapes_names() -> None:
    errors = {"recommended_p95_10m_m": 1.2}
    (done,) = rows("a|b*c", errors=errors, baseline=errors, changes=("x_y changed",))
    failed = replace(rows("d")[0], status="failed", reason="no <wheels>")
    lines = format_markdown(fleet_blocks([done, failed], ["gone"])).splitlines()
    assert lines[:3] == ["## 2 logs", "", "1 done, 1 failed"]
    table = [line for line in lines if line.startswith("|")]
    assert table[2] == "| a\\|b\\*c | 1.200 m | 1.200 m | +0.000 m |"
    assert "no \\<wheels\\>" in table[3]
    assert lines[-2:] == ["- not in this batch, but in the baseline: gone", "- a\\|b\\*c: x\\_y changed"]


def test_the_logs_of_a_robot_and_group_have_one_calibration(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    logs = [*rows("a", "b", "c", "copy"), *rows("c", group="ice"), FleetLog("d", "runs/d", "failed", robot="barn")]
    grass, ice = found = list(pooled_calibrations(logs, place))
    assert (grass.group, grass.logs, grass.left_out) == ("grass", ("a", "b"), ("c", "copy"))
    calibration = open_calibration(place / grass.file)
    assert (len(calibration.logs), calibration.recommended) == (2, grass.recommended)
    assert grass.multiplier == pytest.approx(calibration.controller.multiplier)
    assert "each log left out in turn (2 logs)" in grass.table
    assert (ice.file, ice.logs) == ("", ("c",))
    assert "usable" in ice.reason
    lines = calibrations_text(found).splitlines()
    assert sum(not line.startswith("  ") for line in lines) == len(found)
    assert max(map(len, lines)) <= 80
    assert grass.within is not None
    far = f"within 0.5 m (95 %) for {grass.within.short_text} with recommended, in"
    numbers = f"multiplier {grass.multiplier:.4f} ± {grass.multiplier_std:.4f}, {far}"
    assert numbers in " ".join(calibrations_text(found).split())
    write_fleet(logs, place, found)
    monkeypatch.setattr("icrtool.fleet.fleet_files.open_run", None)
    assert list(pooled_calibrations(logs, place)) == found, "nothing changed: nothing is fitted"
    with pytest.raises(TypeError):
        list(pooled_calibrations(logs[:1], place))


def test_of_many_logs_some_are_calibrated_together(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("icrtool.fleet.fleet_files.MOST_POOLED_S", 300.0)
    (one,) = pooled_calibrations(rows("a", "b", "copy", duration_s=300.0), place)
    assert (one.logs, one.left_out, one.reason) == (("a",), ("b", "copy"), "")


def test_a_fleet_s_groups_are_those_of_its_manifest(place: Path) -> None:
    logs = [*rows("a", multiplier=1.5), *rows("b", "copy", group="ice", multiplier=1.5)]
    logs += [*rows("unusable", usable=False), FleetLog("d", "runs/d", "failed", robot="barn")]
    write_fleet(logs, place)
    groups = {"grass": [place / "runs/a"], "ice": [place / "runs/b", place / "runs/copy"]}
    assert runs_of_fleet(place) == groups_of((str(place),)) == groups
    write_fleet([*logs, *rows("a", multiplier=1.5)], place)
    assert runs_of_fleet(place) == groups, "a copy in the same group would be tested on itself"
    assert runs_or_logs(place) == [run for runs in groups.values() for run in runs]
    write_fleet([*logs, FleetLog("e", "runs/e", "done", robot="other", group="ice", multiplier=1.5)], place)
    assert list(runs_of_fleet(place)) == ["barn grass", "barn ice", "other ice"]
    with pytest.raises(RunError):
        runs_of_fleet(place / "runs")


def test_figures_show_what_there_is(tmp_path: Path) -> None:
    icr = {"y_icr_right_m": 0.5, "y_icr_left_m": -0.5, "std_y_icr_right_m": 0.01, "std_y_icr_left_m": 0.01}
    dates = ("2024-05-01T10:00:00Z", "2024-05-02T10:00:00Z")
    good = [replace(row, start_utc=date) for row, date in
            zip(rows("a", "$b_x", icr=icr, errors={"icr_p95_10m_m": 0.3}), dates, strict=True)]  # fmt: skip
    failed = FleetLog("f", "runs/f", "failed", reason="no wheels found; needs a JointState (tried twice)")
    write_fleet([*good, failed], tmp_path, (), ("png",))
    assert {file.name for file in (tmp_path / "plots").iterdir()} == {"icrs.png", "errors.png"}
    write_fleet(good, tmp_path, (), ("svg",))
    assert {file.name for file in (tmp_path / "plots").iterdir()} == {"icrs.svg", "errors.svg"}
    assert json.loads((tmp_path / "fleet.json").read_bytes())["calibrations"] == []


def test_hostile_names_of_robots_and_groups_stay_text() -> None:
    hostile = "\x1b[2J\nError: \u202e" + "n" * 300
    found = FleetCalibration(hostile, hostile, ("a",), reason=hostile)
    assert max(map(len, calibrations_text([found]).split("\n"))) < 600
    row = FleetLog(hostile, "runs/a", "done", robot=hostile, group=hostile)
    for text in (calibrations_text([found]), line_of(row), summary_of([row], Path(hostile[:50]), "fleet.csv")):
        assert text.replace("\n", "").isprintable()
