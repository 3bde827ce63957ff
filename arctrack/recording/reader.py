"""The one reader of recordings."""

from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from arctrack.errors import ArctrackError, in_file
from arctrack.output import real
from arctrack.printable import printable
from arctrack.recording import setup_file, setup_writer
from arctrack.recording.files import FRAMES_CSV, TRUTH_CSV, check_folder
from arctrack.recording.frames import BadFrame, Image, check_source, read_frames, read_images
from arctrack.recording.live_steps import STATE_JSON, STEPS_CSV, RecordedSteps, read_steps
from arctrack.recording.poses import (
    CSV_NAME,
    LOG_NAMES,
    check_coverage,
    pose_at,
    pose_buffer,
    poses_at,
    read_poses,
    runs_against_travel,
)
from arctrack.recording.tables import FrameRow, PoseTable, Truth, read_frame_rows, read_truth_csv
from noise_model.compiled.arrays import Float64
from noise_model.effects import pose_time_s
from noise_model.setup import Setup
from robot_io import PoseBuffer
from tracker.seam.correction import Correction
from tracker.state import Frame, Pose


@dataclass(frozen=True)
class Recording:
    """Recording, checked except for its frames, which are read one at a time.

    Attributes
    ----------
    path : Path
        The recording's folder.
    setup_path : Path
        The file that the setup came from.
    setup : Setup
        The nominal setup.
    correction : Correction
        How the seam is followed: `[follow]` of the setup file.
    robot : mapping
        What `[robot]` of the setup file holds, by key.
    T_tool_controllertool : array (4, 4)
        The controller's tool frame in the tool frame, mm. `poses` are turned by it already.
    unknown_keys : tuple of str
        Keys of the setup file that mean nothing to arctrack.
    rows : tuple of FrameRow
        The lines of frames.csv, in order.
    poses : PoseTable
        T_base_tool (n, 4, 4), mm, over time, s.
    frame_source : Path
        The folder of PNGs, or the video.
    warnings : tuple of str
        One line each.
    steps : RecordedSteps or None
        What a live run's steps took beside the frames; None where that was not kept.
    """

    path: Path
    setup_path: Path
    setup: Setup
    correction: Correction
    robot: Mapping[str, Any]
    T_tool_controllertool: Float64
    unknown_keys: tuple[str, ...]
    rows: tuple[FrameRow, ...]
    poses: PoseTable
    frame_source: Path
    warnings: tuple[str, ...]
    steps: RecordedSteps | None = None

    def __repr__(self) -> str:
        joint, metal = self.setup.joint.type, printable(self.setup.material.name)
        warned = f", {len(self.warnings)} warnings" if self.warnings else ""
        return (
            f"Recording({self.name}: {len(self.rows)} frames and {len(self.poses.timestamps_s)} poses "
            f"of a {joint} in {metal}{warned})"
        )

    @property
    def name(self) -> str:
        """The folder's name, fit to print."""
        return printable(real(self.path).name)

    @property
    def has_truth(self) -> bool:
        """Return True if truth.csv lies next to the frames."""
        return (self.path / TRUTH_CSV).exists()

    @property
    def frame_rate_hz(self) -> float:
        """The mean frame rate; NaN for a single frame."""
        span_s = self.rows[-1].timestamp_s - self.rows[0].timestamp_s
        return (len(self.rows) - 1) / span_s if span_s > 0 else float("nan")

    def is_read_from(self, path: Path) -> bool:
        """Return True if writing to a path, which need not exist, would change the recording or its setup."""
        names = (setup_writer.FILE_NAME, FRAMES_CSV, TRUTH_CSV, CSV_NAME, *LOG_NAMES, STEPS_CSV, STATE_JSON)
        sources = [self.setup_path, self.frame_source, *(self.path / name for name in names)]
        return any(real(path).is_relative_to(real(source)) for source in sources)

    def frames(self, positions: Sequence[int] | None = None) -> Generator[Frame | BadFrame, None, None]:
        """Return frames, read one at a time.

        Parameters
        ----------
        positions : sequence of int, optional
            Positions in `rows`, rising; by default all rows.

        Returns
        -------
        generator of Frame or BadFrame
            A frame that cannot be read, or does not fit the setup, comes as a BadFrame.
        """
        return read_frames(self.frame_source, self.rows, self.setup, positions)

    def images(self, positions: Sequence[int]) -> Iterator[Image]:
        """Return the images of some rows, read one at a time, whatever their shape.

        Parameters
        ----------
        positions : sequence of int
            Positions in `rows`, rising.

        Returns
        -------
        iterator of array (H, W) or str
            Grey levels, DN, or what is wrong with the file. An image may be turned, but is never larger than
            the camera's.
        """
        return read_images(self.frame_source, self.rows, self.setup, positions)

    def readable_frames(self) -> tuple[list[Frame], list[BadFrame]]:
        """Read all frames.

        Returns
        -------
        frames : list of Frame
            The frames that can be read.
        bad : list of BadFrame
            The frames that cannot.

        Raises
        ------
        ArctrackError
            If no frame can be read.
        """
        frames: list[Frame] = []
        bad: list[BadFrame] = []
        for frame in self.frames():
            if isinstance(frame, BadFrame):
                bad.append(frame)
            else:
                frames.append(frame)
        if not frames:
            raise ArctrackError(f"{bad[0].message}; no frame of {self.path} can be read")
        return frames, bad

    def complaint(self, bad_frames: Sequence[BadFrame], of_the_others: str) -> str | None:
        """Return one line on frames that could not be read; None where every frame could be.

        `of_the_others` says what became of the other frames, such as "the pose is that of the others".
        """
        if not bad_frames:
            return None
        count = f"{len(bad_frames)} of {len(self.rows)} frames could not be used"
        return f"{bad_frames[0].message}; {count}, {of_the_others}"

    def posed(self, frames: Iterable[Frame]) -> list[tuple[Frame, Pose]]:
        """Return frames with the tool's pose at each; those without a pose are left out."""
        wanted = list(frames)
        poses = self.poses_at([frame.timestamp_s for frame in wanted])
        return [(frame, pose) for frame, pose in zip(wanted, poses, strict=True) if pose is not None]

    def pose_at(self, poses: PoseBuffer, timestamp_s: float) -> Pose | None:
        """Return the tool's pose at a frame's time.

        Parameters
        ----------
        poses : PoseBuffer
            The poses received, as `pose_buffer` returns them.
        timestamp_s : float
            The middle of the frame's exposure, s.

        Returns
        -------
        Pose or None
            T_base_tool, mm; None where the buffer refuses a pose.
        """
        return pose_at(poses, pose_time_s(self.setup, timestamp_s))

    def poses_at(self, timestamps_s: Iterable[float]) -> list[Pose | None]:
        """Return the tool's pose at many frames' times: those of `pose_at`, in a fraction of its time.

        Parameters
        ----------
        timestamps_s : iterable of float
            The middle of each frame's exposure, s.

        Returns
        -------
        list of Pose or None
            T_base_tool, mm; None where the buffer refuses a pose.
        """
        times_s = [pose_time_s(self.setup, timestamp_s) for timestamp_s in timestamps_s]
        return poses_at(self.pose_buffer(), times_s)

    def pose_buffer(self) -> PoseBuffer:
        """Return all poses in a buffer that answers as in the live run."""
        return pose_buffer(self.poses)


def read_recording(
    path: Path | str, setup_path: Path | str | None = None, must_fit: bool = True
) -> Recording:
    """Read and check all of a recording but its frames.

    Parameters
    ----------
    path : Path or str
        The recording's folder.
    setup_path : Path or str, optional
        A file to take the setup from instead of the recording's own recording.toml.
    must_fit : bool
        False leaves out the checks of whether poses, frames and seam line belong together.

    Returns
    -------
    Recording
        The recording; its frames are read one at a time by `Recording.frames`.

    Raises
    ------
    ArctrackError
        For a missing file, key or column, a value of the wrong type or not finite, times that run backwards,
        a pose that is no rotation, poses that stop before the frames, a seam line that runs against the
        travel. It names the file and the key or line.
    """
    folder = Path(path)
    check_folder(folder)
    stated = setup_file.read_setup_file(folder / setup_writer.FILE_NAME if setup_path is None else setup_path)
    rows, frame_warnings = read_frame_rows(folder / FRAMES_CSV)
    poses, pose_warnings = read_poses(folder, stated.T_tool_controllertool, stated.robot)
    source, source_warnings = check_source(folder, rows, stated.setup)
    recording = Recording(
        path=folder,
        setup_path=stated.path,
        setup=stated.setup,
        correction=stated.correction,
        robot=stated.robot,
        T_tool_controllertool=(
            np.eye(4) if stated.T_tool_controllertool is None else stated.T_tool_controllertool
        ),
        unknown_keys=stated.unknown_keys,
        rows=rows,
        poses=poses,
        frame_source=source,
        warnings=(*stated.warnings, *frame_warnings, *pose_warnings, *source_warnings),
        steps=read_steps(folder),
    )
    return fitted(recording) if must_fit else recording


def fitted(recording: Recording) -> Recording:
    """Return a recording with warnings on frames that its poses do not cover.

    Raises ArctrackError for poses that cover none, and for a seam line that runs against the travel.
    """
    frames_s = [row.timestamp_s for row in recording.rows]
    warnings = check_coverage(recording.poses, frames_s[0], frames_s[-1])
    if runs_against_travel(recording.poses, frames_s, recording.setup.joint):
        problem = "[joint] seam_in_base_mm: runs against the travel; reverse its points"
        raise in_file(recording.setup_path, problem)
    return replace(recording, warnings=(*recording.warnings, *warnings))


def read_truth(path: Path | str) -> Truth | None:
    """Read a recording's truth.csv.

    For scoring alone: nothing that tracks or diagnoses may call it.

    Parameters
    ----------
    path : Path or str
        The recording's folder.

    Returns
    -------
    Truth or None
        The true seam points, mm, tool frame; None if there is no truth.csv.

    Raises
    ------
    ArctrackError
        For a missing column, and for a value that is wrong. It names the file and the line.
    """
    truth = Path(path) / TRUTH_CSV
    return read_truth_csv(truth) if truth.exists() else None
