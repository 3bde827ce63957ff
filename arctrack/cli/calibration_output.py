"""Common part of the calibrations that write a setup and a page: options, files, table."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from arctrack.cli.setups import check_can_be_replaced, write_calibrated
from arctrack.errors import ArctrackError
from arctrack.output import real, write_whole

if TYPE_CHECKING:
    from arctrack.calibrate.page import CalibrationPage
    from arctrack.calibrate.stage import CalibrationStage, Steps
    from arctrack.recording import BadFrame, Recording
    from calibration.boards.board import Board

Sources = Annotated[
    list[Path], typer.Argument(metavar="SOURCE...", help="Folders of images, images, or patterns in quotes.")
]
BOARD = typer.Option(
    help="chessboard:9x6:5mm (inner corners), or charuco:8x6:5mm:3.7mm:5X5_100 (squares, sides of a "
    "square and a marker, dictionary)."
)
Pattern = Annotated[str, BOARD]
Out = Annotated[
    Path | None,
    typer.Option(help="Where to write recording.toml; default: the setup, the one before is kept."),
]
Report = Annotated[
    Path | None, typer.Option(help="Where the page with the pictures goes; default: beside the written file.")
]


def board_of(pattern: str) -> Board:
    """Return the board that `--board` states; ArctrackError for one that is none."""
    from calibration.boards.board import Board

    try:
        return Board.parse(pattern)
    except ValueError as error:
        raise ArctrackError(f"--board: {error}") from None


def check_outputs(
    setup: Path | None,
    page: Path,
    stated: Path | None,
    recording: Recording | None = None,
    images: Iterable[Path] = (),
) -> None:
    """Raise ArctrackError if setup or page could not be written, or would replace what is read.

    `setup` is the file to write, `stated` the one that is read: it may be the same, the earlier one is kept.
    `images` are read as well.
    """
    if setup is not None:
        check_can_be_replaced(setup)
        is_new = stated is None or real(setup) != real(stated)
        if recording is not None and is_new and recording.is_read_from(setup):
            raise ArctrackError(f"{setup}: is of the recording itself; give --out another file")
    check_can_be_replaced(page, "--report")
    if any(path is not None and real(page) == real(path) for path in (setup, stated)):
        raise ArctrackError(f"{page}: is the setup's file; give --report another one")
    if recording is not None and recording.is_read_from(page):
        raise ArctrackError(f"{page}: is of the recording itself; give --report another file")
    read = {real(path) for path in images}
    for path, option in ((setup, "--out"), (page, "--report")):
        if path is not None and real(path) in read:
            raise ArctrackError(f"{path}: is one of the images; give {option} another file")


def calibrate_from_recording(
    make: Callable[[Recording, Steps], tuple[CalibrationStage[Any], list[BadFrame]]],
    recording: Path,
    out: Path | None,
    report: Path | None,
    page: str,
    of_the_others: str,
) -> None:
    """Calibrate with a recording, and write its page and the setup.

    `make` calibrates; its unreadable frames are named at the end, with what became of the others, such as
    "the delay is that of the others". `out` is by default the recording's setup, and `report` a file of the
    name `page` next to it. Raises ArctrackError where nothing can be written, where the calibration is
    refused, and at last for bad frames.
    """
    from arctrack.cli import console
    from arctrack.recording import read_recording

    read = read_recording(recording)
    console.warn(read.warnings)
    target = out or read.setup_path
    page_path = report or target.with_name(page)
    check_outputs(target, page_path, read.setup_path, read)
    with console.progress() as bar:
        stage, bad_frames = make(read, console.steps(bar))
    finish(stage.page, page_path)
    if stage.refusal is not None:
        raise ArctrackError(f"{read.path}: {stage.refusal}")
    write_calibrated(target, read.setup_path, *stage.records)
    refuse_bad_frames(read, bad_frames, of_the_others)


def refuse_bad_frames(read: Recording, bad_frames: Sequence[BadFrame], of_the_others: str) -> None:
    """Raise ArctrackError, when all is written, if there were frames that could not be read."""
    complaint = read.complaint(bad_frames, of_the_others)
    if complaint is not None:
        raise ArctrackError(complaint)


def finish(page: CalibrationPage, path: Path, stages: Sequence[CalibrationPage] = ()) -> None:
    """Print a page's headline, values and sentences; write it, with those of other calibrations below."""
    from rich.table import Table

    from arctrack.calibrate.page import render
    from arctrack.cli import console

    table = Table(box=None, pad_edge=False)
    table.add_column("")
    for head in page.heads:
        table.add_column(head, justify="right")
    table.add_column("")
    for row in page.rows:
        table.add_row(row.what, row.value, row.sigma, row.interval, row.unit)
    screen = console.tables()
    screen.print(f"{page.label}: {page.headline}", markup=False, soft_wrap=True)
    if page.rows:
        screen.print(table)
    for sentence in (*page.sentences, *page.notes):
        screen.print(sentence, markup=False, soft_wrap=True)
    write_whole(path, render(page, stages))
    console.say(f"report in {path}")
