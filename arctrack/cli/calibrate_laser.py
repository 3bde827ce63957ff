"""`arctrack calibrate laser`: the laser sheet from board images without and with the stripe."""

from pathlib import Path
from typing import Annotated

import typer

from arctrack.cli.calibration_output import Out, Pattern, Report, Sources, board_of, run_calibration
from arctrack.cli.inputs import look_at_images, look_at_setup, read_setup


def laser(
    sources: Sources,
    board: Pattern,
    setup: Annotated[
        Path, typer.Option(help="A recording.toml, or a recording, whose camera is calibrated already.")
    ],
    out: Out = None,
    report: Report = None,
) -> None:
    """Find the laser sheet from images of a board, each without and with the laser, or with both at once.

    Two images are a pair by the numbers in their names; the one with the laser has `laser` or `on` in its
    name: board_01.png and laser_01.png, or 7_off.png and 7_on.png. The board stands still meanwhile, and at
    another distance in each pair. An image with the laser alone in its number may show the lit board as well.
    Pairs that do not determine the plane are refused, with the pairs that are missing. Where the stripe ends
    on the board in several pairs, the fan's origin and angle follow; its width gives the sheet's thickness.
    """
    look_at_images(sources)
    look_at_setup(setup)
    pattern = board_of(board)
    from arctrack.calibrate.laser.stage import laser_stage
    from arctrack.recording.importing.image_files import images_of

    stated = read_setup(setup)
    run_calibration(
        "laser",
        sources[0],
        lambda steps, warn: laser_stage(sources, pattern, stated, steps, warn),
        setup=stated.path,
        out=out,
        report=report,
        images=images_of(sources),
    )
