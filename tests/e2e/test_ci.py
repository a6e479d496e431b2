"""docs/ci.md: its commands are run as they stand there, and gates on a baseline decide the exit status.

Its jobs run in tests/e2e/test_ci_jobs.py.
"""

from __future__ import annotations

import json
import re
import shlex
import sys
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from icrtool.cli import main

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "ci.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^ *icrtool ((?!cache warm|batch s3:).*)$", PAGE, re.MULTILINE)
LIMIT = ("--baseline", "baseline", "--gate", "recommended.p95@5m <= 1.1 * baseline")
RATES = ("--duration", "80", "--wheel-rate", "20", "--gnss-rate", "5", "--heading-rate", "20", "--gnss", "0.002")


def call(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["icrtool", *arguments])
    with pytest.raises(SystemExit) as left:
        main()
    return int(left.value.code or 0)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with logs, in which the commands of the page were run one after the other."""
    place = tmp_path_factory.mktemp("repository")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        Path("logs").mkdir()
        for seed, name in enumerate(("field", "other")):
            log = f"logs/{name}.mcap"
            assert call(patch, "simulate", "-q", "--robot", "husky-a200", "-o", log, "--seed", str(seed), *RATES) == 0
        gated, baseline, one_log = (shlex.split(command) for command in COMMANDS)
        written = ("--junit", "gates.xml", "--markdown", "summary.md")
        for command in (baseline, [*gated, *LIMIT, *written], one_log):
            assert call(patch, *command, "-q", "--plots", "none", "--no-page") == 0, command
    return place


def test_a_batch_with_limits_writes_what_a_job_passes_on(place: Path) -> None:
    suites = ET.parse(place / "gates.xml").getroot().findall("testsuite")
    assert [suite.get("name") for suite in suites] == ["field.mcap", "other.mcap"]
    assert all(case.find("failure") is None for suite in suites for case in suite)
    text = (place / "summary.md").read_text(encoding="utf-8")
    assert "All acceptance limits are met" in text
    assert text.count("field.mcap") >= 2
    row = json.loads((place / "results" / "fleet.json").read_bytes())["logs"][0]
    assert row["verdicts"][-1]["baseline_m"] == row["verdicts"][-1]["value_m"]
    assert row["baseline"]["icr_p95_5m_m"] == row["errors"]["icr_p95_5m_m"]


def test_a_batch_has_the_intervals_and_the_next_drive_of_each_report(place: Path) -> None:
    row = json.loads((place / "results" / "fleet.json").read_bytes())["logs"][0]
    report = json.loads((place / "results" / row["run"] / "dropout" / "report.json").read_bytes())
    for model in report["models"]:
        (at,) = (one for one in model["by_horizon"] if one["horizon_m"] == 10.0)
        for end in ("low", "high"):
            assert row["errors"][f"{model['name']}_p95_{end}_10m_m"] == at[f"p95_{end}_m"]
    assert report["budgets"]
    for one in report["budgets"]:
        expected = one["next_low_m"] if one["next_low_m"] is not None or not one["beyond"] else one["distance_m"]
        assert row["errors"][f"{one['model']}_next_low_{one['budget_m']:g}m_m"] == expected


def test_a_gate_beyond_the_interval_fails_and_says_where(place: Path, icrtool, monkeypatch, tmp_path: Path) -> None:
    monkeypatch.chdir(place)
    run = place / "icrtool-runs" / "field"
    gate = "icr_final.p95@1m <= 0.01 * baseline"
    status, out, err = icrtool(
        "dropout-report", run, "--baseline", "baseline", "--gate", gate, "--plots", "none", "--junit",
        tmp_path / "j.xml", "--markdown", tmp_path / "m.md", "--no-ladder",
    )  # fmt: skip
    assert status == 3, err
    assert re.search(r"FAIL .*0\.01 \* baseline: .* m, bound .* margin -.* \(95 %: -.*\(log field\)", out)
    assert ET.parse(tmp_path / "j.xml").getroot().get("failures") == "1"
    text = (tmp_path / "m.md").read_text(encoding="utf-8")
    assert "difference to the baseline" in text
    report = json.loads((run / "dropout" / "report.json").read_bytes())
    assert report["baseline"]["same_recording"] is True
    assert report["gates"][0]["margin_high_m"] < 0


def test_what_is_not_in_the_baseline_is_reported_and_all_of_it_is_an_error(place: Path, icrtool, monkeypatch) -> None:
    monkeypatch.chdir(place)
    baseline = place / "alone"
    (baseline / "runs").mkdir(parents=True)
    document = json.loads((place / "baseline" / "fleet.json").read_bytes())
    for one in document["logs"]:
        one["tool_version"], one["robot"] = "0.0", "another"
        if one["log"] == "field.mcap":
            one["log"], one["inputs"] = "gone.mcap", []
        (baseline / one["run"] / "dropout").mkdir(parents=True)
        report = (place / "baseline" / one["run"] / "dropout" / "report.json").read_text(encoding="utf-8")
        (baseline / one["run"] / "dropout" / "report.json").write_text(report, encoding="utf-8")
    (baseline / "fleet.json").write_text(json.dumps(document), encoding="utf-8")
    lean = ("--plots", "none", "--no-ladder", "--no-page")
    command = ("batch", "logs", "-o", "results", "--robot", "husky-a200", *lean, "--baseline", "alone")
    gate = ("--gate", "icr.p95@5m <= 2 * baseline")
    status, out, err = icrtool(*command, *gate, "--set", "filter.process_icr_mps=0.011", "--json", "--junit", "j.xml")
    assert status == 0, err
    for part in ("gone.mcap", "field.mcap", "filter.process_icr_mps"):
        assert part in err
    rows = {row["log"]: row for row in json.loads(out)["logs"]}
    assert rows["field.mcap"]["verdicts"][0]["not_checked"]
    assert not rows["other.mcap"]["verdicts"][0]["not_checked"]
    assert ET.parse(place / "j.xml").getroot().get("skipped") == "1"
    for one in document["logs"]:
        one["log"], one["inputs"] = f"x{one['log']}", []
    (baseline / "fleet.json").write_text(json.dumps(document), encoding="utf-8")
    status, out, err = icrtool(*command, *gate)
    assert (status, out) == (1, "")
    assert "robots in it: another; robots of the logs: husky-a200" in err
    assert icrtool("dropout-report", "logs/field.mcap", "--robot", "husky-a200", *command[-2:], *gate)[0] == 1
    # New recordings are compared with all drives of their robot, and what is met is printed too.
    for one in document["logs"]:
        one["robot"] = "husky-a200"
    (baseline / "fleet.json").write_text(json.dumps(document), encoding="utf-8")
    status, out, err = icrtool(*command, *gate)
    assert status == 0, err
    assert out.count("pass  icr.p95@5m <= 2 * baseline") == 2
    assert "2 drives of husky-a200" in err
    verdicts = [one["verdicts"][0] for one in json.loads(Path("results/fleet.json").read_bytes())["logs"]]
    assert verdicts[0]["baseline_m"] == pytest.approx(verdicts[1]["baseline_m"])
    assert icrtool("batch", "logs", "-o", "results", *gate)[0] == 1, "a gate on a baseline needs one"
    assert icrtool("batch", "logs", "-o", "results", "--baseline", "results")[0] == 1
