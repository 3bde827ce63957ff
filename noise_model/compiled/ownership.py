"""Ownership of files: who may write what arctrack runs as code.

On Windows `os.stat` tells neither a file's owner nor who may write it. Windows keeps a user's folder from
other users by itself: what lies in there is trusted, and nothing else.
"""

from __future__ import annotations

import os
from pathlib import Path


def is_open_to_others(path: Path) -> bool:
    """Return True if a user other than this process's and root may write a file or a folder.

    The group of this user is trusted: many systems give each user one of his own, and let it write.
    """
    if not hasattr(os, "geteuid"):
        return not _is_in_home(path)
    status = path.stat()
    strange_group = status.st_mode & 0o020 and status.st_gid not in (0, os.getegid())
    return status.st_uid not in (0, os.geteuid()) or bool(status.st_mode & 0o002 or strange_group)


def is_open_to_more(path: Path, code: Path) -> bool:
    """Return True if users may write a file who may not write the file of code that would load it.

    Raises OSError if one of them is not there.
    """
    status, trusted = path.stat(), code.stat()
    if not hasattr(os, "geteuid"):
        return not (_is_in_home(path) or path.resolve().is_relative_to(code.resolve().parent))
    return status.st_uid not in (0, os.geteuid(), trusted.st_uid) or bool(
        status.st_mode & ~trusted.st_mode & 0o022
    )


def _is_in_home(path: Path) -> bool:
    home = Path(os.path.expanduser("~"))
    return home.is_absolute() and path.resolve().is_relative_to(home.resolve())
