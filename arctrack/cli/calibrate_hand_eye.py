"""`arctrack calibrate hand-eye`: the camera's pose in the tool from the arc's own light."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from arctrack.cli.setups import check_can_be_written, check_replaces_nothing
from arctrack.errors import ArctrackError
from arctrack.output import write_whole


def hand_eye(
    recording: Annotated[Path, typer.Argument(help="A recording with the arc on; best of a straight seam.")],
    out: Annotated[Path, typer.Option(help="Where to write recording.toml with the pose that was found.")],
) -> None:
    """Find the camera's pose in the tool from the arc's own light, within its stated tolerance.

    The arc burns below the torch; how its reflected light falls off over the image says where the camera
    stands beside it. Use the file with `replay --setup`. An arc or material other than stated, or a seam that
    bends within the image, is refused where it would move the camera too far.
    """
    from arctrack.cli import console
    from arctrack.recording import read_recording, with_camera_pose
    from calibration.hand_eye import estimate_hand_eye

    read = read_recording(recording)
    console.warn(read.warnings)
    check_can_be_written(out, read.setup_path)
    check_replaces_nothing(out, read)
    buffer = read.pose_buffer()
    readable, bad_frames = read.readable_frames()
    frames = [
        (frame, pose) for frame in readable if (pose := read.pose_at(buffer, frame.timestamp_s)) is not None
    ]
    if len(frames) < len(readable):
        count = f"{len(readable) - len(frames)} of {len(readable)}"
        console.warn([f"{read.path}: {count} frames have no pose and are left out"])
    with console.progress() as bar:
        task = bar.add_task("rounds", total=None)
        try:
            found = estimate_hand_eye(
                read.setup, frames, lambda done, total: bar.update(task, completed=done, total=total)
            )
        except ValueError as error:
            raise ArctrackError(f"{read.path}: {error}") from None
    screen = console.tables()
    for parameter, value, sigma in zip(found.fit.parameters, found.fit.values, found.fit.sigmas, strict=True):
        screen.print(f"{parameter.name:13} {value:9.4f} ± {sigma:.4f} {parameter.unit}", markup=False)
    if found.fit.not_learned:
        screen.print(f"learned little about: {', '.join(found.fit.not_learned)}", markup=False)
    write_whole(out, with_camera_pose(read.setup_path, found.T_tool_camera))
    console.say(f"{out}: the setup with the pose found")
    complaint = read.complaint(bad_frames, "the pose is that of the others")
    if complaint is not None:
        raise ArctrackError(complaint)
