"""Images of a board, each with the robot's pose: which belong together."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from arctrack.calibrate.camera.board_images import BoardImages, read_boards
from arctrack.calibrate.robot_poses import PoseSource, read_robot_poses
from arctrack.calibrate.stated_camera import check_size, stated_lens
from arctrack.errors import in_file
from arctrack.recording import SetupFile
from arctrack.recording.importing.image_files import distinct_names, find_images
from arctrack.recording.importing.pose_files import PoseFile
from calibration.boards.board import Board
from calibration.camera.adjustment import BoardScene
from calibration.camera.known_lens import board_poses
from calibration.camera.sightings import Sightings
from noise_model.compiled.arrays import Float64, Int64


@dataclass
class PosedBoards:
    """Images of a board with the robot's poses.

    `scene` and `seen` are of the boards whose robot pose is known: `T_base_tool` (V, 4, 4), mm, of which
    `rows` (V,) are the numbers in `poses`. `lens_covariance` (n, n) is None where the setup keeps none.
    `T_controllertool_tool` (4, 4) is mm. `joint_rad` (V, joints) is None where the file has no joint angles.
    `left_out` maps unused images to the reason.
    """

    boards: BoardImages
    scene: BoardScene
    seen: Sightings
    T_base_tool: Float64
    lens_covariance: Float64 | None
    poses: PoseFile
    rows: Int64
    T_controllertool_tool: Float64
    joint_rad: Float64 | None
    left_out: dict[str, str] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


def read_posed_boards(
    sources: Sequence[Path],
    board: Board,
    stated: SetupFile,
    source: PoseSource,
    progress: Callable[[int, int], None] | None = None,
) -> PosedBoards:
    """Find a board in images, and the robot's pose of each.

    ArctrackError where images or poses cannot be read, do not belong together, or are of another size than
    the camera.
    """
    series = find_images(sources)
    poses = read_robot_poses(source, series, stated)
    names = distinct_names(series.paths)
    image_of = {names[path]: n for n, path in enumerate(series.paths)}
    boards = read_boards(sources, board, progress)
    check_size(boards.size, stated)
    left_out = dict(boards.left_out)
    views = []
    for view in boards.views:
        if poses.has(image_of[view.name]):
            views.append(view)
        else:
            left_out[view.name] = f"has no pose in {source.path.name}"
    if not views:
        raise in_file(source.path, "has a pose of no image that shows the board")
    lens, covariance = stated_lens(stated)
    rows = poses.rows[[image_of[view.name] for view in views]]
    scene, seen = board_poses(board, views, lens)
    return PosedBoards(
        boards=boards,
        scene=scene,
        seen=seen,
        T_base_tool=poses.at(rows),
        lens_covariance=covariance,
        poses=poses.file,
        rows=rows,
        T_controllertool_tool=poses.T_controllertool_tool,
        joint_rad=None if poses.file.joint_rad is None else poses.file.joint_rad[rows],
        left_out=left_out,
        warnings=[*boards.warnings, *poses.file.warnings, *poses.file.notes],
    )
