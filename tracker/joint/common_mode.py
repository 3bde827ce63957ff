"""Common-mode error of a stripe's centres, and the joint as it is reported, with it and its evidence."""

from __future__ import annotations

import math

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.compiled.kernel import kernel
from noise_model.compiled.median import finite_median, median_of, numbers_for
from tracker.joint.evidence import MIN_EVIDENCE_NATS, section_evidence_nats
from tracker.joint.measured import MeasuredJoint
from tracker.joint.misfit import SeamEdge, find_misfit
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


def as_reported(
    section: Section, joint: MeasuredJoint, edges: tuple[SeamEdge, ...] = (), shown: Section | None = None
) -> MeasuredJoint:
    """Return a joint with the common-mode error, its misfit, and its evidence where it has none of its own.

    `edges` place it, where they are upright. Its faces are `shown` in a part of the section alone.
    """
    points, nats = section.points, joint.evidence_nats
    if math.isnan(nats):
        nats = section_evidence_nats(points, joint.corners_mm, section.reach_mm)
    off_y, off_z = common_mode_mm(points, joint.y_mm)
    covariance_mm2 = joint.covariance_mm2 + np.array(
        [[off_y * off_y, off_y * off_z], [off_y * off_z, off_z * off_z]]
    )
    shape, misfit_nats, covered_mm = joint.shape, -math.inf, 0.0
    # Without an edge, another surface at the seam moves nothing.
    for edge in edges or (SeamEdge(joint.y_mm, 0.0, is_upright=False),):
        misfit = find_misfit(section if shown is None else shown, joint.corners_mm, edge.y_mm)
        misfit_nats = max(misfit_nats, misfit.nats)
        if edge.is_upright and misfit.nats > MIN_EVIDENCE_NATS:
            covered_mm = max(covered_mm, misfit.reach_mm)
        # The edge is anywhere within the reach on either side, as probably as there is another surface.
        probability = 1.0 / (1.0 + math.exp(MIN_EVIDENCE_NATS - misfit.nats))
        sigma_mm = misfit.reach_mm * math.sqrt(probability / 3.0)
        moved_mm = sigma_mm * np.array([edge.by_y, edge.by_z])
        covariance_mm2 += np.outer(moved_mm, moved_mm)
        shape = shape._replace(gap_sigma_mm=math.hypot(shape.gap_sigma_mm, edge.by_gap * sigma_mm))
    return joint._replace(
        covariance_mm2=covariance_mm2,
        shape=shape,
        evidence_nats=nats,
        misfit_nats=misfit_nats,
        covered_mm=covered_mm,
    )


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
