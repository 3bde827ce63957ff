"""Images of a board, each with the robot's pose: which belong together."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from arctrack.calibration_files.board_images import BoardImages, read_boards
from arctrack.calibration_files.laser_pairs import lens_covariance
from arctrack.errors import ArctrackError, in_file
from arctrack.importing.columns import UNKNOWN_IMAGE, check_all_named
from arctrack.importing.image_files import distinct_names, find_images
from arctrack.importing.pose_files import PoseFile, known_names, read_poses
from arctrack.importing.units import Units
from arctrack.recording import SetupFile
from calibration.boards.board import Board
from calibration.camera.adjustment import Scene
from calibration.camera.known_lens import board_poses, lens_of
from calibration.camera.sightings import Sightings
from noise_model.arrays import Float64, Int64
from noise_model.transforms import invert


@dataclass
class PosedBoards:
    """Images of a board with the robot's poses.

    Parameters
    ----------
    boards : BoardImages
        All boards that are seen.
    scene : Scene
        The poses of those whose robot's pose is known.
    seen : Sightings
        Their corners.
    T_base_tool : array (V, 4, 4)
        The robot's poses, mm.
    lens_covariance : array (n, n) or None
        That of the lens' parameters, as the setup keeps it; None where it keeps none.
    poses : PoseFile
        The poses as they were read.
    rows : array (V,)
        Which of them each image has.
    T_controllertool_tool : array (4, 4)
        The tool in the controller's tool, mm.
    left_out : dict
        Images that are not used, and why.
    warnings : list of str
        What looks wrong.
    """

    boards: BoardImages
    scene: Scene
    seen: Sightings
    T_base_tool: Float64
    lens_covariance: Float64 | None
    poses: PoseFile
    rows: Int64
    T_controllertool_tool: Float64
    left_out: dict[str, str] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class PoseSource:
    """Where the robot's poses are and how they are written, as a user states it; see `read_poses`."""

    path: Path
    translations: Path | None = None
    rotation: str | None = None
    units: Units = field(default_factory=Units)
    columns: Mapping[str, str] = field(default_factory=dict)


def read_posed_boards(
    sources: Sequence[Path],
    board: Board,
    stated: SetupFile,
    source: PoseSource,
    progress: Callable[[int, int], None] | None = None,
) -> PosedBoards:
    """Find a board in images, and the robot's pose of each.

    Parameters
    ----------
    sources : sequence of Path
        Folders of images, images, and patterns.
    board : Board
        The board.
    stated : SetupFile
        The setup, whose camera is calibrated.
    source : PoseSource
        The robot's poses.
    progress : callable, optional
        Told how many images are done, and of how many.

    Returns
    -------
    PosedBoards
        Boards and poses.

    Raises
    ------
    ArctrackError
        Where images or poses cannot be read, do not belong together, or are of another size than the camera.
    """
    series = find_images(sources)
    poses, files = read_poses(
        source.path,
        source.translations,
        source.rotation,
        source.units,
        source.columns,
        series,
        False,
        may_lack=True,
    )
    if files:
        check_all_named(source.columns, (*known_names(source.rotation), "time", "frame", "file"), files)
    if poses.rows is None and len(poses.T_base_tool) != len(series):
        counts = f"{len(poses.T_base_tool)} poses for {len(series)} images"
        raise in_file(source.path, f"has {counts}: add a column file or frame that says which is whose")
    rows = np.arange(len(series)) if poses.rows is None else poses.rows
    names = distinct_names(series.paths)
    row_of = {names[path]: int(row) for path, row in zip(series.paths, rows, strict=True)}
    boards = read_boards(sources, board, progress)
    camera = stated.setup.camera
    if boards.size != (camera.width, camera.height):
        raise ArctrackError(
            f"{stated.path}: [camera] width, height: {camera.width} x {camera.height}, but the images are "
            f"{boards.size[0]} x {boards.size[1]} px: `arctrack calibrate camera` comes first"
        )
    left_out = dict(boards.left_out)
    views = []
    for view in boards.views:
        if row_of[view.name] == UNKNOWN_IMAGE:
            left_out[view.name] = f"has no pose in {source.path.name}"
        else:
            views.append(view)
    if not views:
        raise in_file(source.path, "has a pose of no image that shows the board")
    record = stated.calibrations.get("camera")
    lens = lens_of(camera, [] if record is None else record.parameters)
    chosen = np.array([row_of[view.name] for view in views])
    to_tool = np.eye(4) if stated.T_tool_controllertool is None else invert(stated.T_tool_controllertool)
    return PosedBoards(
        boards,
        *board_poses(board, views, lens),
        poses.T_base_tool[chosen] @ to_tool,
        None if record is None else lens_covariance(record, lens, stated.path),
        poses,
        chosen,
        to_tool,
        left_out,
        [*poses.warnings, *poses.notes],
    )
