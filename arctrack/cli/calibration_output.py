"""Common part of the calibrations that write a setup and a page: options, files, table."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from arctrack.cli.inputs import check_can_be_replaced, write_calibrated
from arctrack.cli.interrupt import interruptible
from arctrack.errors import ArctrackError
from arctrack.output import real, write_whole

if TYPE_CHECKING:
    from arctrack.calibrate.page import CalibrationPage
    from arctrack.calibrate.stage import CalibrationStage, Steps, Warn
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
    poses: Iterable[Path] = (),
) -> None:
    """Raise ArctrackError if setup or page could not be written, or would replace what is read.

    `setup` is the file to write, `stated` the one that is read: it may be the same, the earlier one is kept.
    `images` and the files of the robot's `poses` are read as well.
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
    held = {real(path): "is one of the images" for path in images}
    held |= {real(path): "holds the robot's poses" for path in poses}
    for path, option in ((setup, "--out"), (page, "--report")):
        if path is not None and real(path) in held:
            raise ArctrackError(f"{path}: {held[real(path)]}; give {option} another file")


def run_calibration(
    name: str,
    source: Path,
    make: Callable[[Steps, Warn], CalibrationStage[Any]],
    *,
    setup: Path | None,
    out: Path | None,
    report: Path | None,
    recording: Recording | None = None,
    images: Iterable[Path] = (),
    poses: Iterable[Path] = (),
) -> None:
    """Make a calibration; print it, write its page, and its values into a setup.

    `source` is blamed for a refusal; `recording`, or `images` and `poses`, are what it reads. `out` is by
    default the setup, and `report` a file beside it. Without a setup there is a page alone. Raises
    ArctrackError where nothing can be written, where the calibration is refused, and at last for frames that
    could not be read.
    """
    from arctrack.cli import console
    from arctrack.recording import require_images

    if recording is not None and name != "delay":
        instead = "state the profile's place in [camera.pose_in_tool]"
        require_images(recording.setup, recording.setup_path, instead)
    target = out or setup
    page = report or (Path() if target is None else target.parent) / f"calibrate_{name}.html"
    check_outputs(target, page, setup, recording, images, poses)
    with interruptible("the calibration was", "nothing was written"), console.progress() as bar:
        stage = make(console.steps(bar), console.warn)
    finish(stage.page, page)
    if stage.refusal is not None:
        raise ArctrackError(f"{source}: {stage.refusal}. No setup is written; see {page}")
    if target is not None and setup is not None:
        write_calibrated(target, setup, *stage.records)
    if recording is not None:
        refuse_bad_frames(recording, stage.bad_frames, "the values are those of the others")


def calibrate_from_recording(
    name: str,
    make: Callable[[Recording, Steps], CalibrationStage[Any]],
    recording: Path,
    out: Path | None,
    report: Path | None,
) -> None:
    """Make a calibration of a recording, and write its values into the recording's setup."""
    from arctrack.cli import console
    from arctrack.recording import read_recording

    read = read_recording(recording)
    console.warn(read.warnings)
    run_calibration(
        name,
        read.path,
        lambda steps, _: make(read, steps),
        setup=read.setup_path,
        out=out,
        report=report,
        recording=read,
    )


def refuse_bad_frames(read: Recording, bad_frames: Sequence[BadFrame], of_the_others: str) -> None:
    """Raise ArctrackError, when all is written, if there were frames that could not be read."""
    complaint = read.complaint(bad_frames, of_the_others)
    if complaint is not None:
        raise ArctrackError(complaint)


def finish(page: CalibrationPage, path: Path, stages: Sequence[CalibrationPage] = ()) -> None:
    """Print a page's headline, values and sentences; write it, with those of other calibrations below."""
    from rich.table import Column, Table

    from arctrack.calibrate.page import render
    from arctrack.cli import console

    numbers = (Column(head, justify="right") for head in page.heads)
    table = Table("", *numbers, "", box=None, pad_edge=False)
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
