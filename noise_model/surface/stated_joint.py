"""Dimensions of a setup's joint for the kernels."""

from __future__ import annotations

import math
from typing import NamedTuple

from noise_model.compiled.arrays import Float64
from noise_model.surface.joint import Joint, section


class StatedJoint(NamedTuple):
    """Stated dimensions of a joint, NaN where its type has none.

    `corners_mm` (n, 2) are those of its section, its seam point at y = 0. `tan` is that of a bevel's angle
    from upright, or of half the angle between a fillet's plates; `gap_mm` is a groove's at its root;
    `radius_mm` that of a U's roundings. Of two sheets side by side `is_edge` tells upright ones from plates.
    """

    corners_mm: Float64
    gap_mm: float
    depth_mm: float
    thickness_mm: float
    tan: float
    radius_mm: float
    is_edge: bool

    @classmethod
    def of(cls, joint: Joint) -> StatedJoint:
        """Return a joint as it is stated."""
        size = joint.dimensions
        angle_deg = size.get("bevel_angle_deg", 0.5 * size.get("included_angle_deg", math.nan))
        if joint.type == "outside_corner":
            # The angle that the plates enclose on the torch's side.
            angle_deg = 180.0 - angle_deg
        return cls(
            section(joint).vertices,
            float(size.get("root_gap_mm", size.get("gap_mm", math.nan))),
            float(size.get("depth_mm", math.nan)),
            float(size.get("thickness_mm", math.nan)),
            math.tan(math.radians(angle_deg)),
            float(size.get("root_radius_mm", math.nan)),
            joint.type == "edge",
        )
