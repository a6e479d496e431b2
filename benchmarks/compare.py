"""Print the ratio of two tables of `make bench`: ``python benchmarks/compare.py OLD.json NEW.json``.

Of each row the ratio new / old of the medians, and of the ratios to the peer, which were measured on one machine at one
time and so depend less on what else it did.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from table import SCHEMA


def load(path: Path) -> dict[str, Any]:
    """Return a table that `benchmarks/run.py` wrote."""
    found: dict[str, Any] = json.loads(path.read_bytes())
    if found.get("schema") != SCHEMA:
        raise SystemExit(f"{path}: no table of `make bench`; found schema {found.get('schema')!r}")
    return found


def compare(old: dict[str, Any], new: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of the comparison."""
    if old["log_s"] != new["log_s"]:
        raise SystemExit(f"logs of {old['log_s']:.0f} s and {new['log_s']:.0f} s: no row can be compared")
    before, after = ({row["what"]: row for row in table["rows"]} for table in (old, new))
    yield "| what | old | new | new / old | new / old, in parts of the peer |"
    yield "|---|---|---|---|---|"
    for what in [*before, *(name for name in after if name not in before)]:
        if what not in before or what not in after:
            yield f"| {what} | {'only in the ' + ('old' if what in before else 'new') + ' table'} | | | |"
            continue
        one, other = before[what], after[what]
        medians = [f"{row['median']:.3g} {row['unit']}" for row in (one, other)]
        # peer / ours: its inverse grows as ours does
        parts = one["ratio"] / other["ratio"]
        yield f"| {what} | {' | '.join(medians)} | {other['median'] / one['median']:.2f} | {parts:.2f} |"


def main() -> None:
    """Compare two tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    asked = parser.parse_args()
    print("\n".join(compare(load(asked.old), load(asked.new))))


if __name__ == "__main__":
    main()
