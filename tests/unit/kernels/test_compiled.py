from __future__ import annotations

import math
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest

from icrtool.kernels import compiled
from icrtool.kernels.compiled import all_kernels, cache_directories, njit

CALL = """
import sys
import numpy as np
from icrtool.kernels.kinematics import lag
speed = np.array([1.0, 2.0, 2.0])
lag(speed, np.array([1.0, 0.5]))
print(speed[2], lag.compiled, "numba" in sys.modules)
"""


def called(cache: str | Path) -> list[str]:
    """Return what a process prints that calls a kernel with machine code in a folder."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    done = subprocess.run([sys.executable, "-c", CALL], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_kernels_compile_where_no_cache_can_be_written() -> None:
    assert called(os.devnull + "/cache") == ["1.5", "1", "True"]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which one process kept a kernel."""
    folder = tmp_path_factory.mktemp("made")
    assert called(folder) == ["1.5", "1", "True"]
    return folder


@pytest.fixture
def place(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "place"))


def test_a_process_needs_no_compiler_where_machine_code_is_kept(place: Path) -> None:
    assert called(place) == ["1.5", "0", "False"]


def test_machine_code_is_as_readable_as_other_files(made: Path) -> None:
    [file] = made.iterdir()
    other = made.parent / "other"
    other.touch()
    assert file.stat().st_mode == other.stat().st_mode


@pytest.mark.parametrize(
    "damage", [lambda data: data[:-100], lambda data: data + b"x", lambda _: b""], ids=("cut", "longer", "empty")
)
def test_damaged_machine_code_is_not_run(place: Path, damage: Callable[[bytes], bytes]) -> None:
    [file] = place.iterdir()
    assert compiled.MachineCode.read(file) is not None
    file.write_bytes(damage(file.read_bytes()))
    assert compiled.MachineCode.read(file) is None


def test_damaged_machine_code_is_compiled_again(place: Path) -> None:
    [file] = place.iterdir()
    whole = file.read_bytes()
    file.write_bytes(whole[:-100])
    assert called(place) == ["1.5", "1", "True"]
    assert file.read_bytes() == whole


class Two(NamedTuple):
    matrix: np.ndarray[Any, Any]
    flag: bool


def weigh(values: np.ndarray[Any, Any], two: Two, pair: tuple[int, float], more: float | None) -> float:
    total = 0.0 if more is None else more
    for i in range(len(values)):
        for j in range(two.matrix.shape[1]):
            total += pair[0] * values[i] * two.matrix[i, j] + pair[1] * np.sin(values[i])
    return total if two.flag else -total


def arguments(*, flag: bool = True, more: float | None = 0.5) -> tuple[Any, ...]:
    rng = np.random.default_rng(3)
    return rng.random(4), Two(rng.random((4, 3)), flag), (2, np.float64(0.25)), more


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Machine code of the tests' own functions is kept nowhere else."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kept"))


MALFORMED = (
    b"",
    b"lag",
    b"lag\nnone\n\x7fELF",
    b"lag\nnone\n\x7fELF" + bytes(900),
    b"lag\nnone\nno object",
    b"\xff\nnone\n\x7fELF",
)

CALL_MALFORMED = """
import hashlib, sys
from pathlib import Path
import numpy as np
from icrtool.kernels.compiled import njit
from icrtool.kernels.kinematics import lag
[file] = Path(sys.argv[1]).iterdir()
whole = file.read_bytes()
for stored in (whole, *(hashlib.sha256(one).digest() + one for one in map(bytes.fromhex, sys.stdin))):
    file.write_bytes(stored)
    kernel, speed = njit(lag.py_func), np.array([1.0, 2.0, 2.0])
    kernel(speed, np.array([1.0, 0.5]))
    print(speed[2], kernel.compiled, flush=True)
"""


def run_script(script: str, place: Path, text: str = "") -> subprocess.CompletedProcess[str]:
    """Run a script with the folder of compiled kernels as its argument and cache, and a text as standard input."""
    return subprocess.run(
        [sys.executable, "-c", script, str(place)], env={**os.environ, "NUMBA_CACHE_DIR": str(place)},
        input=text, capture_output=True, text=True, check=False,
    )  # fmt: skip


def test_malformed_machine_code_with_the_right_digest_is_not_run(place: Path) -> None:
    done = run_script(CALL_MALFORMED, place, "".join(f"{code.hex()}\n" for code in MALFORMED))
    assert done.stdout.splitlines() == ["1.5 0"] + ["1.5 1"] * len(MALFORMED), done.stderr
    assert done.returncode == 0


CALL_OPEN_TO_ALL = """
import sys
from pathlib import Path
import numpy as np
from icrtool.kernels.compiled import njit
from icrtool.kernels.kinematics import lag
place = Path(sys.argv[1])
[file] = place.iterdir()
for of_file, of_place in ((0o644, 0o700), (0o777, 0o700), (0o644, 0o777), (0o644, 0o700)):
    file.chmod(of_file)
    place.chmod(of_place)
    kernel, speed = njit(lag.py_func), np.array([1.0, 2.0, 2.0])
    kernel(speed, np.array([1.0, 0.5]))
    print(speed[2], kernel.compiled, flush=True)
"""


def test_machine_code_that_everybody_may_write_is_not_run(place: Path) -> None:
    """Neither a file nor a folder that is open to all; as soon as both are the owner's again, it is."""
    done = run_script(CALL_OPEN_TO_ALL, place)
    assert done.stdout.splitlines() == ["1.5 0", "1.5 1", "1.5 1", "1.5 0"], done.stderr
    assert done.returncode == 0


@pytest.mark.parametrize(
    "given", [arguments(), arguments(flag=False), arguments(more=None)], ids=("all", "flag", "none")
)
def test_machine_code_takes_what_the_python_function_takes(given: tuple[Any, ...]) -> None:
    for _ in range(2):
        kernel = njit(weigh)
        assert kernel(*given) == pytest.approx(weigh(*given), abs=1e-12)
    assert kernel.compiled == 0


def patched_flags(patch: pytest.MonkeyPatch) -> None:
    """Pass flags the other way round, as a version of numba might: the form of the arguments stays."""
    add = compiled._Arguments._add

    def changed(self: Any, value: object) -> None:
        add(self, value)
        if isinstance(value, bool):
            self.words[-1] = not value

    patch.setattr(compiled._Arguments, "_add", changed)


def raises(*_: object, **__: object) -> Any:
    raise NotImplementedError("of another version")


DISPATCHER = type(numba.njit(weigh))


def turn_over(values: np.ndarray[Any, Any], flag: bool) -> float:
    for i in range(len(values) if flag else 0):
        values[i] = 2 - i
    return values[0] + 7.0


OTHERWISE: dict[str, Callable[[pytest.MonkeyPatch], None]] = {
    "an option is not known": lambda patch: patch.setattr(compiled, "_BARE", {**compiled._BARE, "_gone": True}),
    "no signatures": lambda patch: patch.setattr(DISPATCHER, "nopython_signatures", property(raises)),
    "no text of LLVM": lambda patch: patch.setattr(DISPATCHER, "inspect_llvm", raises),
    "another text of LLVM": lambda patch: patch.setattr(DISPATCHER, "inspect_llvm", lambda *_: "other"),
    "other words": lambda patch: patch.setitem(compiled._LLVM_TYPES, compiled._INTEGER, "i128"),
    "words that mean something else": patched_flags,
    "another sign of success": lambda patch: patch.setattr(compiled, "_RETURNED", (7,)),
    "llvmlite loads no object": lambda patch: patch.setattr(compiled.llvm, "create_mcjit_compiler", raises),
    "no overloads with options": lambda patch: patch.setattr(numba.extending, "overload", raises),
}
"""What a version of numba or llvmlite may do otherwise, in each part that is used and not public."""


@pytest.mark.parametrize("otherwise", OTHERWISE)
def test_where_numba_differs_a_kernel_is_plain_njit_with_its_cache(
    monkeypatch: pytest.MonkeyPatch, otherwise: str
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(compiled, "_parts", [])
        OTHERWISE[otherwise](patch)
        compiled.passes_as_expected.cache_clear()
        values = np.arange(3.0)
        assert njit(turn_over)(values, True) == 9.0
        assert not compiled.passes_as_expected()
    compiled.passes_as_expected.cache_clear()
    assert values.tolist() == [2.0, 1.0, 0.0]
    [folder] = cache_directories()[0].iterdir()
    assert folder.name.startswith("numba-")
    assert list(folder.rglob("*.nbc"))
    assert not list(folder.rglob("*.o"))


def test_numba_finds_its_own_cache_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled, "_RETURNED", (7,))
    compiled.passes_as_expected.cache_clear()
    hits = []
    for _ in range(2):
        kernel = njit(weigh)
        kernel(*arguments())
        hits.append(sum(kernel._by_numba.stats.cache_hits.values()))
    compiled.passes_as_expected.cache_clear()
    assert hits == [0, 1]


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="a folder has no owner here")
def test_numba_keeps_nothing_where_others_may_write(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled, "_RETURNED", (7,))
    compiled.passes_as_expected.cache_clear()
    place = cache_directories()[0]
    place.mkdir()
    place.chmod(0o777)
    assert njit(weigh)(*arguments()) == pytest.approx(weigh(*arguments()), abs=1e-12)
    compiled.passes_as_expected.cache_clear()
    assert not list(place.rglob("*.nbc"))


def rise(value: float) -> float:
    return math.log1p(value)


def test_numba_runs_what_calls_more_than_the_known_functions() -> None:
    assert njit(rise)(0.5) == pytest.approx(math.log1p(0.5))
    assert not list(cache_directories()[0].rglob("*.o"))


def double(value: float) -> float:
    return value * 2


def test_numbers_of_numpy_are_taken_as_those_of_python() -> None:
    kernel = njit(double)
    assert [kernel(one) for one in (np.uint64(3), -1, np.float32(0.5), 0.25)] == [6, -2, 1.0, 0.5]
    assert kernel.compiled == 2
    assert len(list(cache_directories()[0].glob("*.o"))) == 2


@pytest.mark.parametrize("wrong", ["text", 2**63, [1.0]], ids=repr)
def test_what_no_kernel_takes_is_refused(wrong: object) -> None:
    with pytest.raises(TypeError, match="a kernel takes no"):
        njit(double)(wrong)


@pytest.mark.parametrize(("name", "compiles"), [("NUMBA_DISABLE_JIT", 0), ("NUMBA_BOUNDSCHECK", 1)])
def test_nothing_is_kept_of_what_numba_does_to_find_faults(
    monkeypatch: pytest.MonkeyPatch, name: str, compiles: int
) -> None:
    monkeypatch.setenv(name, "1")
    compiled._stamp.cache_clear()
    kernel = njit(double)
    assert kernel(2.0) == 4.0
    compiled._stamp.cache_clear()
    assert kernel.compiled == compiles
    assert not list(cache_directories()[0].glob("*"))


def test_code_for_another_processor_or_target_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for name in ("get_default_triple", "get_host_cpu_name"):
        compiled._stamp.cache_clear()
        found.append(compiled._stamp())
        with monkeypatch.context() as patch:
            patch.setattr(compiled.llvm, name, lambda: "another")
            compiled._stamp.cache_clear()
            found.append(compiled._stamp())
    compiled._stamp.cache_clear()
    assert len(set(found)) == 3


def test_threads_compile_a_kernel_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", os.devnull + "/cache")
    kernel = njit(double)
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(kernel, [1.0, 2.0, 3.0, 4.0])) == [2.0, 4.0, 6.0, 8.0]
    assert kernel.compiled == 1


def test_an_array_that_machine_code_would_misread_is_refused() -> None:
    values, two, *rest = arguments()
    fixed = values.copy()
    fixed.flags.writeable = False
    for wrong in (np.repeat(values, 2)[::2], fixed):
        with pytest.raises(TypeError, match="contiguous"):
            njit(weigh)(wrong, two, *rest)


def test_a_kernel_compiles_again_where_any_file_of_kernels_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # the machine code of a kernel holds that of those it calls, whatever file they are in
    kernels = tmp_path / "kernels"
    shutil.copytree(Path(compiled.__file__).parent, kernels, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(compiled, "__file__", str(kernels / "compiled.py"))
    found = []
    for changed in ("", "\n", ""):
        with (kernels / "open_loop.py").open("a", encoding="utf-8") as file:
            file.write(changed)
        compiled._stamp.cache_clear()
        kernel = njit(weigh)
        kernel(*arguments())
        found.append(kernel.compiled)
    compiled._stamp.cache_clear()
    assert found == [1, 1, 0]


def test_a_user_without_a_home_has_no_cache_there(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    assert len(cache_directories()) == 2

    def homeless(path: Path) -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "expanduser", homeless)
    assert cache_directories() == [Path(compiled.__file__).parent / "__pycache__"]


def test_every_kernel_is_found() -> None:
    names = {one.py_func.__qualname__ for one in all_kernels()}
    assert {"filter_events", "integrate_trials", "fill_errors"} <= names
