"""Sample of a recording in which a mistake can be undone: setup, poses, lines."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from arctrack.check.bright_line import BrightLine, find_lines
from arctrack.check.fit import SectionMatch, SightedLine, fit
from arctrack.check.stripe_seen import stripe_seen
from arctrack.recording import FrameRow, PoseTable, Recording
from arctrack.recording.frames import frame_of
from arctrack.recording.poses import pose_at, pose_buffer
from calibration.check.stripe_place import StripeSight
from noise_model.compiled.arrays import Float64, Integers
from noise_model.effects import apply_setup_effects, pose_time_s
from noise_model.even_sample import evenly
from noise_model.instrument.sensor import Sensor
from noise_model.setup import Setup
from noise_model.transforms import invert
from robot_io.poses.pose_buffer import PoseBuffer
from tracker.geometry import SensorGeometry
from tracker.state import Pose
from tracker.step import step
from tracker.stripe.read import Work
from tracker.tracker_state import TrackerMemory

MAX_FRAMES, MAX_DARK = 10, 4
"""Number of frames used with the laser on, and of these without arc, where lines are clearest."""

MAX_LASER_OFF = 6
"""Number of frames used with the laser off."""

POSES_BEFORE, POSES_AFTER = 40, 3
"""The poses about a frame that its own is made of."""

NO_POSE = np.full((4, 4), np.nan)


@dataclass(frozen=True, eq=False)
class CheckCase:
    """Some frames' lines, the setup that should explain them and the poses.

    `images_dn` (H, W) are the frames as they are and `rows` their lines of frames.csv; `points_px` is each
    one's line, (n, 2) x y, of images of `size_px` (width, height), `sigma_px` the width of all, 1 sigma, NaN
    if unknown; `frames_s` are their times, `poses` all poses over time, `T_base_tool` those at the frames,
    NaN where there is none. `T_tool_controllertool` (4, 4) is the controller's tool frame as the setup states
    it.
    """

    setup: Setup
    images_dn: tuple[Integers, ...]
    rows: tuple[FrameRow, ...]
    points_px: tuple[Float64, ...]
    size_px: tuple[int, int]
    sigma_px: float
    frames_s: tuple[float, ...]
    poses: PoseTable
    T_base_tool: tuple[Float64, ...]
    T_tool_controllertool: Float64

    @cached_property
    def section_match(self) -> SectionMatch:
        """The lines laid over the setup's section."""
        sights = [SightedLine(*pair) for pair in zip(self.points_px, self.T_base_tool, strict=True)]
        return fit(self.setup, sights)

    @property
    def stripe_sights(self) -> list[StripeSight]:
        """The lines of the frames that have a pose."""
        pairs = zip(self.points_px, self.T_base_tool, strict=True)
        return [StripeSight(*pair) for pair in pairs if len(pair[0]) and np.isfinite(pair[1]).all()]

    def with_setup(self, setup: Setup) -> CheckCase:
        """Return the case with another setup."""
        return replace(self, setup=setup)

    def with_poses(self, change: Callable[[Float64], Float64]) -> CheckCase:
        """Return the case with another pose of the controller's in the place of each."""
        there, back = self.T_tool_controllertool, invert(self.T_tool_controllertool)
        return replace(
            self,
            T_base_tool=tuple(T if np.isnan(T).any() else change(T @ there) @ back for T in self.T_base_tool),
        )

    def with_tool(self, T_tool_controllertool: Float64) -> CheckCase:
        """Return the case with another frame for the controller's tool."""
        changed = self.T_tool_controllertool @ invert(T_tool_controllertool)
        return replace(
            self,
            T_base_tool=tuple(T @ changed for T in self.T_base_tool),
            T_tool_controllertool=T_tool_controllertool,
        )

    def with_times(self, frames: float = 1.0, poses: float = 1.0) -> CheckCase:
        """Return the case with the times of frames and poses multiplied."""
        frames_s = tuple(frames * timestamp_s for timestamp_s in self.frames_s)
        table = replace(self.poses, timestamps_s=poses * self.poses.timestamps_s)
        return replace(
            self, frames_s=frames_s, poses=table, T_base_tool=_poses_at(table, frames_s, self.setup)
        )

    def with_images(self, turn: Callable[[Integers], Integers]) -> CheckCase:
        """Return the case with its images turned or mirrored, and its lines with them."""
        width, height = self.size_px
        numbers = turn(np.arange(width * height).reshape(height, width))
        # Where the first pixel goes, and those to its right and below it.
        first, right, below = (np.argwhere(numbers == n)[0, ::-1] for n in (0, 1, width))
        axes = np.stack([right - first, below - first]).astype(np.float64)
        return replace(
            self,
            images_dn=tuple(np.ascontiguousarray(turn(image)) for image in self.images_dn),
            points_px=tuple(first + points @ axes for points in self.points_px),
            size_px=(numbers.shape[1], numbers.shape[0]),
        )

    @cached_property
    def n_read(self) -> int:
        """Number of frames that the tracker reads, each by itself."""
        try:
            geometry = SensorGeometry.of(self.setup)
        except ValueError:
            return 0
        work = Work.of(geometry)
        return sum(
            step(geometry, TrackerMemory(), frame_of(row, image), Pose(T_base_tool), work)[1].valid
            for row, image, T_base_tool in zip(self.rows, self.images_dn, self.T_base_tool, strict=True)
            if np.isfinite(T_base_tool).all()
        )

    @property
    def fits_camera(self) -> bool:
        """True if the images have the size that the setup states."""
        return self.size_px == (self.setup.camera.width, self.setup.camera.height)


def chosen_rows(recording: Recording) -> list[int]:
    """Return the positions of the frames to look at: the laser on, without arc first, over the whole run."""
    lasers = [(n, row.arc_on) for n, row in enumerate(recording.rows) if row.laser_on]
    dark, lit = ([n for n, arc_on in lasers if arc_on is state] for state in (False, True))
    some = _spread(dark, MAX_DARK if lit else MAX_FRAMES)
    return sorted({*some, *_spread(lit, MAX_FRAMES - len(some))})


def laser_off_rows(recording: Recording) -> list[int]:
    """Return the positions of the frames with the laser off to look at, over the whole run."""
    return _spread([n for n, row in enumerate(recording.rows) if not row.laser_on], MAX_LASER_OFF)


def case_of(recording: Recording, positions: Sequence[int] | None = None) -> CheckCase | None:
    """Return the case of some frames, by default of `chosen_rows`, None where no image can be read.

    Images of the commonest size count.
    """
    chosen = chosen_rows(recording) if positions is None else positions
    usable = [
        (recording.rows[n], image)
        for n, image in zip(chosen, recording.images(chosen), strict=True)
        if not isinstance(image, str) and image.ndim == 2
    ]
    if not usable:
        return None
    shapes = [image.shape for _, image in usable]
    shape = max(shapes, key=shapes.count)
    usable = [(row, image) for row, image in usable if image.shape == shape]
    lines: list[BrightLine] = find_lines([image for _, image in usable], recording.setup.sensor)
    frames_s = tuple(row.timestamp_s for row, _ in usable)
    setup = apply_setup_effects(recording.setup)
    return CheckCase(
        setup=setup,
        images_dn=tuple(image for _, image in usable),
        rows=tuple(row for row, _ in usable),
        points_px=tuple(line.points_px for line in lines),
        size_px=(shape[1], shape[0]),
        sigma_px=_sigma_px(usable, lines, recording.setup.sensor),
        frames_s=frames_s,
        poses=recording.poses,
        T_base_tool=_poses_at(recording.poses, frames_s, setup),
        T_tool_controllertool=recording.T_tool_controllertool,
    )


def _sigma_px(
    usable: Sequence[tuple[FrameRow, Integers]], lines: Sequence[BrightLine], sensor: Sensor
) -> float:
    """Return the median width of the lines, 1 sigma, px, of frames without arc if there are any."""
    seen = [
        (row.arc_on, stripe_seen(image, sensor, line).sigma_px)
        for (row, image), line in zip(usable, lines, strict=True)
    ]
    known = [(arc_on, sigma_px) for arc_on, sigma_px in seen if math.isfinite(sigma_px)]
    dark = [sigma_px for arc_on, sigma_px in known if not arc_on]
    return float(np.median(dark or [sigma_px for _, sigma_px in known])) if known else math.nan


def _spread(positions: list[int], most: int) -> list[int]:
    """Return at most `most` positions, spread over all of them."""
    return [positions[n] for n in evenly(len(positions), most)]


def _poses_at(poses: PoseTable, frames_s: Sequence[float], setup: Setup) -> tuple[Float64, ...]:
    """Return the pose (4, 4) at each time, as the run would have it, NaN where it is refused."""

    @cache
    def buffered(first: int, end: int) -> PoseBuffer:
        return pose_buffer(PoseTable(poses.path, poses.timestamps_s[first:end], poses.T_base_tool[first:end]))

    T_base_tools = []
    for timestamp_s in frames_s:
        asked_s = pose_time_s(setup, timestamp_s)
        k = int(np.searchsorted(poses.timestamps_s, asked_s)) if math.isfinite(asked_s) else 0
        # A run has all poses, but only those near a time count. Many times lie before or after all poses.
        pose = pose_at(buffered(max(0, k - POSES_BEFORE), k + POSES_AFTER), asked_s)
        T_base_tools.append(NO_POSE if pose is None else pose.T_base_tool)
    return tuple(T_base_tools)
