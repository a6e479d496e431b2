"""The decorator of compiled kernels, and the directory of their machine code.

numba compiles a kernel when it is first called on a computer. The object file is kept, and later processes run it by
llvmlite, the library below numba, because the import of numba takes longer than all other imports of a command: 0.6 s
of CPU and 64 MB.

The machine code is called as numba calls it, and numba does not publish this calling convention. Therefore a small
kernel is compiled and compared with Python before any code is kept (`passes_as_expected`). If the results differ, or if
a part of numba that is not public is missing, kernels are plain ``numba.njit(cache=True)``.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import importlib
import os
import pkgutil
import stat
import struct
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, TypeVar, cast

import llvmlite
import llvmlite.binding as llvm
import numpy as np

Function = TypeVar("Function", bound=Callable[..., Any])
Result = float | None

_OPTIONS = {"nogil": True, "error_model": "numpy"}
"""Options of every kernel. With ``error_model="numpy"`` a division by zero gives inf, as in NumPy, and loops can be
vectorised. With ``nogil`` another thread can read files while a kernel runs."""

_BARE = {**_OPTIONS, "no_cpython_wrapper": True, "no_cfunc_wrapper": True, "_nrt": False}
"""Options of machine code that `Kernel` calls itself. The wrappers for calls from Python and C, which take a fifth of
the compile time, are left out. Reference counts of arrays (``_nrt``), which took a third of the filter's time, are left
out, because no kernel allocates an array."""

_MATHEMATICS = {"atan2", "ceil", "cos", "exp", "floor", "fmod", "hypot", "log", "pow", "sin", "sqrt", "tan"}
"""Functions of the C library, which every process has. Machine code that calls any other function needs numba."""

_POINTER, _INTEGER, _FLOAT, _BOOL = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double, ctypes.c_bool
_ARRAY_FORM = (_POINTER, _POINTER, _INTEGER, _INTEGER, _POINTER)
"""C types of the first five words of an array."""

_BYTE = ctypes.c_char
_LLVM_TYPES = {_POINTER: "ptr", _INTEGER: "i64", _FLOAT: "double", _BOOL: "i8"}
"""Types of LLVM by C type."""

_SCALARS = {"bool": _BOOL, "int": _INTEGER, "float": _FLOAT, "NoneType": _POINTER}
"""C types of numbers and None by the name of their Python type."""

_RESULTS = {"none": None, "int64": _INTEGER, "float64": _FLOAT}
"""C types of results by the name of their type in numba."""

_DEBUGGING = ("NUMBA_BOUNDSCHECK", "NUMBA_DEBUGINFO")
"""Settings of numba for debugging. Machine code that is compiled with one of them is slower, and is not kept."""

_RETURNED = (0, -2)
"""Status codes of machine code that raised no exception: it returned a number, or None."""

_watchers: list[Callable[[], None]] = []
"""Functions that are called when numba begins to compile a kernel, which happens once on a computer."""

_parts: list[Callable[..., Any]] = []
_lock = threading.RLock()


def _is_set(name: str) -> bool:
    """Return whether a setting of numba is on."""
    return os.environ.get(name, "0") not in {"", "0"}


class _Arguments:
    """Arguments of a call, in the form that machine code of numba takes.

    Attributes
    ----------
    types : types that the machine code depends on, one for each array, tuple and number
    words, forms : the values in order, with tuples unpacked, and their C types
    """

    def __init__(self, values: Sequence[object]) -> None:
        self.types: list[object] = []
        self.words: list[object] = []
        self.forms: list[Any] = []
        for value in values:
            self._add(value)

    def _add(self, value: object) -> None:
        """Append an argument."""
        if isinstance(value, np.ndarray):
            if not value.flags.carray:
                raise TypeError("a kernel takes arrays that are contiguous and can be written")
            # This takes a tenth of the time of `ctypes.data`; only an array without elements needs `ctypes.data`.
            address = ctypes.addressof(_BYTE.from_buffer(cast(Any, value))) if value.size else value.ctypes.data
            self.types.append((value.dtype, value.ndim))
            # The words of an array are: owner, parent, size, size of an item, address, shape, strides.
            self.words += (None, None, value.size, value.itemsize, address, *value.shape, *value.strides)
            self.forms += _ARRAY_FORM + (_INTEGER,) * (2 * value.ndim)
        elif isinstance(value, tuple):
            self.types.append((type(value).__qualname__, len(value)))
            for item in value:
                self._add(item)
        else:
            plain: Any = value.item() if isinstance(value, np.generic) else value
            name = type(plain).__name__
            if name not in _SCALARS or (name == "int" and not -(2**63) <= plain < 2**63):
                raise TypeError(f"a kernel takes no {name} like {plain!r}")
            self.types.append(name)
            self.words.append(plain)
            self.forms.append(_SCALARS[name])


_OBJECT_MAGICS = (b"\x7fELF", b"\xcf\xfa\xed\xfe", b"\x64\x86", b"\x64\xaa")
"""First bytes of an object file: of Linux, macOS and Windows (two processors)."""


_ELF_SECTIONS = struct.Struct("<40xQ10xHHH")
"""Layout of the header of an ELF file (64 bits): offset of the table of sections, size of an entry, number of
entries."""


def _is_object(content: bytes) -> bool:
    """Return whether bytes are an object file. A file in ELF must be complete, because LLVM crashes otherwise."""
    if not content.startswith(_OBJECT_MAGICS) or len(content) < _ELF_SECTIONS.size:
        return False
    if not content.startswith(_OBJECT_MAGICS[0]):
        return True
    at, size, count, names = map(int, _ELF_SECTIONS.unpack_from(content))
    return _ELF_SECTIONS.size <= at and at + size * count <= len(content) and size == 64 and names < count


def _is_own(directory: Path) -> bool:
    """Return whether no other user can write a file or folder, because machine code in it is executed."""
    if not hasattr(os, "geteuid"):
        return True
    status = directory.stat()
    return status.st_uid in (0, os.geteuid()) and not status.st_mode & stat.S_IWOTH


class MachineCode(NamedTuple):
    """A compiled kernel: name of its function, type of its result (a key of `_RESULTS`), and object file."""

    name: str
    result: str
    content: bytes

    def written(self) -> bytes:
        """Return the bytes of its file: a digest of all that follows, name and type as lines, and the object file."""
        rest = b"\n".join([self.name.encode(), self.result.encode(), self.content])
        return hashlib.sha256(rest).digest() + rest

    @classmethod
    def read(cls, file: Path) -> MachineCode | None:
        """Return the kernel in a file; None if the file is missing or damaged, or if another user can write it."""
        with suppress(OSError, ValueError):
            data = file.read_bytes() if _is_own(file) and _is_own(file.parent) else b""
            if hashlib.sha256(data[32:]).digest() == data[:32]:
                name, result, content = data[32:].split(b"\n", 2)
                if result.decode() in _RESULTS and _is_object(content):
                    return cls(name.decode(), result.decode(), content)
        return None

    def function(self, forms: Sequence[Any]) -> Callable[[Sequence[object]], Result]:
        """Return a function that runs the code on words of arguments; `forms` are their C types."""
        engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine())
        engine.add_object_file(llvm.ObjectFileRef.from_data(self.content))
        engine.finalize_object()
        run = ctypes.CFUNCTYPE(ctypes.c_int32, _POINTER, _POINTER, *forms)(engine.get_function_address(self.name))
        result = _RESULTS[self.result]

        def call(words: Sequence[object], _: object = engine) -> Result:
            """Return the result of the code; the default argument keeps the engine in memory."""
            returned, raised = (result or _INTEGER)(), _POINTER()
            if run(ctypes.byref(returned), ctypes.byref(raised), *words) not in _RETURNED:
                raise RuntimeError(f"{self.name} raised an exception: kernels must not")
            return returned.value if result else None

        return call


class Kernel:
    """A function that runs as machine code.

    Its parameters are contiguous arrays, numbers, None, and tuples of these; it returns a number or None.

    Attributes
    ----------
    py_func : the plain Python function
    compiled : number of times that numba compiled it in this process
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self.py_func, self.compiled = function, 0
        self._runs_python = _is_set("NUMBA_DISABLE_JIT")
        self._functions: dict[tuple[object, ...], Callable[[Sequence[object]], Result] | None] = {}
        functools.update_wrapper(self, function)

    def __call__(self, *values: object) -> Result:
        """Run the machine code for arguments of these types; if ``NUMBA_DISABLE_JIT`` is 1, run the Python function."""
        if self._runs_python:
            return cast(Result, self.py_func(*values))
        arguments = _Arguments(values)
        types = tuple(arguments.types)
        if types not in self._functions:
            with _lock:
                # Another thread may have compiled the kernel meanwhile.
                if types not in self._functions:
                    self._functions[types] = self._function(types, values, arguments)
        run = self._functions[types]
        return run(arguments.words) if run else self._by_numba(*values)

    @functools.cached_property
    def _by_numba(self) -> Callable[..., Result]:
        """The function as numba itself calls and keeps it."""
        with _lock:
            return _plain_njit(self.py_func)

    def _function(
        self, types: tuple[object, ...], values: Sequence[object], arguments: _Arguments
    ) -> Callable[[Sequence[object]], Result] | None:
        """Return a function that runs machine code, kept or compiled now; None if only numba can run it."""
        name = f"{self.py_func.__module__.rpartition('.')[2]}.{self.py_func.__qualname__}"
        file = f"{name}-{hashlib.sha256(repr((_stamp(), types)).encode()).hexdigest()[:24]}.o"
        for directory in cache_directories() if _stamp() else ():
            if kept := MachineCode.read(directory / file):
                return _loaded(kept, arguments.forms)
        self.compiled += 1
        for watch in _watchers:
            watch()
        code = None
        if passes_as_expected():
            _mark_parts()
            code = machine_code(self.py_func, values, arguments.forms)
        if code is not None and _stamp():
            _keep(file, code.written())
        return _loaded(code, arguments.forms)


def _loaded(code: MachineCode | None, forms: Sequence[Any]) -> Callable[[Sequence[object]], Result] | None:
    """Return a function that runs machine code; None without code, or if this llvmlite cannot load it."""
    try:
        return code and code.function(forms)
    except Exception:  # noqa: BLE001 - whatever the reason, numba runs the kernel
        return None


def machine_code(function: Callable[..., Any], values: Sequence[object], forms: Sequence[Any]) -> MachineCode | None:
    """Return the machine code that numba makes of a function for arguments of some types.

    Parameters
    ----------
    values, forms : examples of the arguments, and the C types of their words

    Returns
    -------
    MachineCode or None
        None if this version of numba differs from the expected versions, or if the machine code needs numba.
    """
    try:
        return _machine_code(function, values, forms)
    except Exception:  # noqa: BLE001 - a part of numba that is not public may raise any error
        return None


def _machine_code(function: Callable[..., Any], values: Sequence[object], forms: Sequence[Any]) -> MachineCode | None:
    """Return the result of `machine_code`, or raise any error."""
    numba = _numba()
    dispatcher = numba.njit(**_BARE)(function)
    dispatcher.compile(tuple(numba.typeof(_writable(value)) for value in values))
    [signature] = dispatcher.nopython_signatures
    module, result = llvm.parse_assembly(dispatcher.inspect_llvm(signature.args)), signature.return_type
    called = {
        declared.name
        for declared in module.functions
        if declared.is_declaration and not declared.name.startswith("llvm.")
    }
    # A version of numba that passes arguments in another form has no such function.
    expected = [_LLVM_TYPES[form] for form in [_POINTER, _POINTER, *forms]]
    entries = [
        defined.name
        for defined in module.functions
        if not defined.is_declaration
        and ["ptr" if word.type.is_pointer else str(word.type) for word in defined.arguments] == expected
    ]
    returned = str(numba.types.unliteral(result))
    if not called <= _MATHEMATICS or len(entries) != 1 or returned not in _RESULTS:
        return None
    return MachineCode(entries[0], returned, _machine(numba.config.OPT).emit_object(module))


class _Example(NamedTuple):
    """An array and a flag, passed as one argument."""

    weights: np.ndarray[Any, Any]
    doubled: bool


def _scaled(weight: float, factor: float) -> float:
    """Return a product. It is a part of the tested kernel."""
    return weight * factor


def _fill(sums: np.ndarray[Any, Any], example: _Example, count: int, factor: float, shift: float | None) -> float:
    """Fill `sums` (m, 2) and return its last number. It is the tested kernel, with an argument of each kind."""
    for i in range(sums.shape[0]):
        for j in range(sums.shape[1]):
            sums[i, j] = count * _scaled(example.weights[i], factor) + 10 * i + j
            if example.doubled:
                sums[i, j] *= 2
            if shift is not None:
                sums[i, j] += shift
    return float(sums[-1, -1])


def _clear(sums: np.ndarray[Any, Any]) -> None:
    """Set all numbers to 0. It is the tested kernel without a result."""
    sums[:] = 0.0


@functools.cache
def passes_as_expected() -> bool:
    """Return whether machine code of this numba takes and returns values as `Kernel` expects.

    Two small kernels must give the same results as Python. The check takes 0.3 s of CPU, once in a process that
    compiles.
    """
    try:
        _numba()
        _mark(_scaled, _BARE)
        return _gives_the_same(_fill, _Example(np.array([0.5, 3.0, 1.25]), True), 7, 0.75, None) and _gives_the_same(
            _clear
        )
    except Exception:  # noqa: BLE001 - a part of numba that is not public may raise any error
        return False


def _gives_the_same(function: Callable[..., Any], *given: object) -> bool:
    """Return whether machine code fills an array as the Python function does, and returns the same."""
    theirs, ours = np.full((3, 2), 5.0), np.full((3, 2), 5.0)
    arguments = _Arguments((ours, *given))
    run = _loaded(machine_code(function, (ours, *given), arguments.forms), arguments.forms)
    return run is not None and run(arguments.words) == function(theirs, *given) and np.array_equal(theirs, ours)


def _plain_njit(function: Callable[..., Any]) -> Callable[..., Result]:
    """Return a function as ``numba.njit(cache=True)`` makes it; without the cache if no directory can be written.

    Numba compares only the file of the function to find a change. Therefore the name of the folder depends on the
    sources of all kernels.
    """
    numba, directory, stamp = _numba(), writable_directory(), _stamp()
    _mark_parts()
    if directory is not None and stamp:
        folder = directory / f"numba-{hashlib.sha256(repr(stamp).encode()).hexdigest()[:24]}"
        with suppress(OSError, RuntimeError, AttributeError):
            folder.mkdir(mode=0o755, exist_ok=True)
            if _is_own(directory) and _is_own(folder):
                before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(folder)
                try:
                    return cast(Callable[..., Result], numba.njit(cache=True, **_OPTIONS)(function))
                finally:
                    numba.config.CACHE_DIR = before
    return cast(Callable[..., Result], numba.njit(**_OPTIONS)(function))


@contextmanager
def watched(watch: Callable[[], None]) -> Iterator[None]:
    """Call `watch` whenever numba begins to compile a kernel in the block."""
    _watchers.append(watch)
    try:
        yield
    finally:
        _watchers.remove(watch)


def _writable(value: object) -> object:
    """Return an example of the type that is compiled for: an array that can be written, or a plain Python number."""
    if isinstance(value, np.ndarray):
        return np.empty((0,) * value.ndim, value.dtype)
    if isinstance(value, tuple):
        made = tuple(_writable(item) for item in value)
        return value._make(made) if hasattr(value, "_make") else made
    return value.item() if isinstance(value, np.generic) else value


def _numba() -> ModuleType:
    """Return numba, loaded without scipy's BLAS.

    The search for BLAS takes longer than the rest of the import, and no kernel multiplies matrices. Numba searches
    again if a function of another package does.
    """
    numba = importlib.import_module("numba")
    blas = "scipy.linalg.cython_blas"
    if blas not in sys.modules:
        sys.modules[blas] = None  # type: ignore[assignment]  # Python's mark for "cannot be imported"
        try:
            with suppress(ImportError):
                importlib.import_module("numba.np.arraymath")
        finally:
            del sys.modules[blas]
    return numba


def _mark_parts() -> None:
    """Register the parts of kernels that were marked before this call."""
    options = _BARE if passes_as_expected() else _OPTIONS
    while _parts:
        _mark(_parts.pop(), options)


def _mark(part: Callable[..., Any], options: Mapping[str, object]) -> None:
    """Register a function as a part that numba compiles with the kernels that call it."""
    extending = importlib.import_module("numba.extending")
    extending.overload(part, jit_options=dict(options), strict=False, prefer_literal=True)(lambda *_: part)


def _machine(level: int = 0) -> llvm.TargetMachine:
    """Return the target of the compiler: the processor of `processor`, with a level of optimisation."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    name, features = processor()
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=name, features=features, opt=level, codemodel="jitdefault", jit=True
    )


def processor() -> tuple[str, str]:
    """Return name and features of the processor that is compiled for.

    Numba's settings for both apply; ``NUMBA_ENABLE_AVX`` applies only to code that numba itself runs.
    """
    name = os.environ.get("NUMBA_CPU_NAME") or llvm.get_host_cpu_name()
    features = "" if name == "generic" else llvm.get_host_cpu_features().flatten()
    return name, os.environ.get("NUMBA_CPU_FEATURES", features)


@functools.cache
def _stamp() -> tuple[str, ...]:
    """Return the texts that machine code depends on: sources of all kernels, compiler, target and processor.

    The sources of all kernels count, because the machine code of a kernel holds the kernels that it calls. The result
    is empty if no code is kept, because the sources cannot be read or numba compiles for debugging.
    """
    files = sorted(Path(__file__).parent.rglob("*.py"))
    if not files or any(map(_is_set, _DEBUGGING)):
        return ()
    numba = find_spec("numba")
    if numba is not None and numba.origin is not None:
        # This file holds the version of numba, which is then not imported.
        files += Path(numba.origin).parent.glob("_version.py")
    sources = hashlib.sha256(b"\0".join(file.read_bytes() for file in files)).hexdigest()
    return sources, llvmlite.__version__, llvm.get_default_triple(), *processor()


def cache_directories() -> list[Path]:
    """Return the directories of machine code: ``NUMBA_CACHE_DIR``, else one of the package, then the user's cache."""
    if named_place := os.environ.get("NUMBA_CACHE_DIR"):
        return [Path(named_place)]
    directories = [Path(__file__).parent / "__pycache__"]
    users = Path(os.environ.get("XDG_CACHE_HOME", ""))
    # The user of a container may have no home directory.
    with suppress(RuntimeError):
        directories.append((users if users.is_absolute() else Path("~/.cache").expanduser()) / "icrtool")
    return directories


def writable_directory() -> Path | None:
    """Return the first directory that can be written, made if it is missing; None if no directory can be written."""
    for directory in cache_directories():
        with suppress(OSError):
            directory.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=directory).close()
            return directory
    return None


def _keep(name: str, content: bytes) -> None:
    """Write a file to the cache; if it cannot be written (full disk), only this process uses the code."""
    directory = writable_directory()
    if directory is None:
        return
    # Other users may read the file, because one user may build an image that another user runs.
    temporary = directory / f"{name}.{os.urandom(8).hex()}"
    with suppress(OSError):
        try:
            temporary.write_bytes(content)
            temporary.replace(directory / name)
        finally:
            temporary.unlink(missing_ok=True)


def njit(function: Function) -> Function:
    """Return a kernel that numba compiles when it is first called; its machine code is kept.

    Notes
    -----
    If no directory can be written (read-only containers, CI sandboxes), it is compiled once in each process.
    """
    return cast(Function, Kernel(function))


def njit_part(function: Function) -> Function:
    """Mark a function as a part of kernels: it is compiled with the kernels that call it; otherwise it is plain Python.

    Notes
    -----
    Numba treats a plain number in a call as a constant, and compiles a copy of the function for each number.
    """
    _parts.append(function)
    return function


def all_kernels() -> Iterator[Kernel]:
    """Import every module of kernels, and yield each kernel once."""
    package = importlib.import_module(__name__.rpartition(".")[0])
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        for value in vars(importlib.import_module(module.name)).values():
            if isinstance(value, Kernel) and value.py_func.__module__ == module.name:
                yield value
