"""Print the pins that icrtool needs to be built and used, with hashes: pinned_requirements.py [EXTRA...].

Without extras that is constraints.txt. Of extras, pip finds out which packages they need on this system; it takes
hashes only for a whole list. With ``--only PACKAGE...`` it is what these packages need, with ``--rest FILE`` what FILE
pins and constraints.txt does not.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def needed(extras: list[str]) -> list[str]:
    """Return the requirements of the package, of its build, and of the extras."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    groups = project["project"]["optional-dependencies"]
    if unknown := set(extras) - set(groups):
        sys.exit(f"{', '.join(sorted(unknown))}: no such extra of icrtool; there are {', '.join(sorted(groups))}")
    wanted = [*project["build-system"]["requires"], *project["project"]["dependencies"]]
    return wanted + [one for extra in extras for one in groups[extra]]


def resolved(requirements: list[str], pins: str) -> set[str]:
    """Return the names of all packages that pip would install for `requirements`."""
    with tempfile.TemporaryDirectory() as scratch:
        wanted, pinned, report = (Path(scratch) / name for name in ("wanted", "pinned", "report"))
        wanted.write_text("\n".join(requirements), encoding="utf-8")
        pinned.write_text(re.sub(r" *\\$|^ +--hash.*$", "", pins, flags=re.MULTILINE), encoding="utf-8")
        pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--quiet", "--dry-run"]
        subprocess.run(
            [*pip, "--ignore-installed", "--report", report, "-c", pinned, "-r", wanted], check=True, stdout=sys.stderr
        )
        found = json.loads(report.read_bytes())["install"]
    return {re.sub(r"[-_.]+", "-", one["metadata"]["name"]).lower() for one in found}


def by_name(pins: str) -> dict[str, str]:
    """Return the lines of each package, by its name."""
    return {one.split("==")[0]: one for one in re.split(r"\n(?=\S)", pins.strip())}


def main() -> None:
    """Print a line for each package, with its hashes."""
    words = sys.argv[1:]
    of_use, of_development = ((ROOT / f"constraints{part}.txt").read_text(encoding="utf-8") for part in ("", "-dev"))
    if not words:
        print(of_use, end="")
        return
    if words[:1] == ["--rest"]:
        found = by_name(Path(words[1]).read_text(encoding="utf-8"))
        names = set(found) - set(by_name(of_use))
    else:
        found = by_name(of_use) | by_name(of_development)
        names = resolved(words[1:] if words[:1] == ["--only"] else needed(words), "\n".join(found.values()))
    print("\n".join(lines for name, lines in found.items() if name in names))


if __name__ == "__main__":
    main()
