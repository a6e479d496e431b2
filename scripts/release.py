"""Check that a tag can be released, and write its notes and its recipe for conda-forge: release.py TAG PACKAGES OUTPUT.

PACKAGES is the folder with the built source archive. The version is that of the package: the tag, the newest section of
CHANGELOG.md (with a date) and CITATION.cff have to agree with it.
"""

from __future__ import annotations

import hashlib
import re
import sys
import tomllib
from pathlib import Path

from icrtool import __version__

ROOT = Path(__file__).resolve().parents[1]
TO_BE_SET = "OWNER"
"""What stands in the repository's address as long as it has none."""


def read(name: str) -> str:
    """Return the text of a file of the project."""
    return (ROOT / name).read_text(encoding="utf-8")


def newest_changes(changelog: str) -> tuple[str, str, str]:
    """Return version, date and text of the newest section of a changelog in the form of Keep a Changelog."""
    heading, _, rest = changelog.partition("\n## ")[2].partition("\n")
    found = re.fullmatch(r"\[(\S+)\] - (\S+)", heading)
    if not found:
        raise SystemExit(f"CHANGELOG.md: its newest section is {heading!r}; write ## [VERSION] - DATE")
    return found[1], found[2], rest.partition("\n## ")[0].strip()


def problems(tag: str, version: str, changelog: str, citation: str, address: str) -> list[str]:
    """Return what keeps a tag from being released, a line each."""
    changed, date, text = newest_changes(changelog)
    cited = re.search(r"^version: (\S+)$", citation, re.MULTILINE)
    found = {
        f"tag {tag}: not the version of the package; it is v{version}": tag != f"v{version}",
        f"CHANGELOG.md: its newest section is {changed}; write one for {version}": changed != version,
        f"CHANGELOG.md: {changed} has {date!r} for a date; write YYYY-MM-DD": not re.fullmatch(
            r"\d{4}(-\d\d){2}", date
        ),
        f"CHANGELOG.md: the section of {changed} is empty": not re.search(r"^- ", text, re.MULTILINE),
        f"CITATION.cff: its version is not {version}": cited is None or cited[1] != version,
        f"pyproject.toml: {address}: not the repository's address yet; set it": TO_BE_SET in address,
    }
    return [line for line, wrong in found.items() if wrong]


def recipe(template: str, version: str, address: str, archive: Path) -> str:
    """Return the recipe with what is known of a release: its version, archive and repository."""
    known = {
        "version": version,
        "archive": f"{address}/releases/download/v{version}/{archive.name}",
        "sha256": f'"{hashlib.sha256(archive.read_bytes()).hexdigest()}"',
        "repository": address,
    }
    for key, value in known.items():
        template, count = re.subn(rf"^  {key}: \S+$", f"  {key}: {value}", template, count=1, flags=re.MULTILINE)
        if not count:
            raise SystemExit(f".conda/recipe.yaml: has no {key} in its context")
    return template


def main() -> None:
    """Check, then write notes.md and recipe.yaml."""
    tag, packages, output = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])
    address = tomllib.loads(read("pyproject.toml"))["project"]["urls"]["Repository"]
    changelog = read("CHANGELOG.md")
    if found := problems(tag, __version__, changelog, read("CITATION.cff"), address):
        sys.exit("\n".join(found))
    output.mkdir(parents=True, exist_ok=True)
    archive = packages / f"icrtool-{__version__}.tar.gz"
    (output / "notes.md").write_text(newest_changes(changelog)[2] + "\n", encoding="utf-8")
    text = recipe(read(".conda/recipe.yaml"), __version__, address, archive)
    (output / "recipe.yaml").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
