"""Places that are not on a disk of this machine: addresses such as ``s3://bucket/drive.mcap``."""

from __future__ import annotations

import re
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from typing import Self

if sys.platform == "win32":
    from pathlib import Path, PurePosixPath
    from pathlib import WindowsPath as _LocalPath
else:
    from pathlib import Path, PurePosixPath
    from pathlib import PosixPath as _LocalPath

_URL = re.compile(r"^([a-z][a-z0-9+.-]+)://", re.IGNORECASE)
_SECRETS = re.compile(r"(?<=://)[^/\s'\"@]*@|(?<=[\w/.~%+*-])\?[^\s'\"]*")


class UrlPath(_LocalPath):
    """An address where the path of a log or of a result is expected.

    Its text has no password and no query, where tokens and signatures stand: it is what every output shows. Only
    `url` has them. To Python's functions on files it is a path that does not exist; nothing here opens a connection.
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
        """The address, with all that it takes to read it."""
        return self._url

    @property
    def scheme(self) -> str:
        """What stands before ``://``."""
        return self._url.partition("://")[0].lower()

    @property
    def parent(self) -> Path:  # type: ignore[override]  # of any path
        """The folder that it lies in."""
        return Path(*self.parts[:-1])

    def with_segments(self, *segments: object) -> Path:
        """Return what is made of parts of it: a path like any other."""
        return Path(*map(str, segments))

    def __truediv__(self, name: object) -> Self:
        """Return the address of what lies below it."""
        place, mark, query = self._url.partition("?") if self.scheme.startswith("http") else (self._url, "", "")
        return type(self)(f"{place.rstrip('/')}/{PurePosixPath(str(name)).as_posix()}{mark}{query}")

    def absolute(self) -> Self:
        """Return itself."""
        return self

    def __str__(self) -> str:
        return without_secrets(self._url)

    def __fspath__(self) -> str:
        return self._url

    def __reduce__(self) -> tuple[type[UrlPath], tuple[str]]:
        return UrlPath, (self._url,)

    def exists(self, **_: bool) -> bool:
        """Return False: it is no file of this machine."""
        return False

    is_file = is_dir = is_symlink = exists


def place_of(text: str) -> Path:
    """Return what a user named: an address as `UrlPath`, anything else as a path."""
    return UrlPath(text) if _URL.match(text) else Path(text)


def without_secrets(text: str) -> str:
    """Return a text with the passwords, tokens and signatures of the addresses in it left out."""
    return _SECRETS.sub("", text)
