"""Some frames of a recording as the tracker sees them, each by itself, with what is in their images."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from arctrack.check.bright_line import BrightLine, find_lines
from arctrack.check.stripe_seen import StripeMeasurement, stripe_seen
from arctrack.recording import Recording
from noise_model.arc.scene import make_scene
from noise_model.condition import Condition
from noise_model.forward import predict
from noise_model.setup import Setup
from noise_model.surface.joint import SeamLine
from tracker.geometry import SensorGeometry
from tracker.observation import Reading
from tracker.seam.locate import locate
from tracker.state import Frame, Pose, Track
from tracker.step import step
from tracker.stripe.expected import ExpectedStripe, expect_stripe
from tracker.stripe.read import Work
from tracker.tracker_state import TrackerMemory

MIN_LINE_SHARE = 0.5
"""A frame whose line is in fewer of the scan lines shows none."""

MAX_PIXELS = 200
"""Number of the stripe's pixels at which its light is predicted."""


@dataclass(frozen=True, eq=False)
class CheckedFrame:
    """A frame with the laser on: the tracker's view of it, and the bright line in its image.

    `expected` is the stripe at the nominal seam, `placed` that at the measured one, None where there is none;
    `seam_mm` how far that lies to the left of, and above, its nominal line; `peak_e` the stripe's predicted
    peak.
    """

    frame: Frame
    pose: Pose | None
    track: Track
    line: BrightLine
    seen: StripeMeasurement
    expected: ExpectedStripe | None = None
    placed: ExpectedStripe | None = None
    seam_mm: tuple[float, float] = (math.nan, math.nan)
    peak_e: float = math.nan

    @property
    def shows_line(self) -> bool:
        """True if most of the scan lines hold a bright line."""
        return self.line.share >= MIN_LINE_SHARE

    @property
    def course_px(self) -> float:
        """Median distance of the stripe that was read from the expected one; NaN if there is none."""
        if self.placed is None or self.track.stripe is None:
            return math.nan
        off = np.abs(self.track.stripe.position_px - self.placed.position_px - self.placed.bias_px)
        known = off[np.isfinite(off)]
        return float(np.median(known)) if len(known) else math.nan


def looks_at(
    recording: Recording,
    geometry: SensorGeometry,
    frames: Sequence[Frame],
    on_frame: Callable[[int], None] | None = None,
) -> list[CheckedFrame]:
    """Examine some frames of a recording; `on_frame` is called with the number done."""
    sensor = recording.setup.sensor
    lines = find_lines([frame.image_dn for frame in frames], sensor)
    poses, work = recording.pose_buffer(), Work.of(geometry)
    looks: list[CheckedFrame] = []
    for frame, line in zip(frames, lines, strict=True):
        pose = recording.pose_at(poses, frame.timestamp_s)
        state, track, reading = step(geometry, TrackerMemory(), frame, pose, work)
        seen = stripe_seen(frame.image_dn, sensor, line)
        look = CheckedFrame(frame, pose, track, line, seen)
        if pose is not None:
            look = _with_expected(recording.setup, geometry, look, pose, state, reading)
        looks.append(look)
        if on_frame is not None:
            on_frame(len(looks))
    return looks


def _with_expected(
    setup: Setup,
    geometry: SensorGeometry,
    look: CheckedFrame,
    pose: Pose,
    state: TrackerMemory,
    reading: Reading | None,
) -> CheckedFrame:
    """Return a look with what the setup expects at its pose, and at its seam where that was measured."""
    nominal_scene = make_scene(geometry.setup, pose.T_base_tool)
    if nominal_scene.below_surface:
        return look
    look = replace(look, expected=expect_stripe(geometry, nominal_scene))
    if reading is None or reading.joint is None:
        return look
    joint = reading.joint
    located = locate(geometry.seam_source, pose.T_base_tool, reading.scene, joint.y_mm, joint.z_mm)
    seam, _ = geometry.seam_source.line_at(state.history, located.segment, located.station_mm)
    placed = expect_stripe(geometry, make_scene(geometry.setup, pose.T_base_tool, seam))
    look = replace(look, placed=placed, seam_mm=located.displacement_mm)
    if placed is None:
        return look
    return replace(look, peak_e=_peak_e(setup, geometry, look.frame, pose, seam, placed))


def _peak_e(
    setup: Setup, geometry: SensorGeometry, frame: Frame, pose: Pose, seam: SeamLine, placed: ExpectedStripe
) -> float:
    """Return the stripe's predicted peak in a frame, of the median scan line."""
    n_pos = geometry.n_pos
    scan = np.flatnonzero(placed.shown & (placed.position_px > 0.0) & (placed.position_px < n_pos - 1.0))
    scan = scan[:: max(1, len(scan) // MAX_PIXELS)]
    if not len(scan):
        return math.nan
    points_px = geometry.image_points(scan.astype(np.float64), placed.position_px[scan])
    u, v = np.rint(points_px).astype(np.int64).T
    laser_alone = Condition(laser_level=1.0, arc_level=0.0, exposure_s=frame.exposure_s)
    pixels = v * setup.camera.width + u
    sharp_e = predict(setup, pose.T_base_tool, laser_alone, seam=seam, pixels=pixels).mean_e
    # Single pixels are predicted before the point-spread function, which widens the stripe.
    narrowed = np.sqrt(np.maximum(1.0 - (setup.camera.psf_sigma_px / placed.sigma_px[scan]) ** 2, 0.0))
    return float(np.median(narrowed * sharp_e))
