"""Files in memory that the processes of one user share, and nobody else reaches.

They lie in a folder of the user's own, which is used only if it is this user's and nobody else may enter:
others can guess a name, and so must not own it. The same holds for each file.
"""

import errno
import os
import stat
import tempfile
from collections.abc import Callable
from pathlib import Path

MEMORY = Path("/dev/shm")

_OTHERS = stat.S_IRWXG | stat.S_IRWXO


def memory_folder() -> Path:
    """Return the folder whose files are memory, where the machine has one."""
    return MEMORY if MEMORY.is_dir() else Path(tempfile.gettempdir())


def private_path(name: str) -> Path:
    """Return where a file of a name lies, in this user's own folder.

    Raises PermissionError if the folder's name is taken by what is not this user's alone.
    """
    folder = memory_folder() / f"arctrack-{os.geteuid()}"
    try:
        folder.mkdir(0o700)
    except FileExistsError:
        _require_private(folder, folder.lstat(), stat.S_ISDIR)
    return folder / name


def open_private(path: Path, flags: int) -> int:
    """Open a file of `private_path`, and return its descriptor; what is created is new.

    Raises PermissionError if the file is not this user's alone, or is none, such as a link.
    """
    if flags & os.O_CREAT:
        flags |= os.O_EXCL
    try:
        file = os.open(path, flags | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise _refused(path) from None
        raise
    try:
        _require_private(path, os.fstat(file), stat.S_ISREG)
    except PermissionError:
        os.close(file)
        raise
    return file


def _require_private(path: Path, status: os.stat_result, is_kind: Callable[[int], bool]) -> None:
    if not is_kind(status.st_mode) or status.st_uid != os.geteuid() or status.st_mode & _OTHERS:
        raise _refused(path)


def _refused(path: Path) -> PermissionError:
    return PermissionError(
        errno.EPERM, "is not this user's alone; have its owner or root remove it", str(path)
    )
