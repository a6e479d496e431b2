"""Results at an address: they are made in a temporary folder and then uploaded.

The files without which results are not valid are uploaded last. Of several commands that upload to one address at the
same time, the first one claims the address; the others change nothing there.

Only this module writes over a connection. All other modules write to a folder on disk (`folder_on_disk`).
"""

from __future__ import annotations

import errno
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path, PurePath, PurePosixPath
from typing import Any, NoReturn, TypeVar

from icrtool.errors import IcrToolError, LogError, OutputError
from icrtool.logs.containers.connection import ask_server, filesystem
from icrtool.logs.containers.source import version_of
from icrtool.logs.containers.unpack import ScratchFolder
from icrtool.output.files.atomic import ABANDONED_S, make_folders, may_still_write, place_errors, write_file, writer_id
from icrtool.output.files.formats import CHECKSUM_FILE, SOURCES_FILE
from icrtool.records.fleet_document import FLEET_FILE
from icrtool.records.places import Below, UrlPath

Result = TypeVar("Result")

VALIDITY_FILES = (CHECKSUM_FILE, FLEET_FILE)
"""Names of the files without which a run or a batch is not valid. They are removed before any other file is replaced,
and uploaded last."""

MOST_REQUESTS = 8
"""Largest number of requests at the same time."""

_PROBE, _CLAIM = ".icrtool-upload", ".icrtool-writer"
"""Names of two files at an address. `_PROBE` is written and removed before any work is done, to test that the address
can be written. `_CLAIM` exists during an upload and states the command that uploads: no other command then changes the
address."""

_ANNOUNCEMENT = f"{_CLAIM}-"
"""Begin of the names of files that announce a claim, at a store without conditional writes."""

CLAIM_CHECKED_S = 60.0
"""Time after which a command reads the claim again before it uploads a further file [s]. The claim must still be its
own."""

_LONGEST_CLAIM = 200
"""Number of bytes of a claim that are read. icrtool writes about 40."""

Needed = Callable[[str], bool]
"""Function that states, by the name of a file below a place, whether the content of the file is needed, or only its
name."""


def is_document(name: str) -> bool:
    """Return whether a file states what a folder of results holds and whether the folder may be replaced."""
    is_ours = name.endswith((".json", ".html", ".png")) or PurePosixPath(name).name in {SOURCES_FILE, CHECKSUM_FILE}
    return is_ours and not name.startswith("runs/")


@contextmanager
def folder_on_disk(
    place: Path,
    needed: Needed = is_document,
    parts: Collection[str] | None = None,
    begin: Callable[[str], None] | None = None,
    *,
    writes: bool = True,
) -> Iterator[Path]:
    """Yield a folder on disk with the results at a place; at the end, upload its changes if the place is an address.

    Parameters
    ----------
    place : a folder on disk, which is yielded itself, or an address
    needed : states which files are fetched; every other file at the address becomes an empty file on disk
    parts : names of the folders below an address that are listed, in addition to its own files; None: all folders
    begin : called with the name of the stage before the upload
    writes : whether changes are uploaded; otherwise the address is only read

    Yields
    ------
    Path
        The folder on disk. If `place` is an address, the folder is removed at the end.

    Raises
    ------
    OutputError
        The address cannot be read or written. The results there are then unchanged, or not valid.
    """
    if not isinstance(place, UrlPath):
        yield place
        return
    store = _Store(place, "written" if writes else "read")
    if writes:
        store.probe()
    scratch = ScratchFolder()
    folder = scratch.path / (place.name or "results")
    try:
        before = store.fetch(folder, needed, parts)
        yield folder
        if writes:
            if begin is not None:
                begin("uploading")
            store.upload(folder, before)
    except IcrToolError as err:
        texts = [str(err.what), err.why, err.advice]
        if not any(str(folder) in text for text in texts):
            raise
        # The temporary folder is replaced by the address, because the user knows only the address.
        raise type(err)(*(text.replace(str(folder), str(place)) for text in texts)) from err
    finally:
        scratch.close()


def write_below(folder: Path, name: str, content: bytes) -> None:
    """Write a file below a folder of results, on disk or at an address.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    file = folder / name
    if isinstance(file, UrlPath):
        _Store(file).put(content)
        return
    make_folders(Below(folder, PurePath(name).parent))
    write_file(Below(folder, name), content)


def has_file(place: UrlPath, name: str) -> bool:
    """Return whether there is a file of this name below an address in an object store; False on a web server."""
    if place.scheme.startswith("http"):
        return False
    files, path = filesystem(place / name)
    return bool(ask_server(place, lambda: files.exists(path)))


class _Store:
    """A folder or a file in an object store.

    Parameters
    ----------
    place : its address
    done : participle for messages of errors, for example "written"

    Raises
    ------
    OutputError
        The address is on a web server, or its scheme cannot be used.
    """

    def __init__(self, place: UrlPath, done: str = "written") -> None:
        self._participle = done
        if place.scheme.startswith("http"):
            raise OutputError(place, "results are not written to a web server", "name a folder, or s3://, gs://, az://")
        self._place = place
        with _as_output(place):
            self._files, self._name = filesystem(place)
        self._name = self._name.rstrip("/")
        self._found: list[object] = []
        self._checked_s = 0.0
        self._is_conditional = False

    def probe(self) -> None:
        """Write and remove a file: a place that cannot be written is refused before any work is done for it."""
        self.put(b"icrtool", _PROBE)
        # Some stores refuse conditions, others ignore them.
        self._is_conditional = self._create(b"icrtool", _PROBE) == errno.EEXIST
        self.remove([_PROBE])

    def put(self, content: bytes, name: str = "") -> None:
        """Write a file of this name below the address, or at the address itself."""
        self._ask(lambda: self._files.pipe_file(self._address_of(name), content))

    def fetch(self, folder: Path, needed: Needed, parts: Collection[str] | None) -> dict[str, tuple[int, int]]:
        """Copy the files at the address to a folder on disk; a file that is not `needed` becomes an empty file.

        Returns
        -------
        dict of str to (int, int)
            Two numbers by name of the file, which change if the file on disk changes.
        """
        names = []
        self._found = self._validity_facts()
        for name in self._list_files(parts):
            # A stranger may have written the name, so a name that leads out of the folder is left out.
            path = PurePosixPath(name)
            below = name and not name.endswith("/") and not path.is_absolute() and ".." not in path.parts
            if below and name not in {_PROBE, _CLAIM} and not name.startswith(_ANNOUNCEMENT):
                names.append(name)
        with place_errors(self._place):
            for name in names:
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                (folder / name).touch(exist_ok=False)
        self._ask_for_each(
            lambda name: self._files.get_file(self._address_of(name), str(folder / name)), filter(needed, names)
        )
        return {name: _identity(folder / name) for name in names}

    def upload(self, folder: Path, before: dict[str, tuple[int, int]]) -> None:
        """Copy the changes of a folder on disk to the address; `before` is the result of `fetch`."""
        files_now = [path for path in folder.rglob("*") if path.is_file() and path.stat().st_size]
        now = {path.relative_to(folder).as_posix(): _identity(path) for path in files_now}
        gone = [name for name in before if not (folder / name).exists()]
        changed = [name for name, identity in now.items() if identity != before.get(name)]
        if not changed and not gone:
            return
        claim = self._take_claim()
        try:
            if self._validity_facts() != self._found:
                advice = "its results stay; name another place, or run the command again"
                raise OutputError(self._place, "another command wrote there meanwhile", advice)
            last = [name for name in VALIDITY_FILES if name in now]
            self.remove([name for name in VALIDITY_FILES if name in before])
            self.remove([name for name in gone if name not in VALIDITY_FILES])
            # If the upload is interrupted, run.json shows that the other files there are icrtool's.
            first = [name for name in changed if name.endswith(".json") and name not in last]
            for names in (first, [name for name in changed if name not in {*first, *last}], last):
                self._check_claim(claim)
                self._ask_for_each(partial(self._put_file, folder, claim), names)
        finally:
            # If the connection is lost, the claim stays. The next command on this host finds that its process has
            # ended.
            with suppress(IcrToolError):
                self._check_claim(claim)
                self.remove([_CLAIM])

    def _put_file(self, folder: Path, claim: bytes, name: str) -> None:
        """Copy one file of a folder on disk to the address; check the claim from time to time."""
        if time.time() > self._checked_s + CLAIM_CHECKED_S:
            self._check_claim(claim)
        self._files.put_file(str(folder / name), self._address_of(name))

    def _take_claim(self) -> bytes:
        """Write a claim to the address, unless another command that still runs has written one; return the claim.

        Of several commands only one can write the claim: all others end before they changed anything. The store itself
        sees to that; at a store without conditional writes, commands announce their claims.

        Raises
        ------
        OutputError
            Another command is writing there.
        """
        writer, time_s = writer_id(), f"{time.time():.0f}"
        claim = f"{writer} {time_s}".encode()
        if self._is_conditional:
            self._write_claim(claim)
        else:
            with self._announced(f"{_ANNOUNCEMENT}{writer}-{time_s}"):
                self._write_claim(claim)
        self._check_claim(claim)
        return claim

    @contextmanager
    def _announced(self, own: str) -> Iterator[None]:
        """Announce a claim while it is written; refuse to go on where another command announces one.

        Notes
        -----
        Each command writes an announcement under a name of its own, and then lists all names. Of two commands, the one
        that wrote its announcement later finds the announcement of the other, or its claim, and ends. Both end if both
        announcements were written before both lists.
        """
        self.put(b"icrtool", own)
        try:
            self._files.invalidate_cache()
            names = [name.rpartition("/")[2] for name in self._ask(self._list_top_files)]
            others = [name for name in names if name.startswith(_ANNOUNCEMENT) and name != own]
            for name in others:
                writer, _, time_s = name.removeprefix(_ANNOUNCEMENT).rpartition("-")
                self._refuse_writer(f"{writer} {time_s}".encode())
            self.remove(others)
            yield
        finally:
            self.remove([own])

    def _write_claim(self, claim: bytes) -> None:
        """Write a claim, in the place of none or of an abandoned one."""
        if other := self._read_claim():
            self._refuse_writer(other)
            self.remove([_CLAIM])
        answer = self._create(claim, _CLAIM)
        if answer == errno.EEXIST:
            self._refuse_writer(self._read_claim())
            self._raise_claimed()
        if answer == errno.ENOSYS:
            self.put(claim, _CLAIM)

    def _refuse_writer(self, claim: bytes) -> None:
        """Refuse to write where another command's claim lies that is not abandoned.

        Raises
        ------
        OutputError
            Such a claim lies there.
        """
        if claim and not _is_abandoned(claim):
            minutes = max(time.time() - _time_of(claim), 0.0) / 60
            why = f"another command has been writing there for {minutes:.0f} min"
            advice = f"its results stay; wait for its end, or remove {_CLAIM} there where it was killed"
            raise OutputError(self._place, why, advice)

    def _create(self, content: bytes, name: str) -> int:
        """Write a file if the store finds none of its name.

        Returns
        -------
        int
            0; EEXIST if there is one; ENOSYS if the store refuses conditions.
        """

        def write() -> int:
            try:
                self._files.pipe_file(self._address_of(name), content, mode="create")
            except OSError as err:
                if isinstance(err, FileExistsError) or err.errno in (errno.EINVAL, errno.EBUSY):
                    return errno.EEXIST
                if err.errno != errno.ENOSYS:
                    raise
                return errno.ENOSYS
            return 0

        return self._ask(write)

    def _read_claim(self) -> bytes:
        """Return the claim at the address; empty if there is none."""

        def ask() -> bytes:
            self._files.invalidate_cache()
            try:
                return bytes(self._files.cat_file(self._address_of(_CLAIM), end=_LONGEST_CLAIM))
            except FileNotFoundError:
                return b""

        return self._ask(ask)

    def _check_claim(self, claim: bytes) -> None:
        """Refuse to continue if another command claimed the address at the same time."""
        if self._read_claim() != claim:
            self._raise_claimed()
        self._checked_s = time.time()

    def _raise_claimed(self) -> NoReturn:
        """Raise the error that another command has claimed the address."""
        why = "another command began to write there at the same time"
        raise OutputError(self._place, why, "its results stay; run this command again")

    def _validity_facts(self) -> list[object]:
        """Return size and version of each of `VALIDITY_FILES`; None for a file that does not exist."""
        return [
            (about.get("size"), version_of(about)) if (about := self._facts_of(name)) else None
            for name in VALIDITY_FILES
        ]

    def _facts_of(self, name: str) -> dict[str, Any]:
        """Return the facts that the store states about a file now; empty if there is no such file."""

        def ask() -> dict[str, Any]:
            self._files.invalidate_cache()
            try:
                facts: dict[str, Any] = self._files.info(self._address_of(name))
            except FileNotFoundError:
                return {}
            return facts

        return self._ask(ask)

    def _list_files(self, parts: Collection[str] | None) -> list[str]:
        """Return the names of the files below the address; `parts` as in `folder_on_disk`."""
        self._files.invalidate_cache()
        if parts is None:
            names = self._ask(lambda: self._files.find(self._name))
        else:
            names = self._ask(self._list_top_files)
            names += self._ask(lambda: [name for part in parts for name in self._files.find(self._address_of(part))])
        if names == [self._name]:
            raise OutputError(self._place, "a file is there", "name another place")
        return [name.removeprefix(f"{self._name}/") for name in names]

    def _list_top_files(self) -> list[str]:
        """Return the names of the files at the address, without its folders."""
        # `find` with a depth lists all files at az://, and ignores errors at s3://.
        try:
            entries = self._files.ls(self._name, detail=True)
        except FileNotFoundError:
            return []
        return [entry["name"] for entry in entries if entry["type"] == "file"]

    def _address_of(self, name: str) -> str:
        """Return the address of a file of this name, as the object store takes it."""
        return f"{self._name}/{name}" if name else self._name

    def remove(self, names: list[str]) -> None:
        """Remove the files of these names."""
        self._ask_for_each(lambda name: self._files.rm_file(self._address_of(name)), names)

    def _ask_for_each(self, request: Callable[[str], object], names: Iterable[str]) -> None:
        """Call `request` with the name of each file, several at the same time."""
        with ThreadPoolExecutor(MOST_REQUESTS) as pool:
            list(pool.map(lambda name: self._ask(lambda: request(name)), names))

    def _ask(self, request: Callable[[], Result]) -> Result:
        """Return the answer of the store to a request; raise its errors as OutputError."""
        with place_errors(self._place), _as_output(self._place):
            return ask_server(self._place, request, done=self._participle)


@contextmanager
def _as_output(place: UrlPath) -> Iterator[None]:
    """Raise a LogError of the block as an OutputError of a place."""
    try:
        yield
    except LogError as err:
        why = "cannot be written" if err.why == "no such file" else err.why
        raise OutputError(place, why, err.advice or "check that the bucket exists") from err


def _time_of(claim: bytes) -> float:
    """Return the time at which a claim was written [s since 1970]; 0 if the claim does not state it."""
    time_text = claim.rpartition(b" ")[2]
    return float(time_text) if time_text.isdigit() and len(time_text) < 15 else 0.0


def _is_abandoned(claim: bytes) -> bool:
    """Return whether no command holds a claim any more: its process has ended, or it was written an hour ago."""
    writer = claim.partition(b" ")[0].decode("ascii", "replace")
    # A process uploads to one address at a time, so a claim of this process is left from a broken connection.
    is_own = writer.rpartition("-")[0] == writer_id().rpartition("-")[0]
    return is_own or not may_still_write(writer) or _time_of(claim) < time.time() - ABANDONED_S


def _identity(file: Path) -> tuple[int, int]:
    """Return two numbers of a file on disk that change if it is replaced or written to."""
    status = file.stat()
    return status.st_ino, status.st_mtime_ns
