"""Inputs of a command, checked before what computes is imported, which takes seconds."""

from collections.abc import Sequence
from pathlib import Path

import typer

from arctrack.cli.setups import setup_path
from arctrack.errors import ArctrackError, as_line


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
