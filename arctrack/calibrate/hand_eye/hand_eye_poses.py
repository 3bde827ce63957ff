"""Images of a board, each with the robot's pose: which belong together, and other readings of the poses."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import permutations, product
from pathlib import Path

import numpy as np

from arctrack.calibrate.camera.board_images import BoardImages, read_boards
from arctrack.calibrate.robot_poses import PoseSource, read_robot_poses
from arctrack.calibrate.stated_camera import check_size, stated_lens
from arctrack.errors import ArctrackError, in_file
from arctrack.recording import SetupFile
from arctrack.recording.importing.image_files import distinct_names, find_images
from arctrack.recording.importing.pose_files import PoseFile
from arctrack.recording.importing.rotations import CONVENTIONS, NoRotationError, convention
from arctrack.recording.importing.units import ANGLE, LENGTH, UNITS, factor
from calibration.boards.board import Board
from calibration.camera.adjustment import BoardScene
from calibration.camera.enough import UndeterminedError
from calibration.camera.known_lens import board_poses
from calibration.camera.sightings import Sightings
from calibration.hand_eye_boards.calibrate import HandEyeCalibration, calibrate_hand_eye
from calibration.hand_eye_boards.chain import Chain
from calibration.hand_eye_boards.enough import turn_mismatch_deg
from noise_model.compiled.arrays import Float64, Int64

SEQUENCES = tuple("".join(axes) for letters in ("ZYX", "xyz") for axes in permutations(letters)) + tuple(
    f"{first}{second}{first}" for letters in ("ZYX", "xyz") for first, second in permutations(letters, 2)
)
"""All sequences of three axes, those that turn along first."""

LENGTHS_MM = {**UNITS[LENGTH], "inches, which arctrack does not read: convert them": 25.4}

MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
"""Makes left-handed axes right-handed; any other axis would do, for frames turned by half a turn."""

Reread = Callable[[PoseSource], Float64]
"""Returns T_base_tool (V, 4, 4) of the images from a source; ArctrackError where it cannot be read so."""


def assumption(result: HandEyeCalibration) -> str:
    """Return other meanings of the poses that explain the same images.

    With poses inverted, T_camera_board = X^-1 T_tool_base Y of a carried camera is the equation of one that
    stands still, X^-1 T_base_tool Y.
    """
    return (
        f"This holds if {_taken(result, is_eye_to_hand=result.is_eye_to_hand, is_inverted=False)}. The same "
        f"images fit if {_taken(result, is_eye_to_hand=not result.is_eye_to_hand, is_inverted=True)}: the "
        "images cannot tell the two apart."
    )


def other_meanings(
    posed: PosedBoards, source: PoseSource, reread: Reread, *, is_eye_to_hand: bool
) -> list[str]:
    """Return all other readings of the poses that fit the boards.

    Tried are controllers' conventions and sequences of axes, rotations transposed, left-handed axes, and
    positions in another unit; each with the camera carried, and with it standing still. `reread` parses the
    poses of `source` in another convention.
    """
    readings: list[str] = []
    known = [(False, posed.poses.T_base_tool[posed.rows])]
    stated = next(unit for unit in UNITS[LENGTH] if unit in posed.poses.units.split(", "))
    for words, turned in _written(posed, source, reread):
        for (change, T_base_tool), is_flipped in product(_changes(turned), (False, True)):
            held = is_eye_to_hand != is_flipped
            chain = Chain(T_base_tool @ posed.T_controllertool_tool, np.eye(4), np.eye(4), held)
            # Largest median difference of robot's and board's rotations between images that fit.
            if turn_mismatch_deg(chain.T_holder_mount, posed.scene.T_camera_board) > 1.5:
                continue
            for unit, mm in LENGTHS_MM.items():
                scaled = T_base_tool.copy()
                scaled[:, :3, 3] *= mm / UNITS[LENGTH][stated]
                if any(flip == is_flipped and np.allclose(scaled, other, atol=1e-6) for flip, other in known):
                    continue  # The same by another name.
                known.append((is_flipped, scaled))
                result = _calibrated(posed, scaled, is_eye_to_hand=held)
                if result is not None:
                    length = f"positions in {unit}" if unit != stated else ""
                    meaning = " and ".join(filter(None, (words(), change, length)))
                    readings.append(
                        " with ".join(filter(None, (meaning, _flipped(result) if is_flipped else "")))
                    )
    return readings


def _calibrated(
    posed: PosedBoards, T_base_tool: Float64, *, is_eye_to_hand: bool
) -> HandEyeCalibration | None:
    T_base_tool = T_base_tool @ posed.T_controllertool_tool
    try:
        return calibrate_hand_eye(posed.scene, posed.seen, T_base_tool, is_eye_to_hand=is_eye_to_hand)
    except UndeterminedError:
        return None


def _changes(T_base_tool: Float64) -> Iterator[tuple[str, Float64]]:
    """Yield the poses as they are, and with other meanings of their axes, in words."""
    yield "", T_base_tool
    transposed = T_base_tool.copy()
    transposed[:, :3, :3] = T_base_tool[:, :3, :3].swapaxes(1, 2)
    yield "each rotation of the file transposed", transposed
    mirrored = "one axis of base and tool mirrored (the file's are left-handed)"
    yield mirrored, MIRROR @ T_base_tool @ MIRROR


def _flipped(result: HandEyeCalibration) -> str:
    """Return both ways to read poses that fit with the camera held by the other of base and tool."""
    is_eye_to_hand = result.is_eye_to_hand
    switch = "--eye-to-hand" if is_eye_to_hand else "no --eye-to-hand"
    stated = _taken(result, is_eye_to_hand=is_eye_to_hand, is_inverted=False)
    inverted = _taken(result, is_eye_to_hand=not is_eye_to_hand, is_inverted=True)
    return (
        f"{switch}, if {stated}; or each pose of the file inverted, if {inverted}; the images cannot tell "
        "the two apart"
    )


def _taken(result: HandEyeCalibration, *, is_eye_to_hand: bool, is_inverted: bool) -> str:
    chain = result.refined.chain
    camera_mm, board_mm = (
        float(np.linalg.norm(T[:3, 3])) for T in (chain.T_holder_camera, chain.T_mount_board)
    )
    poses = "base in the tool (inverted)" if is_inverted else "the tool in base"
    if is_eye_to_hand:
        return (
            f"the file's poses are {poses}, the camera stands still, {camera_mm:.0f} mm from base's origin, "
            f"and the robot carries the board, {board_mm:.0f} mm from its tool"
        )
    return (
        f"the file's poses are {poses}, the robot carries the camera, {camera_mm:.0f} mm from its tool, and "
        f"the board stands still, {board_mm:.0f} mm from base's origin"
    )


def _written(
    posed: PosedBoards, source: PoseSource, reread: Reread
) -> Iterator[tuple[Callable[[], str], Float64]]:
    """Yield the poses (V, 4, 4) of each way to write rotations, after what says it; the stated first."""
    yield str, posed.poses.T_base_tool[posed.rows]
    if posed.poses.rotation is None:
        return
    numbers = posed.poses.rotation[posed.rows]
    # Of the names of one convention the stated one is said.
    for name in dict.fromkeys((*filter(None, (source.rotation,)), *CONVENTIONS, *SEQUENCES)):
        written = convention(name)
        if len(written.columns[0]) != numbers.shape[1]:
            continue
        for unit in UNITS[ANGLE] if written.are_angles else [""]:
            try:
                R = written.matrices(numbers * (factor(ANGLE, unit) if unit else 1.0))
            except NoRotationError:
                continue
            T_base_tool = posed.poses.T_base_tool[posed.rows]
            T_base_tool[:, :3, :3] = R
            yield partial(_option, name, unit, T_base_tool, posed, source, reread), T_base_tool


def _option(
    name: str, unit: str, T_base_tool: Float64, posed: PosedBoards, source: PoseSource, reread: Reread
) -> str:
    """Return the options by which the file is read so, tried on it; plain words where none does."""
    headers = posed.poses.rotation_columns
    other_columns = {key: header for key, header in source.columns.items() if header not in headers}
    # A controller's listing has no columns to name.
    named = dict(zip(convention(name).columns[0], headers, strict=bool(headers)))
    without = [f"without --column {key}" for key in source.columns if key not in other_columns]
    for columns, units in product(({}, named), (source.units, replace(source.units, angle=unit or None))):
        try:
            read = reread(replace(source, rotation=name, columns={**other_columns, **columns}, units=units))
        except ArctrackError:
            continue
        if np.allclose(read, T_base_tool @ posed.T_controllertool_tool, atol=1e-6):
            stated = ",".join(filter(None, (units.length, units.angle, units.time)))
            options = [f"--column {key}={header}" for key, header in columns.items()] or without
            options += [f"--units {stated}"] if units != source.units else []
            return " ".join([f"--rotation {name}", *options])
    as_written = "" if name == source.rotation else f" as --rotation {name} has them"
    return f"{', '.join(headers) or 'rotations'}{as_written}{f' in {unit}' if unit else ''}"


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
