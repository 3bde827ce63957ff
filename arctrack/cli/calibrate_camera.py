"""`arctrack calibrate camera`: intrinsics and distortion from images of a board."""

from pathlib import Path
from typing import Annotated

import typer

from arctrack.cli.calibration_output import Out, Pattern, Report, Sources, board_of, run_calibration
from arctrack.cli.inputs import look_at_images, look_at_setup, read_setup
from arctrack.errors import ArctrackError

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
        str, typer.Option(help="none, k1, 'k1 k2', 'k1 k2 p1 p2', 'k1 k2 p1 p2 k3', rational; auto chooses.")
    ] = AUTOMATIC,
    tilted: Annotated[
        bool, typer.Option("--tilted", help="The sensor is tilted to the lens, after Scheimpflug.")
    ] = False,
) -> None:
    """Find the camera's focal lengths, principal point and distortion from images of a board.

    Each value has its sigma, and so has the projection all over the image. Images that do not determine the
    lens are refused, with the image that is missing.
    """
    look_at_images(sources)
    if setup is not None:
        look_at_setup(setup)
    pattern = board_of(board)
    from arctrack.calibrate.camera.stage import camera_stage
    from arctrack.recording.importing.image_files import images_of

    if out is not None and setup is None:
        raise ArctrackError("--out: needs --setup, whose other values stay; `arctrack new` writes one")
    stated = None if setup is None else read_setup(setup)
    orders = _orders(distortion)
    run_calibration(
        "camera",
        sources[0],
        lambda steps, warn: camera_stage(sources, pattern, stated, steps, warn, orders, tilted),
        setup=None if stated is None else stated.path,
        out=out,
        report=report,
        images=images_of(sources),
    )


def _orders(distortion: str) -> tuple[str, ...]:
    """Return the distortions to choose from; ArctrackError for one that is none."""
    from calibration.camera.lens import ORDERS

    if distortion == AUTOMATIC:
        return tuple(ORDERS)
    if distortion not in ORDERS:
        raise ArctrackError(f"--distortion {distortion}: must be {AUTOMATIC}, {', '.join(ORDERS)}")
    return (distortion,)
