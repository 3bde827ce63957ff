"""Fitness of a part to be welded: of its joint before the arc, and of the stretches without one."""

import math
from dataclasses import dataclass, replace

import numpy as np

from arctrack.control.job import Bridging, Job, PartLimits
from noise_model.compiled.arrays import Float64
from noise_model.transforms import transform
from robot_io import Fault
from tracker.state import JointShape, Track

FAULTS = {
    "gap_mm": Fault.GAP,
    "mismatch_mm": Fault.MISMATCH,
    "depth_mm": Fault.DEPTH,
    "angle_deg": Fault.ANGLE,
}
"""Fault of a part by the required quantity."""


@dataclass(frozen=True)
class PartCheck:
    """Result of the frames of a part before the arc; a new one has none.

    `passed` says that the part was measured and is as required; `fault` is why it is refused, or NONE.
    """

    passed: bool = False
    fault: Fault = Fault.NONE
    latest: Fault = Fault.NONE
    looks: int = 0

    def seen(self, track: Track, limits: PartLimits) -> "PartCheck":
        """Return the state after a frame before the arc; one without a seam changes nothing.

        A required value that is not known is out of its range.
        """
        if not track.valid or not limits.required:
            return self
        latest = fault_of(track, limits)
        looks = self.looks + 1 if latest is self.latest else 1
        state = replace(self, latest=latest, looks=looks)
        if looks < limits.looks:
            return state
        return replace(state, passed=latest is Fault.NONE, fault=latest)


@dataclass(frozen=True)
class Bridge:
    """Distance that the sensor has gone along the seam since it last saw the joint."""

    seen_at_mm: float = math.nan
    bridged_mm: float = 0.0

    def seen(self, track: Track, T_base_tool: Float64, bridging: Bridging) -> "Bridge":
        """Return the state after a frame from a pose (4, 4), mm."""
        ahead_base = transform(T_base_tool, np.array(bridging.ahead_tool_mm))
        x_mm, y_mm, z_mm = ahead_base.tolist()
        station_mm = bridging.path.place((x_mm, y_mm, z_mm)).station_mm
        is_on_seam = 0.0 <= station_mm <= bridging.path.length_mm
        if track.valid or not is_on_seam or math.isnan(self.seen_at_mm):
            return Bridge(station_mm if is_on_seam else math.nan)
        return Bridge(self.seen_at_mm, station_mm - self.seen_at_mm)


class PartWatch:
    """Watch of a seam's frames for whether its part is fit to be welded."""

    def __init__(self) -> None:
        self._check, self._bridge = PartCheck(), Bridge()

    def begin(self) -> None:
        """Forget what was seen: the next seam may be another part's."""
        self._check, self._bridge = PartCheck(), Bridge()

    def is_fit(self, job: Job) -> bool:
        """Return True if all that a job requires before the arc was measured and is in range."""
        return self._check.passed or not job.part.required

    def look(self, track: Track, T_base_tool: Float64 | None, job: Job, is_arc_off: bool) -> Fault:
        """Take a frame of an armed tracker, and return what the part is refused for; NONE if nothing.

        `T_base_tool` (4, 4) is the pose at the capture, mm; without one no distance along the seam is known.
        """
        if is_arc_off:
            self._check = self._check.seen(track, job.part)
        if job.bridging is not None and T_base_tool is not None:
            self._bridge = self._bridge.seen(track, T_base_tool, job.bridging)
            if self._bridge.bridged_mm > job.bridging.max_mm:
                return Fault.BRIDGED_TOO_FAR
        return self._check.fault


def opening_deg(shape: JointShape) -> float:
    """Return the angle between a groove's faces, or between a joint's plates, degrees; NaN if unknown."""
    bevels_deg = _bevels_deg(shape)
    if bevels_deg:
        return sum(bevels_deg)
    # Both are positive where a plate rises to the left: two level plates make 180 degrees.
    left_deg, right_deg = shape.plate_angles_deg
    return 180.0 - (left_deg - right_deg)


def depth_mm(track: Track) -> float:
    """Return the depth of a groove with a sharp root, mm; NaN if unknown.

    The opening of a groove of depth d, gap g and bevels l and r is A = g d + d^2 (tan l + tan r) / 2.
    """
    area_mm2, gap_mm = track.shape.area_mm2, track.gap_mm
    slopes = sum(math.tan(math.radians(angle_deg)) for angle_deg in _bevels_deg(track.shape))
    if not (slopes > 0.0 and area_mm2 >= 0.0 and gap_mm >= 0.0):
        return math.nan
    return (math.sqrt(gap_mm**2 + 2.0 * area_mm2 * slopes) - gap_mm) / slopes


def _bevels_deg(shape: JointShape) -> list[float]:
    """Return the bevels of the sides that have one, degrees."""
    return [angle_deg for angle_deg in shape.bevel_angles_deg if math.isfinite(angle_deg)]


def fault_of(track: Track, limits: PartLimits) -> Fault:
    """Return what a part is refused for by one frame; a required value that is not known is out of range."""
    measured = {
        "gap_mm": track.gap_mm,
        "mismatch_mm": track.mismatch_mm,
        "depth_mm": depth_mm(track),
        "angle_deg": opening_deg(track.shape),
    }
    for name, value in measured.items():
        required = getattr(limits, name)
        # Written so that a NaN fails.
        if required is not None and not required[0] <= value <= required[1]:
            return FAULTS[name]
    return Fault.NONE
