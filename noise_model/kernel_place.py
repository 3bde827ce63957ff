"""The folder on disk that keeps compiled kernels, and who may write there.

What is kept is pickled: whoever writes it runs code as the user who loads it. So a folder counts only if no
other user may write in it. `__pycache__` beside the sources holds Python's own compiled code already.
"""

from __future__ import annotations

import hashlib
import os
from functools import cache
from pathlib import Path
from types import FunctionType

import numba


class KernelPlace:
    """The folders of one kernel, as numba asks a cache's locator for them.

    Attributes
    ----------
    folders : tuple of Path
        Where it may lie.
    kept : Path or None
        Where it is written; None where no folder may be, and each process compiles for itself.
    """

    def __init__(self, function: FunctionType, source: str) -> None:
        self._line = function.__code__.co_firstlineno
        self._in_tree = Path(source).parent / "__pycache__"
        self.folders, self.kept = kernel_folders(Path(source).parent)

    @classmethod
    def from_function(cls, function: FunctionType, source: str) -> KernelPlace:
        """Return the folders of a function's kernel, whether they may be written or not."""
        return cls(function, source)

    def get_cache_path(self) -> str:
        """Return the folder that kernels are written to."""
        return str(self.kept or self._in_tree)

    def ensure_cache_path(self) -> None:
        """Make the folder that kernels are written to."""
        os.makedirs(self.get_cache_path(), exist_ok=True)

    def get_source_stamp(self) -> str:
        """Return nothing: the index of a kernel has `noise_model.kernel.source_key`."""
        return ""

    def get_disambiguator(self) -> str:
        """Return what tells two functions of one name in one file apart."""
        return str(self._line)


@cache
def kernel_folders(sources: Path) -> tuple[tuple[Path, ...], Path | None]:
    """Return where the kernels of a folder of sources may lie, and where they are kept.

    That is NUMBA_CACHE_DIR where it is set. Else it is `__pycache__` beside the sources, and the user's own
    cache where an installation is read-only.
    """
    in_tree = sources / "__pycache__"
    if not numba.config.CACHE_DIR and _make(in_tree):
        return (in_tree,), in_tree
    user_cache = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
    own = Path(numba.config.CACHE_DIR or user_cache / "arctrack" / "kernels")
    # As numba names it: the folder's name for people, a digest for short paths.
    own /= f"{sources.name}_{hashlib.sha1(str(sources).encode()).hexdigest()}"
    if not _make(own, 0o700) or _is_open_to_others(own):
        return (in_tree,), None
    return ((own,) if numba.config.CACHE_DIR else (in_tree, own)), own


def kernels_are_kept() -> bool:
    """Return True if the next process finds on disk what this one compiles."""
    return kernel_folders(Path(__file__).parent)[1] is not None


def _make(folder: Path, mode: int = 0o777) -> bool:
    """Make a folder unless it is there; return True if files can be made in it."""
    try:
        folder.mkdir(mode, parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK | os.X_OK, effective_ids=os.access in os.supports_effective_ids)


def _is_open_to_others(folder: Path) -> bool:
    """Return True if a user other than this process's and root may write in a folder.

    The group of this user is trusted: many systems give each user one of his own, and let it write.
    """
    status = folder.stat()
    strange_group = status.st_mode & 0o020 and status.st_gid not in (0, os.getegid())
    return status.st_uid not in (0, os.geteuid()) or bool(status.st_mode & 0o002 or strange_group)
