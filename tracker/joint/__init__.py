"""Joint features: from a profile to the seam point, gap and mismatch, one file a shape.

`fit_joint` picks the shape by the setup's joint type.
"""

from __future__ import annotations

from noise_model.frames import Float64
from noise_model.surface import Joint
from tracker.joint.lap import fit_lap
from tracker.joint.measured import MeasuredJoint
from tracker.joint.v_groove import fit_v_groove
from tracker.profile import Profile

__all__ = ["MeasuredJoint", "fit_joint"]


def fit_joint(profile: Profile, joint: Joint, camera_mm: Float64, laser_mm: Float64) -> MeasuredJoint | None:
    """Return the joint that a profile shows, or None where it does not determine one.

    `camera_mm` and `laser_mm` (3,), joint frame: what stands between them and a point hides it.
    """
    if len(profile.y_mm) < 20:
        return None
    if joint.type == "v_groove":
        return fit_v_groove(profile, joint)
    if joint.type in ("lap", "corrugation"):
        return fit_lap(profile, joint, camera_mm, laser_mm)
    return None
