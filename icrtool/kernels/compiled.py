"""One decorator for every compiled kernel."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import cpu_target

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

_BLAS = "scipy.linalg.cython_blas"
if _BLAS not in sys.modules:
    # numba looks for scipy's BLAS when its array functions are loaded, which takes longer than to load all the rest of
    # it. No kernel of ours multiplies matrices; numba finds it again when someone else's does.
    sys.modules[_BLAS] = None  # type: ignore[assignment]  # Python's mark for "cannot be imported"
    try:
        importlib.import_module("numba.np.arraymath")
    finally:
        del sys.modules[_BLAS]


def load_compiler() -> None:
    """Make numba ready to load kernels, as the first call of one does; another thread may read files meanwhile."""
    # numba takes this lock where it compiles; two threads that refresh at once fail
    with global_compiler_lock:
        for context in (cpu_target.typing_context, cpu_target.target_context):
            context.refresh()


def njit(function: Kernel) -> Kernel:
    """Compile `function` with numba, cached on disk where a cache can be written.

    Notes
    -----
    numba refuses ``cache=True`` with RuntimeError when neither the package's folder nor the user's cache folder is
    writable (read-only containers, CI sandboxes). The kernel then compiles in memory, once a process.
    ``error_model="numpy"`` makes a division by zero an inf, as in the NumPy twins, and lets loops vectorise.
    ``nogil=True`` lets the next piece of a log be read and decompressed while a kernel runs.
    ``no_cfunc_wrapper``: no kernel is called from C, and the wrapper for that takes time to compile.
    The plain Python function stays reachable as ``.py_func``.
    """
    options = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
    try:
        dispatcher = numba.njit(cache=True, **options)(function)
    except RuntimeError:
        dispatcher = numba.njit(**options)(function)
    return cast(Kernel, dispatcher)
