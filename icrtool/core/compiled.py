"""One decorator for every compiled kernel."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Kernel = TypeVar("Kernel", bound=Callable[..., Any])


def njit(function: Kernel) -> Kernel:
    """Compile `function` with numba, cached on disk where a cache can be written.

    Notes
    -----
    numba refuses ``cache=True`` with RuntimeError when neither the package's folder nor the user's cache folder is
    writable (read-only containers, CI sandboxes). The kernel then compiles in memory, once a process.
    ``error_model="numpy"`` makes a division by zero an inf, as in the NumPy twins, and lets loops vectorise.
    ``nogil=True`` lets the next piece of a log be read and decompressed while a kernel runs.
    The plain Python function stays reachable as ``.py_func``.
    """
    try:
        dispatcher = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:
        dispatcher = numba.njit(nogil=True, error_model="numpy")(function)
    return cast(Kernel, dispatcher)
