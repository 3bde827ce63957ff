"""A frame with what is known of its capture, through the tracker: the step of every live tracker."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from arctrack.control.innovation import SeamMeasurement
from arctrack.recording.weld_schedule import WeldValues
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from noise_model.surface.joint import seam_frame
from noise_model.transforms import invert, transform
from robot_io import PoseAt, PoseStatus, RobotStatus
from tracker import flags
from tracker.geometry import SensorGeometry
from tracker.observation import Reading
from tracker.seam.correction import UNSTATED, Correction
from tracker.seam.earlier_pass import EarlierPass
from tracker.seam.locate import seam_displacement
from tracker.state import NAN, Frame, OffsetLookAhead, Pose, Track
from tracker.step import StepInputs
from tracker.tracker import Tracker
from tracker.tracker_state import TrackerMemory


@dataclass(frozen=True)
class Capture:
    """Conditions of a frame's capture as the tracker knows them.

    `captured_s` is on the tracker's clock; `pose` is the tool's then, and may be refused; `robot` is the
    latest status, None before the first. Measurements from poses that are not trusted must not last.
    `look_ahead` is that of the offset. Frames count for a pass while the robot has armed the tracker.
    """

    index: int
    captured_s: float
    pose: PoseAt
    robot: RobotStatus | None
    is_trusted: bool
    look_ahead: OffsetLookAhead
    is_armed: bool = True


@dataclass(frozen=True)
class FrameStep:
    """A completed step: the frame, the step's other inputs, and the reading that its track rests on."""

    frame: Frame
    inputs: StepInputs
    reading: Reading | None


@dataclass(frozen=True)
class TrackedFrame:
    """A frame's track and what it was made of.

    `seam` is the seam as the pose puts it, None where none was measured. `took_ms` is the time from frame and
    pose to the track. It is NaN, and `step` None, where there was no frame to step. `weld` is what the weld
    schedule gives for the torch's place, None without one.
    """

    track: Track
    seam: SeamMeasurement | None = None
    step: FrameStep | None = None
    took_ms: float = NAN
    weld: WeldValues | None = None


class PassFrame(NamedTuple):
    """A tracked frame of a pass: its track, the seam that it measured, None for none, and its pose.

    `T_base_tool` is (4, 4), mm; `calibration_variance_mm2` is the calibration's part in the variances of the
    track's (y, z).
    """

    track: Track
    seam: SeamMeasurement | None
    T_base_tool: Float64
    calibration_variance_mm2: tuple[float, float]


class PassKeeper(Protocol):
    """Keeper of a seam from pass to pass; see `SeamPasses`."""

    def begin(self) -> EarlierPass | None:
        """Begin a pass; return the one that it follows again, None for none."""

    @property
    def is_outdated(self) -> bool:
        """True once the seam of the earlier pass has become too old for a pass to begin with it."""

    def add(self, frame: PassFrame) -> None:
        """Take a frame whose pose is trusted."""

    def finish(self) -> None:
        """End a pass."""

    def weld_at(self, T_base_tool: Float64, look_ahead: OffsetLookAhead) -> WeldValues | None:
        """Return the weld's inputs where the torch will stand, None without a schedule."""


class FrameTracking:
    """Tracker of one seam; see `Tracker` of the arguments.

    `make_passes` makes what keeps the seam from pass to pass; without it there is one pass.
    """

    def __init__(
        self,
        setup: Setup,
        correction: Correction = UNSTATED,
        use_arc_map: bool = True,
        make_passes: Callable[[SensorGeometry], PassKeeper] | None = None,
    ) -> None:
        self.tracker = Tracker(setup, use_arc_map, correction)
        self._passes = None if make_passes is None else make_passes(self.tracker.geometry)
        self.begin()

    def begin(self) -> None:
        """Forget the seam: another part, or the next pass, comes."""
        self.finish()
        earlier = self.tracker.state.earlier
        if self._passes is not None:
            earlier = self._passes.begin()
        self.tracker.state = TrackerMemory(earlier=earlier)

    def finish(self) -> None:
        """End the pass: its seam is kept where the job says so."""
        if self._passes is not None:
            self._passes.finish()

    def track(self, shown: Frame | None, capture: Capture) -> TrackedFrame:
        """Track a frame, None for an unreadable one; measurements from doubted poses do not last."""
        if self._passes is not None and not capture.is_armed and self._passes.is_outdated:
            self.begin()
        before = self.tracker.state
        if shown is None:
            raised = flags.FRAME_UNREADABLE.mask | before.lasting_flags
            return TrackedFrame(Track(capture.index, capture.captured_s, raised))
        pose = None
        if capture.pose.status is not PoseStatus.REFUSED:
            pose = Pose(capture.pose.T_base_tool, capture.pose.status is PoseStatus.EXTRAPOLATED)
        began_ns = time.perf_counter_ns()
        track = self.tracker.step(shown, pose, capture.look_ahead)
        took_ms = (time.perf_counter_ns() - began_ns) / 1e6
        calibration_mm2 = self.tracker.state.steering.hand_eye_variance_mm2
        if not capture.is_trusted:
            # What the picture says of the arc steers nothing.
            self.tracker.state = before._replace(arc=self.tracker.state.arc)
        inputs = StepInputs(before, pose, capture.look_ahead, capture.is_trusted)
        setup = self.tracker.geometry.setup
        seam = seam_measurement(setup, track, pose, calibration_mm2)
        weld = None
        if self._passes is not None and pose is not None:
            if capture.is_trusted and capture.is_armed:
                self._passes.add(PassFrame(track, seam, pose.T_base_tool, calibration_mm2))
            weld = self._passes.weld_at(pose.T_base_tool, capture.look_ahead)
        return TrackedFrame(track, seam, FrameStep(shown, inputs, self.tracker.reading), took_ms, weld)


def seam_measurement(
    setup: Setup, track: Track, pose: Pose | None, calibration_variance_mm2: tuple[float, float]
) -> SeamMeasurement | None:
    """Return the seam that a track saw, placed by its pose; None where it saw none.

    Its sigma leaves out the calibration's error, which turns with the tool and is common to all frames;
    `calibration_variance_mm2` is that error's part in the variances of the track's (y, z).
    """
    if pose is None or not math.isfinite(track.seam_tool_mm[1]):
        return None
    seam_tool = np.array(track.seam_tool_mm)
    seam_base = transform(pose.T_base_tool, seam_tool)
    T_base_joint = seam_frame(setup.joint, seam_base)
    T_joint_tool = invert(T_base_joint) @ pose.T_base_tool
    station_mm, displacement = seam_displacement(setup, T_joint_tool, seam_tool)
    y_mm, z_mm = displacement.tolist()
    sigma_y_mm, sigma_z_mm = (
        math.sqrt(max(0.0, sigma_mm**2 - of_calibration))
        for sigma_mm, of_calibration in zip(
            (track.sigma_y_mm, track.sigma_z_mm), calibration_variance_mm2, strict=True
        )
    )
    (y_x, z_x), (y_y, z_y), (y_z, z_z) = T_base_joint[:3, 1:3].tolist()
    axes_base, lever_mm = ((y_x, y_y, y_z), (z_x, z_y, z_z)), math.hypot(*track.seam_tool_mm)
    return SeamMeasurement(station_mm, (y_mm, z_mm), (sigma_y_mm, sigma_z_mm), axes_base, lever_mm)
