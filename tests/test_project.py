"""The project's own files agree with one another, and carry no address or path of the machine they were made on."""

from __future__ import annotations

import ast
import importlib.util
import re
import subprocess
import tomllib
from itertools import chain
from pathlib import Path

import pytest

import icrtool

ROOT = Path(__file__).resolve().parents[1]
PINS = ROOT / "constraints.txt", ROOT / "constraints-dev.txt"

# Written in pieces, so that this file does not hold what it looks for.
PRIVATE = {
    "a registry's address": re.compile(r"py" r"pi\.org|python" r"hosted\.org|registry\.npm" r"js", re.IGNORECASE),
    "a package index option": re.compile(r"(?<!no-emit-)\b(?:extra-)?index-" r"url\b|(?<!no-emit-)\bfind-" r"links\b"),
    "a path of a machine": re.compile(r"(?<![\w./<>~-])/(?:" r"work|root|home|Users|opt/wheels|opt/py" r"pi)/[\w.]"),
}


def tracked_text_files() -> list[Path]:
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    try:
        listed = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    except (FileNotFoundError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout: nothing says which files are ours")
    return [path for name in listed.split("\0") if name and (path := ROOT / name).is_file() and _is_text(path)]


def _is_text(path: Path) -> bool:
    with path.open("rb") as file:
        return b"\0" not in file.read(8192)


def pinned() -> dict[str, str]:
    text = "\n".join(path.read_text(encoding="utf-8") for path in PINS)
    return dict(re.findall(r"^([a-z0-9-]+)==(\S+)", text, re.MULTILINE))


def test_no_file_names_a_registry_or_a_machine() -> None:
    said = []
    for path in tracked_text_files():
        for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
            said += [
                f"{path.relative_to(ROOT)}:{number}: holds {what}: {hit.group()}"
                for what, pattern in PRIVATE.items()
                if (hit := pattern.search(line))
            ]
    assert not said, "\n".join(said)


@pytest.mark.parametrize(
    ("line", "what"),
    [
        ("see https://py" + "pi.org/project/numpy", "a registry's address"),
        ("--extra-index" + "-url=x", "a package index option"),
        ("open('/wo" + "rk/main/x')", "a path of a machine"),
    ],
)
def test_what_must_not_stand_in_a_file_is_found(line: str, what: str) -> None:
    assert PRIVATE[what].search(line)


def test_newest_change_log_heading_is_the_version_of_the_package() -> None:
    headings = re.findall(r"^## \[?([^\]\s]+)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert headings[0] == icrtool.__version__


def test_the_citation_has_the_version_of_the_package() -> None:
    from ruamel.yaml import YAML

    citation = YAML(typ="safe").load(ROOT / "CITATION.cff")
    assert citation["version"] == icrtool.__version__
    assert citation["preferred-citation"]["doi"] == "10.1002/rob.21509"


def test_every_dependency_is_pinned_within_its_bounds() -> None:
    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    pins = pinned()
    for text in chain(project["dependencies"], *project["optional-dependencies"].values()):
        requirement = Requirement(text)
        version = pins.get(canonicalize_name(requirement.name), "")
        assert version, f"{requirement.name} is not pinned; run `make constraints`"
        assert requirement.specifier.contains(version), (
            f"{text} does not admit the pinned {version}; run `make constraints`"
        )


def test_a_package_is_pinned_once() -> None:
    names = [re.findall(r"^([a-z0-9-]+)==", path.read_text(encoding="utf-8"), re.MULTILINE) for path in PINS]
    assert not set(names[0]) & set(names[1])
    assert {"numba", "hatchling"} <= set(names[0])
    assert {"pytest", "mujoco", "sphinx"} <= set(names[1])


def test_constraints_hold_names_versions_and_hashes_only() -> None:
    allowed = re.compile(r"[a-z0-9-]+==[\w.]+(?: ; [\w .<>=!'\"()]+)? \\|    --hash=sha256:[0-9a-f]{64}(?: \\)?")
    lines = [line for path in PINS for line in path.read_text(encoding="utf-8").splitlines()]
    assert [line for line in lines if not allowed.fullmatch(line)] == []


@pytest.mark.parametrize(
    "script", [*ROOT.glob("benchmarks/*.py"), *ROOT.glob("scripts/*.py")], ids=lambda one: one.name
)
def test_a_script_finds_what_it_imports_from_icrtool(script: Path) -> None:
    for node in ast.walk(ast.parse(script.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and str(node.module).split(".")[0] == "icrtool":
            module = importlib.import_module(str(node.module))
            for one in node.names:
                assert hasattr(module, one.name) or importlib.util.find_spec(f"{node.module}.{one.name}"), one.name
