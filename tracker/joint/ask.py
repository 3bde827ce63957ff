"""What is asked of a joint that was fitted: whether it is one, and whether the section is the joint's."""

from __future__ import annotations

import math

from noise_model.arrays import Float64
from noise_model.kernel import kernel
from tracker import checks
from tracker.checks import Asked, ask, ask_whether
from tracker.joint.evidence import MIN_EVIDENCE_NATS
from tracker.joint.measured import MeasuredJoint, undetermined

JOINT_CHI2_LIMIT = 9.0
UNEXPLAINED_LIMIT = 0.1
"""So large a share of the points near the seam may lie off the joint's shape: spatter, a tack weld's end."""

MIN_MARGIN_MM = 1.0
"""A seam nearer to the profile's end than this is out of view."""


@kernel(allocates=True)
def ask_joint(asked: Asked, joint: MeasuredJoint, y_mm: Float64) -> tuple[MeasuredJoint, float]:
    """Ask whether a joint that was fitted to points (n,) counts.

    Returned are the joint, undetermined if it does not, and its margin in the view, mm, NaN for none.
    """
    is_seen = ask_whether(asked, checks.JOINT_SEEN, not math.isnan(joint.y_mm))
    if not is_seen or not ask(asked, checks.JOINT_EVIDENCE, joint.evidence_nats, MIN_EVIDENCE_NATS):
        return undetermined(), math.nan
    margin_mm = min(joint.y_mm - y_mm[0], y_mm[-1] - joint.y_mm)
    if not ask(asked, checks.VIEW_MARGIN, margin_mm, MIN_MARGIN_MM):
        return undetermined(), margin_mm
    ask(asked, checks.JOINT_CHI2, joint.chi2, JOINT_CHI2_LIMIT)
    ask(asked, checks.JOINT_UNEXPLAINED, joint.unexplained, UNEXPLAINED_LIMIT)
    return joint, margin_mm
