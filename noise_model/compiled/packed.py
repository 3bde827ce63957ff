"""Packs: compiled kernels that come with arctrack, one file for each level of processor.

`validation.packs` makes them. A pack holds what a user's folder of kernels would, under the same keys, so a
kernel that has changed since is not found and compiled. What is in a pack is pickled, as trusted as the
package's sources: it lies next to them, and one that more users may write than those is left aside.
"""

from __future__ import annotations

import hashlib
import json
import lzma
import os
import pickle
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import cache
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from noise_model.compiled.content import versions
from noise_model.compiled.ownership import is_open_to_more
from noise_model.compiled.store import Record, is_stored, read_records, warn
from noise_model.compiled.target import target


class Pack(NamedTuple):
    """Content of a pack.

    `made_with` are the versions of what compiled it. `costs` has, for each work such as a joint's name, the
    bytes of machine code of each kernel that it needs. `entries` locate compiled kernels by name and key:
    first byte in `content` and number of bytes, for the pickled relies_on and body and the machine_code of
    `Record`.
    """

    made_with: list[str]
    costs: Mapping[str, Mapping[str, int]]
    entries: Mapping[str, Mapping[str, list[tuple[int, int]]]]
    content: bytes


def find_records(kernel: str, key: str) -> Iterator[Record]:
    """Yield what this user has compiled of a kernel under a key, then what came with arctrack."""
    return chain(read_records(kernel, key), _read_packed(kernel, key))


def is_found(kernel: str, key: str) -> bool:
    """Return True if something is at hand of a kernel under a key."""
    return is_stored(kernel, key) or any(True for _ in _read_packed(kernel, key))


def compile_costs(work: str) -> Mapping[str, int]:
    """Return the bytes of machine code, which time follows, of each kernel that some work needs.

    It is known for arctrack as released, without anything compiled on this machine before. Empty without a
    pack, and where the pack itself serves, since little is compiled then.
    """
    pack = _pack()
    return {} if pack is None or pack_serves() else pack.costs.get(work, {})


def pack_serves() -> bool:
    """Return True if arctrack came with kernels that are compiled for what is installed here."""
    pack = _pack()
    return pack is not None and pack.made_with == versions()


def _read_packed(kernel: str, key: str) -> Iterator[Record]:
    pack = _pack()
    if pack is None:
        return
    if pack.made_with != versions():
        warn(
            "other",
            f"the kernels that come with arctrack are compiled for {', '.join(pack.made_with)}, and here is "
            f"{', '.join(versions())}: compiling anew; requirements.lock has those versions",
        )
        return
    for name, places in pack.entries.get(kernel, {}).items():
        if name.startswith(key):
            relies_on, body, machine_code = (pack.content[first : first + n] for first, n in places)
            # A class of an argument may have moved since the release.
            with suppress(AttributeError, ImportError):
                yield Record(pickle.loads(relies_on), 0.0, body, machine_code)


def pack_folder() -> Path:
    """Return the folder of the packs: next to this file, or that of ARCTRACK_PACKS."""
    return Path(os.environ.get("ARCTRACK_PACKS") or Path(__file__).with_name("packs"))


@cache
def _pack() -> Pack | None:
    """Return the pack for what this process compiles for; None if there is none, or none to be trusted."""
    file = pack_folder() / f"{target()}.pack"
    try:
        if is_open_to_more(file, Path(__file__)):
            warn("foreign", file, "may be written by other users than arctrack itself: it is left aside")
            return None
        return read_pack(file)
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        warn("pack", file, f"is left aside ({error}): compiling anew; install arctrack again")
        return None


def read_pack(file: Path) -> Pack:
    """Return a pack's content; ValueError if it is damaged."""
    digest, _, compressed = file.read_bytes().partition(b"\n")
    if hashlib.sha256(compressed).hexdigest().encode() != digest:
        raise ValueError("it is damaged")
    index, _, content = lzma.decompress(compressed).partition(b"\n")
    made_with, costs, entries = json.loads(index)
    return Pack(made_with, costs, entries, content)
