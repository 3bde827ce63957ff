"""Joint features: from a profile to the seam point, gap and mismatch, one file a shape.

`fit_joint` picks the shape by the setup's joint type.
"""

from __future__ import annotations

import math

import numpy as np

from noise_model.arrays import Float64
from noise_model.kernel import kernel
from noise_model.median import finite_median, median_of, numbers_for
from noise_model.surface.joint import Joint
from tracker.joint.evidence import evidence_nats
from tracker.joint.fillet import fit_fillet
from tracker.joint.groove import fit_u_groove, fit_v_groove
from tracker.joint.half_v import fit_half_v
from tracker.joint.image_line import ImageLine
from tracker.joint.lap import fit_lap
from tracker.joint.measured import MeasuredJoint
from tracker.joint.slot import fit_closed_slot, fit_slot
from tracker.profile import MIN_POINTS, Profile

ALIKE_OFF_PX = 0.01
"""By how much all centres of a stripe may be off alike, px: its bell is none, and pixels are not all alike.

`benchmarks/stripe_bias.py` shows it; no number of lines averages it out.
"""

BIAS_SHARE, NEAR_MM = 0.25, 3.0
"""The share of the centres' correction near the seam by which it may be off, alike on all lines.

It goes with the metal's reflectance as the setup states it. On steep flanks of a corrugation it is over 1 px,
and a ray caster's frames there show it to be off by a tenth to a fifth.
"""

HIDING_TYPES = frozenset({"half_v", "lap", "corrugation"})
"""Their upright side may hide a strip of what lies behind it."""

_NOWHERE = np.full(3, math.nan)

__all__ = ["HIDING_TYPES", "MeasuredJoint", "fit_closed_joint", "fit_joint"]


def fit_joint(
    profile: Profile, joint: Joint, camera_mm: Float64 = _NOWHERE, laser_mm: Float64 = _NOWHERE
) -> MeasuredJoint | None:
    """Return the joint that a profile shows, or None where it does not determine one.

    `camera_mm` and `laser_mm` (3,), joint frame: what stands between them and a point hides it. Only
    HIDING_TYPES ask for them.
    """
    if len(profile.y_mm) < MIN_POINTS:
        return None
    measured = _fit(profile, joint, camera_mm, laser_mm)
    if measured is None:
        return None
    nats = measured.evidence_nats
    if math.isnan(nats):
        nats = evidence_nats(profile, measured.corners_mm)
    return measured._replace(covariance_mm2=_with_alike(profile, measured), evidence_nats=nats)


def fit_closed_joint(profile: Profile, joint: Joint, line: ImageLine) -> MeasuredJoint | None:
    """Return the closed joint that a line in the image shows amid a profile, or None without two plates."""
    measured = fit_closed_slot(profile, joint, line)
    return None if measured is None else measured._replace(covariance_mm2=_with_alike(profile, measured))


def _with_alike(profile: Profile, measured: MeasuredJoint) -> Float64:
    """Return a joint's covariance (2, 2) with what all centres of its stripe may be off alike."""
    bias_px = np.empty(0) if profile.bias_px is None else profile.bias_px
    covariance_mm2: Float64 = with_alike(
        profile.y_mm, profile.dy_mm, profile.dz_mm, bias_px, measured.y_mm, measured.covariance_mm2
    )
    return covariance_mm2


@kernel(allocates=True)
def with_alike(
    y_mm: Float64, dy_mm: Float64, dz_mm: Float64, bias_px: Float64, seam_mm: float, covariance_mm2: Float64
) -> Float64:
    """Return a joint's covariance (2, 2) with what all points of its profile (n,) may be off alike."""
    off = off_alike_mm(y_mm, dy_mm, dz_mm, bias_px, seam_mm)
    together = covariance_mm2.copy()
    for i in range(2):
        for j in range(2):
            together[i, j] += off[i] * off[j]
    return together


@kernel(allocates=True)
def off_alike_mm(
    y_mm: Float64, dy_mm: Float64, dz_mm: Float64, bias_px: Float64, seam_mm: float
) -> tuple[float, float]:
    """Return the (y, z), mm, that all points of a profile (n,) may be off alike.

    `bias_px` (n,), or none, is by how much their centres were corrected.
    """
    n = y_mm.shape[0]
    room, count = np.empty(numbers_for(n), np.float32), 0
    off_px = ALIKE_OFF_PX
    for i in range(bias_px.shape[0]):
        if abs(y_mm[i] - seam_mm) < NEAR_MM:
            room[count] = abs(bias_px[i])
            count += 1
    if count > 0:
        off_px = math.hypot(off_px, BIAS_SHARE * median_of(room, count))
    return off_px * finite_median(dy_mm, room), off_px * finite_median(dz_mm, room)


def _fit(profile: Profile, joint: Joint, camera_mm: Float64, laser_mm: Float64) -> MeasuredJoint | None:
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
