"""`arctrack calibrate camera`, `laser` and `hand-eye`: by images of a board, or by the arc's own light."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from arctrack.cli.calibration_output import (
    BOARD,
    Out,
    Pattern,
    Report,
    Sources,
    board_of,
    refuse_bad_frames,
    run_calibration,
)
from arctrack.cli.inputs import (
    check_can_be_written,
    check_replaces_nothing,
    look_at_file,
    look_at_images,
    look_at_recording,
    look_at_setup,
    read_setup,
)
from arctrack.cli.options import NamedColumns, Poses, Rotation, Translations, named_columns
from arctrack.errors import ArctrackError
from arctrack.output import write_whole

if TYPE_CHECKING:
    from calibration.hand_eye_arc import HandEye
    from noise_model.compiled.arrays import Float64

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


def from_arc(recording: Path, out: Path) -> None:
    """Find the camera's pose in the tool from the arc's own light, within its stated tolerance.

    The arc burns below the torch; how its reflected light falls off over the image says where the camera
    stands beside it. The seam's expected error is printed, before and after; where it is not clearly smaller
    after, no file is written. Use the file with `replay --setup`.
    """
    look_at_recording(recording)
    from arctrack.cli import console
    from arctrack.recording import read_recording, with_camera_pose
    from calibration.hand_eye_arc import estimate_hand_eye

    read = read_recording(recording)
    console.warn(read.warnings)
    check_can_be_written(out, read.setup_path)
    check_replaces_nothing(out, read)
    readable, bad_frames = read.readable_frames()
    frames = read.posed(readable)
    if len(frames) < len(readable):
        count = f"{len(readable) - len(frames)} of {len(readable)}"
        console.warn([f"{read.path}: {count} frames have no pose and are left out"])
    with console.progress() as bar:
        task = bar.add_task("rounds", total=None, unit="rounds")
        try:
            result = estimate_hand_eye(
                read.setup, frames, lambda done, total: bar.update(task, completed=done, total=total)
            )
        except ValueError as error:
            raise ArctrackError(f"{read.path}: {error}") from None
    screen = console.tables()
    for line in _lines(result):
        screen.print(line, markup=False, soft_wrap=True)
    if not result.is_gain:
        raise ArctrackError(
            f"{read.path}: the seam's expected error would be "
            f"{_total_mm(result.seam_sigma_after_mm):.2f} mm, "
            f"{_total_mm(result.seam_sigma_before_mm):.2f} mm before: no clear gain, and no file is written; "
            "record more frames with the arc on, at several heights, tilts and sideways"
        )
    write_whole(out, with_camera_pose(read.setup_path, result.T_tool_camera))
    console.say(f"{out}: the setup with the pose found")
    refuse_bad_frames(read, bad_frames, "the pose is that of the others")


def _lines(result: HandEye) -> list[str]:
    """Return the result in words: the seam's expected error, the camera's change, what was hardly learned."""
    before, after = result.seam_sigma_before_mm, result.seam_sigma_after_mm
    camera = list(zip(result.fit.parameters, result.fit.values, result.fit.sigmas, strict=True))[:6]
    names = {parameter.name for parameter, _, _ in camera}
    few = [name for name in result.fit.not_learned if name in names]
    return [
        "expected error of the seam, 1 σ:",
        f"  lateral  {before[0]:.3f} mm before, {after[0]:.3f} mm after",
        f"  vertical {before[1]:.3f} mm before, {after[1]:.3f} mm after",
        "change of the camera's pose, in its own frame:",
        *(
            f"  {parameter.name:6} {value:+.4f} ± {sigma:.4f} {parameter.unit}"
            for parameter, value, sigma in camera
        ),
        *([f"learned little about: {', '.join(few)}"] if few else []),
    ]


def _total_mm(sigma_mm: Float64) -> float:
    return math.hypot(*sigma_mm.tolist())
