"""Board images without and with the laser: which belong together, and the stripes that they show.

An image with the laser that has no partner may show both, board and stripe.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from arctrack.calibrate.camera.board_images import BoardImages, read_boards, reason_of
from arctrack.calibrate.stated_camera import check_size, stated_lens
from arctrack.errors import ArctrackError, in_file
from arctrack.recording import SetupFile
from arctrack.recording.importing.grey import channel_of_laser, grey
from arctrack.recording.importing.image_decoder import EncodedImage
from arctrack.recording.importing.image_files import distinct_names, images_of
from calibration.boards.board import Board
from calibration.boards.detect import MIN_CORNERS, WINDOW
from calibration.camera.adjustment import BoardScene, adjust
from calibration.camera.known_lens import board_poses
from calibration.camera.sightings import Sightings
from calibration.laser.cross_sections import CrossSections, cross_sections, placed
from calibration.laser.lit_board import lit_board
from calibration.laser.stripe import BoardStripe, board_area, find_stripe, laser_light
from calibration.threads import one_thread
from noise_model.compiled.arrays import Float64, Integers
from noise_model.setup import Setup

NAMING = (
    "pairs share their numbers, and `laser` or `on` is in the name of that with the laser: board_01, "
    "laser_01; an image of both has it too"
)


@dataclass
class LaserPairs:
    """Boards and stripes in pairs of images.

    `boards` are in the images without the laser, with poses in `scene`. `lens_covariance` (n, n) is None
    where the setup keeps none. `stripes` and `sections` are by the name of the image without the laser, or of
    the one with both; `lit` has for the latter the rendered board's residual over its contrast, 1 sigma.
    `left_out` maps unused images to the reason; `sample` (H, W) is the first image with a stripe.
    """

    boards: BoardImages
    scene: BoardScene
    seen: Sightings
    lens_covariance: Float64 | None
    stripes: dict[str, BoardStripe] = field(default_factory=dict)
    sections: dict[str, CrossSections] = field(default_factory=dict)
    lit: dict[str, float] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    sample: Integers | None = None


def find_pairs(sources: Sequence[Path]) -> tuple[dict[Path, Path], list[Path], list[Path]]:
    """Return images without the laser with theirs with it, and those of either kind without a partner.

    Raises ArctrackError if there is none with the laser, or if two images could be the same half of a pair.
    """
    halves: dict[bool, dict[tuple[int, ...], Path]] = {True: {}, False: {}}
    for path in images_of(sources):
        number = tuple(int(digits) for digits in re.findall(r"\d+", path.stem))
        words = set(re.findall(r"[a-z]+", path.stem.lower()))
        # Words in a file's name: an image with the laser has one of the first, and not the second.
        half = halves["off" not in words and bool(words.intersection(("laser", "on")))]
        if number in half:
            raise in_file(path, f"has the number of {half[number].name}, and both are of one kind: {NAMING}")
        half[number] = path
    off, on = halves[False], halves[True]
    if not on:
        raise in_file(sources[0], f"holds no pair of images without and with the laser: {NAMING}")
    pairs = {path: on[number] for number, path in off.items() if number in on}
    dark = [path for number, path in off.items() if number not in on]
    return pairs, [path for number, path in on.items() if number not in off], dark


def read_pairs(
    sources: Sequence[Path],
    board: Board,
    stated: SetupFile,
    progress: Callable[[int, int], None] | None = None,
) -> LaserPairs:
    """Find boards and stripes in pairs of images, and in images that show both.

    ArctrackError where there is no image with the laser, no board, or images of another size than the
    camera's.
    """
    pairs, with_both, dark = find_pairs(sources)
    with_board = [*pairs, *with_both]
    total = len(with_board) + len(pairs)

    def tell(done: int) -> None:
        if progress is not None:
            progress(done, total)

    boards = read_boards(with_board, board, lambda n, _: tell(n))
    check_size(boards.size, stated)
    names, on_names, dark_names = (distinct_names(each) for each in (with_board, [*pairs.values()], dark))
    left_out = {dark_names[path]: "has no image with the laser" for path in dark}
    for path in with_both:
        if names[path] in boards.left_out:
            boards.left_out[names[path]] += "; and it has no image without the laser"
    lens, covariance = stated_lens(stated)
    result = LaserPairs(
        boards, *board_poses(board, boards.views, lens), covariance, left_out=left_out | boards.left_out
    )
    paths = {names[path]: path for path in with_board}
    for n, name in enumerate(result.seen.names):
        off_path = paths[name]
        on_path = pairs.get(off_path, off_path)
        shown_name = on_names.get(on_path, name)
        try:
            stripe = _add_stripe(result, n, board, stated.setup, off_path, on_path)
        except ArctrackError as error:
            result.left_out[shown_name] = reason_of(error, on_path)
            continue
        if stripe is None:
            result.left_out[shown_name] = "shows no stripe on the board"
        tell(len(with_board) + n + 1)
    return _without_lit_corners(result)


def _add_stripe(
    result: LaserPairs, n: int, board: Board, setup: Setup, off_path: Path, on_path: Path
) -> BoardStripe | None:
    """Add a view's stripe and its light, if there is one; ArctrackError for images that are no pair."""
    lens, T, name = result.scene.lens, result.scene.T_camera_board[n], result.seen.names[n]
    channel = channel_of_laser(setup)
    on = grey(EncodedImage(on_path).pixels(), channel)
    without: Integers | Float64
    if off_path == on_path:
        lit = lit_board(on, board, lens, T, setup.camera.psf_sigma_px)
        light, without = lit.light, lit.board_dn
        result.lit[name] = lit.rest_dn / max(lit.contrast_dn, 1e-9)
    else:
        off = grey(EncodedImage(off_path).pixels(), channel)
        if on.shape != off.shape or on.dtype != off.dtype:
            raise in_file(on_path, f"has another size or depth than {name}")
        light, without = laser_light(off, on, board_area(board, lens, T)), off
    stripe = find_stripe(light)
    if stripe is None:
        return None
    # A gamma makes widths others: they are told of linear codes alone.
    sections = cross_sections(light, without, on, stripe, setup.sensor.black_level_dn)
    if sections is not None and setup.sensor.is_linear:
        result.sections[name] = sections
        stripe = placed(stripe, sections)
    result.stripes[name] = stripe
    if result.sample is None:
        result.sample = on
    return stripe


def _without_lit_corners(pairs: LaserPairs) -> LaserPairs:
    """Return the pairs without corners that lie in the stripe's light, where an image shows both."""
    seen = pairs.seen
    is_unlit = np.ones(len(seen), dtype=bool)
    for n, (name, part) in enumerate(zip(seen.names, seen.slices, strict=True)):
        if name in pairs.lit and name in pairs.stripes:
            stripe, points = pairs.stripes[name], seen.points_px[part]
            square_px = (
                pairs.scene.lens.values[0] * seen.board.square_mm / pairs.scene.T_camera_board[n, 2, 3]
            )
            # Distance of an unlit corner from the stripe, sigmas, in addition to half the corner's window.
            near_px = 3.0 * stripe.scale_px + WINDOW * square_px
            is_unlit[part] = np.linalg.norm(points[:, None] - stripe.points_px, axis=2).min(axis=1) > near_px
            if is_unlit[part].sum() < MIN_CORNERS:
                is_unlit[part] = True
                del pairs.stripes[name]
                pairs.left_out[name] = "the stripe hides too many of the board's corners"
    if is_unlit.all():
        return pairs
    with one_thread():
        rest = seen.where(is_unlit)
        scene = adjust(pairs.scene, rest, np.ones(len(rest)), poses_only=True)
    return replace(pairs, scene=scene, seen=rest)
