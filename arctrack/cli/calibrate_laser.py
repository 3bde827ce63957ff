"""`arctrack calibrate laser`: the laser sheet's plane from board images without and with the stripe."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from arctrack.cli.calibration_output import check_outputs, finish
from arctrack.cli.interrupt import interruptible
from arctrack.cli.setups import read_setup, write_calibrated
from arctrack.errors import ArctrackError

REPORT = "calibrate_laser.html"

EXAMPLE = (
    "Example: arctrack calibrate laser /tmp/pairs --board chessboard:8x6:2.5mm --setup examples/v_groove "
    "--out /tmp/laser.toml"
)


def laser(
    sources: Annotated[
        list[Path],
        typer.Argument(metavar="SOURCE...", help="Folders of images, images, or patterns in quotes."),
    ],
    board: Annotated[
        str,
        typer.Option(help="As for calibrate camera: chessboard:9x6:5mm, or charuco:8x6:5mm:3.7mm:5X5_100."),
    ],
    setup: Annotated[
        Path, typer.Option(help="A recording.toml, or a recording, whose camera is calibrated already.")
    ],
    out: Annotated[
        Path | None, typer.Option(help="Where to write it; default: --setup, whose file before is kept.")
    ] = None,
    report: Annotated[
        Path | None, typer.Option(help=f"Where the page goes; default: {REPORT} beside the written file.")
    ] = None,
) -> None:
    """Find the laser sheet's plane from images of a board, each without and with the laser.

    Two images are a pair by the numbers in their names; the one with the laser has `laser` or `on` in its
    name: board_01.png and laser_01.png, or 7_off.png and 7_on.png. The board stands still meanwhile, and at
    another distance in each pair. Pairs that do not determine the plane are refused, and what is missing is
    named.
    """
    from arctrack.calibration_files.laser_pairs import lens_covariance, read_pairs
    from arctrack.calibration_files.laser_record import laser_record
    from arctrack.cli import console
    from arctrack.report.calibration.laser import laser_page
    from calibration.boards.board import Board
    from calibration.camera.enough import UndeterminedError
    from calibration.laser.calibrate import calibrate_laser

    try:
        pattern = Board.parse(board)
    except ValueError as error:
        raise ArctrackError(f"--board: {error}") from None
    stated = read_setup(setup)
    target = out or stated.path
    shown = report or target.with_name(REPORT)
    check_outputs(target, shown, stated.path)
    with interruptible("the calibration was", "nothing was written"), console.progress() as bar:
        looking = bar.add_task("looking for board and stripe", total=None, unit="images")
        pairs = read_pairs(
            sources, pattern, stated, lambda n, total: bar.update(looking, completed=n, total=total)
        )
        console.warn(f"{name}: left out: {reason}" for name, reason in pairs.left_out.items())
        known = lens_covariance(stated, pairs.scene.lens)
        try:
            result = calibrate_laser(pairs.scene, pairs.seen, pairs.stripes, known)
        except UndeterminedError as error:
            raise ArctrackError(f"{sources[0]}: {error}") from None
    console.warn(f"{name}: left out: {reason}" for name, reason in result.left_out.items())
    page = laser_page(result, pairs, stated.setup, is_lens_known=known is not None)
    finish(page, shown)
    write_calibrated(target, stated.path, laser_record(result, stated.setup))
