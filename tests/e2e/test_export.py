"""`icrtool export` as a user runs it."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from ruamel.yaml import YAML

from icrtool.cli.export import CONTROLLERS, EXPORT_TARGETS
from support.documents import with_summary


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory, short_logs: Path) -> Path:
    from icrtool.logs.read_log import read_log
    from icrtool.output.run_directory import write_run
    from icrtool.pipeline import fit

    config = __import__("icrtool").load_config(robot="husky-a200")
    folder = tmp_path_factory.mktemp("runs")
    write_run(fit(read_log(short_logs / "field.mcap", config), config), folder / "icrtool-runs" / "mower", plots=())
    return folder


@pytest.fixture
def run_place(runs: Path) -> Path:
    return runs


@pytest.mark.parametrize("target", CONTROLLERS)
def test_what_is_printed_loads_as_yaml(icrtool, target: str) -> None:
    status, out, err = icrtool("export", "--for", target, "icrtool-runs/mower")
    assert (status, err) == (0, "")
    assert YAML(typ="safe").load(out)


def test_without_an_argument_the_newest_run_is_taken(icrtool) -> None:
    assert icrtool("export", "--for", "clearpath") == icrtool("export", "--for", "clearpath", "icrtool-runs/mower")


def test_a_log_is_no_run(icrtool, short_logs: Path) -> None:
    status, out, err = icrtool("export", "--for", "json", short_logs / "field.mcap")
    assert (status, out) == (1, "")
    assert err.startswith("Error: ")


def test_an_unknown_target_is_wrong_usage(icrtool) -> None:
    status, _, err = icrtool("export", "--for", "moveit", "icrtool-runs/mower")
    assert status == 2
    assert "diff_drive_controller" in err


def test_without_a_target_there_is_a_command_for_each_kind_of_program(icrtool, runs: Path) -> None:
    status, out, err = icrtool("export", "icrtool-runs/mower")
    assert (status, out) == (2, "")
    commands = [line.partition("icrtool ")[2].split() for line in err.splitlines() if " icrtool export --for " in line]
    assert len(commands) == 6
    assert {words[2] for words in commands} < set(EXPORT_TARGETS)
    assert all("icrtool-runs/mower" in words for words in commands)
    # what is not typed is named behind the command, so that no target is missing
    assert all(target in err for target in EXPORT_TARGETS)
    (runs / "season.json").write_text("{}", encoding="utf-8")
    _, _, err = icrtool("export", "season.json")
    assert err.count(" icrtool export --for ") == 3
    assert "evo" not in err


def test_a_run_that_is_not_usable_is_exported_by_force_only(icrtool, runs: Path) -> None:
    from icrtool.output.run_directory import open_run

    run = open_run(runs / "icrtool-runs" / "mower")
    spoilt = with_summary(run, usable=False, unusable_because="42 % of the headings rejected")
    spoilt.write(runs / "unusable", plots=())
    status, out, err = icrtool("export", "--for", "clearpath", "unusable")
    assert (status, out) == (1, "")
    assert "42 % of the headings rejected" in err
    assert "--force" in err
    status, out, _ = icrtool("export", "--for", "clearpath", "--force", "unusable")
    assert status == 0
    assert "# WARNING: not usable: 42 % of the headings rejected" in out


@pytest.mark.parametrize("target", ["evo", "kitti", "google-earth", "qgis"])
def test_a_path_that_is_printed_is_the_one_in_the_file(icrtool, tmp_path: Path, target: str) -> None:
    status, out, err = icrtool("export", "--for", target, "icrtool-runs/mower")
    assert (status, err) == (0, "")
    assert icrtool("export", "--for", target, "-o", tmp_path / "out.txt") == (0, "", "")
    assert (tmp_path / "out.txt").read_text(encoding="utf-8") == out


def test_trajectories_into_a_directory_are_a_file_a_path(icrtool, tmp_path: Path) -> None:
    status, out, _ = icrtool("export", "--for", "evo", "-o", tmp_path / "evo")
    assert status == 0
    assert {file.name for file in (tmp_path / "evo").iterdir()} == {"filter.tum", "icr.tum", "no_slip.tum"}
    assert out.count("written to") == 3
    for name in ("2024.05.01-field", "field.bag"):
        assert icrtool("export", "--for", "kitti", "-o", tmp_path / name)[0] == 0
        assert {file.suffix for file in (tmp_path / name).iterdir()} == {".kitti"}


def test_foxglove_needs_a_file_and_gets_a_layout_beside_it(icrtool, tmp_path: Path) -> None:
    assert icrtool("export", "--for", "foxglove")[0] == 2
    status, out, _ = icrtool("export", "--for", "foxglove", "-o", tmp_path / "mower.mcap")
    assert status == 0
    assert {file.name for file in tmp_path.iterdir()} == {"mower.mcap", "mower.layout.json"}
    assert "mower.layout.json" in out


def test_the_paths_of_a_run_that_is_not_usable_are_exported_with_a_warning(icrtool, runs: Path) -> None:
    from icrtool.output.run_directory import open_run

    run = open_run(runs / "icrtool-runs" / "mower")
    with_summary(run, usable=False, unusable_because="it hopped").write(runs / "hopping", plots=())
    status, out, err = icrtool("export", "--for", "evo", "hopping")
    assert (status, out.count("\n")) == (0, len(run.table))
    assert "it hopped" in err


def test_a_calibration_file_has_no_paths(icrtool, tmp_path: Path) -> None:
    (tmp_path / "season.json").write_text("{}", encoding="utf-8")
    status, out, err = icrtool("export", "--for", "qgis", tmp_path / "season.json")
    assert (status, out) == (1, "")
    assert "icrtool fit" in err


def test_a_calibration_that_is_not_fit_for_use_is_exported_by_force_only(icrtool, runs: Path) -> None:
    import icrtool as library

    good = library.calibrate(library.open_run(runs / "icrtool-runs" / "mower"))
    bad = tuple(
        msgspec.structs.replace(one, p95_m=14.8) if one.model == "recommended" else one for one in good.held_out_pooled
    )
    file = msgspec.structs.replace(good, held_out_pooled=bad).write(runs / "bad.json")
    status, out, err = icrtool("export", "--for", "clearpath", file)
    assert (status, out) == (1, "")
    assert "not fit for use: its error after 10 m" in err
    assert icrtool("export", "--for", "clearpath", "--force", file)[0] == 0


def test_an_export_does_not_replace_the_log_of_its_run(icrtool, short_logs: Path) -> None:
    log = short_logs / "field.mcap"
    content = log.read_bytes()
    status, _, err = icrtool("export", "--for", "foxglove", "-o", log)
    assert status == 1
    assert "log" in err
    assert log.read_bytes() == content


def test_an_export_is_no_log_of_wheels(icrtool, tmp_path: Path) -> None:
    """Its ICRs have a left and a right field in a message with "track" in its name."""
    assert icrtool("export", "--for", "foxglove", "-o", tmp_path / "paths.mcap")[0] == 0
    assert "/icrs" not in icrtool("info", tmp_path / "paths.mcap")[1].partition("wheels (key")[2]
