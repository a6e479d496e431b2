"""`icrtool export` as a user runs it."""

from __future__ import annotations

from pathlib import Path

import pytest
from ruamel.yaml import YAML

from icrtool.cli.export import TARGETS
from icrtool.output.exports import controllers as export

ROOT = Path(__file__).resolve().parents[2]
LOG = ROOT / "sample_logs" / "wheeled_lawnmower.mcap"


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from icrtool.estimation.fit import fit
    from icrtool.logs import read_log
    from icrtool.output.run_directory import write_run

    config = __import__("icrtool").load_config(robot="segway-rmp400")
    folder = tmp_path_factory.mktemp("runs")
    write_run(fit(read_log(LOG, config), config), folder / "icrtool-runs" / "mower", plots=())
    return folder


@pytest.fixture
def run_place(runs: Path) -> Path:
    return runs


@pytest.mark.parametrize("target", TARGETS)
def test_what_is_printed_loads_as_yaml(icrtool, target: str) -> None:
    status, out, err = icrtool("export", "--for", target, "icrtool-runs/mower")
    assert (status, err) == (0, "")
    assert YAML(typ="safe").load(out)


def test_without_an_argument_the_newest_run_is_taken(icrtool) -> None:
    assert icrtool("export", "--for", "clearpath") == icrtool("export", "--for", "clearpath", "icrtool-runs/mower")


def test_the_choices_are_those_of_the_report() -> None:
    assert TARGETS == export.TARGETS


def test_a_log_is_no_run(icrtool) -> None:
    status, out, err = icrtool("export", "--for", "json", LOG)
    assert (status, out) == (1, "")
    assert err.startswith("Error: ")


def test_an_unknown_target_is_wrong_usage(icrtool) -> None:
    status, _, err = icrtool("export", "--for", "moveit", "icrtool-runs/mower")
    assert status == 2
    assert "diff_drive_controller" in err


def test_a_run_that_is_not_usable_is_exported_by_force_only(icrtool, runs: Path) -> None:
    from dataclasses import replace

    from icrtool.output.stored_run import open_run

    run = open_run(runs / "icrtool-runs" / "mower")
    spoilt = {"usable": False, "unusable_because": "42 % of the headings rejected"}
    replace(run, summary=run.summary | spoilt).write(runs / "unusable", plots=())
    status, out, err = icrtool("export", "--for", "clearpath", "unusable")
    assert (status, out) == (1, "")
    assert "42 % of the headings rejected" in err
    assert "--force" in err
    status, out, _ = icrtool("export", "--for", "clearpath", "--force", "unusable")
    assert status == 0
    assert "# WARNING: not usable: 42 % of the headings rejected" in out
