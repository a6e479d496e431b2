"""Runs as a stranger may send them: links, pipes, devices and foreign content in the place of icrtool's own files."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from random import Random

from support.edits import edited

SECRET = b"-----BEGIN PRIVATE KEY----- of the user, never to leave his machine"
MOST_FORGED_BYTES = 1 << 24
"""Of a file that is forged by its content; a run's own are smaller."""

PNG = b"\x89PNG\r\n\x1a\n"

ASIDE = f".icrtool-{hashlib.blake2b(b'dropout', digest_size=8).hexdigest()}"
"""How the hidden names beside dropout/ begin."""

HIDDEN = (
    ".icrtool-0123456789abcdef-0123abcd.partial", f"{ASIDE}-0123abcd.old", f"{ASIDE}-0123abcd.partial", "plots/.x.png",
    ".icrtool-files", "notes.txt",
)  # fmt: skip


class Home:
    """A user's own files, outside of every run, which no command may change or show."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "home"
        (self.folder / "folder").mkdir(parents=True)
        self.file = self.folder / "secret.txt"
        for file in (self.file, self.folder / "folder" / "trajectory.png", self.folder / "folder" / "run.json"):
            file.write_bytes(SECRET)
        self.run: Path | None = None
        self.remember()

    def remember(self) -> None:
        """Take its content as it is now for what no command may change."""
        self._before = self.content()

    def add_run(self, run: Path) -> None:
        """Add a run of the user's own."""
        self.run = Path(shutil.copytree(run, self.folder / "own-run"))
        self.remember()

    def content(self) -> dict[str, bytes]:
        """Return a sum of every file by its path; links and folders by their kind."""
        found = {}
        for path in sorted(self.folder.rglob("*")):
            kind = b"link" if path.is_symlink() else b"folder" if path.is_dir() else b""
            size = 0 if kind else path.stat().st_size
            kind = kind or (b"%d bytes" % size if size > 1 << 28 else b"")
            found[str(path)] = kind or hashlib.blake2b(path.read_bytes()).digest()
        return found

    def is_untouched(self) -> bool:
        """Return whether all is as it was."""
        return self.content() == self._before

    def is_shown_in(self, place: Path) -> str:
        """Return which file below a place, links not followed, holds the secret; empty where none does."""
        marks = [SECRET[11:35], *(base64_of(SECRET[k:])[:30] for k in (9, 10, 11))]
        for path in place.rglob("*"):
            if path.is_symlink() or not path.is_file() or path.is_relative_to(self.folder):
                continue
            if path.stat().st_size > 1 << 28:
                continue  # a forgery: what commands write is smaller
            content = path.read_bytes()
            if any(mark in content for mark in marks):
                return str(path)
        return ""


def base64_of(content: bytes) -> bytes:
    """Return content as a page would hold it."""
    from base64 import b64encode

    return b64encode(content)


def is_small(path: Path) -> bool:
    """Return whether a path is a file that a forger may read: an earlier forgery may be a pipe, or of 64 GB."""
    return path.is_file() and path.stat().st_size <= MOST_FORGED_BYTES


def sums(place: Path) -> None:
    """Write checksums that fit the files, as whoever forges a run can."""
    file = place / "B2SUMS"
    try:
        if not is_small(file):
            return
        names = [line.partition("  ")[2] for line in file.read_text().splitlines()]
        regular = [name for name in names if is_small(place / name)]
        lines = [f"{hashlib.blake2b((place / name).read_bytes()).hexdigest()}  {name}\n" for name in regular]
        if not file.is_symlink():
            file.write_text("".join(lines))
    except (OSError, ValueError):
        return


Forgery = Callable[[Path, Home, Random], str]


def files_of(place: Path, random: Random) -> Path:
    """Return a place of a run: a file of it, or one that a command looks for."""
    found = sorted(path for path in place.rglob("*") if not path.is_dir() or path.is_symlink())
    return random.choice([*found, *(place / name for name in HIDDEN), place / "report.html"])


def remove(path: Path) -> None:
    """Remove a file, link or folder, and make the folder it lies in."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
    path.parent.mkdir(parents=True, exist_ok=True)


def link_to_file(place: Path, home: Home, random: Random) -> str:
    """Put a link to a file of the user, or to one that is not there, in the place of a file."""
    path = files_of(place, random)
    target = random.choice([home.file, home.folder / "not-there", home.folder / "folder" / "run.json"])
    remove(path)
    path.symlink_to(target)
    return f"{path.relative_to(place)} -> {target.name}"


def link_to_same(place: Path, home: Home, random: Random) -> str:
    """Put a link to the same file of a run of the user in the place of a file."""
    path = files_of(place, random)
    name = path.relative_to(place)
    remove(path)
    path.symlink_to((home.run or home.folder) / name)
    return f"{name} -> own run"


def link_to_folder(place: Path, home: Home, random: Random) -> str:
    """Put a link to a folder of the user in the place of a folder or a file."""
    path = random.choice([place / "plots", place / "dropout", place / "dropout" / "plots", files_of(place, random)])
    own = (home.run or home.folder) / path.relative_to(place)
    target = random.choice([home.folder / "folder", own])
    remove(path)
    path.symlink_to(target, target_is_directory=True)
    return f"{path.relative_to(place)} -> {target.name}/"


def special(place: Path, home: Home, random: Random) -> str:
    """Put a pipe, or a link to a device, in the place of a file."""
    path, device = files_of(place, random), random.choice(["", "", "/dev/zero", "/dev/tty", "/dev/stdin"])
    remove(path)
    if device:
        path.symlink_to(device)
    else:
        os.mkfifo(path)
    return f"{path.relative_to(place)}: {device or 'pipe'}"


def content(place: Path, home: Home, random: Random) -> str:
    """Replace the content of a file, with checksums that fit."""
    path = files_of(place, random)
    old = path.read_bytes() if is_small(path) and not path.is_symlink() else b""
    at = random.randrange(len(old) + 1)
    new = random.choice([
        b"", PNG, PNG + SECRET[:5] * 1000, b"[" * 100_000, old[:at], old + old, b"\xff" * 50,
        old[:at] + bytes(random.randbytes(8)) + old[at + 8 :],
    ])  # fmt: skip
    remove(path)
    path.write_bytes(new)
    sums(place)
    return f"{path.relative_to(place)}: {len(new)} other bytes"


def sparse(place: Path, home: Home, random: Random) -> str:
    """Make a file very large without writing it."""
    path = files_of(place, random)
    remove(path)
    with path.open("wb") as file:
        file.truncate(random.choice([1 << 30, 1 << 36]))
    return f"{path.relative_to(place)}: sparse"


def folder_for_file(place: Path, home: Home, random: Random) -> str:
    """Put a folder in the place of a file, or a file in that of a folder."""
    path = files_of(place, random)
    if random.random() < 0.3:
        path = random.choice([place / "plots", place / "dropout"])
        remove(path)
        path.write_bytes(SECRET[:3])
    else:
        remove(path)
        path.mkdir()
    return f"{path.relative_to(place)}: other kind"


def document(place: Path, home: Home, random: Random) -> str:
    """Edit one place of a JSON document, with checksums that fit."""
    path = random.choice([place / "run.json", place / "dropout" / "report.json"])
    try:
        if not is_small(path):
            return f"{path.name}: forged already"
        plain = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):  # brackets within brackets, of an earlier forgery
        return f"{path.name}: gone"
    every = random.randrange(40, 200)
    choices = list(edited(plain, every)) if isinstance(plain, dict) else []
    if not choices:
        return f"{path.name}: no place"
    what, changed = random.choice(choices)
    path.write_text(json.dumps(changed))
    sums(place)
    return f"{path.name} {what[:80]}"


def names(place: Path, home: Home, random: Random) -> str:
    """Name files outside of the run in its lists."""
    own = place / ".icrtool-files"
    outside = os.path.relpath(home.file, place)
    if random.random() < 0.5:
        remove(own)
        kind = random.choice(["run directory", "dropout report", "x" * 5000])
        listed = [outside, str(home.file), "..", "plots/../../home/secret.txt"]
        own.write_text(json.dumps({"schema": "icrtool/files/1", "kind": kind, "files": listed, "made_from": listed}))
        return "names in .icrtool-files"
    lists = place / "B2SUMS"
    if is_small(lists) and not lists.is_symlink():
        line = f"{hashlib.blake2b(SECRET).hexdigest()}  {outside}\n"
        lists.write_text(lists.read_text(errors="replace").replace("states.csv", outside) + line)
    return "names in B2SUMS"


FORGERIES: tuple[Forgery, ...] = (
    link_to_file, link_to_same, link_to_folder, special, content, sparse, folder_for_file, document, document, names,
)  # fmt: skip


def forge(place: Path, home: Home, random: Random) -> list[str]:
    """Forge a run in one to three places, and return what was done."""
    done = []
    for _ in range(random.choice([1, 1, 1, 2, 3])):
        try:
            done.append(random.choice(FORGERIES)(place, home, random))
        except (OSError, ValueError) as err:
            # An earlier forgery is in its place.
            done.append(f"none: {err}")
    # A second forgery may have gone over the link of a first one.
    home.remember()
    return done
