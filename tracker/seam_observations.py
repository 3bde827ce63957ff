"""Observations of the seam in the image, and their positions in space for a given setup.

A wrong camera, clock or plate displaces every observation, each by its own pose. So a fit of these includes
the seam: a seam that a wrong camera has bent is straight again with the right one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.effects import apply_setup_effects, pose_time_s
from noise_model.even_sample import evenly
from noise_model.setup import Setup
from noise_model.surface.joint import seam_frame
from noise_model.transforms import invert, transform
from tracker.geometry import to_laser_plane
from tracker.seam.locate import seam_displacement
from tracker.state import Frame, Pose
from tracker.tracker import Tracker

TRIANGULATION_EFFECTS = frozenset({"hand_eye", "surface_tilt", "lens_distortion", "pose_delay"})
"""The effects that change where an image point is triangulated."""


@dataclass(frozen=True, eq=False)
class SeamObservations:
    """The seam point of each frame that showed it.

    `image_px` (n, 2), taken at `timestamps_s` (n,), with the variances (n, 2) of its y and z, mm^2; `poses`
    (n) give the tool's (4, 4) for a time about the frame's.
    """

    image_px: Float64
    timestamps_s: Float64
    variances_mm2: Float64
    poses: tuple[Callable[[float], Float64], ...]

    @classmethod
    def of(
        cls, setup: Setup, frames: Sequence[Frame], poses: Sequence[Callable[[float], Float64]]
    ) -> SeamObservations:
        """Track a recording twice, so that its first frames too know where the seam is."""
        tracker, true = Tracker(setup), apply_setup_effects(setup)
        T_camera_tool = invert(true.camera.T_tool_camera)
        seen = []
        for is_last in (False, True):
            for frame, T_base_tool in zip(frames, poses, strict=True):
                if not frame.laser_on:
                    continue
                track = tracker.step(frame, Pose(T_base_tool(pose_time_s(setup, frame.timestamp_s))))
                if is_last and track.valid:
                    point = transform(T_camera_tool, np.array([track.seam_tool_mm]))
                    variance = tracker.state.history.variances_mm2[-1]
                    seen.append((true.camera.project(point)[0], frame.timestamp_s, variance, T_base_tool))
        if not seen:
            return cls(np.empty((0, 2)), np.empty(0), np.empty((0, 2)), ())
        image, timestamps, variances, pose_functions = zip(*seen, strict=True)
        return cls(np.array(image), np.array(timestamps), np.array(variances), pose_functions)

    def thinned(self, max_count: int) -> SeamObservations:
        """Return at most `max_count` of the observations, evenly chosen."""
        kept = evenly(len(self.image_px), max_count)
        poses = tuple(self.poses[i] for i in kept)
        return SeamObservations(self.image_px[kept], self.timestamps_s[kept], self.variances_mm2[kept], poses)

    def in_joint(self, setup: Setup) -> tuple[Float64, Float64]:
        """Return stations (n,) and displacements (n, 2) from the nominal line as y and z, mm, for a setup."""
        true = apply_setup_effects(setup)
        points_tool, _ = to_laser_plane(true, self.image_px)
        stations, displacements = np.empty(len(points_tool)), np.empty((len(points_tool), 2))
        for n, (point, time, pose) in enumerate(zip(points_tool, self.timestamps_s, self.poses, strict=True)):
            T_base_tool = pose(pose_time_s(true, float(time)))
            T_joint_tool = invert(seam_frame(true.joint, transform(T_base_tool, point))) @ T_base_tool
            stations[n], displacements[n] = seam_displacement(true, T_joint_tool, point)
        return stations, displacements
