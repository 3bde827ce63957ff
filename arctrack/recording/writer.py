"""The one writer of recordings.

A recording grows in a folder named `NAME.unfinished`, line by line and frame by frame, and gets its own name
when it is closed: what was cut short keeps what it has and cannot be taken for whole.
"""

import csv
import math
from collections.abc import Iterable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Self, TextIO

from arctrack.errors import in_file
from arctrack.output import check_new_folder, write_whole, writing
from arctrack.recording import ffv1, frames, png, setup_writer, tables
from arctrack.recording.files import FRAMES_CSV, TRUTH_CSV, UNFINISHED_SUFFIX
from arctrack.recording.poses import CSV_NAME as POSES_CSV
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup, require_setup
from tracker.state import Frame, frame_misfit

TIME_FORMAT, VALUE_FORMAT = ".6f", ".10g"
"""Formats in frames.csv of times, and of currents and exposures."""


def as_stated(frame: Frame) -> Frame:
    """Return a frame with time, current and exposure as frames.csv can state them; the time is no later."""
    stated_s = float(format(frame.timestamp_s, TIME_FORMAT))
    if stated_s > frame.timestamp_s:
        stated_s = float(format(stated_s - 1e-6, TIME_FORMAT))
    return replace(
        frame,
        timestamp_s=stated_s,
        current_a=float(format(frame.current_a, VALUE_FORMAT)),
        exposure_s=float(format(frame.exposure_s, VALUE_FORMAT)),
    )


@dataclass(frozen=True)
class VideoFormat:
    """Frames go to one lossless video, played at this rate, instead of to PNGs."""

    rate_hz: float


class RecordingWriter:
    """Writer of one recording.

    Use it as a context manager. An exception leaves the folder with the suffix `.unfinished`.

    Parameters
    ----------
    path : Path or str
        The recording's folder, which must not exist yet.
    setup : Setup
        The nominal setup, which recording.toml states.
    video : VideoFormat, optional
        Writes one lossless video; by default frames are written as PNGs.
    toml : str, optional
        The text of recording.toml, where that says more than the setup.

    Raises
    ------
    ArctrackError
        If the folder exists or cannot be made.
    """

    def __init__(
        self, path: Path | str, setup: Setup, *, video: VideoFormat | None = None, toml: str | None = None
    ) -> None:
        self.path = Path(path)
        self._setup = require_setup(setup)
        if not self.path.name:
            raise in_file(self.path, "is no name for a recording; give that of a new folder")
        self._folder = self.path.with_name(self.path.name + UNFINISHED_SUFFIX)
        for folder in (self.path, self._folder):
            check_new_folder(folder)
        text = setup_writer.format_setup(setup) if toml is None else toml
        with writing(self._folder):
            (self._folder / frames.FOLDER_NAME if video is None else self._folder).mkdir(
                parents=True, exist_ok=True
            )
        write_whole(self._folder / setup_writer.FILE_NAME, text)
        self._opened = ExitStack()
        self._tables: dict[str, TextIO] = {}
        self._video: ffv1.VideoWriter | None = None
        if video is not None:
            height, width = setup.frame_shape
            self._video = ffv1.VideoWriter(
                self._folder / frames.VIDEO_NAME,
                width,
                height,
                setup.sensor.dtype,
                video.rate_hz,
            )
            self._opened.enter_context(self._video)

    @property
    def unfinished_path(self) -> Path:
        """The folder in which the recording grows until it is closed."""
        return self._folder

    def write_frame(self, frame: Frame) -> None:
        """Append a frame and its line in frames.csv.

        Parameters
        ----------
        frame : Frame
            Its image has the camera's size (H, W) and the sensor's type.

        Raises
        ------
        ValueError
            For an image of another size or type.
        """
        misfit = frame_misfit(frame.image_dn.shape, frame.image_dn.dtype, self._setup)
        if misfit is not None:
            raise ValueError(f"frame {frame.index} {misfit}")
        if self._video is not None:
            with writing(self._folder / frames.VIDEO_NAME):
                self._video.write(frame.image_dn, frame.timestamp_s)
        else:
            path = frames.png_path(self._folder / frames.FOLDER_NAME, frame.index)
            with writing(path):
                path.write_bytes(png.encode(frame.image_dn))
        current_a = "" if math.isnan(frame.current_a) else format(frame.current_a, VALUE_FORMAT)
        self._append(
            FRAMES_CSV,
            tables.FRAME_COLUMNS,
            (
                str(frame.index),
                format(frame.timestamp_s, TIME_FORMAT),
                str(int(frame.laser_on)),
                str(int(frame.arc_on)),
                current_a,
                format(frame.exposure_s, VALUE_FORMAT),
            ),
        )

    def write_pose(self, timestamp_s: float, T_base_tool: Float64) -> None:
        """Append a line to poses.csv.

        Parameters
        ----------
        timestamp_s : float
            The pose's time, s, on the frames' clock.
        T_base_tool : array (4, 4)
            The pose: it takes points of the tool frame to base, mm.
        """
        pose = setup_writer.pose_table(T_base_tool)
        values = [f"{timestamp_s:.6f}"]
        values += [f"{value:.6f}" for value in pose["translation_mm"]]
        # Nine decimals turn by less than 1e-7 degrees.
        values += [f"{value:.9f}" for value in pose["quaternion_xyzw"]]
        self._append(POSES_CSV, tables.POSE_COLUMNS, values)

    def write_truth(self, frame: int, seam_tool_mm: Float64) -> None:
        """Append a line to truth.csv.

        Parameters
        ----------
        frame : int
            The frame's number.
        seam_tool_mm : array (3,)
            The true seam point, mm, tool frame.
        """
        values = [str(frame), *(f"{value:.5f}" for value in seam_tool_mm)]
        self._append(TRUTH_CSV, tables.TRUTH_COLUMNS, values)

    def close(self) -> None:
        """Finish all files and give the folder its name."""
        with writing(self._folder):
            self._opened.close()
            if self.path.exists():
                self.path.rmdir()
            self._folder.rename(self.path)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            # The first error says which file fails; that no more can be written is nothing new.
            with suppress(OSError):
                self._opened.close()

    def _append(self, name: str, columns: Iterable[str], values: Iterable[str]) -> None:
        path = self._folder / name
        with writing(path):
            file = self._tables.get(name)
            if file is None:
                file = self._opened.enter_context(path.open("w", encoding="utf-8", newline=""))
                self._tables[name] = file
                csv.writer(file, lineterminator="\n").writerow(columns)
            csv.writer(file, lineterminator="\n").writerow(values)
            file.flush()
