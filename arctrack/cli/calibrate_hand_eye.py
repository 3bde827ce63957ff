"""`arctrack calibrate hand-eye`: the camera's pose in the tool, from a board or from the arc's own light."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from arctrack.cli.calibration_output import BOARD, Out, Report
from arctrack.cli.pose_options import NamedColumns, Poses, Rotation, Translations
from arctrack.errors import ArctrackError

EXAMPLE = (
    "Example: arctrack calibrate hand-eye /tmp/hand_eye --board chessboard:9x6:4mm "
    "--poses /tmp/hand_eye/poses.csv --rotation kuka --setup examples/v_groove --out /tmp/hand_eye.toml\n\n"
    "Example: arctrack calibrate hand-eye examples/v_groove --out /tmp/found.toml"
)


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
    own inaccuracy is estimated along. Poses that do not determine the camera are refused, and the motion that
    is missing is named.

    Without --board the arc's own light says where the camera stands, within its stated tolerance. Where the
    seam's expected error is not clearly smaller after, no file is written.
    """
    from arctrack.cli.calibrate_hand_eye_arc import from_arc
    from arctrack.cli.calibrate_hand_eye_boards import from_boards

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
        from_arc(sources[0], out)
        return
    if poses is None:
        raise ArctrackError("--poses: give the robot's pose of each image, as a CSV file or as matrices")
    if setup is None:
        raise ArctrackError("--setup: give the recording.toml whose camera took the images")
    from_boards(
        sources,
        board,
        setup,
        poses=poses,
        translations=translations,
        rotation=rotation,
        units=units,
        columns=column or [],
        is_eye_to_hand=eye_to_hand,
        out=out,
        report=report,
    )
