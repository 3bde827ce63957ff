"""`arctrack calibrate hand-eye` with a board: the camera's pose from images and the robot's poses."""

from __future__ import annotations

from pathlib import Path

from arctrack.cli.calibration_output import board_of, check_outputs, finish
from arctrack.cli.inputs import look_at_file, look_at_images, look_at_setup
from arctrack.cli.interrupt import interruptible
from arctrack.cli.pose_options import named_columns
from arctrack.cli.setups import read_setup, write_calibrated
from arctrack.errors import ArctrackError
from arctrack.output import real

REPORT = "calibrate_hand_eye.html"


def from_boards(
    sources: list[Path],
    board: str,
    setup: Path,
    *,
    poses: Path,
    translations: Path | None,
    rotation: str | None,
    units: str,
    columns: list[str],
    is_eye_to_hand: bool,
    out: Path | None,
    report: Path | None,
) -> None:
    """Calibrate, and write page and setup."""
    look_at_images(sources)
    look_at_setup(setup)
    look_at_file(poses)
    pattern = board_of(board)
    from arctrack.calibrate.hand_eye.stage import hand_eye_stage
    from arctrack.calibrate.robot_poses import PoseSource
    from arctrack.cli import console
    from arctrack.recording.importing.image_files import images_of
    from arctrack.recording.importing.units import parse_units

    source = PoseSource(poses, translations, rotation, parse_units(units), named_columns(columns))
    stated = read_setup(setup)
    target = out or stated.path
    page_path = report or target.with_name(REPORT)
    check_outputs(target, page_path, stated.path, images=images_of(sources))
    held = {real(file) for file in (poses, translations) if file is not None}
    for file, option in ((target, "--out"), (page_path, "--report")):
        if real(file) in held:
            raise ArctrackError(f"{file}: holds the robot's poses; give {option} another file")
    with interruptible("the calibration was", "nothing was written"), console.progress() as bar:
        stage = hand_eye_stage(
            sources, pattern, stated, source, console.steps(bar), console.warn, is_eye_to_hand
        )
    finish(stage.page, page_path)
    write_calibrated(target, stated.path, *stage.records)
