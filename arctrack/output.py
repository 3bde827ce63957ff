"""Output: folders without an earlier run's files, files that are written whole or not at all."""

from __future__ import annotations

import glob
import os
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from arctrack.errors import ArctrackError, in_file


def make_folder(folder: Path, files: Iterable[str]) -> None:
    """Make a folder and take an earlier run's files out of it, so that no two are ever mixed."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name in files:
            (folder / name).unlink(missing_ok=True)
    except OSError as error:
        raise in_file(folder, f"cannot be written: {error.strerror}; choose another with --out") from None


def check_new_folder(folder: Path) -> None:
    """Raise ArctrackError for a folder that holds anything, and for a file in its place."""
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise in_file(folder, "exists already; remove it or choose another name")


def make_new_folder(folder: Path) -> None:
    """Make a folder, or take an empty one; ArctrackError if it holds anything, or if it cannot be made."""
    check_new_folder(folder)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)


def real(path: Path) -> Path:
    """Return a path through all links, as far as they resolve: one may point at itself."""
    return Path(os.path.realpath(path))


def folders_for(recordings: Sequence[Path], out: Path | None, name: str, clash: str) -> list[Path]:
    """Return the folder of each recording's files: `name` in it, or `out`, where several get a folder each.

    ArctrackError, which says the `clash`, if two recordings would share a folder.
    """
    if out is None:
        folders = [path / name for path in recordings]
    elif len(recordings) == 1:
        folders = [out]
    else:
        folders = [out / real(path).name for path in recordings]
    for n, (path, folder) in enumerate(zip(recordings, folders, strict=True)):
        if real(folder) in map(real, folders[:n]):
            raise ArctrackError(f"{path}: {clash} in {folder}")
    return folders


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Make an ArctrackError that names the file of what fails to be written: a full disk names none."""
    try:
        yield
    except OSError as error:
        raise in_file(path, f"cannot be written: {error.strerror or error}") from None


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Give the path of a draft that becomes the file at the context's end, or never.

    Of a file that is there the permissions stay, and a link still points at it. Raises ArctrackError if it
    cannot be written; what was there is then as it was.
    """
    target = real(path)
    draft = target.with_name(f".{target.name}.{os.getpid()}.part")
    with writing(path):
        try:
            yield draft
            if target.exists():
                shutil.copymode(target, draft)
            draft.replace(target)
        finally:
            draft.unlink(missing_ok=True)


def write_whole(path: Path, text: str) -> None:
    """Write a file of text in one go, as `whole_file` does."""
    with whole_file(path) as draft:
        # A folder's name need not be UTF-8.
        draft.write_text(text, encoding="utf-8", errors="backslashreplace")


def write_keeping(path: Path, text: str) -> Path | None:
    """Write a file atomically, and keep the previous one under its name and the next free number.

    Returns where it is kept, such as recording.toml.1 (the largest number is the newest); None if there was
    none, or if it held the same. Raises ArctrackError if the file cannot be written, and leaves the previous
    one as it was.
    """
    former = None
    with writing(path):
        if path.exists() and path.read_bytes() != text.encode():
            taken = [name.suffix[1:] for name in path.parent.glob(f"{glob.escape(path.name)}.*")]
            number = 1 + max((int(n) for n in taken if n.isdecimal()), default=0)
            former = path.with_name(f"{path.name}.{number}")
            shutil.copy2(path, former)
    write_whole(path, text)
    return former
