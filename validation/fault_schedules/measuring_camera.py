"""A camera without a picture: it measures the seam at once, with noise, for thousands of runs."""

import math
from dataclasses import dataclass

import numpy as np

from arctrack.control.frame_tracking import Capture, TrackedFrame
from arctrack.control.innovation import SeamMeasurement
from arctrack.simulation.cell.cell import COMPUTED_S, Shown
from arctrack.simulation.cell.robot import Robot
from robot_io import PoseAt, PoseStatus
from tracker import flags
from tracker.seam.gaussian_process import SeamHistory
from tracker.state import Track


@dataclass
class MeasuringCamera:
    """Simulated sensor without images over a straight seam: its crossing, and the real seam filter.

    `aside_mm` is how far to the left the seam seems to lie.
    """

    robot: Robot
    rng: np.random.Generator
    aside_mm: float = 0.0

    def __post_init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """Forget all but what a search pass left: the stretch that the torch begins on."""
        history, world = SeamHistory(), self.robot.world
        start_mm = self.robot.station_mm
        for station_mm in np.arange(start_mm - 5.0, start_mm + world.look_ahead_mm, 1.5):
            seam_mm = np.array(world.seam_mm(float(station_mm))) + self.rng.normal(0.0, world.noise_mm, 2)
            history = history.with_measurement(float(station_mm), seam_mm, np.full(2, world.noise_mm**2))
        self._history = history

    def finish(self) -> None:
        """Do nothing: nothing is kept."""

    def look(self) -> Shown:
        """Return the stripe's crossing with the seam, (3,) mm, in the frame of the true tool."""
        world = self.robot.world
        station_mm = self.robot.station_mm + world.look_ahead_mm
        y_mm, z_mm = world.seam_mm(station_mm)
        x, y, z = world.start_base_mm
        seam_base_mm = np.array(
            [x + station_mm, y + y_mm + self.aside_mm, z + z_mm + world.ridge_mm(station_mm)]
        )
        seam_tool = world.R_seam_tool.T @ (seam_base_mm - self.robot.place_mm())
        return np.asarray(seam_tool + np.array([0.0, *self.rng.normal(0.0, world.noise_mm, 2)]))

    def track(self, shown: Shown, capture: Capture) -> TrackedFrame:
        """Take a measurement into the seam, and return the offset at the torch."""
        if capture.pose.status is PoseStatus.REFUSED:
            refused = Track(capture.index, capture.captured_s, flags.POSE_REFUSED.mask)
            return TrackedFrame(refused, took_ms=1000.0 * COMPUTED_S)
        if shown is None:
            return self._tracked(shown, capture, flags.JOINT_NOT_FOUND.mask, None)
        world, T_base_tool = self.robot.world, capture.pose.T_base_tool
        x, y, z = (T_base_tool[:3, :3] @ shown + T_base_tool[:3, 3]).tolist()
        place = world.path.place((x, y, z))
        displacement = (place.lateral_mm, place.height_mm - world.ridge_mm(place.station_mm))
        if capture.is_trusted:
            self._history = self._history.with_measurement(
                place.station_mm, np.array(displacement), np.full(2, world.noise_mm**2)
            )
        measured = SeamMeasurement(place.station_mm, displacement, (world.noise_mm, world.noise_mm))
        return self._tracked(shown, capture, 0, measured)

    def _tracked(
        self, shown: Shown, capture: Capture, flag_bits: int, measured: SeamMeasurement | None
    ) -> TrackedFrame:
        displacement, sigma = self._history.at(self._torch_mm(capture.pose) + capture.look_ahead.way_mm)
        y_mm, z_mm = displacement.tolist()
        sigma_y_mm, sigma_z_mm = sigma.tolist()
        noise_mm = self.robot.world.noise_mm
        within = 0.25 / math.sqrt(2.0)
        track = Track(
            capture.index,
            capture.captured_s,
            flag_bits,
            seam_tool_mm=(math.nan,) * 3 if shown is None else tuple(shown.tolist()),
            sigma_y_mm=noise_mm,
            sigma_z_mm=noise_mm,
            offset_y_mm=y_mm,
            offset_z_mm=z_mm,
            offset_sigma_y_mm=sigma_y_mm,
            offset_sigma_z_mm=sigma_z_mm,
            offset_confidence=math.erf(within / sigma_y_mm) * math.erf(within / sigma_z_mm),
            valid_at_s=capture.captured_s + capture.look_ahead.time_s,
        )
        return TrackedFrame(track, measured, took_ms=1000.0 * COMPUTED_S)

    def _torch_mm(self, pose: PoseAt) -> float:
        x, y, z = pose.T_base_tool[:3, 3].tolist()
        return self.robot.world.path.place((x, y, z)).station_mm
