"""Files that are written whole or not at all."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from arctrack.errors import in_file


def write_whole(path: Path, text: str) -> None:
    """Write a file in one go; of one that is there the permissions stay, and a link still points at it.

    Raises ArctrackError if it cannot be written; what was there is then as it was.
    """
    target = path.resolve()
    draft = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        try:
            draft.write_text(text, encoding="utf-8")
            if target.exists():
                shutil.copymode(target, draft)
            draft.replace(target)
        finally:
            draft.unlink(missing_ok=True)
    except OSError as error:
        raise in_file(path, f"cannot be written: {error.strerror}") from None
