"""Store of a user's compiled kernels: one folder for all clones, environments and processes.

A file is a kernel compiled for some types. Its name is made of keys, so nothing in it goes out of date: what
changes is compiled under another name. What is kept is pickled: whoever writes it runs code as the user who
loads it. So a folder that another user may write is left alone.
"""

from __future__ import annotations

import hashlib
import logging
import os
import pickle
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from noise_model.compiled.ownership import is_open_to_others

MAX_BYTES = 1 << 30
"""Largest size of the store: all joints' kernels thirty times. The longest unused are removed first."""

_DIGEST_BYTES = hashlib.sha256().digest_size
_LOG = logging.getLogger(__name__)
_WARNED: set[str] = set()


class Record(NamedTuple):
    """A stored compiled kernel.

    `relies_on` is what its machine code relies on, `compile_s` is CPU time, `body` numba's pickled record,
    `machine_code` an object file, `bitcode` what LLVM inlines into callers, or empty.
    """

    relies_on: tuple[Any, ...]
    compile_s: float
    body: bytes
    machine_code: bytes = b""
    bitcode: bytes = b""


@cache
def kernel_folder() -> Path | None:
    """Return the folder of the compiled kernels, None where there is none that only this user may write.

    It lies in NUMBA_CACHE_DIR where that is set, else in the user's cache.
    """
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    user_cache = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    folder = Path(chosen or user_cache) / "arctrack" / "kernels"
    # A user without a home is none that `~` stands for.
    return _own(folder) if chosen or folder.is_absolute() else None


def kernels_are_stored() -> bool:
    """Return True if the next process finds on disk what this one compiles."""
    folder = kernel_folder()
    return folder is not None and os.access(folder, os.W_OK | os.X_OK) and "lost" not in _WARNED


def warn(kind: str, *what: object) -> None:
    """Print in one line what is wrong with kept kernels, each kind once: hundreds of files may be damaged."""
    if kind not in _WARNED:
        _WARNED.add(kind)
        _LOG.warning("arctrack: warning: " + " ".join(map(str, what)))


def read_records(kernel: str, key: str) -> Iterator[Record]:
    """Yield what is kept of a kernel under a key, the last used first."""
    folder = _existing_folder_of(kernel)
    if folder is None:
        return
    try:
        files = [file for file in os.scandir(folder) if file.name.startswith(key)]
        files.sort(key=lambda file: file.stat().st_mtime, reverse=True)
    except OSError:
        return
    for file in files:
        record = read_record(Path(file.path))
        if record is not None:
            yield record


def is_stored(kernel: str, key: str) -> bool:
    """Return True if something is kept of a kernel under a key."""
    folder = _existing_folder_of(kernel)
    with suppress(OSError):
        return folder is not None and any(name.startswith(key) for name in os.listdir(folder))
    return False


def read_record(file: Path) -> Record | None:
    """Return what a file keeps, None where it is gone, damaged or of classes that have changed."""
    try:
        content = file.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        warn("damaged", file, f"cannot be read ({error.strerror}); what cannot be is compiled anew")
        return None
    if hashlib.sha256(content[_DIGEST_BYTES:]).digest() != content[:_DIGEST_BYTES]:
        warn("damaged", file, "is damaged; what is damaged is compiled anew")
        return None
    with suppress(OSError):
        os.utime(file)
    try:
        return Record(*pickle.loads(content[_DIGEST_BYTES:]))
    # Unpickling raises nearly anything where an update has moved or changed the class of an argument.
    except Exception:
        return None


def write_record(kernel: str, key: str, record: Record) -> None:
    """Keep a compiled kernel, where a folder may be written and has room."""
    folder = _folder_of(kernel)
    if folder is None:
        warn("lost", "no folder keeps compiled kernels; set NUMBA_CACHE_DIR to one that only you may write")
        return
    _make_room()
    content = pickle.dumps(tuple(record), protocol=pickle.HIGHEST_PROTOCOL)
    try:
        with tempfile.NamedTemporaryFile(dir=folder, delete=False) as unfinished:
            unfinished.write(hashlib.sha256(content).digest())
            unfinished.write(content)
        os.replace(unfinished.name, folder / key)
    except OSError as error:
        warn("lost", folder, f"cannot be written ({error.strerror}): the next run compiles anew")
        with suppress(OSError, UnboundLocalError):
            os.unlink(unfinished.name)


@cache
def _make_room() -> None:
    """Remove kernels that were not used longest, once a process, where all take more than MAX_BYTES."""
    folder = kernel_folder()
    if folder is None:
        return
    with suppress(OSError):
        used = [(file.stat(), file) for file in folder.glob("*/*")]
        size = sum(status.st_size for status, _ in used)
        for status, file in sorted(used, key=lambda kept: kept[0].st_mtime):
            if size <= MAX_BYTES:
                break
            file.unlink()
            size -= status.st_size


@cache
def _folder_of(kernel: str) -> Path | None:
    """Return the folder that keeps one kernel, made unless it is there."""
    folder = kernel_folder()
    return None if folder is None else _own(folder / kernel)


def _existing_folder_of(kernel: str) -> Path | None:
    """Return the folder of one kernel, None if nothing is kept, or others may write there."""
    folder = kernel_folder()
    is_stored = folder is not None and (folder / kernel).is_dir()
    return _folder_of(kernel) if is_stored else None


def _own(folder: Path) -> Path | None:
    """Return a folder, made unless it is there, if no other user may write in it."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        return None if is_open_to_others(folder) else folder
    except OSError:
        return folder if folder.is_dir() and not is_open_to_others(folder) else None
