"""What a release needs: a tag that agrees with the project, its notes, and a recipe for conda-forge that renders."""

from __future__ import annotations

import hashlib
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

import icrtool
from support.scripts import load_script

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
ADDRESS = PROJECT["urls"]["Repository"]
CHANGES = "# Changes\n\n## [1.2.3] - 2026-01-31\n\n- One.\n\n## [1.2.2] - 2026-01-01\n\n- Older.\n"
READY = ("v1.2.3", "1.2.3", CHANGES, "version: 1.2.3\n", "https://example.org/icrtool")

CONDA_NAMES = {"matplotlib": "matplotlib-base"}
"""Those that conda-forge has under another name; matplotlib-base is it without a window."""


@pytest.fixture(scope="module")
def release() -> ModuleType:
    return load_script("release")


def test_a_tag_that_agrees_with_everything_can_be_released(release: ModuleType) -> None:
    assert release.problems(*READY) == []
    assert release.newest_changes(CHANGES) == ("1.2.3", "2026-01-31", "- One.")


@pytest.mark.parametrize(
    ("place", "value", "named"),
    [
        (0, "v1.2.4", "tag v1.2.4"),
        (0, "1.2.3", "tag 1.2.3"),
        (2, CHANGES.replace("[1.2.3]", "[1.2.4]"), "CHANGELOG.md: its newest section is 1.2.4"),
        (2, CHANGES.replace("2026-01-31", "unreleased"), "'unreleased' for a date"),
        (2, CHANGES.replace("- One.\n", ""), "is empty"),
        (3, "version: 1.2.2\n", "CITATION.cff"),
        (4, "https://example.org/OWNER/icrtool", "pyproject.toml"),
    ],
)
def test_what_does_not_agree_keeps_a_tag_from_being_released(
    release: ModuleType, place: int, value: str, named: str
) -> None:
    changed = list(READY)
    changed[place] = value
    [line] = release.problems(*changed)
    assert named in line


def test_a_release_writes_its_notes_and_the_recipe_of_its_archive(
    release: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from rattler_build import Stage0Recipe

    version = icrtool.__version__
    texts = {
        "CHANGELOG.md": CHANGES.replace("1.2.3", version), "CITATION.cff": f"version: {version}\n",
        "pyproject.toml": '[project.urls]\nRepository = "https://example.org/icrtool"\n',
        ".conda/recipe.yaml": (ROOT / ".conda" / "recipe.yaml").read_text(encoding="utf-8"),
    }  # fmt: skip
    monkeypatch.setattr(release, "read", texts.__getitem__)
    archive = tmp_path / f"icrtool-{version}.tar.gz"
    archive.write_bytes(b"an archive")
    monkeypatch.setattr(sys, "argv", ["release.py", f"v{version}", str(tmp_path), str(tmp_path / "out")])
    release.main()
    assert (tmp_path / "out" / "notes.md").read_text(encoding="utf-8") == "- One.\n"
    [rendered] = Stage0Recipe.from_file(tmp_path / "out" / "recipe.yaml").render()
    recipe = rendered.recipe.to_dict()
    assert recipe["package"]["version"] == version
    assert recipe["source"] == [
        {
            "url": f"https://example.org/icrtool/releases/download/v{version}/{archive.name}",
            "sha256": hashlib.sha256(b"an archive").hexdigest(),
        }
    ]
    texts["CITATION.cff"] = "version: 0\n"
    with pytest.raises(SystemExit, match=r"CITATION\.cff"):
        release.main()


def test_the_recipe_asks_for_what_the_package_asks_for() -> None:
    from packaging.requirements import Requirement
    from rattler_build import Stage0Recipe

    [rendered] = Stage0Recipe.from_file(ROOT / ".conda" / "recipe.yaml").render()
    recipe = rendered.recipe.to_dict()
    wanted = {f"python {PROJECT['requires-python']}"}
    for one in map(Requirement, PROJECT["dependencies"]):
        wanted.add(f"{CONDA_NAMES.get(one.name, one.name)} {one.specifier}")
    assert set(recipe["requirements"]["run"]) == wanted
    assert recipe["about"]["license"] == PROJECT["license"]
    assert recipe["build"]["python"]["entry_points"] == [f"icrtool = {PROJECT['scripts']['icrtool']}"]


def test_the_address_of_the_repository_stands_once() -> None:
    files = [ROOT / "pyproject.toml", *ROOT.glob("*.md"), ROOT / "CITATION.cff", ROOT / "Dockerfile"]
    for folder in (".github", ".gitlab", ".conda", "docs", "scripts", "icrtool"):
        files += [path for path in (ROOT / folder).rglob("*") if path.suffix in {".md", ".yml", ".yaml", ".py", ".sh"}]
    holding = [path.name for path in files if ADDRESS in path.read_text(encoding="utf-8")]
    assert holding == ["pyproject.toml"]


def test_no_page_installs_what_is_not_published() -> None:
    for page in (ROOT / "README.md", *(ROOT / "docs").rglob("*.md")):
        assert "pip install icrtool" not in page.read_text(encoding="utf-8"), page
