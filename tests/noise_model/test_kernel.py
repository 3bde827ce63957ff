"""Machine code on disk is used again while its sources are what they were, and only then."""

import os
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from documented import FORKS

from noise_model import kernel as kernels
from noise_model.linking import MIN_INSTRUCTIONS

INNER = (
    "import math\n\nfrom noise_model.kernel import kernel\n\n\n"
    "@kernel({options})\ndef inner(x):\n    y = x\n{more}    return {value} * x + 0.0 * y\n"
)
LONG = "".join(f"    y = math.sqrt(y * y + {n}.5)\n" for n in range(MIN_INSTRUCTIONS))
OUTER = (
    "from noise_model.kernel import kernel\nfrom optics_of_a_test.{module} import inner\n\n\n"
    "@kernel\ndef outer(x):\n    return inner(x) + 1.0\n"
)


def write(package: Path, options: str, value: float, more: str = "") -> None:
    """Write two kernels, one that calls the other, with times and sizes that tell nothing.

    `more` makes the inner one longer and changes nothing.
    """
    package.mkdir(exist_ok=True)
    sources = {
        "__init__.py": "",
        "inner.py": INNER.format(options=options, value=value, more=more),
        "outer.py": OUTER.format(module="inner"),
        "beside.py": f"# {value}\n",
    }
    for name, source in sources.items():
        (package / name).write_text(source)
        os.utime(package / name, (1e9, 1e9))


def run(folder: Path, first: str = "") -> tuple[float, int, int]:
    """Return the outer kernel's result, and what of it a new process found on disk, and compiled.

    That is the kernel, and what lets Python call it. The process runs the lines `first` before. It is forked
    from one that has imported numba, and no kernel of these.
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
    exec(first)
    outer = import_module("optics_of_a_test.outer").outer
    result = outer(2.0)
    sender.send((result, sum(outer.stats.cache_hits.values()), sum(outer.stats.cache_misses.values())))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "more"), [("inline=True", ""), ("", ""), ("", LONG)], ids=["written out", "short", "long"]
)
def test_a_kernel_is_compiled_anew_when_one_that_it_calls_has_changed(
    options: str, more: str, tmp_path: Path
) -> None:
    package = tmp_path / "optics_of_a_test"
    write(package, options, 3.0, more)
    assert run(tmp_path) == (7.0, 0, 2)
    assert run(tmp_path) == (7.0, 2, 0)
    write(package, options, 5.0, more)
    assert run(tmp_path) == (11.0, 0, 2)
    assert run(tmp_path) == (11.0, 2, 0)


@pytest.mark.slow
def test_a_kernel_is_compiled_anew_when_a_long_one_that_it_calls_has_another_symbol(tmp_path: Path) -> None:
    """numba counts what it compiles, and the number is in the symbol."""
    package = tmp_path / "optics_of_a_test"
    write(package, "", 3.0, LONG)
    assert run(tmp_path) == (7.0, 0, 2)
    for kept in package.glob("__pycache__/inner.inner*"):
        kept.unlink()
    compile_another = "from optics_of_a_test.inner import inner\ninner(1), inner(True)\n"
    assert run(tmp_path, compile_another) == (7.0, 0, 2)
    assert run(tmp_path) == (7.0, 2, 0)


@pytest.mark.slow
def test_the_machine_code_of_a_long_kernel_is_not_in_that_of_its_caller(tmp_path: Path) -> None:
    package = tmp_path / "optics_of_a_test"
    sizes = []
    for more in ("", LONG):
        write(package, "", 3.0, more)
        run(tmp_path)
        sizes.append({name: _kept_bytes(package, name) for name in ("inner", "outer")})
    short, long = sizes
    assert long["inner"] > 2 * short["inner"]
    # A link takes two kilobytes.
    assert long["outer"] - short["outer"] < 0.2 * (long["inner"] - short["inner"])


def _kept_bytes(package: Path, name: str) -> int:
    """Return how large a kernel is on disk."""
    return max(kept.stat().st_size for kept in package.glob(f"__pycache__/{name}.{name}*.nbc"))


@pytest.mark.slow
def test_what_a_kernel_does_not_import_leaves_it_alone(tmp_path: Path) -> None:
    package = tmp_path / "optics_of_a_test"
    write(package, "", 3.0)
    run(tmp_path)
    (package / "beside.py").write_text("# another thing\n")
    assert run(tmp_path) == (7.0, 2, 0)


@pytest.fixture
def installed() -> Iterator[Path]:
    """Yield a folder with the two kernels, which other users may read."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o755)
        write(folder / "optics_of_a_test", "", 3.0)
        yield folder


def as_nobody(home: Path) -> str:
    """Return the lines by which a process becomes a user who may write nothing but his home.

    He may not even read what numba imports late, so that is imported before.
    """
    environment = f"os.environ['HOME'] = {str(home)!r}\nos.environ.pop('XDG_CACHE_HOME', None)\n"
    return f"import numba\nnumba.njit(lambda: 1)()\nos.setuid(65534)\n{environment}"


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
def test_kernels_of_a_read_only_installation(installed: Path) -> None:
    assert run(installed, as_nobody(Path("/proc"))) == (7.0, 0, 2), "no folder to keep them: compiled"
    home = installed / "home"
    home.mkdir()
    os.chown(home, 65534, 65534)
    assert run(installed, as_nobody(home)) == (7.0, 0, 2)
    assert run(installed, as_nobody(home)) == (7.0, 2, 0), "kept in the user's cache"
    for kept in (home / ".cache/arctrack/kernels").iterdir():
        assert kept.stat().st_mode & 0o077 == 0
        kept.chmod(0o777)
    assert run(installed, as_nobody(home)) == (7.0, 0, 2), "what others may write is not loaded"
    run(installed)
    assert run(installed, as_nobody(Path("/proc"))) == (7.0, 2, 0), "the installation's own are loaded"


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
def test_a_damaged_file_of_a_kernel_is_compiled_anew(suffix: str, tmp_path: Path) -> None:
    write(tmp_path / "optics_of_a_test", "", 3.0)
    run(tmp_path)
    for kept in tmp_path.rglob(f"*.{suffix}"):
        kept.write_bytes(kept.read_bytes()[:-9])
    assert run(tmp_path) == (7.0, 0, 2)
    assert run(tmp_path) == (7.0, 2, 0)


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
            f"from noise_model.kernel import kernel\nfrom optics_of_a_test.{module} import Lens\n\n\n"
            "@kernel\ndef of_lens(lens):\n    return 2.0 * lens.f_mm\n\n\n"
            "def outer(x):\n    return of_lens(Lens(x))\n\n\nouter.stats = of_lens.stats\n"
        )
        assert run(tmp_path) == (4.0, 0, 2)
        (package / "old.py").unlink(missing_ok=True)


def test_python_asks_once_for_a_kernel_that_two_threads_call_first_at_once() -> None:
    """numba finds two entry points for the same types ambiguous, and asks at each call for another."""
    nothing: Any = kernels.kernel(run_nothing)
    with ThreadPoolExecutor(2) as threads:
        both = [threads.submit(nothing._compile_for_args) for _ in range(2)]
    assert both[0].result() is both[1].result()

    def ask_again(*arguments: object) -> None:
        raise AssertionError("numba knows no entry point for the types that it was given one for")

    nothing._compile_for_args = ask_again
    assert nothing() is None


def test_a_kernel_outside_the_project_is_compiled_anew_when_what_keeps_it_has_changed() -> None:
    """What is on disk has the form that an earlier version gave it."""
    keeps = Path(kernels.__file__)
    cache = vars(kernels.kernel(run_nothing))["_cache"]
    assert kernels.source_key(keeps) in cache._cache_file._source_stamp


def run_nothing() -> None:
    """Do nothing."""
