"""Memory that was freed, given back to the system between the stages of a long log."""

from __future__ import annotations

import sys

LARGE_BYTES = 600 << 20
"""A process that never took more has nothing to give back that would matter: all logs of up to an hour."""

M_ARENA_MAX = -8
"""Of glibc's ``malloc.h``."""


def use_one_arena() -> None:
    """Have all threads that start from now on allocate where the main thread does.

    glibc gives each thread an arena of its own, whose free end `malloc_trim` does not give back.
    """
    _call_libc("mallopt", M_ARENA_MAX, 1)


def give_back_freed() -> None:
    """Have the C library give freed memory back.

    glibc keeps freed blocks of up to 32 MB, in pieces that no other column of a long log fits into: after reading 10 h
    at 100 Hz they are 0.3 GB.
    """
    if sys.platform == "linux":
        from resource import RUSAGE_SELF, getrusage

        if getrusage(RUSAGE_SELF).ru_maxrss * 1024 > LARGE_BYTES:
            _call_libc("malloc_trim", 0)


def _call_libc(name: str, *arguments: int) -> None:
    """Call a function of the C library; other systems, and musl, have none of that name."""
    if sys.platform == "linux":
        import ctypes

        function = getattr(ctypes.CDLL(None), name, None)
        if function is not None:
            function(*arguments)
