"""A joint as it is reported: told from a plate, and with what all centres of its stripe may be off alike."""

from __future__ import annotations

import math

import numpy as np

from noise_model.arrays import Float64
from noise_model.kernel import kernel
from noise_model.median import finite_median, median_of, numbers_for
from tracker.joint.evidence import section_evidence_nats
from tracker.joint.measured import MeasuredJoint
from tracker.profile import Section
from tracker.state import BIAS_PX, DY_MM, DZ_MM, Y_MM

ALIKE_OFF_PX = 0.01
"""By how much all centres of a stripe may be off alike, px: its bell is none, and pixels are not all alike.

`benchmarks/stripe_bias.py` shows it; no number of lines averages it out.
"""

BIAS_SHARE, NEAR_MM = 0.25, 3.0
"""The share of the centres' correction near the seam by which it may be off, alike on all lines.

It goes with the metal's reflectance as the setup states it. On steep flanks of a corrugation it is over 1 px,
and a ray caster's frames there show it to be off by a tenth to a fifth.
"""


@kernel(allocates=True)
def completed(section: Section, measured: MeasuredJoint) -> MeasuredJoint:
    """Return a joint that a section shows, with its evidence where it has none of its own yet."""
    points, nats = section.points, measured.evidence_nats
    if math.isnan(nats):
        nats = section_evidence_nats(points, measured.corners_mm, section.reach_mm)
    return MeasuredJoint(
        y_mm=measured.y_mm,
        z_mm=measured.z_mm,
        covariance_mm2=with_alike(points, measured.y_mm, measured.covariance_mm2),
        gap_mm=measured.gap_mm,
        mismatch_mm=measured.mismatch_mm,
        chi2=measured.chi2,
        shape=measured.shape,
        unexplained=measured.unexplained,
        corners_mm=measured.corners_mm,
        evidence_nats=nats,
    )


@kernel(allocates=True)
def with_alike(points: Float64, seam_mm: float, covariance_mm2: Float64) -> Float64:
    """Return a joint's covariance (2, 2) with what all points of its section may be off alike."""
    off = off_alike_mm(points, seam_mm)
    together = covariance_mm2.copy()
    for i in range(2):
        for j in range(2):
            together[i, j] += off[i] * off[j]
    return together


@kernel(allocates=True)
def off_alike_mm(points: Float64, seam_mm: float) -> tuple[float, float]:
    """Return the (y, z), mm, that all points of a section may be off alike."""
    n = points.shape[1]
    room, count = np.empty(numbers_for(n), np.float32), 0
    off_px = ALIKE_OFF_PX
    for i in range(n):
        if abs(points[Y_MM, i] - seam_mm) < NEAR_MM:
            room[count] = abs(points[BIAS_PX, i])
            count += 1
    if count > 0:
        off_px = math.hypot(off_px, BIAS_SHARE * median_of(room, count))
    return off_px * finite_median(points[DY_MM], room), off_px * finite_median(points[DZ_MM], room)
