"""Joint features: from a profile to the seam point, gap and mismatch, one file a shape.

`fit_joint` picks the shape by the setup's joint type.
"""

from __future__ import annotations

from noise_model.arrays import Float64
from noise_model.surface.joint import Joint
from tracker.joint.fillet import fit_fillet
from tracker.joint.groove import fit_u_groove, fit_v_groove
from tracker.joint.half_v import fit_half_v
from tracker.joint.lap import fit_lap
from tracker.joint.measured import MeasuredJoint
from tracker.joint.slot import fit_slot
from tracker.profile import Profile

__all__ = ["MeasuredJoint", "fit_joint"]


def fit_joint(profile: Profile, joint: Joint, camera_mm: Float64, laser_mm: Float64) -> MeasuredJoint | None:
    """Return the joint that a profile shows, or None where it does not determine one.

    `camera_mm` and `laser_mm` (3,), joint frame: what stands between them and a point hides it.
    """
    if len(profile.y_mm) < 20:
        return None
    match joint.type:
        case "v_groove":
            return fit_v_groove(profile, joint)
        case "u_groove":
            return fit_u_groove(profile, joint)
        case "half_v":
            return fit_half_v(profile, joint, camera_mm, laser_mm)
        case "fillet":
            return fit_fillet(profile, joint)
        case "butt" | "edge":
            return fit_slot(profile, joint)
        case "lap" | "corrugation":
            return fit_lap(profile, joint, camera_mm, laser_mm)
        case _:
            return None
