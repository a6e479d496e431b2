"""The table of `make bench`, and the comparison of two; `make check` runs every benchmark once (`make bench-quick`)."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def scripts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))


def written(path: Path, log_s: float = 600.0, **rows: tuple[float, float]) -> Path:
    table = importlib.import_module("table").Table(log_s)
    for what, (ours, peer) in rows.items():
        table.add(what, [ours, 9.0 * ours, 0.1 * ours], peer, "of another tool")
    table.write(path)
    return path


@pytest.mark.usefixtures("scripts")
def test_a_row_has_the_ratio_of_its_median_to_the_peer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    written(tmp_path / "table.json", read=(2.0, 50.0))
    assert "| 25 |" in capsys.readouterr().out
    [row] = importlib.import_module("compare").load(tmp_path / "table.json")["rows"]
    assert (row["median"], row["ratio"]) == (2.0, 25.0)


@pytest.mark.usefixtures("scripts")
def test_two_tables_are_compared_by_their_rows_and_by_their_peers(tmp_path: Path) -> None:
    compare = importlib.import_module("compare")
    old = compare.load(written(tmp_path / "old.json", read=(2.0, 50.0), gone=(1.0, 1.0)))
    # half of the time, on a machine on which the peer takes three quarters of it
    new = compare.load(written(tmp_path / "new.json", read=(1.0, 37.5), added=(1.0, 1.0)))
    lines = [line.split(" | ") for line in compare.compare(old, new)]
    assert [line[0] for line in lines[2:]] == ["| read", "| gone", "| added"]
    assert lines[2][3:] == ["0.50", "0.67 |"]


@pytest.mark.usefixtures("scripts")
def test_tables_of_logs_of_other_lengths_are_not_compared(tmp_path: Path) -> None:
    compare = importlib.import_module("compare")
    quick, full = (compare.load(written(tmp_path / f"{s}.json", s, read=(1.0, 1.0))) for s in (600.0, 3600.0))
    with pytest.raises(SystemExit, match="600 s and 3600 s"):
        list(compare.compare(quick, full))


@pytest.mark.usefixtures("scripts")
def test_a_section_that_fails_fails_the_benchmark(monkeypatch: pytest.MonkeyPatch) -> None:
    run = importlib.import_module("run")

    def fail(bench: object) -> None:
        raise RuntimeError("no such kernel")

    monkeypatch.setattr("sys.argv", ["run.py", "--quick"])
    monkeypatch.setattr(run, "SECTIONS", {"filter": fail})
    with pytest.raises(RuntimeError, match="no such kernel"):
        run.main()
