"""The frames of a recording, read one at a time from PNGs or a lossless video."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from arctrack.errors import in_file
from arctrack.recording import ffv1, png
from arctrack.recording.tables import FrameRow
from noise_model.arrays import Integers
from noise_model.setup import Setup
from tracker.state import Frame

FOLDER_NAME = "frames"
VIDEO_NAME = "frames.mkv"


@dataclass(frozen=True)
class BadFrame:
    """A frame that cannot be used: the file that should hold it and what is wrong with it."""

    row: FrameRow
    path: Path
    problem: str

    @property
    def message(self) -> str:
        """One line for people."""
        return f"{self.path}: {self.problem}"


def png_path(folder: Path, index: int) -> Path:
    """Return where the frame of an index lies."""
    return folder / f"{index:06d}.png"


def check_source(recording: Path, rows: Sequence[FrameRow], setup: Setup) -> tuple[Path, list[str]]:
    """Return the folder or the video that holds the frames, and warnings; ArctrackError if there is none."""
    folder, video = recording / FOLDER_NAME, recording / VIDEO_NAME
    if folder.is_dir():
        warnings = [f"{folder} is read, {video.name} beside it is not"] if video.exists() else []
        return folder, warnings + _check_folder(folder, rows)
    if not video.exists():
        raise in_file(folder, f"there are no frames: neither this folder nor {video.name} exists")
    return video, _check_video(video, rows, setup)


def read_frames(
    source: Path, rows: Sequence[FrameRow], setup: Setup, positions: Sequence[int] | None = None
) -> Iterator[Frame | BadFrame]:
    """Yield the frames of all rows, or of those at rising positions, one at a time.

    The n-th row of frames.csv is the PNG with its number, or the n-th frame of the video.
    """
    chosen = range(len(rows)) if positions is None else positions
    if source.is_dir():
        for position in chosen:
            path = png_path(source, rows[position].index)
            yield _judge(_read_png(path), rows[position], path, setup)
        return
    for position, image in zip(chosen, ffv1.read_video(source, chosen), strict=True):
        yield _judge(image, rows[position], source, setup)


def _read_png(path: Path) -> Integers | str:
    try:
        return png.decode(path.read_bytes())
    except FileNotFoundError:
        return "there is no such file, though frames.csv names the frame"
    except OSError as error:
        return f"cannot be read: {error.strerror}"
    except ValueError as error:
        return str(error)


def _judge(image: Integers | str, row: FrameRow, path: Path, setup: Setup) -> Frame | BadFrame:
    problem = image if isinstance(image, str) else _misfit(image, setup)
    if isinstance(image, str) or problem is not None:
        return BadFrame(row, path, str(problem))
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
    camera, sensor = setup.camera, setup.sensor
    if image.ndim != 2:
        return f"has {image.shape[2]} channels: a raw grey frame is needed"
    if image.shape != (camera.height, camera.width):
        height, width = image.shape
        return f"is {width} x {height}, [camera] width and height say {camera.width} x {camera.height}"
    if image.dtype != np.dtype(sensor.dtype):
        return f"has {8 * image.itemsize} bits a pixel, which is not what [sensor] bits = {sensor.bits} gives"
    brightest = int(image.max())
    if brightest > sensor.max_dn:
        return f"holds {brightest} DN, [sensor] bits = {sensor.bits} ends at {sensor.max_dn}"
    return None


def _check_folder(folder: Path, rows: Sequence[FrameRow]) -> list[str]:
    present = {path.name for path in folder.glob("*.png")}
    named = {png_path(folder, row.index).name for row in rows}
    if not present & named:
        raise in_file(
            png_path(folder, rows[0].index), "there is no such file, nor any other that frames.csv names"
        )
    spare = len(present - named)
    return [f"{folder} holds {spare} PNGs that frames.csv does not name"] if spare else []


def _check_video(video: Path, rows: Sequence[FrameRow], setup: Setup) -> list[str]:
    camera = setup.camera
    with ffv1.open_video(video) as container:
        codec = container.streams.video[0].codec_context
        if (codec.width, codec.height) != (camera.width, camera.height):
            raise in_file(
                video,
                f"is {codec.width} x {codec.height}, [camera] width and height in recording.toml say "
                f"{camera.width} x {camera.height}",
            )
    # Of fewer frames the last are lost; of more nobody knows which row is whose.
    if (count := ffv1.count_frames(video)) > len(rows):
        raise in_file(video, f"holds {count} frames where frames.csv has {len(rows)} rows")
    if ffv1.carries_checksums(video):
        return []
    return [f"{video}: carries no checksums, so that damage may go unnoticed; write it with slicecrc=1"]
