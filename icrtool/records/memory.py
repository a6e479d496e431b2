"""Memory that was freed, given back to the system between the stages of a long log."""

from __future__ import annotations

import sys

LARGE_BYTES = 600 << 20
"""A process that never took more has nothing to give back that would matter: all logs of up to an hour."""


def give_back_freed() -> None:
    """Have the C library give freed memory back.

    glibc keeps freed blocks of up to 32 MB, in pieces that no other column of a long log fits into: after reading 10 h
    at 100 Hz they are 0.3 GB.
    """
    if sys.platform == "linux":
        import ctypes
        from resource import RUSAGE_SELF, getrusage

        if getrusage(RUSAGE_SELF).ru_maxrss * 1024 > LARGE_BYTES:
            trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # musl has none
            if trim is not None:
                trim(0)
