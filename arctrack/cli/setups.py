"""Common part of the commands that read or write a setup."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from arctrack.errors import ArctrackError
from arctrack.output import real

if TYPE_CHECKING:
    from arctrack.recording import CalibrationValues, Recording, SetupFile


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
