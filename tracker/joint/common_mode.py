"""Common-mode error of a stripe's centres, and the joint as it is reported, with it and its evidence."""

from __future__ import annotations

import math

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.compiled.kernel import kernel
from noise_model.compiled.median import finite_median, median_of, numbers_for
from tracker.joint.evidence import section_evidence_nats
from tracker.joint.measured import MeasuredJoint
from tracker.profile import Section
from tracker.state import BIAS_PX, DY_MM, DZ_MM, Y_MM

COMMON_MODE_PX = 0.01
"""Common-mode error of the stripe centres, px (non-Gaussian profile, pixel response).

`benchmarks/stripe_bias.py` shows it; no number of lines averages it out.
"""

BIAS_SHARE, NEAR_MM = 0.25, 3.0
"""The share of the centres' correction near the seam by which all lines may be off in common.

It goes with the metal's reflectance as the setup states it. On steep flanks of a corrugation it is over 1 px,
and a ray caster's frames there show it to be off by a tenth to a fifth.
"""


def as_reported(section: Section, joint: MeasuredJoint) -> MeasuredJoint:
    """Return a joint with the common-mode error, and with its evidence where it has none of its own yet."""
    points, nats = section.points, joint.evidence_nats
    if math.isnan(nats):
        nats = section_evidence_nats(points, joint.corners_mm, section.reach_mm)
    off_y, off_z = common_mode_mm(points, joint.y_mm)
    covariance_mm2 = joint.covariance_mm2 + np.array(
        [[off_y * off_y, off_y * off_z], [off_y * off_z, off_z * off_z]]
    )
    return joint._replace(covariance_mm2=covariance_mm2, evidence_nats=nats)


@kernel(allocates=True)
def common_mode_mm(points: Float64, seam_mm: float) -> tuple[float, float]:
    """Return the (y, z), mm, that all points of a section may be off in common."""
    n = points.shape[1]
    room, count = np.empty(numbers_for(n), np.float32), 0
    off_px = COMMON_MODE_PX
    for i in range(n):
        if abs(points[Y_MM, i] - seam_mm) < NEAR_MM:
            room[count] = abs(points[BIAS_PX, i])
            count += 1
    if count > 0:
        off_px = math.hypot(off_px, BIAS_SHARE * median_of(room, count))
    return off_px * finite_median(points[DY_MM], room), off_px * finite_median(points[DZ_MM], room)
