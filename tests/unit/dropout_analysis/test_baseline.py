"""Limits on a baseline: the interval of a difference holds, and a limit fails only beyond it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from icrtool.dropout_analysis.dropout_report import dropout_report
from icrtool.dropout_analysis.report import BaselineReport, DropoutReport, check_gate, parse_gate, pooled_baseline
from icrtool.errors import ConfigError, IcrToolError
from icrtool.fleet.fleet_files import fleet_document, runs_of_fleet
from icrtool.kernels.error_statistics import (
    BlockSums,
    RankedTrials,
    block_sums,
    cut_blocks,
    difference_half_width,
    error_summary,
)
from icrtool.output.dropout_directory import open_baseline, read_baseline
from icrtool.output.files.formats import json_bytes
from icrtool.records.acceptance import Verdict
from icrtool.records.dropout_document import DropoutDocument
from icrtool.records.fleet_document import FleetFile, FleetLog
from icrtool.records.rows import row_of
from icrtool.records.run import Run
from icrtool.records.samples import InputFile
from support.edits import edited

HORIZON = 100
"""Starts per horizon of the made errors."""


def moving_sums(rng: np.random.Generator, starts: int) -> np.ndarray:
    """Errors of overlapping trials: each is the size of a sum of what happened over the horizon."""
    white = rng.normal(0.0, 1.0, (2, starts + HORIZON))
    sums = np.cumsum(white, axis=1)
    return np.hypot(*(sums[:, HORIZON:] - sums[:, :-HORIZON])) / math.sqrt(HORIZON)


def sums_of(errors: np.ndarray) -> tuple[BlockSums, dict[str, float]]:
    blocks = cut_blocks(np.isfinite(errors), np.arange(len(errors), dtype=float), float(HORIZON))
    summary = error_summary(errors[:, np.newaxis])
    found = block_sums(errors, blocks, RankedTrials.from_errors(errors), float(summary.p50[0]), float(summary.p95[0]))
    assert found is not None
    return found, {"expected": float(summary.expected[0]), "p50": float(summary.p50[0]), "p95": float(summary.p95[0])}


def test_block_sums_are_sums() -> None:
    errors = moving_sums(np.random.default_rng(1), 3000)
    found, numbers = sums_of(errors)
    assert found.trials.sum() == len(errors)
    assert found.errors_m.sum() / len(errors) == pytest.approx(numbers["expected"])
    assert found.above_p95.sum() == np.count_nonzero(errors > numbers["p95"])
    for metric in numbers:
        assert abs(found.influence(metric).sum()) < 1e-3
    assert block_sums(errors, None, RankedTrials.from_errors(errors), 1.0, 2.0) is None


@pytest.mark.parametrize(("metric", "least"), [("expected", 0.90), ("p50", 0.90), ("p95", 0.88)])
def test_the_interval_of_two_recordings_holds_no_difference(metric: str, least: float) -> None:
    rng = np.random.default_rng(7)
    held = 0
    for _ in range(300):
        (a, now), (b, before) = sums_of(moving_sums(rng, 3000)), sums_of(moving_sums(rng, 4500))
        half = difference_half_width(a, b, metric, 1.0, paired=False)
        held += abs(now[metric] - before[metric]) <= half
    assert least <= held / 300 <= 0.99


def test_one_recording_is_compared_block_by_block() -> None:
    rng = np.random.default_rng(3)
    errors = moving_sums(rng, 4000)
    changed = 1.05 * errors + 0.02 * moving_sums(rng, 4000)
    a, b = sums_of(changed)[0], sums_of(errors)[0]
    for metric in ("expected", "p95"):
        paired = difference_half_width(a, b, metric, 1.0, paired=True)
        apart = difference_half_width(a, b, metric, 1.0, paired=False)
        assert paired < 0.3 * apart
    assert difference_half_width(b, b, "p95", 1.0, paired=True) == 0.0
    assert math.isnan(difference_half_width(a, b, "max", 1.0, paired=True))
    assert math.isnan(difference_half_width(None, b, "p95", 1.0, paired=True))


@pytest.mark.parametrize(
    ("text", "factor", "bound"),
    [
        ("icr.p95@10m <= 1.1 * baseline", 1.1, 0.0),
        ("icr.p95@10m<=baseline+0.1m", 1.0, 0.1),
        ("icr.p95@10m <= baseline + 0.1 m", 1.0, 0.1),
        ("icr.p95@10m >= .9*baseline - 0.2", 0.9, -0.2),
        ("icr.p95@10m <= baseline", 1.0, 0.0),
        ("icr.p95@10m <= 0.4 m", 0.0, 0.4),
    ],
)
def test_limits_on_a_baseline_are_read(text: str, factor: float, bound: float) -> None:
    gate = parse_gate(text)
    assert (gate.baseline_factor, gate.bound_m) == (factor, bound)


@pytest.mark.parametrize(
    "text", ["icr.p95@10m <= baseline * ", "icr.p95@10m <= baseline 0.1", "icr.p95@10m <= 2 baseline"]
)
def test_other_texts_are_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="not of the form"):
        parse_gate(text)


@pytest.fixture(scope="module")
def report(run: Run) -> DropoutReport:
    return dropout_report(run, horizons_m=[1.0, 2.0, 5.0])


@pytest.fixture
def written(report: DropoutReport, tmp_path: Path) -> Path:
    report.write(tmp_path / "dropout", plots=())
    return tmp_path / "dropout" / "report.json"


def test_a_report_equals_its_own_baseline(report: DropoutReport, written: Path) -> None:
    baseline = open_baseline(written).find("any", ())
    assert baseline is not None
    for model in ("icr", "recommended"):
        verdict = check_gate(parse_gate(f"{model}.p95@2m <= baseline"), report, baseline)
        assert verdict.passed
        assert verdict.margin_m == 0.0
        result = report.result(model)
        assert result is not None
        assert verdict.baseline_m == result.column("p95_m")[1]
    held_out = "controller"
    assert check_gate(parse_gate(f"{held_out}.p95@5m <= baseline"), report, baseline).margin_m == 0.0
    stored, made = baseline.at("icr", 2.0)[1], report.result("icr").block_sums[1]
    for name, column in made._asdict().items():
        np.testing.assert_allclose(getattr(stored, name), column, rtol=1e-5)


def test_a_limit_is_missed_only_beyond_the_interval(report: DropoutReport, written: Path) -> None:
    baseline = read_baseline(written, "earlier")
    gate = parse_gate("icr.p95@2m <= 0.97 * baseline")
    verdict = check_gate(gate, report, other_document(baseline, inputs=(other_file(baseline),)))
    assert verdict.margin_m < 0 < verdict.margin_high_m
    assert verdict.passed
    assert not check_gate(gate, report, baseline, strict=True).passed
    far = check_gate(parse_gate("no_slip.p95@2m <= 0.1 * baseline"), report, baseline)
    assert not far.passed
    assert far.margin_high_m < 0
    for part in (
        "0.1 * baseline",
        f"{far.value_m:.3g} m",
        f"{far.value_bound_m:.3g} m",
        f"{far.margin_m:+.3g} m",
        report.name,
    ):
        assert part in far.verdict
    unknown = check_gate(gate, report)
    assert unknown.passed
    assert unknown.not_checked
    with pytest.raises(ConfigError, match="over 3 m"):
        baseline.number_for(msgspec.structs.replace(gate, horizon_m=3.0))


def other_file(baseline: BaselineReport) -> InputFile:
    """The first file of the baseline's log, with another content."""
    return replace(baseline.document.run.inputs[0], sha256="other")


def other_document(baseline: BaselineReport, **changes: Any) -> BaselineReport:
    """The baseline, with other facts of its run."""
    run = msgspec.structs.replace(baseline.document.run, **changes)
    return replace(baseline, document=msgspec.structs.replace(baseline.document, run=run))


def test_what_changed_is_listed(run: Run, report: DropoutReport, written: Path) -> None:
    baseline = read_baseline(written, "earlier")
    config = baseline.document.run.config.with_filter(gate_probability=0.5)
    other = other_document(baseline, config=config, inputs=(other_file(baseline),))
    other = replace(other, document=msgspec.structs.replace(other.document, tool_version="0.0"))
    changes = other.changes(report.run_document)
    assert [
        any(part in change for change in changes) for part in ("another recording", "filter.gate_probability", "0.0")
    ]
    assert all(
        any(part in change for change in changes) for part in ("recording", "filter.gate_probability", "with 0.0")
    )


def test_a_baseline_is_found_by_content_then_by_name(run: Run, report: DropoutReport, tmp_path: Path) -> None:
    for name in ("a", "b"):
        report.write(tmp_path / "runs" / name / "dropout", plots=())
        file = tmp_path / "runs" / name / "dropout" / "report.json"
        document = json.loads(file.read_bytes())
        document["run"]["log"], document["run"]["inputs"] = name, [{"path": name, "bytes": 1, "sha256": f"sum-{name}"}]
        file.write_text(json.dumps(document), encoding="utf-8")
    baseline = open_baseline(tmp_path / "runs")
    found = baseline.find("b", ["sum-a"])
    assert found is not None
    assert found.log == "a"
    found = baseline.find("b", ["other"])
    assert found is not None
    assert found.log == "b"
    assert baseline.find("c", ["other"]) is None
    assert baseline.missing(["a"]) == ["b"]


def scaled(report: DropoutReport, factor: float) -> DropoutDocument:
    """The document of a report whose errors are larger by a factor."""
    models = [
        msgspec.structs.replace(
            one,
            by_horizon=[
                msgspec.structs.replace(row, p95_m=row.p95_m * factor, expected_error_m=row.expected_error_m * factor)
                for row in one.by_horizon
            ],
        )
        for one in report.document.models
    ]
    return msgspec.structs.replace(report.document, models=models)


def test_a_new_recording_is_compared_with_the_mean_of_the_robots_drives(report: DropoutReport) -> None:
    """A change that drives of one robot differ by is not a failure, a larger one is."""
    value = report.result("no_slip").column("p95_m")[1]

    def verdict(*factors: float) -> Verdict:
        pooled = pooled_baseline([scaled(report, one) for one in factors], "drives", "folder")
        assert not pooled.is_of(report.run_document)
        return check_gate(parse_gate("no_slip.p95@2m <= baseline"), report, pooled)

    found = verdict(0.5, 2.0)
    assert found.baseline_m == pytest.approx(value)
    assert found.margin_m == pytest.approx(0.0, abs=1e-9)
    spread = verdict(0.8, 0.8)
    assert spread.margin_m < 0
    assert spread.passed
    assert not verdict(*[0.2] * 6).passed
    # Drives that are alike give a narrower interval than few, or those that differ.
    widths = [(one.margin_high_m - one.margin_low_m) / one.baseline_m
              for one in (verdict(*[1.0] * 12), verdict(1.0, 1.0), verdict(*[0.3, 3.0] * 6))]  # fmt: skip
    assert widths == sorted(widths)


def test_the_interval_of_pooled_drives_holds_the_next_drive(report: DropoutReport) -> None:
    """Drives drawn with the spread that is known of other robots: 19 of 20 next drives are within the interval.

    Of 100 draws an interval that held 8 of 10 next drives fails with a probability of 0.97.
    """
    rng = np.random.default_rng(5)
    gate = parse_gate("no_slip.expected@2m <= baseline")
    result = report.result("no_slip")
    value, half = result.column("expected_error_m")[1], []
    held, draws, spread = 0, 100, row_of("no_slip").spread.between
    for _ in range(draws):
        # The next drive is the report itself, so the others are drawn about a mean that it was drawn about.
        mean = math.exp(rng.normal(0.0, spread))
        pooled = pooled_baseline(
            [scaled(report, mean * math.exp(rng.normal(0.0, spread))) for _ in range(4)], "drives", "folder"
        )
        before, _ = pooled.number_for(gate)
        half.append(pooled.half_width("no_slip", 2.0, "expected", result.block_sums[1], 1.0, same=False))
        held += abs(value - before) <= half[-1]
    assert 0.88 <= held / draws <= 1.0


def test_drives_of_another_robot_or_group_are_not_pooled(report: DropoutReport, tmp_path: Path) -> None:
    logs = []
    for name, robot, group in (("a", "husky", "grass"), ("b", "husky", "sand"), ("c", "jackal", "grass")):
        report.write(tmp_path / "runs" / name / "dropout", plots=())
        logs.append(FleetLog(name, f"runs/{name}", "done", robot=robot, group=group))
    logs.append(msgspec.structs.replace(logs[0], log="d", usable=False))
    (tmp_path / "fleet.json").write_bytes(json_bytes(fleet_document(logs)))
    baseline = open_baseline(tmp_path)
    assert baseline.drives_of("husky") == ["a", "b"]
    assert baseline.drives_of("husky", "sand") == ["b"]
    assert baseline.drives_of("") == []
    found = baseline.find("new", ["other"], "husky", "")
    assert found is not None
    assert (found.log, len(found.drives)) == ("2 drives of husky", 2)
    assert baseline.find("new", ["other"], "warthog") is None
    baseline.check_compares([("new", (), "warthog", ""), ("c", (), "", "")])
    with pytest.raises(ConfigError, match="robots in it: husky, jackal; robots of the logs: warthog"):
        baseline.check_compares([("new", (), "warthog", "")])


@pytest.mark.parametrize(("old", "new"), [("}", ""), ("by_horizon", "x"), ("icrtool/dropout/", "other/")])
def test_what_is_no_report_is_refused(written: Path, old: str, new: str) -> None:
    written.write_text(written.read_text(encoding="utf-8").replace(old, new), encoding="utf-8")
    with pytest.raises(ConfigError, match="baseline"):
        read_baseline(written, "x")
    with pytest.raises(ConfigError, match="baseline"):
        open_baseline(written.parent / "nothing")


def test_an_edited_baseline_is_refused_in_one_line_or_compared(report: DropoutReport, written: Path) -> None:
    document = json.loads(written.read_text(encoding="utf-8"))
    compared, refusals = 0, []
    read = {key: document.pop(key) for key in ("schema", "tool_version", "run", "models")}
    for _, changed in edited(read, 4):
        whole = document | changed if isinstance(changed, dict) else changed
        written.write_text(json.dumps(whole), encoding="utf-8")
        try:
            baseline = open_baseline(written).find("any", ())
            assert baseline is not None
            for metric in ("p50", "p95", "expected", "max"):
                check_gate(parse_gate(f"icr.{metric}@2m <= 1.1 * baseline"), report, baseline)
            compared += bool(str(baseline.changes(report.run_document)))
        except ConfigError as err:
            refusals.append(str(err))
    assert compared
    assert refusals
    assert not [text for text in refusals if not text.isprintable()]


def test_an_edited_fleet_is_refused_in_one_line_or_used(report: DropoutReport, tmp_path: Path) -> None:
    report.write(tmp_path / "runs" / "a" / "dropout", plots=())
    log = FleetLog("a", "runs/a", "done", robot="r", inputs=(FleetFile("a", 1, 1, "sum-a"),))
    document = json.loads(json_bytes(fleet_document([log])))
    found, refusals = 0, []
    long_name = {**document, "logs": [{**document["logs"][0], "run": "n" * 300}]}
    for _, place in (*edited(document), ("", long_name)):
        (tmp_path / "fleet.json").write_text(json.dumps(place), encoding="utf-8")
        try:
            found += open_baseline(tmp_path).find("a", ["sum-a"]) is not None
            runs_of_fleet(tmp_path)
        except IcrToolError as err:
            refusals.append(str(err))
    assert found > 1
    assert not [text for text in refusals if not text.isprintable()]
