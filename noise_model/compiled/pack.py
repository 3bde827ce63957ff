"""Compile what arctrack's commands need, and write it into one file for each target, its pack.

    python -m noise_model.compiled.pack

From a clone, at a release: it takes minutes, and needs no cache of this user's. It builds for each target
whose machine code this machine runs: a machine with AVX-512 for x86-64-v4 and x86-64-v3, another x86-64 for
the latter, a 64-bit ARM for aarch64. The same sources and packages give the same bytes.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numba

from noise_model.compiled.content import versions
from noise_model.compiled.packed import Pack, pack_folder, write_pack
from noise_model.compiled.store import Record, kept_records
from noise_model.compiled.target import CPU_NAMES, host_targets

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = str(ROOT / "examples/v_groove")

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
"""A command in a process of its own, which tells the kernels that it used."""


def main() -> None:
    """Write the packs that the command line asks for."""
    parser = argparse.ArgumentParser(prog="python -m noise_model.compiled.pack", description=__doc__)
    parser.add_argument("--target", choices=host_targets(), action="append", help="only this one; repeat")
    parser.add_argument("--out", type=Path, default=pack_folder(), help="folder of the packs")
    asked = parser.parse_args()
    for target in asked.target or host_targets():
        pack = build_pack(target, works())
        file = asked.out / f"{target}.pack"
        write_pack(file, pack)
        n_entries = sum(map(len, pack.entries.values()))
        print(f"{file}: {n_entries} functions, {file.stat().st_size / 1e6:.2f} MB")


def works() -> dict[str, list[list[str]]]:
    """Return the commands whose kernels a pack holds; of a joint's the last one tells what it needs."""
    from_arctrack = "from arctrack.nominal import DIMENSIONS; print(*DIMENSIONS)"
    asked = subprocess.run([sys.executable, "-c", from_arctrack], capture_output=True, text=True, check=True)
    joints = {
        joint: [["simulate", joint, "--joint", joint, "--frames", "12"], ["warm", joint]]
        for joint in asked.stdout.split()
    }
    replay = ["replay", EXAMPLE, "--out", "replayed"]
    checks = [["check", EXAMPLE, "--out", "check.png"], ["explain", EXAMPLE, "12", "--out", "explained.html"]]
    return {**joints, "commands": [replay, *checks]}


def build_pack(target: str, works: Mapping[str, list[list[str]]]) -> Pack:
    """Run commands with an empty cache, and return what they compiled."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        used = {work: [_run(target, command, folder) for command in works[work]][-1] for work in works}
        records = list(kept_records(folder / "kept"))
    sizes: dict[str, int] = {}
    for kernel, _, record in records:
        sizes[kernel] = sizes.get(kernel, 0) + len(record.machine_code)
    costs = {work: {kernel: sizes[kernel] for kernel in used[work] if kernel in sizes} for work in works}
    return pack_of(records, costs)


def _run(target: str, command: list[str], folder: Path) -> list[str]:
    """Run a command for a target, and return the names of the kernels that it used."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    environment |= {
        "NUMBA_CACHE_DIR": str(folder / "kept"),
        "NUMBA_CPU_NAME": CPU_NAMES[target],
        "NUMBA_CPU_FEATURES": "",
        "ARCTRACK_PACKS": str(folder / "none"),
        "PYTHONPATH": str(ROOT),
    }
    names = folder / "names.json"
    arguments = [sys.executable, "-c", RUN, str(names), *command]
    subprocess.run(arguments, cwd=folder, env=environment, check=True, stdout=subprocess.DEVNULL)
    used: list[str] = json.loads(names.read_text())
    return used


def pack_of(records: Iterable[tuple[str, str, Record]], costs: Mapping[str, Mapping[str, int]]) -> Pack:
    """Return a pack of compiled kernels, each with its name and key."""
    entries: dict[str, dict[str, list[tuple[int, int]]]] = {}
    content: list[bytes] = []
    end = 0
    ordered = sorted(records, key=lambda named: named[:2])
    # What is alike lies together: the compressor finds it.
    for part in ("described", "machine code"):
        for kernel, key, record in ordered:
            described = [canonical(record.relies_on), canonical(pickle.loads(record.body))]
            for piece in described if part == "described" else [record.machine_code]:
                entries.setdefault(kernel, {}).setdefault(key, []).append((end, len(piece)))
                content.append(piece)
                end += len(piece)
    return Pack(versions(), costs, entries, b"".join(content))


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
