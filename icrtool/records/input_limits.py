"""Limits on the input from standard input and from servers.

The limits are environment variables, because the processes of a batch inherit the environment.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from icrtool.errors import ConfigError

MOST_BYTES, SERVER_TIMEOUT_S = "ICRTOOL_MOST_BYTES", "ICRTOOL_SERVER_TIMEOUT_S"
"""Names of the environment variables with the limits: largest size of a saved input [bytes], and longest time in which
a server may send nothing [s]."""

QUIET_S = 15.0
"""Longest time in which a server may send nothing, where nothing else is set [s]."""

Limit = TypeVar("Limit", int, float)

_UNITS = {"": 1, "k": 10**3, "M": 10**6, "G": 10**9, "T": 10**12}


def bytes_in(text: str) -> int:
    """Return the bytes that a text states: ``800000``, ``500M``, ``2GB``.

    Raises
    ------
    ValueError
        It states no number of bytes above 0.
    """
    parts = re.fullmatch(r"\s*(\d{1,18}(?:\.\d{1,9})?)\s*([kMGT]?)B?\s*", text, re.ASCII)
    count = int(float(parts[1]) * _UNITS[parts[2]]) if parts is not None else 0
    if count < 1:
        raise ValueError(f"{text!r} is no number of bytes; for example 800000, 500M or 2GB")
    return count


def seconds_in(text: str) -> float:
    """Return the seconds that a text states.

    Raises
    ------
    ValueError
        It states no finite number above 0.
    """
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0.0 < seconds < math.inf:
        raise ValueError(f"{text!r} is no number of seconds above 0")
    return seconds


def most_bytes() -> int | None:
    """Return the largest size of a saved input [bytes]; None without a limit.

    Raises
    ------
    ConfigError
        The environment states no number of bytes.
    """
    return _of_environment(MOST_BYTES, bytes_in)


def server_timeout_s() -> float:
    """Return the longest time in which a server may send nothing [s].

    Raises
    ------
    ConfigError
        The environment states no number of seconds.
    """
    stated_s = _of_environment(SERVER_TIMEOUT_S, seconds_in)
    return QUIET_S if stated_s is None else stated_s


def _of_environment(variable: str, parse: Callable[[str], Limit]) -> Limit | None:
    """Return the limit in an environment variable; None where the variable is not set."""
    if not (text := os.environ.get(variable)):
        return None
    try:
        return parse(text)
    except ValueError as err:
        raise ConfigError(variable, str(err)) from None


@contextmanager
def set_limit(variable: str, value: float) -> Iterator[None]:
    """Set a limit in the environment of this process until the block ends."""
    before = os.environ.get(variable)
    os.environ[variable] = f"{value!r}"
    try:
        yield
    finally:
        if before is None:
            del os.environ[variable]
        else:
            os.environ[variable] = before
