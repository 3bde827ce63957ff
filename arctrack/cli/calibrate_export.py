"""`arctrack calibrate export`: a setup's lens for another program."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from arctrack.cli.inputs import check_can_be_written, look_at_setup, read_setup

LensFormat = StrEnum("LensFormat", ["mrcal", "kalibr", "ros"])
"""A program that reads the file."""


def export_lens(
    setup: Annotated[Path, typer.Argument(metavar="SETUP", help="A recording.toml, or a recording.")],
    program: Annotated[
        LensFormat,
        typer.Option("--format", help="mrcal's .cameramodel, Kalibr's camchain, or ROS' camera_info."),
    ],
    out: Annotated[Path, typer.Option(help="The file to write; one that is there already is kept.")],
) -> None:
    """Write focal lengths, principal point and distortion of a setup for another program.

    All digits are kept. A distortion that the program has no model for is refused. Kalibr's rostopic is
    /camera/image_raw, mrcal's extrinsics are none.
    """
    look_at_setup(setup)
    from arctrack.calibrate.exchange.write_lens import WRITERS
    from arctrack.cli import console
    from arctrack.errors import in_file
    from arctrack.output import write_keeping

    stated = read_setup(setup)
    check_can_be_written(out, stated.path)
    try:
        text = WRITERS[program.value](stated.setup.camera)
    except ValueError as error:
        raise in_file(stated.path, str(error)) from None
    former = write_keeping(out, text)
    console.say(
        f"{out}: the lens for {program.value}{'' if former is None else f'; the one before is {former.name}'}"
    )
