"""A pack holds what was compiled elsewhere: the same bytes for the same sources. It is used or left aside."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest
from test_kernel import COMPILED, COMPILED_ANEW, FOUND, LONG, run, write

from noise_model.compiled import packed as packed_module
from noise_model.compiled.content import versions
from noise_model.compiled.packed import Pack, read_pack
from noise_model.compiled.target import CPU_NAMES, V3, V4, levels, target
from validation.packs import COMPILE, pack_of, run_python, stored_records, write_pack

RELEASED = Path(packed_module.__file__).with_name("packs") / f"{target()}.pack"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(target() is None, reason="this machine compiles for no level of processors"),
]

BUILD = """
from pathlib import Path
from validation.packs import COMPILE, pack_of, run_python, stored_records, write_pack
from noise_model.compiled.target import target
folder = Path({folder!r})
write_pack(folder / "packs" / f"{{target()}}.pack", pack_of(stored_records(folder / "kept"), {{}}))
"""


def pack_file(folder: Path) -> Path:
    """Return where the pack of a test's folder lies."""
    return folder / "packs" / f"{target()}.pack"


def packed(folder: Path, more: str = "") -> None:
    """Compile two kernels, one that calls the other, into a pack; nothing stays in the cache."""
    write(folder / "optics_of_a_test", "", "3.0", more)
    assert run(folder) == (7.0, *COMPILED)
    run(folder, BUILD.format(folder=str(folder)))
    (folder / "kept").rename(folder / "compiled")


def use(folder: Path) -> str:
    """Return the line by which a process takes the pack of a test."""
    return f"os.environ['ARCTRACK_PACKS'] = {str(folder / 'packs')!r}"


def test_kernels_of_a_pack_are_not_compiled(tmp_path: Path) -> None:
    packed(tmp_path)
    assert run(tmp_path, use(tmp_path)) == (7.0, *FOUND)
    assert list((tmp_path / "kept").rglob("*/*.*/*")) == [], "the user's cache stays empty"


@pytest.mark.parametrize("more", ["", LONG], ids=["short", "long"])
def test_a_kernel_that_was_edited_calls_one_of_a_pack(more: str, tmp_path: Path) -> None:
    packed(tmp_path, more)
    outer = tmp_path / "optics_of_a_test" / "outer.py"
    outer.write_text(outer.read_text().replace("+ 1.0", "+ 2.0"))
    assert run(tmp_path, use(tmp_path)) == (8.0, *COMPILED_ANEW)
    assert run(tmp_path, use(tmp_path)) == (8.0, *FOUND)


@pytest.mark.parametrize("more", ["", LONG], ids=["short", "long"])
def test_a_kernel_of_a_pack_calls_one_that_was_edited(more: str, tmp_path: Path) -> None:
    packed(tmp_path, more)
    inner = tmp_path / "optics_of_a_test" / "inner.py"
    inner.write_text(inner.read_text().replace("return 3.0", "return 5.0"))
    assert run(tmp_path, use(tmp_path)) == (11.0, *(COMPILED_ANEW if not more else FOUND))


def test_a_damaged_pack_is_left_aside_with_a_line(tmp_path: Path) -> None:
    packed(tmp_path)
    file = pack_file(tmp_path)
    file.write_bytes(file.read_bytes()[:-1])
    assert run(tmp_path, use(tmp_path)) == (7.0, *COMPILED)
    file.write_bytes(b"")
    assert run(tmp_path, use(tmp_path)) == (7.0, *FOUND), "of the user's cache"


def test_a_pack_that_others_may_write_is_left_aside(tmp_path: Path) -> None:
    packed(tmp_path)
    pack_file(tmp_path).chmod(0o666)
    assert run(tmp_path, use(tmp_path)) == (7.0, *COMPILED)


def test_a_pack_of_other_versions_is_left_aside(tmp_path: Path) -> None:
    packed(tmp_path)
    pack = read_pack(pack_file(tmp_path))
    write_pack(pack_file(tmp_path), pack._replace(made_with=["CPython 3.1", *pack.made_with[1:]]))
    assert run(tmp_path, use(tmp_path)) == (7.0, *COMPILED)


KERNELS = """
import numpy as np
from noise_model.compiled.kernel import REDUCTION, kernel

@kernel(fastmath=REDUCTION)
def mean(values):
    total = 0.0
    for value in values:
        total += value
    return total / len(values)

@kernel(allocates=True)
def solved(matrix, values):
    if len(values) > 9:
        raise ValueError("too many")
    values[np.argsort(values)[0]] = mean(values)
    return np.linalg.solve(matrix, values)
"""


def test_two_builds_are_the_same_bytes(tmp_path: Path) -> None:
    """In other folders, by processes that order sets otherwise; one has compiled something else before."""
    packs = []
    for n, first in enumerate(("", "import numba; numba.njit(lambda: 1)(); ")):
        folder = tmp_path / str(n)
        folder.mkdir()
        (folder / "algebra_of_a_test.py").write_text(KERNELS)
        call = "import numpy as np; from algebra_of_a_test import solved; solved(np.eye(2), np.ones(2))"
        environment = {**os.environ, "PYTHONHASHSEED": str(n), "NUMBA_CACHE_DIR": str(folder / "kept")}
        environment["PYTHONPATH"] = os.pathsep.join((str(folder), *sys.path))
        code = f"import noise_model.compiled.kernel; {first}{call}\n{BUILD.format(folder=str(folder))}"
        subprocess.run([sys.executable, "-c", code], env=environment, check=True)
        packs.append(pack_file(folder).read_bytes())
    assert packs[0] == packs[1]


NAME_CONTENTS = """
from importlib import import_module
from pkgutil import walk_packages
import noise_model, tracker
from noise_model.compiled.content import describe_function, digest
from numba.extending import is_jitted
for package in (noise_model, tracker):
    for found in walk_packages(package.__path__, package.__name__ + "."):
        module = import_module(found.name)
        for name, value in sorted(vars(module).items()):
            if is_jitted(value):
                print(found.name, name, digest(describe_function(value.py_func)))
"""


def test_kernels_have_the_same_keys_on_other_processors() -> None:
    """OpenBLAS and NumPy compute other last digits there: none may become a kernel's constant."""
    oldest = {"OPENBLAS_CORETYPE": "Prescott", "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL X86_V3"}
    found = []
    for processor in ({}, oldest if platform.machine() == "x86_64" else {"OPENBLAS_CORETYPE": "ARMV8"}):
        environment = {**os.environ, **processor, "PYTHONPATH": os.pathsep.join(sys.path)}
        named = subprocess.run(
            [sys.executable, "-W", "ignore", "-c", NAME_CONTENTS],
            env=environment,
            capture_output=True,
            check=True,
        )
        found.append(named.stdout.splitlines())
    assert len(found[0]) > 100
    assert found[0] == found[1]


PRINT_KEY = """
from noise_model.compiled.content import entry_key
from noise_model.compiled.kernel import kernel
print(entry_key(kernel(lambda: 1)))
"""


@pytest.mark.slow
def test_an_empty_setting_of_numba_changes_no_key() -> None:
    """With other keys no kernel of a pack is found."""
    none = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    empty, other = {"NUMBA_OPT": "", "NUMBA_LLVM_REFPRUNE_FLAGS": ""}, {"NUMBA_OPT": "1"}
    keys = [
        subprocess.check_output([sys.executable, "-W", "ignore", "-c", PRINT_KEY], env={**none, **more})
        for more in ({}, empty, other)
    ]
    assert keys[0] == keys[1] != keys[2]


ELF_MACHINES = {"x86-64-v4": 62, "x86-64-v3": 62, "aarch64": 183}
"""The field e_machine of an object file, by the ELF specification's supplements."""


@pytest.mark.parametrize("other", CPU_NAMES)
def test_what_a_folder_keeps_is_compiled_for_each_target(other: str, tmp_path: Path) -> None:
    """For the host's it becomes the same bytes as what numba compiled to run."""
    packed(tmp_path, LONG)
    run_python(["-c", COMPILE, other, str(tmp_path / "compiled")], other, tmp_path)
    kept, compiled = (list(stored_records(tmp_path / name)) for name in ("compiled", other))
    assert [kernel for kernel, *_ in compiled] == [kernel for kernel, *_ in kept]
    machines = {int.from_bytes(record.machine_code[18:20], "little") for *_, record in compiled}
    assert machines == {ELF_MACHINES[other]}
    if other == target():
        codes, expected = ([record.machine_code for *_, record in records] for records in (compiled, kept))
        assert codes == expected


COMPILE_SOME = """
import os
import pickle
from pathlib import Path
from contextlib import suppress
from importlib import import_module
from noise_model.compiled.content import find_kernel
from noise_model.compiled.packed import read_pack
pack = read_pack(Path({file!r}))
places = [entry for kernel in pack.entries.values() for entry in kernel.values()]
# Short ones: what they call is compiled too.
few = sorted(entry for entry in places if entry[0][1] < 2000 and entry[2][1] > 1000)[::{every}]
for _, (first, n), _ in few:
    # Each in a process of its own: LLVM orders some instructions by what it has compiled before.
    if os.fork():
        assert os.wait()[1] == 0
        continue
    # It may have moved, or take other arguments than at the release.
    with suppress(Exception):
        own = pickle.loads(pack.content[first : first + n])[0]
        import_module(own.module)
        find_kernel(own.module, own.name).compile(own.arguments)
    os._exit(0)
"""


@pytest.mark.skipif(not RELEASED.exists(), reason="no pack of the last release for this machine")
def test_machine_code_of_the_release_is_what_its_sources_become(tmp_path: Path) -> None:
    """For a sample of the kernels that are still the same: others are not found in the pack any more."""
    pack = read_pack(RELEASED)
    if pack.made_with != versions():
        pytest.skip(f"the pack is for {pack.made_with}")
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "ARCTRACK_PACKS": str(tmp_path)}
    environment["PYTHONPATH"] = os.pathsep.join(sys.path)
    code = COMPILE_SOME.format(file=str(RELEASED), every=60)
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)
    compiled = pack_of(stored_records(tmp_path), {})
    for kernel, keys in compiled.entries.items():
        for key in keys.keys() & pack.entries.get(kernel, {}).keys():
            assert pieces(compiled, kernel, key) == pieces(pack, kernel, key), kernel


def pieces(pack: Pack, kernel: str, key: str) -> list[bytes]:
    """Return what a pack holds of a kernel under a key."""
    return [pack.content[first : first + n] for first, n in pack.entries[kernel][key]]


def test_the_level_is_the_highest_of_which_a_processor_has_all() -> None:
    assert levels(V4 | {"avx512vnni"}) == ["x86-64-v4", "x86-64-v3"]
    assert levels(V4 - {"avx512vl"}) == ["x86-64-v3"]
    assert levels(V3 - {"fma"}) == []
