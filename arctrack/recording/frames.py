"""The frames of a recording, read one at a time from PNGs or a lossless video."""

import math
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from arctrack.errors import in_file
from arctrack.limits import LIMITS
from arctrack.recording import ffv1, png
from arctrack.recording.files import UnfitFileError, check_file, kind_of, read_bytes
from arctrack.recording.frame_hints import frame_hint, number_hint, source_hint
from arctrack.recording.tables import FrameRow
from arctrack.recording.time_sources import TimeSource, contradictions
from noise_model.compiled.arrays import Integers
from noise_model.setup import Setup
from tracker.state import Frame, frame_misfit

Image = Integers | str
"""An image (H, W), or what is wrong with it."""

FOLDER_NAME = "frames"
VIDEO_NAME = "frames.mkv"


@dataclass(frozen=True)
class BadFrame:
    """A frame that cannot be used.

    Attributes
    ----------
    row : FrameRow
        The frame's line in frames.csv.
    path : Path
        The file that should hold the frame.
    problem : str
        What is wrong with it.
    """

    row: FrameRow
    path: Path
    problem: str

    @property
    def message(self) -> str:
        """Message for people, in one line."""
        return f"{self.path}: {self.problem}"


def png_path(folder: Path, index: int) -> Path:
    """Return the file, or the place in the video, of a frame by its index."""
    return folder / f"{index:06d}.png"


def check_source(recording: Path, rows: Sequence[FrameRow], setup: Setup) -> tuple[Path, list[str]]:
    """Return the folder or the video that holds the frames, and warnings; ArctrackError if there is none."""
    folder, video = recording / FOLDER_NAME, recording / VIDEO_NAME
    if folder.is_dir():
        warnings = [f"{folder} is read, {video.name} beside it is not"] if video.exists() else []
        return folder, warnings + _check_folder(folder, rows)
    if video.exists():
        return video, _check_video(video, rows, setup)
    if folder.exists():
        kind = kind_of(folder.stat().st_mode) or "file"
        raise in_file(folder, f"is a {kind}: a folder of PNGs is needed")
    problem = f"there are no frames: neither this folder nor {VIDEO_NAME} exists"
    raise in_file(folder, problem + source_hint(recording, rows[0].index))


def read_frames(
    source: Path, rows: Sequence[FrameRow], setup: Setup, positions: Sequence[int] | None = None
) -> Generator[Frame | BadFrame, None, None]:
    """Yield the frames of all rows, or of those at rising positions, one at a time.

    The n-th row of frames.csv is the PNG with its number, or the n-th frame of the video.
    """
    chosen = range(len(rows)) if positions is None else positions
    is_folder = source.is_dir()
    for position, image in zip(chosen, read_images(source, rows, setup, chosen), strict=True):
        row = rows[position]
        yield _judge(image, row, png_path(source, row.index) if is_folder else source, setup)


def read_images(
    source: Path, rows: Sequence[FrameRow], setup: Setup, positions: Sequence[int]
) -> Iterator[Image]:
    """Yield the images of rows at rising positions, one at a time; they may be turned, but not larger."""
    if source.is_dir():
        for position in positions:
            yield _read_png(png_path(source, rows[position].index), setup)
        return
    yield from ffv1.read_video(source, positions)


def _read_png(path: Path, setup: Setup) -> Image:
    n_px = math.prod(setup.frame_shape)
    most = LIMITS.png_bytes_per_px * n_px + LIMITS.spare_bytes
    try:
        encoded = read_bytes(path, most)
        header = png.header_of(encoded)
        # A few bytes may stand for gigabytes of pixels: only what is no larger than a frame is decoded.
        if math.prod(header.shape) > n_px:
            return str(frame_misfit(header.shape, header.dtype, setup))
        return png.decode(encoded, header)
    except FileNotFoundError:
        return f"there is no such file, though frames.csv names the frame{frame_hint(path)}"
    except (UnfitFileError, ValueError) as error:
        return str(error)
    except OSError as error:
        return f"cannot be read: {error.strerror}"


def _judge(image: Image, row: FrameRow, path: Path, setup: Setup) -> Frame | BadFrame:
    problem = image if isinstance(image, str) else _misfit(image, setup)
    if isinstance(image, str) or problem is not None:
        return BadFrame(row, path, str(problem))
    return frame_of(row, image)


def frame_of(row: FrameRow, image: Integers) -> Frame:
    """Return the frame of an image (H, W) and its line of frames.csv."""
    return Frame(
        index=row.index,
        timestamp_s=row.timestamp_s,
        image_dn=image,
        exposure_s=row.exposure_s,
        current_a=row.current_a,
        laser_on=row.laser_on,
        arc_on=row.arc_on,
    )


def _misfit(image: Integers, setup: Setup) -> str | None:
    problem = frame_misfit(image.shape, image.dtype, setup)
    brightest = 0 if problem else int(image.max())
    if brightest > setup.sensor.max_dn:
        return f"holds {brightest} DN, [sensor] bits = {setup.sensor.bits} ends at {setup.sensor.max_dn}"
    return problem


def _check_folder(folder: Path, rows: Sequence[FrameRow]) -> list[str]:
    present = {path.name for path in folder.glob("*.png")}
    named = {png_path(folder, row.index).name for row in rows}
    if not present & named:
        first = png_path(folder, rows[0].index)
        problem = "there is no such file, nor any other that frames.csv names"
        raise in_file(first, problem + (frame_hint(first) or number_hint(folder, rows[0].index)))
    spare = len(present - named)
    return [f"{folder} holds {spare} PNGs that frames.csv does not name"] if spare else []


def _check_video(video: Path, rows: Sequence[FrameRow], setup: Setup) -> list[str]:
    height, width = setup.frame_shape
    raw_bytes = len(rows) * width * height * np.dtype(setup.sensor.dtype).itemsize
    try:
        check_file(video, LIMITS.video_bytes_per_byte * raw_bytes + LIMITS.spare_bytes)
    except UnfitFileError as error:
        raise in_file(video, str(error)) from None
    ffv1.check_video(video, width, height)
    # Of fewer frames the last are lost; of more nobody knows which row is whose.
    index = ffv1.index_of(video)
    if len(index) > len(rows):
        raise in_file(video, f"holds {len(index)} frames where frames.csv has {len(rows)} rows")
    warnings = [] if index.breaks_off is None else [index.breaks_off]
    rows_read = rows[: len(index)]
    stated = TimeSource("those of frames.csv", np.array([row.timestamp_s for row in rows_read]))
    problems = contradictions(stated, [index.times], [row.index for row in rows_read])
    warnings += [f"{video}: {line}" for line in problems]
    if not ffv1.carries_checksums(video):
        what = "carries no checksums, so that damage may go unnoticed; write it with slicecrc=1"
        warnings.append(f"{video}: {what}")
    return warnings
