"""Inputs of a command, checked before what computes is imported, which takes seconds."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from arctrack.errors import ArctrackError, as_line
from arctrack.output import real

if TYPE_CHECKING:
    from arctrack.recording import CalibrationValues, Recording, SetupFile


def look_at_recording(folder: Path, setup: Path | None = None) -> None:
    """Raise the ArctrackError of a recording that is missing, or of a wrong key in its setup."""
    from arctrack.recording.files import FRAMES_CSV, check_folder

    check_folder(folder)
    look_at_setup(folder if setup is None else setup)
    look_at_file(folder / FRAMES_CSV)


def look_at_recordings(folders: Sequence[Path], setup: Path | None = None) -> None:
    """Raise the error of one recording, or complain of all if none of several can be read.

    Where one can be read it is worth the wait: of the others the command itself complains.
    """
    problems: list[ArctrackError | OSError] = []
    for folder in folders:
        try:
            look_at_recording(folder, setup)
        except (ArctrackError, OSError) as error:
            problems.append(error)
    if len(problems) < len(folders):
        return
    if len(problems) == 1:
        raise problems[0]
    from arctrack.cli import console
    from arctrack.cli.exit_codes import BAD_INPUT

    console.complain(as_line(error, folder) for error, folder in zip(problems, folders, strict=True))
    raise typer.Exit(BAD_INPUT)


def look_at_setup(source: Path) -> None:
    """Raise the ArctrackError of a recording.toml, or that of a recording, with a wrong key."""
    from arctrack.recording.setup_file import setup_text, stated_keys

    path = setup_path(source)
    stated_keys(setup_text(path), path)


def look_at_cell(path: Path) -> None:
    """Raise the ArctrackError of a cell file with a wrong key, or of the setup that it points to."""
    from arctrack.control.cell_file.reader import stated_keys

    look_at_setup(path.parent / stated_keys(path).setup)


def look_at_stated(path: Path) -> None:
    """Raise the ArctrackError of a cell file or a setup, whichever a path is."""
    from arctrack.control.cell_file.reader import is_cell_file

    (look_at_cell if is_cell_file(path) else look_at_setup)(path)


def look_at_file(path: Path) -> None:
    """Raise the ArctrackError of a file that is missing, or that is none."""
    from arctrack.limits import LIMITS
    from arctrack.recording.files import blamed_on, check_file

    with blamed_on(path):
        check_file(path, LIMITS.log_bytes)


def look_at_images(sources: Sequence[Path]) -> None:
    """Raise the ArctrackError of folders, files and patterns that name no image."""
    from arctrack.recording.importing.image_files import images_of

    images_of(sources)


def setup_path(source: Path) -> Path:
    """Return the recording.toml that a path names: itself, or that of a recording's folder."""
    from arctrack.recording.setup_writer import FILE_NAME

    return source / FILE_NAME if source.is_dir() else source


def read_setup(source: Path) -> SetupFile:
    """Read a recording.toml, or that of a recording's folder; warn of keys that mean nothing in it."""
    from arctrack.cli import console
    from arctrack.recording import read_setup_file

    stated = read_setup_file(setup_path(source))
    console.warn(stated.warnings)
    return stated


def check_replaces_nothing(out: Path, recording: Recording) -> None:
    """Raise ArctrackError if a file to write is a folder, or of those that a recording is read from."""
    _check_is_a_files_name(out)
    if recording.is_read_from(out):
        raise ArctrackError(f"{out}: is of the recording itself; give --out another file")


def check_can_be_written(out: Path, setup: Path, data: Path | None = None) -> None:
    """Raise ArctrackError if a command cannot write its file, or would replace the setup or data it reads."""
    for read, what in ((setup, "setup"), (data, "measurement")):
        if read is not None and out.exists() and real(out) == real(read):
            raise ArctrackError(f"{out}: is the {what} itself; give --out another file")
    check_can_be_replaced(out)


def check_can_be_replaced(out: Path, option: str = "--out") -> None:
    """Raise ArctrackError if a file that may be there already, and is kept if it is, cannot be written."""
    _check_is_a_files_name(out, option)
    if not (out.parent.is_dir() and os.access(out.parent, os.W_OK)):
        raise ArctrackError(f"{out.parent}: nothing can be written there; give {option} another place")


def write_calibrated(out: Path, setup: Path, *results: CalibrationValues) -> None:
    """Write a setup with calibrated values; print where it is, and where the previous one is kept.

    `out` may be the setup itself: the previous file stays next to it under a number.
    """
    from arctrack.cli import console
    from arctrack.output import write_keeping
    from arctrack.recording import with_calibrated

    former = write_keeping(out, with_calibrated(setup, *results))
    before = "" if former is None else f"; the one before is {former.name}"
    console.say(f"{out}: the setup with the values found{before}")


def _check_is_a_files_name(out: Path, option: str = "--out") -> None:
    """Raise ArctrackError for a folder, and for a FIFO or a device that would keep the writer waiting."""
    from arctrack.recording.files import kind_of

    kind = kind_of(out.stat().st_mode) if out.exists() else None
    if kind is not None:
        raise ArctrackError(f"{out}: is a {kind}; give {option} a file's name")
