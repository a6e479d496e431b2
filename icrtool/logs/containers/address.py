"""Connections to object stores and web servers, by fsspec: requests, and the one line that reports where they fail.

The one place that opens connections, and only for an address that the user, or his manifest, names. Credentials are
those that the provider's own library finds.
"""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable
from typing import Any, TypeVar

from icrtool.errors import LogError
from icrtool.records.urls import UrlPath, place_of, without_secrets

Result = TypeVar("Result")

_NEEDS = {"s3": "s3fs", "s3a": "s3fs", "gs": "gcsfs", "gcs": "gcsfs", "az": "adlfs", "abfs": "adlfs", "abfss": "adlfs",
          "http": "aiohttp", "https": "aiohttp"}  # fmt: skip
"""The library that each kind of address is read with."""

_LOGGERS = ("fsspec", "s3fs", "aiobotocore", "botocore", "gcsfs", "google", "adlfs", "azure", "aiohttp")

_PAUSES_S = (0.5, 2.0)
"""Before a request to a web server is made again; the libraries of object stores do so themselves."""

_FAILURES = (
    ("botocore.exceptions", "BotoCoreError"), ("botocore.exceptions", "ClientError"), ("aiohttp", "ClientError"),
    ("google.auth.exceptions", "GoogleAuthError"), ("gcsfs.retry", "HttpError"),
    ("azure.core.exceptions", "AzureError"), ("fsspec.exceptions", "FSTimeoutError"),
)  # fmt: skip
"""What libraries raise beside OSError, where they are loaded."""


def address_of(url: str, asked_for: UrlPath) -> UrlPath:
    """Return an address that was found, with the query of the one that was asked for, where a web server needs it."""
    query = asked_for.url.partition("?")[2] if asked_for.scheme.startswith("http") else ""
    found = place_of(f"{url}?{query}" if query and "?" not in url else url)
    if not isinstance(found, UrlPath):
        raise LogError(asked_for, "is no address", str(found))
    return found


def filesystem(path: UrlPath) -> tuple[Any, str]:
    """Return the fsspec file system of an address, and the name of the file in it."""
    needed = _NEEDS.get(path.scheme)
    extra = "http" if needed == "aiohttp" else "cloud"
    try:
        import fsspec
        from fsspec.core import url_to_fs

        fsspec.get_filesystem_class(path.scheme)
    except ImportError as err:
        raise LogError(path, f"needs {needed or err}", f"pip install 'icrtool[{extra}]'") from err
    except ValueError as err:
        raise LogError(
            path, f"{path.scheme}:// is no kind of address that can be read", "try s3, gs, az or https"
        ) from err
    for name in _LOGGERS:
        # They log tracebacks of requests, and addresses with their queries; one line reports where they fail.
        if (logger := logging.getLogger(name)).level == logging.NOTSET:
            logger.setLevel(logging.CRITICAL + 1)
    found: tuple[Any, str] = asked(path, lambda: url_to_fs(path.url))
    return found


def asked(path: UrlPath, ask: Callable[[], Result], *, again: bool = True, done: str = "read") -> Result:
    """Return the answer to a request, made again where the connection broke.

    Parameters
    ----------
    done : what is to be done: ``read`` or ``written``

    Raises
    ------
    LogError
        The file is not there, it must not be done, or the connection stays broken.
    """
    pauses = list(_PAUSES_S) if again and path.scheme.startswith("http") else []
    while True:
        try:
            return ask()
        except _failures() as err:
            # fsspec calls every failure of a web server a file that is not there, and names the true one as its cause.
            cause = err.__cause__ if isinstance(err, FileNotFoundError) and err.__cause__ is not None else err
            status = getattr(cause, "status", None)
            if isinstance(cause, FileNotFoundError) or status == 404:
                raise LogError(path, "no such file") from None
            refused = isinstance(cause, PermissionError | ValueError) or status in {401, 403}
            if refused or not pauses:
                why = f"may not be {done}" if refused else f"cannot be {done}"
                raise LogError(path, why, without_secrets(str(cause) or type(cause).__name__)) from None
            time.sleep(pauses.pop(0))


def _failures() -> tuple[type[Exception], ...]:
    """Return what a broken connection or a refused request is raised as."""
    loaded = [getattr(sys.modules.get(module), name, None) for module, name in _FAILURES]
    return (OSError, ValueError, *(one for one in loaded if one is not None))
