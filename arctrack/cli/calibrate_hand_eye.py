"""`arctrack calibrate hand-eye`: the camera's pose in the tool, from a board or from the arc's own light."""

from pathlib import Path
from typing import Annotated

import typer

from arctrack.cli.calibration_output import BOARD, Out, Report, board_of, run_calibration
from arctrack.cli.inputs import look_at_file, look_at_images, look_at_setup, read_setup
from arctrack.cli.options import NamedColumns, Poses, Rotation, Translations, named_columns
from arctrack.errors import ArctrackError


def hand_eye(
    sources: Annotated[
        list[Path],
        typer.Argument(
            metavar="SOURCE...",
            help="With --board: folders of images, images, or patterns in quotes. Else a recording with the "
            "arc on.",
        ),
    ],
    board: Annotated[str | None, BOARD] = None,
    poses: Poses = None,
    setup: Annotated[
        Path | None,
        typer.Option(help="A recording.toml, or a recording, whose camera is calibrated already."),
    ] = None,
    out: Out = None,
    report: Report = None,
    rotation: Rotation = None,
    units: Annotated[
        str, typer.Option(help="Units that no name states, such as 'm, rad'; names such as x_mm do.")
    ] = "",
    translations: Translations = None,
    column: NamedColumns = None,
    eye_to_hand: Annotated[
        bool, typer.Option("--eye-to-hand", help="The camera stands still, and the robot carries the board.")
    ] = False,
) -> None:
    """Find the camera's pose in the tool: from images of a board and the robot's poses, or from the arc.

    With --board the board stands still, and the robot shows it to the camera from several sides. The robot's
    own inaccuracy is estimated as well. Poses that do not determine the camera are refused, with the motion
    that is missing.

    Without --board the arc's own light locates the camera, within its stated tolerance. No file is written
    where the seam's expected error would not be clearly smaller.
    """
    if board is None:
        for_boards = {
            "--poses": poses is not None,
            "--setup": setup is not None,
            "--report": report is not None,
            "--rotation": rotation is not None,
            "--units": bool(units),
            "--translations": translations is not None,
            "--column": bool(column),
            "--eye-to-hand": eye_to_hand,
        }
        useless = next((option for option, is_given in for_boards.items() if is_given), None)
        if useless is not None:
            raise ArctrackError(f"{useless}: has no effect without --board; state the board, or leave it")
        if len(sources) > 1:
            raise ArctrackError(f"{sources[1]}: without --board one recording is read; give one")
        if out is None:
            raise ArctrackError("--out: give the file to write the setup with the pose found to")
        from arctrack.cli.calibrate_hand_eye_arc import from_arc

        from_arc(sources[0], out)
        return
    if poses is None:
        raise ArctrackError("--poses: give the robot's pose of each image, as a CSV file or as matrices")
    if setup is None:
        raise ArctrackError("--setup: give the recording.toml whose camera took the images")
    look_at_images(sources)
    look_at_setup(setup)
    look_at_file(poses)
    pattern = board_of(board)
    from arctrack.calibrate.hand_eye.stage import hand_eye_stage
    from arctrack.calibrate.robot_poses import PoseSource
    from arctrack.recording.importing.image_files import images_of
    from arctrack.recording.importing.units import parse_units

    source = PoseSource(poses, translations, rotation, parse_units(units), named_columns(column or []))
    stated = read_setup(setup)
    run_calibration(
        "hand_eye",
        sources[0],
        lambda steps, warn: hand_eye_stage(sources, pattern, stated, source, steps, warn, eye_to_hand),
        setup=stated.path,
        out=out,
        report=report,
        images=images_of(sources),
        poses=[file for file in (poses, translations) if file is not None],
    )
