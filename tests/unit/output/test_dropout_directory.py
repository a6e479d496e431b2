"""RUN/dropout/: its files, their columns and their numbers."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from icrtool.dropout_analysis.dropout_report import dropout, dropout_report
from icrtool.dropout_analysis.report import DropoutReport
from icrtool.errors import OutputError
from icrtool.kernels.error_statistics import LEVEL, NEXT_LEVEL
from icrtool.output.dropout_directory import (
    TRIALS_FILE,
    is_dropout_directory,
    trials_file,
    write_report,
    write_tables,
)
from icrtool.output.files import atomic
from icrtool.output.files.formats import json_bytes
from icrtool.records.dropout_document import DropoutDocument
from icrtool.records.run import Run
from support.contract import SUMMARY_COLUMNS

HORIZONS_M = [1.0, 5.0, 10.0, 900.0]
GATES = ("icr.p95@5m <= 100", "icr.p95@5m <= 0.001", "icr.max@900m <= 1")


def content_of(run: Run, horizons_m: list[float] | None = None, gates: tuple[str, ...] = GATES) -> DropoutReport:
    return dropout_report(
        run, horizons_m=horizons_m or HORIZONS_M, gates=gates, outage_s=(4.0,), outage_at_s=(15.0,), ladder=False
    )


@pytest.fixture(scope="module")
def content(run: Run) -> DropoutReport:
    return content_of(run)


@pytest.fixture(scope="module")
def written(content: DropoutReport, tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("run")
    content.write(directory / "dropout", plots=())
    return directory / "dropout"


def test_summary_csv_is_the_summary_to_the_last_bit(written: Path, content: DropoutReport) -> None:
    read = pd.read_csv(written / "summary.csv")
    pd.testing.assert_frame_equal(read, content.summary, check_exact=True, check_dtype=False)
    assert list(read.columns)[:9] == SUMMARY_COLUMNS
    assert len(read) == 3 * len(HORIZONS_M)
    text = (written / "summary.csv").read_text(encoding="utf-8")
    assert "nan" not in text.lower()
    assert "\nicr,900.0,0,,,," in text


def test_histogram_csv_holds_all_trials_of_every_model_and_horizon(written: Path, content: DropoutReport) -> None:
    read = pd.read_csv(written / "histogram.csv")
    assert list(read.columns) == ["model", "horizon_m", "bin_left_m", "bin_right_m", "percent"]
    sums = read.groupby(["model", "horizon_m"]).percent.sum()
    assert len(sums) == 9
    np.testing.assert_allclose(sums, 100.0)
    assert (read.bin_right_m > read.bin_left_m).all()
    bins = read[(read.model == "icr") & (read.horizon_m == 5.0)]
    assert bins.percent.tolist() == content.results[0].histograms[1].percent.tolist()


def test_report_json_says_the_same_and_why(written: Path, content: DropoutReport, run: Run) -> None:
    document = json.loads((written / "report.json").read_bytes())
    read = pd.read_csv(written / "summary.csv")
    rows = pd.DataFrame(
        [{"model": model["name"], **row} for model in document["models"] for row in model["by_horizon"]]
    )
    pd.testing.assert_frame_equal(rows, read, check_exact=True, check_dtype=False)
    assert document["schema"] == "icrtool/dropout/1"
    assert document["starts"] == len(run.table)
    for row in document["trials"]:
        assert row["trials"] + sum(row["no_trial"].values()) == len(run.table)
    assert document["trials"][1]["no_trial"].keys() == {
        "too_little_way_left",
        "across_wheel_gap",
        "across_slip_event",
        "crosses_jump",
        "ends_in_gnss_outage",
        "from_standstill",
    }
    assert [row["why_none"] is None for row in document["trials"]] == [row["trials"] > 0 for row in document["trials"]]
    own, split = content.document.reference_error, content.document.by_learning
    assert own is not None
    assert split is not None
    assert [row["p95_m"] for row in document["reference_error"]] == [row.p95_m for row in own]
    assert document["by_learning"]["learned_s"] == split.learned_s
    for part, summary in (("before", split.before), ("after", split.after)):
        rows = document["by_learning"][part]
        assert [row["trials"] for row in rows] == [row.trials for row in summary]
        assert [row["p95_m"] for row in rows] == [row.p95_m for row in summary]
    assert document["intervals"]["seed"] == content.document.intervals.seed
    assert {"method", "block"} <= document["intervals"].keys()
    assert (document["intervals"]["level"], document["intervals"]["next_level"]) == (LEVEL, NEXT_LEVEL)
    assert document["tolerance_m"] <= 1e-9
    assert document["run"]["inputs"] == json.loads(json_bytes({"x": run.summary["inputs"]}))["x"]
    assert [gate["passed"] for gate in document["gates"]] == [True, False, False]
    assert document["gates"][2]["value_m"] is None
    assert document["passed"] is False
    assert {outage["kind"] for outage in document["outages"]} == {"forced", "real"}
    assert document["budgets"][0].keys() == {
        "model",
        "budget_m",
        "distance_m",
        "beyond",
        "between_m",
        "low_m",
        "high_m",
        "next_low_m",
        "next_high_m",
        "without_events_m",
        "beyond_without_events",
    }


def test_worst_csv_has_a_row_a_drive(written: Path, content: DropoutReport) -> None:
    read = pd.read_csv(written / "worst.csv")
    assert {"rank", "stamp_ns", "t_s", "north_m", "east_m", "heading_change_deg", "speed_mean_mps"} <= set(read.columns)
    assert read["rank"].tolist() == list(range(1, len(content.worst) + 1))
    assert read.icr_error_m.tolist() == [drive.errors_m["icr"] for drive in content.document.worst]
    assert read.no_slip_error_m.tolist() == [drive.errors_m["no_slip"] for drive in content.document.worst]
    assert read.stamp_ns.tolist() == [drive.stamp_ns for drive in content.document.worst]


def test_without_track_width_the_no_slip_column_is_empty(make_run: Callable[..., Run], tmp_path: Path) -> None:
    run = make_run(track_width_m=None)
    write_tables(content_of(run, gates=()), tmp_path)
    assert pd.read_csv(tmp_path / "worst.csv").no_slip_error_m.isna().all()
    assert set(pd.read_csv(tmp_path / "summary.csv").model) == {"icr", "icr_final"}


def test_the_document_is_json_without_nan_and_is_read_back_equal(
    content: DropoutReport, make_run: Callable[..., Run]
) -> None:
    parked = content_of(make_run(duration_s=20.0), gates=())
    for report in (content, parked):
        document = report.document
        stored = json.loads(json_bytes(document), parse_constant=pytest.fail)
        assert msgspec.convert(stored, DropoutDocument) == document


def test_trials_are_written_group_by_group_with_the_models_as_categories(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "trials.parquet"
    with trials_file(path, run.table.stamp_ns) as sink:
        report = dropout(run, HORIZONS_M, sink=sink)
    table = pq.read_table(path)
    assert table.schema.names == ["model", "stamp_ns", "horizon_m", "error_m"]
    assert pa.types.is_dictionary(table.schema.field("model").type)
    frame = table.to_pandas()
    assert frame.error_m.notna().all()
    assert frame.stamp_ns.isin(run.table.stamp_ns).all()
    found = frame.groupby(["model", "horizon_m"], observed=True).error_m.agg(["size", "mean", "max"])
    expected = report.summary[report.summary.trials > 0].set_index(["model", "horizon_m"]).sort_index()
    found = found.reindex(expected.index)
    assert found["size"].tolist() == expected.trials.tolist()
    np.testing.assert_allclose(found["mean"], expected.expected_error_m, rtol=1e-12)
    assert found["max"].tolist() == expected.max_m.tolist()


def test_a_report_replaces_an_older_one_but_no_files_of_others(content: DropoutReport, tmp_path: Path) -> None:
    write_report(lambda _: content, tmp_path / "dropout", plots=(), stamp_ns=np.arange(3))
    assert (tmp_path / "dropout" / TRIALS_FILE).exists()
    content.write(tmp_path / "dropout", plots=())
    assert [path.name for path in tmp_path.iterdir()] == ["dropout"]
    assert is_dropout_directory(tmp_path / "dropout")
    assert not (tmp_path / "dropout" / TRIALS_FILE).exists()
    (tmp_path / "dropout" / "notes.txt").touch()
    with pytest.raises(OutputError, match=r"dropout: holds notes\.txt, which is no part of a dropout report"):
        content.write(tmp_path / "dropout", plots=())
    assert (tmp_path / "dropout" / "notes.txt").exists()


def test_a_report_that_fails_leaves_the_older_one(
    written: Path, content: DropoutReport, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = (written / "report.json").read_bytes()

    def fail(directory: Path) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(atomic, "sync_tree", fail)
    with pytest.raises(ZeroDivisionError):
        content.write(written, plots=())
    assert (written / "report.json").read_bytes() == before
    assert [path.name for path in written.parent.iterdir()] == ["dropout"]


def test_what_is_not_ours_is_left_alone(content: DropoutReport, tmp_path: Path) -> None:
    (tmp_path / "dropout").mkdir()
    (tmp_path / "dropout" / "thesis.txt").write_text("do not lose me", encoding="utf-8")
    with pytest.raises(OutputError, match="not a dropout report"):
        content.write(tmp_path / "dropout", plots=())
    assert (tmp_path / "dropout" / "thesis.txt").is_file()


def test_a_report_needs_a_place_where_its_run_has_none(content: DropoutReport) -> None:
    with pytest.raises(ValueError, match="path"):
        content.write()
