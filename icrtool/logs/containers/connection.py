"""Connections to servers, opened with fsspec and with limits on time; no other module opens one.

Connections are made only to addresses that the user or a manifest of the user names, and to public addresses that their
servers redirect to. The library of the provider finds the credentials.
"""

from __future__ import annotations

import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable
from functools import cache
from typing import Any, TypeVar

from icrtool.errors import LogError
from icrtool.records.input_limits import server_timeout_s
from icrtool.records.places import SCHEMES, UrlPath
from icrtool.records.text import LONGEST_NAME, LONGEST_TEXT, shortened

Result = TypeVar("Result")

SLOWEST_BPS = 10_000
"""Slowest mean rate at which a server may send data, after the first `server_timeout_s` [bytes/s]. Without this limit a
server that sends a byte now and then would stop a command for days."""

LARGEST_LISTING_BYTES = 1 << 22
"""Largest size of a web page with the list of a folder [bytes]. Such a page lists about 40,000 names."""

_LIBRARIES = {
    "s3": "s3fs", "s3a": "s3fs", "gs": "gcsfs", "gcs": "gcsfs", "az": "adlfs", "abfs": "adlfs", "abfss": "adlfs",
    "http": "aiohttp", "https": "aiohttp",
}  # fmt: skip
"""Name of the library that opens each kind of address."""

_LOGGERS = ("fsspec", "s3fs", "aiobotocore", "botocore", "gcsfs", "google", "adlfs", "azure", "aiohttp", "asyncio")
"""Names of the loggers of these libraries."""

PAUSES_S = (0.5, 2.0)
"""Pauses before a request to a web server is repeated [s]; the libraries of object stores repeat requests
themselves."""

_FAILURES = (
    ("botocore.exceptions", "BotoCoreError"), ("botocore.exceptions", "ClientError"), ("aiohttp", "ClientError"),
    ("google.auth.exceptions", "GoogleAuthError"), ("gcsfs.retry", "HttpError"),
    ("azure.core.exceptions", "AzureError"), ("fsspec.exceptions", "FSTimeoutError"),
)  # fmt: skip
"""Module and name of the errors that libraries raise in addition to OSError."""

_UNREACHED = (("aiohttp", "ClientConnectionError"), ("azure.core.exceptions", "ServiceRequestError"))
"""Module and name of the errors without any answer of a host."""

_SLOW_TO_GIVE_UP = frozenset({"gs", "gcs", "az", "abfs", "abfss"})
"""Schemes whose libraries have no setting that ends the requests to a dead host."""

_READ_BYTES = 1 << 16
"""Number of bytes of a page that are read at a time."""


def filesystem(path: UrlPath) -> tuple[Any, str]:
    """Return the fsspec file system of an address, and the name of the file in it.

    Raises
    ------
    LogError
        The address is not valid, its library is not installed, or the server refuses access.
    """
    if problem := path.problem():
        advice = f"an address begins with {', '.join(f'{scheme}://' for scheme in SCHEMES)}; name a file by its path"
        raise LogError(path, f"is not read: {problem}", advice)
    needed = _LIBRARIES[path.scheme]
    extra = "http" if needed == "aiohttp" else "cloud"
    try:
        import fsspec

        kind: Any = fsspec.get_filesystem_class(path.scheme)
    except ImportError as err:
        raise LogError(path, f"needs {needed or err}", f"pip install 'icrtool[{extra}]'") from err
    for name in _LOGGERS:
        # These libraries log tracebacks, and addresses with secrets. icrtool reports a failure in one line.
        if (logger := logging.getLogger(name)).level == logging.NOTSET:
            logger.setLevel(logging.CRITICAL + 1)
    try:
        # `url_to_fs` of fsspec is not used, because it follows chains with ::, even after a question mark.
        address = path.scheme + path.url[len(path.scheme) :]
        settings = ask_server(path, lambda: {**kind._get_kwargs_from_urls(address), **_timeout_settings(path.scheme)})  # noqa: SLF001 - as it does
        inner: str = ask_server(path, lambda: kind._strip_protocol(address))  # noqa: SLF001
        if path.scheme in _SLOW_TO_GIVE_UP:
            stated, bucket = tuple(sorted(settings.items())), inner.partition("/")[0]
            files = ask_server(path, lambda: _answering_store(kind, stated, bucket, os.getpid()))
        else:
            files = ask_server(path, lambda: kind(**settings))
    except (KeyError, IndexError, TypeError, AttributeError, NotImplementedError) as err:
        raise LogError(path, "is no address that can be read", type(err).__name__) from None
    return files, inner


@cache
def _answering_store(kind: Any, settings: tuple[tuple[str, Any], ...], bucket: str, process: int) -> Any:  # noqa: ANN401, ARG001 - of a library; connections belong to a process
    """Return the file system of a store whose host has answered a first question within `server_timeout_s`.

    Notes
    -----
    The libraries look for credentials and repeat requests to a dead host for 20 to 85 s, and have no setting for that.
    A later request to a store that answered is repeated as they do.

    Raises
    ------
    TimeoutError
        The host does not answer in time.
    """
    answers: list[tuple[Any, Exception | None]] = []

    def ask() -> None:
        files = None
        try:
            files = kind(**dict(settings), skip_instance_cache=True)
            files.exists(bucket)
        except Exception as err:  # noqa: BLE001 - it is looked at in the thread of the caller
            answers.append((files, err))
        else:
            answers.append((files, None))

    asking = threading.Thread(target=ask, daemon=True)
    asking.start()
    asking.join(server_timeout_s())
    if not answers:
        raise TimeoutError
    files, err = answers[0]
    if err is not None and (files is None or isinstance(err, _classes(_UNREACHED))):
        raise err
    # A host that refuses to describe its bucket may still give a file.
    return files


def _timeout_settings(scheme: str) -> dict[str, Any]:
    """Return the fsspec settings of a scheme that end a request if the server sends nothing."""
    quiet_s = server_timeout_s()
    if scheme.startswith("http"):
        from aiohttp import ClientTimeout

        timeout = ClientTimeout(total=None, sock_connect=quiet_s, sock_read=quiet_s)
        return {
            "client_kwargs": {
                "timeout": timeout,
                "response_class": _limited_response_class(),
                "trace_configs": [_redirect_check()],
            }
        }
    if scheme.startswith("s3"):
        return {"config_kwargs": {"connect_timeout": quiet_s, "read_timeout": quiet_s, "retries": {"max_attempts": 1}}}
    return {}


@cache
def _limited_response_class() -> type[Any]:
    """Return a subclass of aiohttp's ``ClientResponse`` with limits on time and length.

    The whole header must arrive within `server_timeout_s`. A body that is read at once has at most
    `LARGEST_LISTING_BYTES`.
    """
    import asyncio

    from aiohttp import ClientResponse

    class LimitedResponse(ClientResponse):
        async def start(self, connection: Any) -> ClientResponse:  # noqa: ANN401 - of a library
            async with asyncio.timeout(server_timeout_s()):
                return await super().start(connection)

        async def read(self) -> bytes:
            if self._body is None:
                body, began_s, quiet_s = bytearray(), time.monotonic(), server_timeout_s()
                while piece := await self.content.read(_READ_BYTES):
                    body += piece
                    check_pace(began_s, len(body), quiet_s)
                    if len(body) > LARGEST_LISTING_BYTES:
                        raise ValueError(f"its server sends a list of more than {LARGEST_LISTING_BYTES:,} bytes")
                self._body = bytes(body)
            return self._body

    return LimitedResponse


@cache
def _redirect_check() -> Any:  # noqa: ANN401 - of a library
    """Return a trace configuration of aiohttp that calls `check_redirect` for each redirect of a web server."""
    from aiohttp import TraceConfig
    from yarl import URL

    async def check(_: object, __: object, redirect: Any) -> None:  # noqa: ANN401 - of a library
        headers = redirect.response.headers
        target = redirect.url.join(URL(headers.get("Location") or headers.get("URI") or ""))
        await check_redirect(redirect.url, target)

    trace = TraceConfig()
    trace.on_request_redirect.append(check)
    return trace


async def check_redirect(url: Any, target: Any) -> None:  # noqa: ANN401 - addresses of a library
    """Refuse a redirect from https to another scheme, or to another host that has no public address.

    Otherwise a server could make a command read from a machine that only this machine can reach.

    Raises
    ------
    ValueError
        The redirect is refused.
    """
    import asyncio
    from ipaddress import ip_address

    if target.scheme not in {url.scheme, "https"}:
        raise ValueError(f"its server redirects from {url.scheme}:// to {target.scheme[:LONGEST_NAME]}://")
    if target.host == url.host:
        return
    found = await asyncio.get_running_loop().getaddrinfo(target.host, target.port)
    if not all(ip_address(str(answer[4][0]).partition("%")[0]).is_global for answer in found):
        raise ValueError(f"its server redirects to {target.host}, which has no public address")


def in_time(files: Any, method: str, *given: object, expected_bytes: int = 0, **named: object) -> Any:  # noqa: ANN401 - of a library
    """Return the result of a method of a file system, called with a limit on time.

    Parameters
    ----------
    given, named : arguments of the method
    expected_bytes : expected size of the answer [bytes]; each `SLOWEST_BPS` of it may take another second

    Raises
    ------
    TimeoutError
        The server sends nothing, or too slowly.
    """
    if not getattr(files, "async_impl", False):
        return getattr(files, method)(*given, **named)
    from fsspec.asyn import sync

    seconds = server_timeout_s() + expected_bytes / SLOWEST_BPS
    return sync(files.loop, getattr(files, f"_{method}"), *given, timeout=seconds, **named)


def check_pace(began_s: float, received: int, quiet_s: float) -> None:
    """Refuse a server that sends too slowly.

    Parameters
    ----------
    began_s : time of `time.monotonic` at the start of the request [s]
    received : number of bytes that were received
    quiet_s : time in which the server may send nothing [s]

    Raises
    ------
    TimeoutError
        The bytes took longer than `quiet_s` and the time that they take at `SLOWEST_BPS`.
    """
    if time.monotonic() - began_s > quiet_s + received / SLOWEST_BPS:
        raise TimeoutError


def ask_server(path: UrlPath, ask: Callable[[], Result], *, again: bool = True, done: str = "read") -> Result:
    """Return the answer to a request.

    Parameters
    ----------
    path : address of the file
    ask : sends the request and returns the answer
    again : whether the request is repeated after a broken connection
    done : purpose of the request in messages: ``read`` or ``written``

    Raises
    ------
    LogError
        The file does not exist, access is refused, or the connection stays broken.
    """
    pauses = list(PAUSES_S) if again and path.scheme.startswith("http") else []
    while True:
        try:
            return ask()
        except _connection_errors() as err:
            # fsspec raises FileNotFoundError for every failure of a web server; its cause is the true error.
            cause = err.__cause__ if isinstance(err, FileNotFoundError) and err.__cause__ is not None else err
            status = getattr(cause, "status", None)
            if isinstance(cause, FileNotFoundError) or status == 404:
                raise LogError(path, "no such file") from None
            refused = isinstance(cause, PermissionError | ValueError) or status in {401, 403}
            timed_out = isinstance(cause, TimeoutError)
            if refused or timed_out or not pauses:
                why = f"may not be {done}" if refused else f"cannot be {done}"
                raise LogError(path, why, _failure_text(cause, path)) from None
            time.sleep(pauses.pop(0))


def _failure_text(cause: BaseException, path: UrlPath) -> str:
    """Return the message of an error of a library, without the secrets of the address."""
    if isinstance(cause, TimeoutError):
        quiet, rate = f"{server_timeout_s():g} s", f"{SLOWEST_BPS / 1e3:g} kB/s"
        return f"its server sent nothing for {quiet}, or less than {rate} after them; --server-timeout sets the time"
    status = getattr(cause, "status", None)
    if isinstance(status, int):
        message = " ".join(str(getattr(cause, "message", "")).split())
        if not status:
            return "its server redirects without an end"
        # Only `message` is printed: the rest of the error is the address, or an address of a redirect.
        words = "sent an answer that is not HTTP:" if cause.__cause__ is not None else f"answered {status}"
        return shortened(f"its server {words} {message}".strip(), LONGEST_TEXT)
    words = " ".join(path.without_own_secrets(str(cause)).split())
    return shortened(words, LONGEST_TEXT) or type(cause).__name__


def _connection_errors() -> tuple[type[Exception], ...]:
    """Return the errors of a broken connection or a refused request."""
    return (OSError, ValueError, *_classes(_FAILURES))


def _classes(named: Iterable[tuple[str, str]]) -> tuple[type[Exception], ...]:
    """Return classes of errors, of those modules that are loaded."""
    loaded = [getattr(sys.modules.get(module), name, None) for module, name in named]
    return tuple(error for error in loaded if error is not None)
