"""Boards in image files: corners of those that show one, a line on each that does not."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from arctrack.errors import ArctrackError
from arctrack.recording.importing.colours import Channel
from arctrack.recording.importing.grey import grey
from arctrack.recording.importing.image_decoder import EncodedImage
from arctrack.recording.importing.image_files import distinct_names, images_of
from calibration.boards.board import Board, BoardKind
from calibration.boards.detect import MIN_PITCH_PX, Corners, find_corners, small_pitch_px
from calibration.camera.sightings import BoardView
from noise_model.compiled.arrays import Float64, Integers


@dataclass
class BoardImages:
    """Corners of a board in images.

    `size` is (width, height), px. `views` are of the images that show the board, `left_out` maps the others
    to the reason. `contrast` is each view's, light squares less dark ones, over full scale. `sample` (H, W)
    is the first image with the board; `lossy` views are JPEG files; `too_small` is the cure for boards that
    are seen too small, or empty.
    """

    size: tuple[int, int]
    views: list[BoardView] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)
    contrast: list[float] = field(default_factory=list)
    sample: Integers | None = None
    lossy: list[str] = field(default_factory=list)
    too_small: str = ""

    @property
    def is_dim(self) -> bool:
        """Return True if the boards are poorly lit."""
        # Least contrast without a warning, DN of 8 bits: less makes noisy corners.
        return bool(self.contrast) and float(np.median(self.contrast)) < 20.0 / 255.0

    @property
    def warnings(self) -> list[str]:
        """Warnings about what degrades the corners."""
        if not self.lossy:
            return []
        others = f" and {len(self.lossy) - 1} more are" if len(self.lossy) > 1 else " is"
        return [
            f"{self.lossy[0]}{others} JPEG, whose compression shifts corners: the sigmas count that as "
            "noise; PNG or TIFF straight from the camera is better"
        ]


def read_boards(
    sources: Sequence[Path], board: Board, progress: Callable[[int, int], None] | None = None
) -> BoardImages:
    """Find a board in image files, of those that have the most frequent size.

    ArctrackError where there is no image, or none that can be read or shows the board.
    """
    paths = images_of(sources)
    names = distinct_names(paths)
    encoded: dict[Path, EncodedImage] = {}
    unread: dict[str, str] = {}
    for path in paths:
        try:
            encoded[path] = EncodedImage(path)
        except ArctrackError as error:
            unread[names[path]] = reason_of(error, path)
    if not encoded:
        raise ArctrackError(f"{sources[0]}: no image can be read: {next(iter(unread.values()))}")
    size = Counter(image.size for image in encoded.values()).most_common(1)[0][0]
    boards = BoardImages(size, left_out=unread)
    for n, (path, image) in enumerate(encoded.items()):
        _add(boards, names[path], image, board)
        if progress is not None:
            progress(n + 1, len(encoded))
    if not boards.views:
        hint = boards.too_small or _hint(encoded, size, board)
        raise ArctrackError(f"{sources[0]}: no image shows a {board}: {hint}")
    return boards


def _add(boards: BoardImages, name: str, image: EncodedImage, board: Board) -> None:
    if image.size != boards.size:
        stated, most = (f"{width} x {height} px" for width, height in (image.size, boards.size))
        boards.left_out[name] = f"is {stated}, most images are {most}"
        return
    try:
        pixels = _brightest(image.pixels())
    except ArctrackError as error:
        boards.left_out[name] = reason_of(error, image.path)
        return
    corners = find_corners(pixels, board)
    if corners is None:
        pitch_px = small_pitch_px(pixels, board)
        boards.left_out[name] = _not_seen(pixels, board) if pitch_px is None else _too_small(pitch_px)
        if pitch_px is not None:
            boards.too_small = boards.too_small or f"{name} {boards.left_out[name]}"
        return
    same = next((view.name for view in boards.views if _is_same_place(view, corners)), None)
    if same is not None:
        boards.left_out[name] = f"shows the board where {same} shows it"
        return
    boards.views.append(BoardView(name, corners.corners, corners.points_px))
    if image.is_lossy:
        boards.lossy.append(name)
    boards.contrast.append(corners.contrast_dn / _full_scale_dn(pixels))
    if boards.sample is None:
        boards.sample = pixels


def reason_of(error: ArctrackError, path: Path) -> str:
    """Return an error's text without the name of its file."""
    return str(error).removeprefix(f"{path}: ")


def _brightest(pixels: Integers) -> Integers:
    """Return the grey levels of an image; of colours the one that shows most, as behind a filter."""
    if pixels.ndim == 2:
        return pixels
    return max((grey(pixels, channel) for channel in (Channel.GREEN, Channel.RED, Channel.BLUE)), key=np.std)


def _full_scale_dn(pixels: Integers) -> int:
    """Return the last code of as many bits as the brightest pixel takes: 12 bits are kept in 16."""
    return int(2 ** max(8, int(pixels.max()).bit_length()) - 1)


def _not_seen(pixels: Integers, board: Board) -> str:
    if not np.ptp(pixels) > 0:
        return "is all of one grey level"
    if board.kind is BoardKind.CHARUCO:
        return "shows too few of the board's markers: none in view, too blurred or too small"
    return "shows no whole board: it is cut off, blurred, or not this one"


def _too_small(pitch_px: float) -> str:
    return (
        f"shows the board's corners {pitch_px:.1f} px apart, more than {MIN_PITCH_PX:g} are needed: "
        "give the images at the camera's own size, or hold the board nearer"
    )


def _is_same_place(view: BoardView, corners: Corners) -> bool:
    _, own, other = np.intersect1d(view.corners, corners.corners, return_indices=True)
    if not len(own):
        return False
    # A board whose corners lie this near those of another image, half of them, has not moved.
    return float(np.median(_distances(view.points_px[own], corners.points_px[other]))) < 0.5


def _distances(a: Float64, b: Float64) -> Float64:
    return np.asarray(np.linalg.norm(a - b, axis=1))


def _hint(encoded: dict[Path, EncodedImage], size: tuple[int, int], board: Board) -> str:
    """Return the cure where no image shows the board: squares may have been counted for corners."""
    if board.kind is BoardKind.CHARUCO:
        return "count the squares, not the corners; check the dictionary, and light the board evenly"
    if min(board.columns, board.rows) > 3:
        fewer = Board(board.kind, board.columns - 1, board.rows - 1, board.square_mm)
        first = next(image for image in encoded.values() if image.size == size)
        if find_corners(_brightest(first.pixels()), fewer) is not None:
            return f"{fewer} is seen: inner corners are counted, not squares"
    return "count its inner corners; the whole board must be in view, sharp and evenly lit"
