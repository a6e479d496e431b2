"""Places of logs and results: files that somebody else may have put there, and addresses such as ``s3://b/drive.mcap``.

Only regular files are opened. Links in the path that a user names are followed. Below a directory no link is followed,
because its files may come from a stranger: a link could lead to any file of the user. Pipes and devices are refused,
because their reading may never end.
"""

from __future__ import annotations

import errno
import os
import re
import stat
import sys
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path, PurePath, PurePosixPath
from typing import Self
from urllib.parse import quote, unquote, unquote_plus, urlsplit

if sys.platform == "win32":
    from pathlib import WindowsPath as _LocalPath
else:
    from pathlib import PosixPath as _LocalPath

LARGEST_DOCUMENT_BYTES = 1 << 28
"""Largest file that is read into memory whole [bytes]. The run.json of a long drive has some MB."""

_READ_ON_BYTES = 1 << 20

# Windows has neither O_NONBLOCK nor O_CLOEXEC; pipes are no files there.
_FILE = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
_NO_LINK = getattr(os, "O_NOFOLLOW", 0)

NOT_REGULAR = "not a regular file"
SAVE_IT = "save its output to a file, and pass that file"

_URL = re.compile(r"^([a-z][a-z0-9+.-]+)://(?!/)", re.IGNORECASE)
SCHEMES = ("s3", "s3a", "gs", "gcs", "az", "abfs", "abfss", "http", "https")
"""Schemes of the addresses that are read: object stores and web servers. Other schemes (``file``, ``memory``,
``github``, chains with ``::``) reach files, devices, memory or programs of this machine."""

_MEANT = re.compile(rf"\b(?:([a-z][a-z0-9+.-]+):[/\\]{{2}}|({'|'.join(SCHEMES)}):[/\\])", re.IGNORECASE)
"""Pattern of texts that are meant as addresses, although text stands before the address or a slash is missing. Such a
text may hold passwords and tokens, which no output shows."""

_LEAST_SECRET = 4
"""Length of the shortest secret that is removed from texts of libraries, in characters."""


class NotRegularFileError(OSError):
    """A link, pipe, device or directory where a regular file is expected."""

    def __init__(self, path: Path, why: str = NOT_REGULAR) -> None:
        advice = f"; {SAVE_IT}" if why == NOT_REGULAR else ""
        super().__init__(errno.EINVAL, f"{why}{advice}", str(path))


@dataclass(frozen=True, slots=True)
class Below:
    """A file or a folder below a folder. It is read and written without following a link below that folder.

    Attributes
    ----------
    folder : links above it are followed, because the user named it
    name : path from the folder
    """

    folder: Path
    name: str | PurePath

    @property
    def path(self) -> Path:
        """The whole path."""
        return self.folder / self.name

    def check_links(self) -> None:
        """Refuse a path that is a link or leads over a link.

        Raises
        ------
        NotRegularFileError
            The path is a link or leads over a link, or it does not lie below the folder.
        """
        above, parts = self.folder, PurePath(self.name).parts
        if ".." in parts or PurePath(self.name).is_absolute():
            raise NotRegularFileError(self.path, f"does not lie in {self.folder}")
        for part in parts:
            above = above / part
            if above.is_symlink():
                raise NotRegularFileError(above, f"{part} is a link, which is not followed")


Place = Path | Below
"""A path that the user named, whose links are followed, or a path below a folder, where no link is followed."""


def path_of(place: Place) -> Path:
    """Return the path of a place."""
    return place.path if isinstance(place, Below) else place


def below(folder: Path | None, path: Path) -> Place:
    """Return a path as `Below` a folder; the path itself where the folder is None, because the user named the path.

    Raises
    ------
    ValueError
        The path does not begin with the folder.
    """
    return path if folder is None else Below(folder, path.relative_to(folder))


def open_regular(place: Place) -> BufferedReader:
    """Return a regular file, opened for reading. The function never waits for a pipe or a device.

    Raises
    ------
    NotRegularFileError
        The place is a pipe, a device or a directory; or, below a folder, it is a link or leads over a link.
    OSError
        The file cannot be opened.
    """
    if isinstance(place, Below):
        place.check_links()
    path = path_of(place)
    handle = os.open(path, _FILE | _NO_LINK if isinstance(place, Below) else _FILE)
    try:
        mode = os.fstat(handle).st_mode
        if stat.S_ISDIR(mode):
            raise NotRegularFileError(path, "a directory; name a file")
        if not stat.S_ISREG(mode):
            raise NotRegularFileError(path)
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


def read_regular(place: Place, most_bytes: int = LARGEST_DOCUMENT_BYTES) -> bytes:
    """Return the content of a file that `open_regular` opens.

    Raises
    ------
    OSError
        As `open_regular`; the file is larger than `most_bytes`.
    """
    with open_regular(place) as file:
        # read() allocates the memory that it is asked for: the size of the file, not the limit. A large sparse file is
        # refused before it is read.
        size = os.fstat(file.fileno()).st_size
        content = file.read(size + 1) if size <= most_bytes else b""
        while max(size, len(content)) <= most_bytes and (
            more := file.read(min(_READ_ON_BYTES, most_bytes + 1 - len(content)))
        ):
            content += more
    if max(size, len(content)) > most_bytes:
        raise OSError(errno.EFBIG, f"larger than {most_bytes} bytes", str(path_of(place)))
    return content


def is_special(path: Path) -> bool:
    """Return whether a path is a pipe or a device, whose reading may never end."""
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):
        return False
    return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))


def is_regular(place: Place) -> bool:
    """Return whether a place is a file that `open_regular` opens."""
    try:
        open_regular(place).close()
    except (OSError, ValueError):  # ValueError: the text is no path
        return False
    return True


class UrlPath(_LocalPath):
    """An address where the path of a log or of a result is expected.

    Its text, which outputs show, has no password and no query, because queries may hold tokens and signatures. Only
    `url` has them. For Python's functions on files it is a path that does not exist. No method opens a connection.
    """

    _url: str

    def __new__(cls, url: str) -> Self:  # noqa: D102 - the constructor
        made = super().__new__(cls, without_secrets(url))
        made._url = url
        return made

    def __init__(self, url: str) -> None:
        if sys.version_info >= (3, 12):
            super().__init__(without_secrets(url))

    @property
    def url(self) -> str:
        """The whole address, with password and query."""
        return self._url

    @property
    def scheme(self) -> str:
        """The kind of the address: the text before ``://``, in lower case."""
        return _parts(self._url)[0].lower()

    @property
    def parent(self) -> Path:  # type: ignore[override]  # of any path
        """The folder of the address."""
        return Path(*self.parts[:-1])

    def with_segments(self, *segments: object) -> Path:
        """Return parts of the address as an ordinary path."""
        return Path(*map(str, segments))

    def __truediv__(self, name: object) -> Self:
        """Return the address of a file or folder below this address."""
        behind = _parts(self._url)[3] if self.scheme.startswith("http") else ""
        place = self._url.removesuffix(behind) or self._url
        return type(self)(f"{place.rstrip('/')}/{PurePosixPath(str(name)).as_posix()}{behind}")

    def absolute(self) -> Self:
        """Return the address itself, which has no relative form."""
        return self

    def __str__(self) -> str:
        return without_secrets(self._url)

    def __fspath__(self) -> str:
        return self._url

    @property
    def digest(self) -> str:
        """SHA-256 (hex) of the whole address, because addresses that differ only in their queries have equal texts."""
        import hashlib  # here, because the help of a command does not need it

        return hashlib.sha256(self._url.encode("utf-8", "surrogateescape")).hexdigest()

    def problem(self) -> str:
        """Return in words why the address cannot be read; empty where it can."""
        if not _URL.match(self._url):
            return "it does not begin with a kind of address, :// and a host or a bucket"
        if "::" in self._url.partition("?")[0]:
            return "chains with :: are not read"
        if self.scheme not in SCHEMES:
            return f"{self.scheme}:// is no kind of address that is read"
        if not self._url.isprintable() or chr(92) in self._url:
            return "it has characters that no address has"
        try:
            parts = urlsplit(without_secrets(self._url))
            is_whole = bool(parts.netloc.strip(".:…")) and (parts.port is None or parts.port > 0)
        except ValueError as err:
            return str(err)
        return "" if is_whole else "it names no host or bucket"

    def without_own_secrets(self, text: str) -> str:
        """Return a text of a library with the secrets of this address left out."""
        for secret in _secrets_of(self._url):
            text = text.replace(secret, "…")
        return text

    def __reduce__(self) -> tuple[type[UrlPath], tuple[str]]:
        return UrlPath, (self._url,)

    def exists(self, **_: bool) -> bool:
        """Return False: an address is no file of this machine."""
        return False

    is_file = is_dir = is_symlink = exists


def place_of(named: str | Path) -> Path:
    """Return the place that a user named: a `UrlPath` for an address, even a malformed address; else a path."""
    text = os.fspath(named)
    return UrlPath(text) if _MEANT.search(text) else Path(text)


def _parts(url: str) -> tuple[str, str, str, str]:
    """Return the parts of an address: scheme, user and password, the part that is shown, and the rest."""
    if not _URL.match(url):
        meant = _MEANT.search(url)
        return (meant[1] or meant[2] if meant is not None else ""), "", "…", url
    scheme, _, rest = url.partition("://")
    is_web, first = scheme.lower().startswith("http"), rest.partition("/")[0]
    known, mark, host = first.rpartition("@")
    shown = host + rest[len(first) :]
    port = first.partition(":")[2]
    if not mark and ":" in first and "@" in rest and not (is_web and (port.isdecimal() or first.startswith("["))):
        known, mark, shown = rest.rpartition("@")  # a password with a slash
    if "?" in known or "#" in known:
        return scheme, "", "…", rest  # a malformed address: its parts cannot be separated
    end = min((at for sign in ("?#" if is_web else "?") if (at := shown.find(sign)) >= 0), default=len(shown))
    return scheme, known, shown[:end], shown[end:]


def without_secrets(url: str) -> str:
    """Return an address without user, password and query, where tokens and signatures stand; other texts unchanged."""
    if not _MEANT.search(url):
        return url
    scheme, _, shown, _ = _parts(url)
    return f"{scheme}://{shown}"


def _secrets_of(url: str) -> list[str]:
    """Return the secret parts of an address, as written, escaped and without escapes, the longest first."""
    _, known, _, behind = _parts(url)
    whole = {form for text in (known, behind) for form in (text, unquote(text), unquote_plus(text), quote(text))}
    # A library may show pieces of the secrets.
    pieces = whole | {piece for text in whole for piece in re.split(r"[^\w.~-]+", text)}
    return sorted((piece for piece in pieces if len(piece) >= _LEAST_SECRET), key=len, reverse=True)
