"""The exposure of the frames to come, chosen from what the last ones show and what the arc map predicts."""

import math
from dataclasses import dataclass

import numpy as np

from arctrack.control.frame_tracking import FrameTracking
from noise_model.arc.map import arc_kernel
from noise_model.arc.scene import make_scene
from noise_model.compiled.arrays import Float64
from noise_model.plan.exposure import POLICY, better_exposure_s, expected_sigma_px, ladder_s
from tracker.observation import expected_output
from tracker.state import Frame, Track
from tracker.stripe.expected import expect_stripe
from tracker.stripe.read import arc_map_of

EVERY_S = 0.25
"""Period of the choice of an exposure, s: a robot at 10 mm/s goes 2.5 mm meanwhile."""


@dataclass(frozen=True)
class _TimedPose:
    """A pose, and when it was that of a frame, s."""

    at_s: float
    T_base_tool: Float64


class ExposureChooser:
    """Choice of the best exposure within `range_s` (least, largest), some times a second."""

    def __init__(self, range_s: tuple[float, float], frame_rate_hz: float) -> None:
        self._min_s = range_s[0]
        # A tenth of the period is for read-out.
        self._max_s = min(range_s[1], 0.9 / frame_rate_hz)
        self._chosen_at_s = self._read_at_s = -math.inf
        self._seen: _TimedPose | None = None

    def choose(
        self, tracking: FrameTracking, frame: Frame, track: Track, T_base_tool: Float64 | None
    ) -> float | None:
        """Take a frame that was tracked, and return the exposure to take from now on, s; None for no change.

        The background is that of the arc map at the pose to come, by the arc's level in this frame.
        """
        before, self._seen = self._seen, None
        if T_base_tool is None:
            return None
        self._seen = _TimedPose(frame.timestamp_s, T_base_tool)
        if track.stripe is not None:
            self._read_at_s = frame.timestamp_s
        # Where the stripe is lost, the setup's exposure is taken again.
        elif frame.laser_on and frame.timestamp_s - self._read_at_s > 1.0:
            return tracking.tracker.geometry.setup.camera.exposure_s
        if before is None or track.stripe is None or frame.timestamp_s - self._chosen_at_s < EVERY_S:
            return None
        self._chosen_at_s = frame.timestamp_s
        return self._better_s(tracking, frame, track, before, self._seen)

    def _better_s(
        self, tracking: FrameTracking, frame: Frame, track: Track, before: _TimedPose, now: _TimedPose
    ) -> float | None:
        geometry, reading, stripe = tracking.tracker.geometry, tracking.tracker.reading, track.stripe
        took_s = now.at_s - before.at_s
        if reading is None or stripe is None or not 0.0 < took_s < 1.0:
            return None
        level = reading.arc.level if reading.arc.is_on else 0.0
        velocity_mm_s = (now.T_base_tool[:3, 3] - before.T_base_tool[:3, 3]) / took_s
        T_to_come = now.T_base_tool.copy()
        T_to_come[:3, 3] += 0.5 * EVERY_S * velocity_mm_s
        scene = make_scene(geometry.setup, T_to_come, reading.seam)
        here, there = expect_stripe(geometry, reading.scene), expect_stripe(geometry, scene)
        if here is None or there is None or not math.isfinite(level):
            return None
        moved_px = there.position_px - here.position_px
        known = np.isfinite(stripe.position_px + moved_px) & (stripe.amplitude_e > 0.0)
        # Number of scan lines that represent all: a choice takes half a millisecond.
        lines = np.flatnonzero(known)[:: max(1, int(known.sum()) // 32)]
        # Least number of lines for a choice.
        if len(lines) < 8:
            return None
        place_px = np.clip(np.rint(stripe.position_px[lines] + moved_px[lines]), 0, geometry.n_pos - 1)
        kernel = arc_kernel(geometry.setup, scene, expected_output(geometry.setup, frame))
        light_e = arc_map_of(geometry, kernel).at(lines * geometry.n_pos + place_px.astype(np.int64))
        rungs_s = ladder_s(self._min_s, max(self._min_s, self._longest_s(velocity_mm_s)))
        sigma_px = expected_sigma_px(
            np.append(rungs_s, frame.exposure_s),
            stripe.amplitude_e[lines] / frame.exposure_s,
            there.sigma_px[lines],
            level * np.nan_to_num(light_e).astype(np.float64) / frame.exposure_s,
            geometry.setup.sensor,
            float(np.median(np.abs(moved_px[lines]))) / (0.5 * EVERY_S),
            POLICY.map_share,
        )
        chosen_s = better_exposure_s(frame.exposure_s, rungs_s, sigma_px)
        return None if chosen_s == frame.exposure_s else chosen_s

    def _longest_s(self, velocity_mm_s: Float64) -> float:
        speed_mm_s = float(np.linalg.norm(velocity_mm_s))
        # Largest travel of the tool during an exposure, mm: a frame shows the mean over it.
        return min(self._max_s, 0.5 / speed_mm_s) if speed_mm_s > 0.0 else self._max_s
