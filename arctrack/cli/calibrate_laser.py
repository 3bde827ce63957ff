"""`arctrack calibrate laser`: the laser sheet's plane from board images without and with the stripe."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from arctrack.cli.calibration_output import Out, Pattern, Report, Sources, board_of, check_outputs, finish
from arctrack.cli.interrupt import interruptible
from arctrack.cli.setups import read_setup, write_calibrated
from arctrack.errors import ArctrackError

REPORT = "calibrate_laser.html"

EXAMPLE = (
    "Example: arctrack calibrate laser /tmp/pairs --board chessboard:8x6:2.5mm --setup examples/v_groove "
    "--out /tmp/laser.toml"
)


def laser(
    sources: Sources,
    board: Pattern,
    setup: Annotated[
        Path, typer.Option(help="A recording.toml, or a recording, whose camera is calibrated already.")
    ],
    out: Out = None,
    report: Report = None,
) -> None:
    """Find the laser sheet's plane from images of a board, each without and with the laser.

    Two images are a pair by the numbers in their names; the one with the laser has `laser` or `on` in its
    name: board_01.png and laser_01.png, or 7_off.png and 7_on.png. The board stands still meanwhile, and at
    another distance in each pair. Pairs that do not determine the plane are refused, and what is missing is
    named.
    """
    from arctrack.calibration_files.laser_pairs import read_pairs
    from arctrack.calibration_files.laser_record import laser_record
    from arctrack.cli import console
    from arctrack.importing.image_files import images_of
    from arctrack.report.calibration.laser import laser_page
    from calibration.camera.enough import UndeterminedError
    from calibration.laser.calibrate import calibrate_laser

    pattern = board_of(board)
    stated = read_setup(setup)
    target = out or stated.path
    shown = report or target.with_name(REPORT)
    check_outputs(target, shown, stated.path, images=images_of(sources))
    with interruptible("the calibration was", "nothing was written"), console.progress() as bar:
        looking = bar.add_task("looking for board and stripe", total=None, unit="images")
        pairs = read_pairs(
            sources, pattern, stated, lambda n, total: bar.update(looking, completed=n, total=total)
        )
        console.warn(f"{name}: left out: {reason}" for name, reason in pairs.left_out.items())
        try:
            result = calibrate_laser(pairs.scene, pairs.seen, pairs.stripes, pairs.lens_covariance)
        except UndeterminedError as error:
            raise ArctrackError(f"{sources[0]}: {error}") from None
    console.warn(f"{name}: left out: {reason}" for name, reason in result.left_out.items())
    finish(laser_page(result, pairs, stated.setup), shown)
    write_calibrated(target, stated.path, laser_record(result, stated.setup))
