from __future__ import annotations

from pathlib import Path

import pytest

from icrtool.logs.containers.recording_files import log_name


@pytest.mark.parametrize(
    "path", ["..mcap", "...mcap", ".mcap", "..", ".", "/", "a/..", "./", "/..", "....", "x/..db3", ".bag", "...", "a/."]
)
def test_a_run_named_after_a_log_stays_in_the_folder_of_runs(path: str) -> None:
    name = log_name(Path(path))
    assert name not in {"", ".", ".."}
    assert Path("/runs", name).parent == Path("/runs")


def test_a_log_is_named_after_its_file_or_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "field.v2" / "deep").mkdir(parents=True)
    (tmp_path / "link").symlink_to("field.v2")
    monkeypatch.chdir(tmp_path / "field.v2" / "deep")
    assert log_name(Path("..")) == log_name(Path("../deep/..")) == "field.v2"
    assert log_name(tmp_path / "link") == "link"
    assert log_name(Path("a/field.v2.mcap")) == "field.v2"
