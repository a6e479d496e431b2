"""The page of all warnings, docs/warnings.md, from the catalogue of their codes."""

from __future__ import annotations

from pathlib import Path

from icrtool.records.note_catalogue import GROUPS

PAGE = Path(__file__).resolve().parents[1] / "docs" / "warnings.md"

HEAD = """# Each warning and what to do

`icrtool` reports what it finds as notes: each has a `code`, a `grade`, a `subject` (the log or file) and a `text`
with its numbers. `run.json`, `report.json`, `fleet.json`, calibration files, `info --json` and `run.notes` in Python
hold them as `notes`; `warnings` lists their texts for people. Codes do not change with the wording: scripts compare
codes. `fleet.csv` has the codes of each log in the column `notes`, separated by `;`.

A command prints the text of a note, not its code. To find a printed warning on this page, search for its words under
*Found*, or print the codes with the texts:

    icrtool fit field.mcap --robot husky-a200 --json | jq -r '.logs[0].run.notes[] | .code + ": " + .text'

| grade | meaning |
|---|---|
| `info` | Corrected, or of little consequence. Nothing needs to be done. |
| `warning` | Numbers may be wrong or less precise. Read what to do. |
| `grave` | Do not use the numbers. These texts make `unusable_because`, and are not repeated in `warnings`. |

This page is made by `make schemas` from `icrtool/records/note_catalogue.py`.
"""


def page() -> str:
    """Return the page as Markdown."""
    parts = [HEAD]
    for title, group in GROUPS.items():
        parts.append(f"## {title}\n")
        for code, entry in group.items():
            rows = [f"- Found: {entry.cause}", f"- Consequence: {entry.consequence}", f"- What to do: {entry.action}"]
            parts.append("\n".join([f"### `{code}`", "", f"Grade: {entry.grade}.", "", *rows, ""]))
    return "\n".join(parts)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
