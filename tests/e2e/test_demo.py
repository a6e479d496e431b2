"""``icrtool demo`` runs the two commands that it prints, on the sample log of the package."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest
from click.testing import CliRunner

from icrtool.cli.commands import icrtool as command_line


def test_the_demo_prints_its_commands_and_leaves_a_run_with_its_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(command_line, ["demo"], catch_exceptions=False)
    assert result.exit_code == 0
    commands = [line for line in result.output.splitlines() if line.startswith("$ ")]
    assert [line.split()[2] for line in commands] == ["fit", "dropout-report"]
    run = tmp_path / "icrtool-runs" / "demo"
    assert (run / "report.html").is_file()
    summary = pd.read_csv(run / "dropout" / "summary.csv").set_index(["model", "horizon_m"])
    assert summary.p95_m["controller", 10.0] < 0.1 * summary.p95_m["no_slip", 10.0]


def test_the_demo_states_where_no_sample_log_is(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("icrtool.cli.demo.SAMPLE_LOG", "absent.mcap")
    result = CliRunner().invoke(command_line, ["demo"])
    assert result.exit_code != 0
    assert not (tmp_path / "icrtool-runs").exists()
