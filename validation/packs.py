"""Compile what arctrack's commands need, and write it into one file for each target, its pack.

    python -m validation.packs

From a clone, at a release: it takes minutes, and needs no cache of this user's. The commands run once,
compiled for this machine. What they needed is then compiled for each other target too, and not run:
one machine builds the packs of all. The same sources and packages give the same bytes.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import lzma
import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import numba
from llvmlite import binding as llvm
from numba.core.compiler_lock import global_compiler_lock

from noise_model.compiled import numba_internals
from noise_model.compiled.content import find_kernel, versions
from noise_model.compiled.packed import Pack, pack_folder
from noise_model.compiled.store import Record, read_record
from noise_model.compiled.target import CPU_NAMES, host_targets

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = str(ROOT / "examples/v_groove")

TRIPLES = {
    target: f"{'aarch64' if target == 'aarch64' else 'x86_64'}-unknown-linux-gnu" for target in CPU_NAMES
}
"""LLVM's machine of each target."""

RUN = """
import json, sys
from pathlib import Path
from arctrack.cli import main
from noise_model.compiled.forecast import kernels_in_use
names, *sys.argv[1:] = sys.argv[1:]
try:
    main()
finally:
    Path(names).write_text(json.dumps(sorted(kernel._cache.name for kernel in kernels_in_use())))
"""
"""Program of a subprocess that runs a command, and prints the kernels that it used."""


COMPILE = """
import sys
from pathlib import Path
from validation.packs import compile_stored
compile_stored(sys.argv[1], Path(sys.argv[2]))
"""


def main() -> None:
    """Write the packs that the command line asks for."""
    parser = argparse.ArgumentParser(prog="python -m validation.packs", description=__doc__)
    parser.add_argument("--target", choices=CPU_NAMES, action="append", help="only this one; repeat")
    parser.add_argument("--out", type=Path, default=pack_folder(), help="folder of the packs")
    asked = parser.parse_args()
    for target, pack in build_packs(asked.target or list(CPU_NAMES), works()):
        file = asked.out / f"{target}.pack"
        write_pack(file, pack)
        n_entries = sum(map(len, pack.entries.values()))
        print(f"{file}: {n_entries} functions, {file.stat().st_size / 1e6:.2f} MB")


def works() -> dict[str, list[list[str]]]:
    """Return the commands whose kernels a pack holds; a joint's last one determines what it needs."""
    from_arctrack = "from arctrack.nominal import DIMENSIONS; print(*DIMENSIONS)"
    asked = subprocess.run([sys.executable, "-c", from_arctrack], capture_output=True, text=True, check=True)
    joints = {
        joint: [["simulate", joint, "--joint", joint, "--frames", "12"], ["warm", joint]]
        for joint in asked.stdout.split()
    }
    replay = ["replay", EXAMPLE, "--out", "replayed"]
    checks = [["check", EXAMPLE, "--out", "check.png"], ["explain", EXAMPLE, "12", "--out", "explained.html"]]
    return {**joints, "commands": [replay, *checks]}


def build_packs(targets: Iterable[str], works: Mapping[str, list[list[str]]]) -> Iterator[tuple[str, Pack]]:
    """Run commands with an empty cache, and yield what they compiled, for each target."""
    with tempfile.TemporaryDirectory() as name:
        folder, host = Path(name), host_targets()[0]
        used = {work: [_run(command, host, folder) for command in works[work]][-1] for work in works}
        for target in targets:
            if target != host:
                run_python(["-c", COMPILE, target, str(folder / host)], target, folder)
            records = list(stored_records(folder / target))
            sizes: dict[str, int] = {}
            for kernel, _, record in records:
                sizes[kernel] = sizes.get(kernel, 0) + len(record.machine_code)
            costs = {
                work: {kernel: sizes[kernel] for kernel in used[work] if kernel in sizes} for work in works
            }
            yield target, pack_of(records, costs)


def _run(command: list[str], target: str, folder: Path) -> list[str]:
    """Run a command, and return the names of the kernels that it used."""
    names = folder / "names.json"
    run_python(["-c", RUN, str(names), *command], target, folder)
    used: list[str] = json.loads(names.read_text())
    return used


def run_python(arguments: list[str], target: str, folder: Path) -> None:
    """Run Python with its kernels compiled for a target, into a folder of its name."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    environment |= {
        "NUMBA_CACHE_DIR": str(folder / target),
        "NUMBA_CPU_NAME": CPU_NAMES[target],
        "NUMBA_CPU_FEATURES": "",
        "ARCTRACK_PACKS": str(folder / "none"),
        "PYTHONPATH": str(ROOT),
    }
    subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=environment, check=True, stdout=subprocess.DEVNULL
    )


def compile_stored(target: str, kept: Path) -> None:
    """Compile the kernels and entry points that a folder keeps, for a target of another processor.

    numba compiles for the machine that LLVM names, so LLVM is given the target's. This process can run none
    of what it compiles.
    """
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    machine = llvm.Target.from_triple(TRIPLES[target])
    llvm.get_process_triple = lambda: machine.triple
    llvm.Target.from_default_triple = lambda: machine
    for _, _, record in stored_records(kept):
        own, _, _, _, (function, *_) = pickle.loads(record.body)
        import_module(function.modname)
        kernel = find_kernel(function.modname, function.qualname)
        kernel.compile(function.argtypes)
        if own is None:
            with global_compiler_lock:
                numba_internals._entry(kernel, kernel.overloads[function.argtypes])


def pack_of(records: Iterable[tuple[str, str, Record]], costs: Mapping[str, Mapping[str, int]]) -> Pack:
    """Return a pack of compiled kernels, each with its name and key."""
    entries: dict[str, dict[str, list[tuple[int, int]]]] = {}
    content: list[bytes] = []
    end = 0
    ordered = sorted(records, key=lambda named: named[:2])
    # Similar contents lie together, for the compressor.
    for part in ("described", "machine code"):
        for kernel, key, record in ordered:
            described = [canonical(record.relies_on), canonical(pickle.loads(record.body))]
            for piece in described if part == "described" else [record.machine_code]:
                entries.setdefault(kernel, {}).setdefault(key, []).append((end, len(piece)))
                content.append(piece)
                end += len(piece)
    return Pack(versions(), costs, entries, b"".join(content))


def stored_records(cache: Path) -> Iterator[tuple[str, str, Record]]:
    """Yield the name, the key and the record of each kernel that is kept in a folder for NUMBA_CACHE_DIR."""
    for file in sorted((cache / "arctrack" / "kernels").glob("*/*")):
        record = read_record(file)
        if record is not None and record.machine_code:
            yield file.parent.name, file.name, record


def write_pack(file: Path, pack: Pack) -> None:
    """Write a pack: the same bytes for the same content."""
    *index, content = pack
    plain = json.dumps(index, sort_keys=True).encode() + b"\n" + content
    compressed = lzma.compress(plain, preset=9 | lzma.PRESET_EXTREME)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(hashlib.sha256(compressed).hexdigest().encode() + b"\n" + compressed)


def canonical(value: Any) -> bytes:
    """Return a pickle of a value that is the same in each process."""
    with io.BytesIO() as buffer:
        _Pickler(buffer, protocol=5).dump(value)
        return buffer.getvalue()


class _Pickler(pickle._Pickler):
    """Refers to nothing but texts by identity: two that are equal may be one object, or two."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._texts: dict[str, str] = {}

    def save(self, value: Any, *arguments: Any, **options: Any) -> None:
        if type(value) is str:
            value = self._texts.setdefault(value, value)
        super().save(value, *arguments, **options)  # type: ignore[misc]

    def memoize(self, value: Any) -> None:
        if type(value) is str:
            super().memoize(value)  # type: ignore[misc]

    def reducer_override(self, value: Any) -> Any:
        if not isinstance(value, numba.types.Type):
            return NotImplemented
        make, (rebuild, arguments, state) = value.__reduce__()
        # Its number is a count of this process.
        return make, (rebuild, arguments, {name: part for name, part in state.items() if name != "_code"})


if __name__ == "__main__":
    main()
