"""Machine code on disk is used again while a kernel would become the same, and only then."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from multiprocessing.connection import Connection
from operator import sub
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest
from documented import FORKS

from noise_model.compiled.callee import MIN_INSTRUCTIONS
from noise_model.compiled.kernel import kernel

INNER = (
    "import math\n\nfrom noise_model.compiled.kernel import kernel\n\n\n"
    "@kernel({options})\ndef inner(x):\n    y = x\n{more}    return {value} * x + 0.0 * y\n"
)
LONG = "".join(f"    y = math.sqrt(y * y + {n}.5)\n" for n in range(MIN_INSTRUCTIONS))
OUTER = (
    "from noise_model.compiled.kernel import kernel\nfrom optics_of_a_test.{module} import inner\n\n\n"
    "@kernel\ndef outer(x):\n    return inner(x) + 1.0\n"
)
COMPILED, COMPILED_ANEW, FOUND = (0, 2), (1, 1), (2, 0)
"""What a process found on disk, and compiled: the outer kernel, and what lets Python call it.

A kernel whose types stay is called as before.
"""


def write(package: Path, options: str, value: str, more: str = "") -> None:
    """Write two kernels, one that calls the other, with times and sizes that tell nothing.

    `more` makes the inner one longer and changes nothing.
    """
    package.mkdir(parents=True, exist_ok=True)
    sources = {
        "__init__.py": "",
        "inner.py": INNER.format(options=options, value=value, more=more),
        "outer.py": OUTER.format(module="inner"),
    }
    for name, source in sources.items():
        (package / name).write_text(source)
        os.utime(package / name, (1e9, 1e9))


def run(folder: Path, first: str = "") -> tuple[float, int, int]:
    """Return the outer kernel's result, and what of it a new process found on disk, and compiled.

    It keeps kernels beside the package. The process runs the lines `first` before. It is forked from one that
    has imported numba, and no kernel of these.
    """
    receiver, sender = FORKS.Pipe(duplex=False)
    process = FORKS.Process(target=_run, args=(folder, first, sender))
    process.start()
    sender.close()
    result: tuple[float, int, int] = receiver.recv()
    process.join()
    return result


def _run(folder: Path, first: str, sender: Connection) -> None:
    sys.path.insert(0, str(folder))
    sys.dont_write_bytecode = True
    os.environ["NUMBA_CACHE_DIR"] = str(folder / "kept")
    exec(first)
    outer = import_module("optics_of_a_test.outer").outer
    result = outer(2.0)
    sender.send((result, sum(outer.stats.cache_hits.values()), sum(outer.stats.cache_misses.values())))


def kept_of(folder: Path, name: str) -> list[Path]:
    """Return what is kept of a kernel, and of what lets Python call it."""
    return list((folder / "kept/arctrack/kernels").glob(f"optics_of_a_test.{name}/*"))


@pytest.mark.slow
@pytest.mark.parametrize(("options", "more"), [("inline=True", ""), ("", "")], ids=["written out", "short"])
def test_a_kernel_is_compiled_anew_when_one_that_is_optimised_into_it_has_changed(
    options: str, more: str, tmp_path: Path
) -> None:
    package = tmp_path / "optics_of_a_test"
    write(package, options, "3.0", more)
    assert run(tmp_path) == (7.0, *COMPILED)
    assert run(tmp_path) == (7.0, *FOUND)
    write(package, options, "5.0", more)
    assert run(tmp_path) == (11.0, *COMPILED_ANEW)
    assert run(tmp_path) == (11.0, *FOUND)
    write(package, options, "3.0", more)
    assert run(tmp_path) == (7.0, *FOUND), "what was before is still there"


@pytest.mark.slow
def test_a_long_kernel_that_has_changed_leaves_its_callers_alone(tmp_path: Path) -> None:
    package = tmp_path / "optics_of_a_test"
    write(package, "", "3.0", LONG)
    assert run(tmp_path) == (7.0, *COMPILED)
    write(package, "", "5.0", LONG)
    assert run(tmp_path) == (11.0, *FOUND)
    for kept in kept_of(tmp_path, "inner.inner"):
        kept.unlink()
    assert run(tmp_path) == (11.0, *FOUND), "it is compiled, and has the symbol that its callers call"
    write(package, "", "5j", LONG)
    assert run(tmp_path) == (1.0 + 10.0j, *COMPILED), "its result has another type"


@pytest.mark.slow
def test_the_machine_code_of_a_long_kernel_is_not_in_that_of_its_caller(tmp_path: Path) -> None:
    sizes = []
    for folder, more in ((tmp_path / "short", ""), (tmp_path / "long", LONG)):
        folder.mkdir()
        write(folder / "optics_of_a_test", "", "3.0", more)
        run(folder)
        kept = {name: kept_of(folder, f"{name}.{name}") for name in ("inner", "outer")}
        sizes.append({name: max(file.stat().st_size for file in files) for name, files in kept.items()})
    short, long = sizes
    assert long["inner"] > 2 * short["inner"]
    # A link takes two kilobytes.
    assert long["outer"] - short["outer"] < 0.2 * (long["inner"] - short["inner"])


READS = (
    "from typing import NamedTuple\n\nimport numpy as np\n\nimport optics_of_a_test.glass as glass\n"
    "from noise_model.compiled.kernel import kernel\n\nFACTOR, TABLE = {factor}, np.array({table})\n\n\n"
    "class Lens(NamedTuple):\n    {fields}: float\n\n\n"
    "@kernel\ndef outer(x{default}):\n{docstring}"
    "    lens = Lens(x, FACTOR)\n    return glass.INDEX * lens.f_mm + TABLE[1] {more}\n"
)
AS_IT_WAS = {
    "factor": "2.0",
    "table": "[0.0, 1.0]",
    "fields": "f_mm: float\n    second",
    "default": "",
    "docstring": "",
    "more": "",
    "index": "1.5",
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changed", "result", "found"),
    [
        ({"docstring": '    """Say more."""\n', "more": "# a remark"}, 4.0, FOUND),
        ({"index": "1.5\nOTHER = 7.0"}, 4.0, FOUND),
        ({"more": "+ 1.0"}, 5.0, COMPILED_ANEW),
        ({"factor": "5.0"}, 4.0, COMPILED_ANEW),
        ({"table": "[0.0, 3.0]"}, 6.0, COMPILED_ANEW),
        ({"fields": "second: float\n    f_mm"}, 4.0, COMPILED_ANEW),
        ({"default": ", y=1.0", "more": "+ y"}, 5.0, COMPILED),
        ({"index": "2.5"}, 6.0, COMPILED_ANEW),
    ],
)
def test_the_key_is_what_a_kernel_reads(
    changed: dict[str, str], result: float, found: tuple[int, int], tmp_path: Path
) -> None:
    package = tmp_path / "optics_of_a_test"
    package.mkdir()
    (package / "__init__.py").touch()
    for values, expected in ((AS_IT_WAS, (4.0, *COMPILED)), ({**AS_IT_WAS, **changed}, (result, *found))):
        (package / "outer.py").write_text(READS.format(**values))
        (package / "glass.py").write_text(f"INDEX = {values['index']}\n")
        assert run(tmp_path) == expected


@pytest.mark.slow
def test_a_clone_elsewhere_finds_what_another_has_compiled(tmp_path: Path) -> None:
    write(tmp_path / "one/optics_of_a_test", "", "3.0")
    assert run(tmp_path / "one") == (7.0, *COMPILED)
    shutil.copytree(tmp_path / "one", tmp_path / "other")
    assert run(tmp_path / "other") == (7.0, *FOUND)


@pytest.fixture
def installed() -> Iterator[Path]:
    """Yield a folder with the two kernels, which other users may read."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o755)
        write(folder / "optics_of_a_test", "", "3.0")
        yield folder


def as_nobody(home: Path) -> str:
    """Return the lines by which a process becomes a user who may write nothing but his home.

    He may not even read what numba imports late, so that is imported before.
    """
    environment = f"os.environ['HOME'] = {str(home)!r}\nos.environ.pop('XDG_CACHE_HOME', None)\n"
    forget = "del os.environ['NUMBA_CACHE_DIR']\n"
    return f"import numba\nnumba.njit(lambda: 1)()\nos.setuid(65534)\n{environment}{forget}"


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
def test_kernels_of_a_read_only_installation(installed: Path) -> None:
    assert run(installed, as_nobody(Path("/proc"))) == (7.0, *COMPILED), "no folder to keep them"
    home = installed / "home"
    home.mkdir()
    os.chown(home, 65534, 65534)
    assert run(installed, as_nobody(home)) == (7.0, *COMPILED)
    assert run(installed, as_nobody(home)) == (7.0, *FOUND), "kept in the user's cache"
    for kept in (home / ".cache/arctrack/kernels").iterdir():
        assert kept.stat().st_mode & 0o077 == 0
        kept.chmod(0o777)
    assert run(installed, as_nobody(home)) == (7.0, *COMPILED), "what others may write is not loaded"


@pytest.mark.slow
def test_a_damaged_file_of_a_kernel_is_compiled_anew(tmp_path: Path) -> None:
    write(tmp_path / "optics_of_a_test", "", "3.0")
    run(tmp_path)
    for kept in kept_of(tmp_path, "*"):
        kept.write_bytes(kept.read_bytes()[:-9])
    assert run(tmp_path) == (7.0, *COMPILED)
    assert run(tmp_path) == (7.0, *FOUND)


@pytest.mark.slow
def test_a_record_that_an_update_has_moved_is_compiled_for_anew(tmp_path: Path) -> None:
    """What is kept names the old module, which is gone."""
    package = tmp_path / "optics_of_a_test"
    package.mkdir()
    (package / "__init__.py").write_text("")
    record = "from typing import NamedTuple\n\n\nclass Lens(NamedTuple):\n    f_mm: float\n"
    for module in ("old", "new"):
        (package / f"{module}.py").write_text(record)
        (package / "outer.py").write_text(
            "from noise_model.compiled.kernel import kernel\n"
            f"from optics_of_a_test.{module} import Lens\n\n\n"
            "@kernel\ndef of_lens(lens):\n    return 2.0 * lens.f_mm\n\n\n"
            "def outer(x):\n    return of_lens(Lens(x))\n\n\nouter.stats = of_lens.stats\n"
        )
        assert run(tmp_path) == (4.0, *COMPILED)
        (package / "old.py").unlink(missing_ok=True)


class Reading(NamedTuple):
    """A result of a kernel, within another."""

    place_mm: float
    values: np.ndarray


class Readings(NamedTuple):
    """A result of a kernel."""

    first: Reading
    both: tuple[Reading, Reading]
    count: int


@kernel(allocates=True)
def read(place_mm: float) -> Readings:
    """Return named tuples within others, and an array in three of them."""
    values = np.full(2, place_mm)
    first = Reading(place_mm, values)
    return Readings(first, (first, Reading(2.0 * place_mm, values)), 3)


def test_a_result_is_of_the_classes_that_the_kernel_returns() -> None:
    readings = read(1.5)
    assert type(readings) is Readings
    assert [type(reading) for reading in (readings.first, *readings.both)] == [Reading] * 3
    assert (readings.count, readings.both[1].place_mm) == (3, 3.0)
    assert type(readings.first.values) is np.ndarray
    assert readings.both[1].values.tolist() == [1.5, 1.5]


def test_results_leave_no_references_behind() -> None:
    owned = (Readings, Reading, np.ndarray, tuple.__new__, np.dtype(float))
    read(1.5)
    before = [sys.getrefcount(thing) for thing in owned]
    for _ in range(100):
        read(1.5)
    assert max(map(sub, map(sys.getrefcount, owned), before)) < 10


def test_kernels_of_one_name_in_one_process_are_told_apart() -> None:
    def times(factor: float) -> Any:
        @kernel
        def inner(x: float) -> float:
            return factor * x

        @kernel
        def outer(x: float) -> float:
            return inner(x) + 1.0

        return outer

    assert [times(factor)(2.0) for factor in (3.0, 5.0)] == [7.0, 11.0]


@pytest.mark.slow
def test_a_kernels_symbol_is_the_same_whatever_records_a_process_knows(tmp_path: Path) -> None:
    assert symbol_after(0, tmp_path / "first") == symbol_after(40, tmp_path / "second")


def symbol_after(n_records: int, kept: Path) -> str:
    """Return a symbol from a new process, in which numba has met so many other records."""
    receiver, sender = FORKS.Pipe(duplex=False)
    process = FORKS.Process(target=_symbol_after, args=(n_records, kept, sender))
    process.start()
    symbol: str = receiver.recv()
    process.join()
    return symbol


def _symbol_after(n_records: int, kept: Path, sender: Connection) -> None:
    os.environ["NUMBA_CACHE_DIR"] = str(kept)
    for i in range(n_records):
        numba.typeof(np.zeros(1, [(f"field_{i}", "f8")]))

    @kernel
    def first_x(points: Any) -> Any:
        return points[0].x

    first_x(np.zeros(1, [("x", "f8")]))
    sender.send(first_x.overloads[first_x.signatures[0]].fndesc.llvm_func_name)


PARTS_OF_NUMBA = """
import sys

import numba


def parts():
    modules = [vars(module) for name, module in list(sys.modules.items()) if name.startswith("numba.core")]
    classes = {part for module in modules for part in module.values() if isinstance(part, type)}
    return {(owner, name): part for owner in classes for name, part in vars(owner).items()}


numba.njit(lambda x: x + 1.0)(1.0)
before = parts()
from noise_model.compiled.kernel import kernel

kernel(lambda x: x + 1.0)(1.0)
after = parts()
print([name for (owner, name), part in before.items() if after[owner, name] is not part])
"""


def test_numba_is_another_only_while_a_kernel_is_compiled(tmp_path: Path) -> None:
    script = [sys.executable, "-c", PARTS_OF_NUMBA]
    kept = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    run = subprocess.run(script, capture_output=True, text=True, check=True, env=kept)
    assert run.stdout.strip() == "[]"


def test_python_asks_once_for_a_kernel_that_two_threads_call_first_at_once() -> None:
    """numba finds two entry points for the same types ambiguous, and asks at each call for another."""
    nothing: Any = kernel(run_nothing)
    with ThreadPoolExecutor(2) as threads:
        both = [threads.submit(nothing._compile_for_args) for _ in range(2)]
    assert both[0].result() is both[1].result()

    def ask_again(*arguments: object) -> None:
        raise AssertionError("numba knows no entry point for the types that it was given one for")

    nothing._compile_for_args = ask_again
    assert nothing() is None


def run_nothing() -> None:
    """Do nothing."""
