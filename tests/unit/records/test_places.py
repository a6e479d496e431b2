"""Regular files, opened below a directory without following links."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from icrtool.records.places import Below, NotRegularFileError, is_regular, read_regular


@pytest.fixture
def place(tmp_path: Path) -> Path:
    (tmp_path / "place" / "inner").mkdir(parents=True)
    (tmp_path / "outside").mkdir()
    for file in ("place/file", "place/inner/file", "outside/file"):
        (tmp_path / file).write_bytes(file.encode())
    (tmp_path / "place" / "link").symlink_to("file")
    (tmp_path / "place" / "out").symlink_to(tmp_path / "outside")
    os.mkfifo(tmp_path / "place" / "pipe")
    return tmp_path / "place"


@pytest.mark.parametrize("name", ["file", "inner/file"])
def test_a_regular_file_below_a_directory_is_read(place: Path, name: str) -> None:
    assert read_regular(Below(place, name)) == f"place/{name}".encode()


@pytest.mark.parametrize("name", ["link", "out", "out/file", "pipe", "inner", "inner/../file", "../outside/file"])
def test_no_link_pipe_or_folder_is_read_below_a_directory(place: Path, name: str) -> None:
    with pytest.raises(OSError, match=r"link|regular|[Dd]irectory|does not lie"):
        read_regular(Below(place, name))
    assert not is_regular(Below(place, name))


def test_a_directory_that_the_user_names_for_a_file_is_stated_to_be_one(place: Path) -> None:
    with pytest.raises(NotRegularFileError, match="a directory; name a file"):
        read_regular(place)


def test_a_file_that_the_user_names_may_be_a_link_and_no_pipe(place: Path) -> None:
    assert read_regular(place / "link") == b"place/file"
    assert read_regular(place / "out" / "file") == b"outside/file"
    for device in (place / "pipe", Path("/dev/zero")):
        with pytest.raises(NotRegularFileError):
            read_regular(device)


def test_a_directory_that_is_named_may_be_a_link(place: Path) -> None:
    assert read_regular(Below(place / "out", "file")) == b"outside/file"


def test_a_file_that_is_too_large_is_not_read(place: Path) -> None:
    assert read_regular(Below(place, "file"), most_bytes=10) == b"place/file"
    with pytest.raises(OSError, match="larger than 9 bytes"):
        read_regular(Below(place, "file"), most_bytes=9)


def test_a_path_that_is_a_link_or_leads_over_one_is_refused(place: Path) -> None:
    Below(place, "inner/new").check_links()
    Below(place, ".").check_links()
    for name in ("link", "out", "out/new", "../outside", str(place / "inner")):
        with pytest.raises(NotRegularFileError):
            Below(place, name).check_links()
