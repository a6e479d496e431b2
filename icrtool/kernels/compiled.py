"""One decorator for every compiled kernel, and where its machine code is kept."""

from __future__ import annotations

import functools
import hashlib
import importlib
import pkgutil
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar, TypeVar, cast

import numba
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.dispatcher import Dispatcher
from numba.core.registry import cpu_target
from numba.extending import overload

Kernel = TypeVar("Kernel", bound=Callable[..., Any])


def _load_compiler() -> None:
    """Load what numba compiles with, except scipy's BLAS.

    To look for it takes longer than all the rest. No kernel multiplies matrices; numba finds it again when someone
    else's does.
    """
    blas = "scipy.linalg.cython_blas"
    if blas not in sys.modules:
        sys.modules[blas] = None  # type: ignore[assignment]  # Python's mark for "cannot be imported"
        try:
            importlib.import_module("numba.np.arraymath")
        finally:
            del sys.modules[blas]


@functools.cache
def _stamp() -> str:
    """Return a digest of all kernels: the machine code of one holds that of those it calls, in whichever file."""
    files = sorted(Path(__file__).parent.rglob("*.py"))
    return hashlib.sha256(b"\0".join(file.read_bytes() for file in files)).hexdigest()


class _Place:
    """One of numba's places for machine code; a directory that holds some is used where it cannot be written, too."""

    def get_source_stamp(self) -> str:
        """Return what the machine code was compiled from; numba compiles again where it changed."""
        return _stamp()

    def ensure_cache_path(self) -> None:
        """Raise OSError where the directory can neither be written nor be read with profit."""
        try:
            super().ensure_cache_path()  # type: ignore[misc]  # of numba's class, beside this one
        except OSError:
            if not (numba.config.CACHE_DIR and any(Path(self.get_cache_path()).glob("*.nbi"))):  # type: ignore[attr-defined]
                raise


class _Places(CompileResultCacheImpl):  # type: ignore[misc]
    """``NUMBA_CACHE_DIR``, else beside the package, else the user's cache: numba's order, its other places left out."""

    _locator_classes: ClassVar[list[type]] = [
        type(one.__name__, (_Place, one), {})
        for one in CompileResultCacheImpl._locator_classes[:3]  # noqa: SLF001 - numba has no public list
    ]


class _Cache(FunctionCache):  # type: ignore[misc]
    """Machine code of a kernel, kept where it can be."""

    _impl_class = _Places

    def load_overload(self, sig: object, target_context: object) -> object:
        """Return the machine code of a kernel, None where it is to be compiled.

        Without what numba compiles with, which its own method loads before it looks: that takes longer than to import
        numba.
        """
        with self._guard_against_spurious_io_errors():
            kept = self._load_overload(sig, target_context)
        if kept is None:
            _load_compiler()
        return kept

    def save_overload(self, sig: object, data: object) -> None:
        """Keep newly compiled code; on a full disk or in a read-only directory it serves this process alone."""
        with suppress(OSError):
            super().save_overload(sig, data)


_OPTIONS = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, "_nrt": False}
"""``error_model="numpy"`` makes a division by zero an inf, as in the NumPy twins, and lets loops vectorise; ``nogil``
lets another thread read files while a kernel runs. No kernel is called from C: that wrapper takes time to compile.
No kernel allocates an array, so none counts references to them (``_nrt``): that took a third of the filter's time."""


def njit(function: Kernel) -> Kernel:
    """Compile `function` with numba, cached on disk where a cache can be written or was.

    Notes
    -----
    Where neither ``NUMBA_CACHE_DIR``, the package's folder nor the user's cache folder is writable (read-only
    containers, CI sandboxes), the kernel compiles in memory, once a process.
    The plain Python function stays reachable as ``.py_func``.
    """
    dispatcher = numba.njit(**_OPTIONS)(function)
    try:
        dispatcher._cache = _Cache(function)  # noqa: SLF001 - as numba's own `cache=True` does, with its class
    except RuntimeError:
        _load_compiler()
    return cast(Kernel, dispatcher)


def njit_part(function: Kernel) -> Kernel:
    """Mark a function as part of kernels: compiled with those that call it, plain Python where Python calls it.

    The wrapper by which Python would call compiled code takes a fifth of the time to compile. A plain number in a call
    is a constant to the compiled function, of which there is one copy for each.
    """
    overload(function, jit_options=_OPTIONS, strict=False, prefer_literal=True)(lambda *_: function)
    return function


def all_kernels() -> Iterator[Any]:
    """Import every module of kernels; yield each compiled function once."""
    package = importlib.import_module(__name__.rpartition(".")[0])
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        for found in vars(importlib.import_module(module.name)).values():
            if isinstance(found, Dispatcher) and found.py_func.__module__ == module.name:
                yield found


def processor() -> str:
    """Return the name of the processor that is compiled for; ``generic`` is any of this architecture."""
    name: str = cpu_target.target_context.codegen().magic_tuple()[1]
    return name
