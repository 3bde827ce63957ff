"""Pairs of board images without and with the laser: which belong together, and the stripes that they show."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from arctrack.calibration_files.board_images import BoardImages, read_boards, reason_of
from arctrack.errors import ArctrackError, in_file
from arctrack.importing.grey import channel_of_laser, grey
from arctrack.importing.image_decoder import EncodedImage
from arctrack.importing.image_files import distinct_names, images_of
from arctrack.recording import SetupFile
from arctrack.recording.setup_model import CalibrationTable
from calibration.boards.board import Board
from calibration.camera.adjustment import Scene
from calibration.camera.lens import PINHOLE, Lens
from calibration.camera.sightings import Sightings
from calibration.laser.calibrate import board_poses, lens_of
from calibration.laser.stripe import Stripe, board_area, find_stripe, laser_light
from noise_model.arrays import Float64, Integers

WITH, WITHOUT = ("laser", "on"), "off"
"""Words in a file's name: an image with the laser has one of the first, and not the second."""

NAMING = (
    "pairs share their numbers, and `laser` or `on` is in the name of that with the laser: board_01, laser_01"
)


@dataclass
class LaserPairs:
    """What pairs of images show.

    Parameters
    ----------
    boards : BoardImages
        The boards, in the images without the laser.
    scene : Scene
        The boards' poses.
    seen : Sightings
        Their corners.
    lens_covariance : array (n, n) or None
        That of the lens' parameters, as the setup keeps it; None where it keeps none.
    stripes : dict
        The stripe of each pair, by the name of its image without the laser.
    left_out : dict
        Images that are not used, and why.
    sample : array (H, W), optional
        The first image with a stripe.
    """

    boards: BoardImages
    scene: Scene
    seen: Sightings
    lens_covariance: Float64 | None
    stripes: dict[str, Stripe] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    sample: Integers | None = None


def find_pairs(sources: Sequence[Path]) -> tuple[dict[Path, Path], dict[str, str]]:
    """Return the images without the laser with theirs with it, and those that have no partner.

    Raises ArctrackError if there is no pair, or if two images could be the same half of one.
    """
    halves: dict[bool, dict[tuple[int, ...], Path]] = {True: {}, False: {}}
    for path in images_of(sources):
        number = tuple(int(digits) for digits in re.findall(r"\d+", path.stem))
        words = set(re.findall(r"[a-z]+", path.stem.lower()))
        half = halves[WITHOUT not in words and bool(words.intersection(WITH))]
        if number in half:
            raise in_file(path, f"has the number of {half[number].name}, and both are of one kind: {NAMING}")
        half[number] = path
    off, on = halves[False], halves[True]
    pairs = {off[number]: on[number] for number in off if number in on}
    if not pairs:
        raise in_file(sources[0], f"holds no pair of images without and with the laser: {NAMING}")
    off_names, on_names = distinct_names([*off.values()]), distinct_names([*on.values()])
    alone = {
        off_names[path]: "has no image with the laser" for number, path in off.items() if number not in on
    }
    alone |= {
        on_names[path]: "has no image without the laser" for number, path in on.items() if number not in off
    }
    return pairs, alone


def read_pairs(
    sources: Sequence[Path],
    board: Board,
    stated: SetupFile,
    progress: Callable[[int, int], None] | None = None,
) -> LaserPairs:
    """Find boards and stripes in pairs of images.

    Parameters
    ----------
    sources : sequence of Path
        Folders of images, images, and patterns.
    board : Board
        The board.
    stated : SetupFile
        The setup, whose camera is calibrated.
    progress : callable, optional
        Told how many images are done, and of how many.

    Returns
    -------
    LaserPairs
        Boards' poses and stripes.

    Raises
    ------
    ArctrackError
        Where there is no pair, no board, or images of another size than the camera's.
    """
    pairs, alone = find_pairs(sources)
    total = 2 * len(pairs)

    def tell(done: int) -> None:
        if progress is not None:
            progress(done, total)

    boards = read_boards(list(pairs), board, lambda n, _: tell(n))
    camera, channel = stated.setup.camera, channel_of_laser(stated.setup)
    if boards.size != (camera.width, camera.height):
        raise ArctrackError(
            f"{stated.path}: [camera] width, height: {camera.width} x {camera.height}, but the images are "
            f"{boards.size[0]} x {boards.size[1]} px: `arctrack calibrate camera` comes first"
        )
    record = stated.calibrations.get("camera")
    lens = lens_of(camera, [] if record is None else record.parameters)
    result = LaserPairs(
        boards,
        *board_poses(board, boards.views, lens),
        None if record is None else lens_covariance(record, lens, stated.path),
        left_out=alone | boards.left_out,
    )
    names = distinct_names([*pairs])
    partner = {names[off]: (off, on) for off, on in pairs.items()}
    on_names = distinct_names([*pairs.values()])
    for n, name in enumerate(result.seen.names):
        off_path, on_path = partner[name]
        try:
            off, on = (grey(EncodedImage(path).pixels(), channel) for path in (off_path, on_path))
        except ArctrackError as error:
            result.left_out[on_names[on_path]] = reason_of(error, on_path)
            continue
        if on.shape != off.shape or on.dtype != off.dtype:
            result.left_out[on_names[on_path]] = f"has another size or depth than {name}"
            continue
        area = board_area(board, lens, result.scene.T_camera_board[n])
        stripe = find_stripe(laser_light(off, on, area))
        if stripe is None:
            result.left_out[on_names[on_path]] = "shows no stripe on the board"
            continue
        result.stripes[name] = stripe
        if result.sample is None:
            result.sample = on
        tell(len(pairs) + n + 1)
    return result


def lens_covariance(record: CalibrationTable, lens: Lens, path: Path) -> Float64 | None:
    """Return the covariance (n, n) of a lens' parameters that a calibration has; None if it lacks some."""
    rows = {name: row for row, name in enumerate(record.parameters)}
    try:
        whole = record.matrix("calibration.camera")
    except ValueError as error:
        raise in_file(path, str(error)) from None
    if not set(PINHOLE) <= set(rows):
        return None
    covariance = np.zeros((len(lens.names), len(lens.names)))
    known = [n for n, name in enumerate(lens.names) if name in rows]
    picked = [rows[lens.names[n]] for n in known]
    covariance[np.ix_(known, known)] = whole[np.ix_(picked, picked)]
    return covariance
