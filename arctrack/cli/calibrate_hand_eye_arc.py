"""`arctrack calibrate hand-eye` without a board: the camera's pose in the tool from the arc's own light."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from arctrack.cli.calibration_output import refuse_bad_frames
from arctrack.cli.inputs import check_can_be_written, check_replaces_nothing, look_at_recording
from arctrack.errors import ArctrackError
from arctrack.output import write_whole

if TYPE_CHECKING:
    from calibration.hand_eye_arc import HandEye
    from noise_model.compiled.arrays import Float64


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
