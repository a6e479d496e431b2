"""Forged runs, calibrations, manifests and links: used by each command, as `scripts/fuzz.py --runs` asks.

A finding is a traceback, a file of the user that was changed or shown, a warning, or an answer of several lines.
"""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import sys
from functools import cache
from pathlib import Path
from random import Random
from unittest import mock

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "tests")]

from support.forged import Home, content, forge, link_to_file, special  # noqa: E402 - the tests are no package

COMMANDS = (
    ("report", "RUN"),
    ("report", "RUN", "-o", "page.html", "--no-coordinates"),
    ("dropout-report", "RUN", "--plots", "none", "--no-ladder"),
    ("dropout-report", "OWN", "--plots", "none", "--no-ladder", "--baseline", "RUN", "--no-page"),
    ("export", "--for", "evo", "RUN", "-o", "paths"),
    ("export", "--for", "qgis", "RUN", "-o", "paths.json"),
    ("export", "--for", "google-earth", "RUN"),
    ("export", "--for", "foxglove", "RUN", "-o", "RUN/x.mcap"),
    ("export", "--for", "json", "CAL"),
    ("calibrate", "RUN", "-o", "RUN"),
    ("compare", "RUN", "other=OWN"),
    ("forecast", "--calibration", "CAL", "--path", "RUN"),
    ("batch", "MANIFEST", "-o", "RUN", "--plots", "none", "-q"),
    ("report", "FOLDER"),
)


LONGEST_LINE = 5000
"""Characters that a command prints in one line."""


@cache
def made(folder: Path) -> Path:
    """Return a folder with a run of a short drive, its report, and a calibration."""
    import icrtool
    from icrtool.pipeline import report_into
    from icrtool.records.requests import ReportRequest, ResultFiles
    from support.barn import configured, simulate

    run = icrtool.fit(simulate(duration_s=40.0), configured())
    run.write(folder / "run")
    report_into(folder / "run", run, ReportRequest(ladder=False), ResultFiles(), lambda _: None)
    icrtool.calibrate([run]).write(folder / "calibration.json")
    return folder


def make_run(folder: Path, source: Path, seed: int) -> tuple[Home, list[str], tuple[str, ...]]:
    """Copy and forge a run, a calibration or a manifest; return what was done, and the command to use it with."""
    random = Random(seed)  # noqa: S311 - the same again
    home = Home(folder)
    home.add_run(source / "run")
    place = Path(shutil.copytree(source / "run", folder / "run"))
    loose = folder / "loose"
    loose.mkdir()
    shutil.copyfile(source / "calibration.json", loose / "calibration.json")
    (loose / "manifest.csv").write_text(f"log,robot,config,group,tags\n{random.choice(LINES)}\n")
    if random.random() < 0.25:
        for file in ("calibration.json", "manifest.csv"):
            if random.random() < 0.6:
                spoil(loose / file, random)
        done = [random.choice((content, link_to_file, special))(place, home, random)]
    else:
        done = forge(place, home, random)
    return home, done, random.choice(COMMANDS)


LINES = ("../run", "*", "/dev/zero,husky-a200", "../../../../../../etc/passwd", "..,../run/run.json", "x" * 5000, '"',
         "-", "=1+1,,,=2", "manifest.csv", "\x1b[2J", "**/*")  # fmt: skip


def spoil(file: Path, random: Random) -> None:
    """Change bytes of a file, or its size."""
    old = bytearray(file.read_bytes())
    for _ in range(random.choice([1, 3])):
        at = random.randrange(len(old) + 1)
        old[at : at + random.choice([0, 1, 8])] = random.choice(
            [b"", b"1e999", b"null", b"[", b'"', b"\xff", b"-1", b"{}", b"NaN", bytes(3), b"9" * 400]
        )
    file.write_bytes(old)


def use_run(folder: Path, home: Home, command: tuple[str, ...]) -> str:
    """Run a command on what `make_run` made; return how it ended.

    Raises
    ------
    AssertionError
        It changed or showed a file of the user, or printed something else than one line of reason.
    """
    names = {"RUN": folder / "run", "OWN": home.folder / "own-run", "CAL": folder / "loose" / "calibration.json",
             "MANIFEST": folder / "loose" / "manifest.csv", "FOLDER": folder}  # fmt: skip
    if "OWN" in command:
        # A command writes into it: a copy, at another place.
        names["OWN"] = Path(shutil.copytree(home.folder / "own-run", folder / "own-copy"))
    given = [swapped(part, names) for part in command]
    status, output, errors = called(given, folder)
    lines = (output + errors).splitlines()
    faults = {
        "the user's files changed": not home.is_untouched(),
        f"a file of the user in {home.is_shown_in(folder)}": bool(home.is_shown_in(folder)),
        f"status {status}": status not in (0, 1, 2, 3) or bool(status) != ("Error: " in errors),
        "not printable": not all(line.isprintable() for line in lines),
        "a long line": command[0] != "export" and max(map(len, lines), default=0) > LONGEST_LINE,
        "a warning or a traceback": "RuntimeWarning" in errors or "Traceback" in errors,
    }
    if found := [what for what, is_so in faults.items() if is_so]:
        raise AssertionError(f"{' '.join(command)}: {', '.join(found)}: {errors[-500:]!r}")
    return f"{command[0]}: {'done' if not status else 'refused'}"


def swapped(part: str, names: dict[str, Path]) -> str:
    """Return a part of a command with the place that it names."""
    first, slash, rest = part.partition("/")
    begin, equals, end = first.rpartition("=")
    return f"{begin}{equals}{names[end]}{slash}{rest}" if end in names else part


def called(arguments: list[str], folder: Path) -> tuple[int, str, str]:
    """Call a command in this process; return its status and what it printed."""
    from icrtool.cli import _run

    output, errors = (io.TextIOWrapper(io.BytesIO(), "utf-8", "replace", write_through=True) for _ in range(2))
    before = Path.cwd()
    os.chdir(folder)
    try:
        with (
            contextlib.redirect_stdout(output),
            contextlib.redirect_stderr(errors),
            mock.patch("sys.argv", ["icrtool", *arguments]),
        ):
            status = _run()
    finally:
        os.chdir(before)
    said, said_of_errors = (stream.buffer.getvalue().decode() for stream in (output, errors))  # type: ignore[attr-defined]
    return status, said, said_of_errors
