"""`arctrack calibrate camera`: intrinsics and distortion from images of a board."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from arctrack.cli.calibration_output import Out, Pattern, Report, Sources, board_of, check_outputs
from arctrack.cli.interrupt import interruptible
from arctrack.cli.setups import read_setup, write_calibrated
from arctrack.errors import ArctrackError

REPORT = "calibrate_camera.html"
AUTOMATIC = "auto"


def camera(
    sources: Sources,
    board: Pattern,
    setup: Annotated[
        Path | None, typer.Option(help="A recording.toml, or a recording, to write the values into.")
    ] = None,
    out: Out = None,
    report: Report = None,
    distortion: Annotated[
        str,
        typer.Option(help="none, k1, 'k1 k2', 'k1 k2 p1 p2', 'k1 k2 p1 p2 k3', rational; auto chooses."),
    ] = AUTOMATIC,
    tilted: Annotated[
        bool, typer.Option("--tilted", help="The sensor is tilted to the lens, after Scheimpflug.")
    ] = False,
) -> None:
    """Find the camera's focal lengths, principal point and distortion from images of a board.

    Each value has its sigma, and so has the projection all over the image. Images that do not determine the
    lens are refused, and what is missing is named.
    """
    from numpy.linalg import LinAlgError

    from arctrack.calibration_files.board_images import read_boards
    from arctrack.calibration_files.camera import calibrated_camera
    from arctrack.cli import console
    from arctrack.cli.camera_text import DIM, lines, warnings
    from arctrack.importing.image_files import images_of
    from arctrack.report.camera.page import write_page
    from calibration.camera.calibrate import calibrate_camera
    from calibration.camera.enough import UndeterminedError
    from calibration.camera.lens import ORDERS

    pattern = board_of(board)
    if out is not None and setup is None:
        raise ArctrackError("--out: needs --setup, whose other values stay; `arctrack new` writes one")
    stated = None if setup is None else read_setup(setup)
    target = None if stated is None else out or stated.path
    shown = report or (Path(REPORT) if target is None else target.with_name(REPORT))
    check_outputs(target, shown, None if stated is None else stated.path, images=images_of(sources))
    orders = _orders(distortion)
    with interruptible("the calibration was", "nothing was written"), console.progress() as bar:
        looking = bar.add_task("looking for the board", total=None, unit="images")
        images = read_boards(sources, pattern, lambda n, total: bar.update(looking, completed=n, total=total))
        console.warn(f"{name}: left out: {reason}" for name, reason in images.left_out.items())
        console.warn([DIM] if images.is_dim else [])
        fitting = bar.add_task("fitting the lens", total=None, unit="steps")
        try:
            result = calibrate_camera(
                pattern,
                images.views,
                images.size,
                tilted=tilted,
                orders=orders,
                progress=lambda n, total: bar.update(fitting, completed=n, total=total),
            )
        except UndeterminedError as error:
            raise ArctrackError(f"{sources[0]}: {error}") from None
        except LinAlgError:
            missing = (
                "the images leave a value of the lens open: add images of the board tilted, beside the middle"
            )
            raise ArctrackError(f"{sources[0]}: {missing}") from None
    console.warn(warnings(result, stated))
    console.say(*lines(result, images))
    write_page(shown, result, images)
    console.say(f"{shown}: the pictures")
    if result.model_error is not None:
        is_lean = distortion not in (AUTOMATIC, [*ORDERS][-1]) and math.isfinite(result.ratio_of_halves)
        richer = "; leave --distortion, which may be too lean" if is_lean else ""
        raise ArctrackError(f"{sources[0]}: {result.model_error}{richer}. No setup is written; see {shown}")
    if stated is not None and target is not None:
        write_calibrated(target, stated.path, calibrated_camera(result))


def _orders(distortion: str) -> tuple[str, ...]:
    """Return the distortions to choose from; ArctrackError for one that is none."""
    from calibration.camera.lens import ORDERS

    if distortion == AUTOMATIC:
        return tuple(ORDERS)
    if distortion not in ORDERS:
        raise ArctrackError(f"--distortion {distortion}: must be {AUTOMATIC}, {', '.join(ORDERS)}")
    return (distortion,)
