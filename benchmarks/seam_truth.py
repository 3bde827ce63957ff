"""The true seam of a scene that a benchmark draws."""

from __future__ import annotations

import numpy as np

from noise_model.arc.scene import Scene
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from noise_model.surface.joint import seam_height_mm
from tracker.seam.locate import SeamSource, seam_point


def seam_in_tool(setup: Setup, scene: Scene) -> Float64:
    """Return the seam point (3,) under the laser sheet, tool frame, mm."""
    T_joint_tool, height_mm = scene.T_joint_tool.tolist(), seam_height_mm(setup.joint)
    return np.array(seam_point(SeamSource.of(setup), T_joint_tool, scene.shape.corrugation, 0.0, height_mm))
