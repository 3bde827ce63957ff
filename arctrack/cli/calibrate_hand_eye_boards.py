"""`arctrack calibrate hand-eye` with a board: the camera's pose from images and the robot's poses."""

from __future__ import annotations

from pathlib import Path

from arctrack.cli.calibration_output import board_of, check_outputs, finish
from arctrack.cli.import_files import named_columns
from arctrack.cli.interrupt import interruptible
from arctrack.cli.setups import read_setup, write_calibrated
from arctrack.errors import ArctrackError

REPORT = "calibrate_hand_eye.html"


def from_boards(
    sources: list[Path],
    board: str,
    setup: Path,
    poses: tuple[Path, Path | None, str | None, str, list[str]],
    *,
    is_eye_to_hand: bool,
    out: Path | None,
    report: Path | None,
) -> None:
    """Calibrate, and write page and setup; `poses` are file, translations, rotation, units and columns."""
    from arctrack.calibration_files.hand_eye_meaning import other_meaning
    from arctrack.calibration_files.hand_eye_poses import PoseSource, read_posed_boards
    from arctrack.calibration_files.hand_eye_record import hand_eye_record
    from arctrack.cli import console
    from arctrack.importing.image_files import images_of
    from arctrack.importing.units import parse_units
    from arctrack.report.calibration.hand_eye import hand_eye_page
    from calibration.camera.enough import UndeterminedError
    from calibration.hand_eye_boards.calibrate import calibrate_hand_eye
    from calibration.hand_eye_boards.enough import InconsistentError

    pattern = board_of(board)
    path, translations, rotation, units, columns = poses
    source = PoseSource(path, translations, rotation, parse_units(units), named_columns(columns))
    stated = read_setup(setup)
    target = out or stated.path
    shown = report or target.with_name(REPORT)
    read = [*images_of(sources), *(file for file in (path, translations) if file is not None)]
    check_outputs(target, shown, stated.path, images=read)
    with interruptible("the calibration was", "nothing was written"), console.progress() as bar:
        looking = bar.add_task("looking for the board", total=None, unit="images")
        posed = read_posed_boards(
            sources, pattern, stated, source, lambda n, total: bar.update(looking, completed=n, total=total)
        )
        console.warn(posed.warnings)
        console.warn(f"{name}: left out: {reason}" for name, reason in posed.left_out.items())
        fitting = bar.add_task("fitting the camera's pose", total=None, unit="steps")
        try:
            result = calibrate_hand_eye(
                posed.scene,
                posed.seen,
                posed.T_base_tool,
                is_eye_to_hand=is_eye_to_hand,
                lens_covariance=posed.lens_covariance,
                progress=lambda n, total: bar.update(fitting, completed=n, total=total),
            )
        except InconsistentError as error:
            # Another reading that fits is named: numbers alone do not say which convention they follow.
            meaning = other_meaning(posed, rotation, is_eye_to_hand=is_eye_to_hand)
            cure = (
                "check how rotations are written (--rotation), units, which pose is of which image, and the "
                "board's squares"
                if meaning is None
                else f"the poses fit the boards if they are read otherwise: {meaning}"
            )
            raise ArctrackError(f"{path}: {error}: {cure}") from None
        except UndeterminedError as error:
            raise ArctrackError(f"{path}: {error}") from None
    console.warn(f"{name}: left out: {reason}" for name, reason in result.left_out.items())
    finish(hand_eye_page(result, posed, stated.setup), shown)
    write_calibrated(target, stated.path, hand_eye_record(result))
