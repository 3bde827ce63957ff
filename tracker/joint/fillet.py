"""The fillet, inside or outside corner: two plates that meet in the seam point, or one a gap off the other.

The seam point is where the plates' faces meet. Where one plate's foot stands off the other, as in a T-joint
with a gap, the other plate is seen below that foot too: from the corner to the foot its points lie on the one
plate's line where the other's was expected. How far is told by the likelihood of the points for each place
of the foot, on either side, against no gap.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Bool, Float64
from noise_model.surface.stated_joint import StatedJoint
from tracker.joint.common_mode import as_reported
from tracker.joint.evidence import MIN_EVIDENCE_NATS
from tracker.joint.measured import (
    START_SIGMA_MM,
    MeasuredJoint,
    fit_points,
    shift_of,
    two_angles,
)
from tracker.joint.section_fit import BISQUARE_WIDTH, SIGMA_FLOOR_PX, ShapeFit
from tracker.joint.section_shapes import CORNER, FAR_MM
from tracker.profile import Section
from tracker.state import BESIDE_PX, DY_MM, DZ_MM, N_LINES, SIGMA_PX, Y_MM, Z_MM, JointShape

SEARCH_STEP_MM = 0.2
SEARCH_LIMIT_MM = 1.0

MIN_POINTS = 10.0
"""The weight of the points that must be seen of either plate."""

MAX_GAP_MM = 6.0
"""The farthest place of a foot, mm from the corner in y: a wider gap is no joint to be welded."""


class Foot(NamedTuple):
    """Place of the foot of a plate over the other: y off the corner, mm, negative for the right plate's.

    `nats` is the evidence of a gap over none at all.
    """

    y_mm: float
    sigma_mm: float
    nats: float


def fit_fillet(section: Section, stated: StatedJoint) -> MeasuredJoint | None:
    """Return the corner that a section shows, None where it does not show both plates."""
    points, y_mm = section.points, section.points[Y_MM]
    y_0, z_0 = shift_of(
        y_mm, points[Z_MM], section.reach_mm, stated.corners_mm, 0.0, SEARCH_STEP_MM, SEARCH_LIMIT_MM
    )
    slope = 1.0 / stated.tan
    # 1 sigma of a plate's rotation from where it is stated.
    plate_sigma = math.radians(2.0) * (1.0 + slope**2)
    start, prior_sigma = np.array([y_0, z_0, slope, -slope]), np.array([5.0, 5.0, plate_sigma, plate_sigma])
    chosen = np.ones(len(y_mm), np.bool_)
    fit = fit_points(CORNER, points, chosen, START_SIGMA_MM, prior_sigma, start)
    if not math.isfinite(fit.chi2):
        return None
    foot = find_foot(points, fit) if slope > 0.0 else None
    # A gap that is stated needs no more evidence than none.
    if foot is not None and foot.nats > (0.0 if stated.gap_mm > 0.0 else MIN_EVIDENCE_NATS):
        chosen = outside_gap(y_mm, fit.parameters[0], foot)
        fit = fit_points(CORNER, points, chosen, START_SIGMA_MM, prior_sigma, fit.parameters)
        if not math.isfinite(fit.chi2):
            return None
        foot = find_foot(points, fit)
    elif math.isnan(stated.gap_mm):
        foot = None
    p, covariance, weights = fit.parameters, fit.covariance, fit.weights
    is_left = y_mm > p[0]
    turned = max(abs(p[2] - start[2]), abs(p[3] - start[3])) / plate_sigma
    # Plates that are turned by more are not this corner's.
    if turned > 5.0 or min(weights[is_left].sum(), weights[~is_left].sum()) < MIN_POINTS:
        return None
    plates, plate_sigmas = two_angles(p, covariance, 2, 3)
    gap_mm, gap_sigma_mm = (math.nan, math.nan) if foot is None else gap_of(p, foot)
    measured = MeasuredJoint(
        y_mm=float(p[0]),
        z_mm=float(p[1]),
        covariance_mm2=covariance[:2, :2].copy(),
        gap_mm=gap_mm,
        mismatch_mm=math.nan,
        chi2=fit.chi2,
        shape=JointShape(gap_sigma_mm=gap_sigma_mm, plate_angles_deg=plates, plate_sigmas_deg=plate_sigmas),
        corners_mm=corners_with_foot(p, foot),
    )
    return as_reported(section, measured)


def find_foot(points: Float64, fit: ShapeFit) -> Foot:
    """Return the foot that points tell, y rising: its mean place if there is a gap, and the evidence of that.

    Each point from the corner to a foot counts for the one plate's line and not the other's, by Tukey's loss.
    Before any is seen, a gap is as likely as none, and its foot is anywhere to MAX_GAP_MM on either side.
    """
    y, z, left_slope, right_slope = fit.parameters
    off_mm = points[Y_MM] - y
    # Errors of neighbours go together: by so much less a run of points tells than each alone would.
    common = max(1.0, float(np.median((points[BESIDE_PX] / points[SIGMA_PX]) ** 2)), fit.chi2)
    sigma_px = math.sqrt(common) * np.hypot(points[SIGMA_PX], SIGMA_FLOOR_PX / np.sqrt(points[N_LINES]))
    losses = []
    for slope in (left_slope, right_slope):
        unit_mm = np.abs(points[DZ_MM] - slope * points[DY_MM]) * sigma_px
        t = (points[Z_MM] - z - slope * off_mm) / unit_mm / BISQUARE_WIDTH
        losses.append(BISQUARE_WIDTH**2 / 6.0 * (1.0 - np.maximum(1.0 - t * t, 0.0) ** 3))
    gain = losses[1] - losses[0]
    places, widths, nats = [], [], []
    for side in (1.0, -1.0):
        (on_side,) = np.nonzero((side * off_mm > 0.0) & (side * off_mm < MAX_GAP_MM))
        on_side = on_side[np.argsort(side * off_mm[on_side], kind="stable")]
        ends = np.array([*np.abs(off_mm[on_side]), MAX_GAP_MM])
        # Beyond the corner the left is the right plate's if its own foot hangs there.
        nats.append(np.cumsum(-side * gain[on_side]))
        places.append(side * 0.5 * (ends[1:] + ends[:-1]))
        widths.append(ends[1:] - ends[:-1])
    place, width, evidence = np.concatenate(places), np.concatenate(widths), np.concatenate(nats)
    if not len(place):
        return Foot(0.0, math.nan, -math.inf)
    most = float(evidence.max())
    weights = np.exp(evidence - most) * width
    total = float(weights.sum())
    if total == 0.0:
        return Foot(0.0, math.nan, -math.inf)
    mean = float(weights @ place) / total
    variance = float(weights @ ((place - mean) ** 2 + width**2 / 12.0)) / total
    return Foot(mean, math.sqrt(variance), most + math.log(total / (2.0 * MAX_GAP_MM)))


def outside_gap(y_mm: Float64, corner_mm: float, foot: Foot) -> Bool:
    """Return the points (n,) that do not lie between the corner and a foot."""
    off_mm = math.copysign(1.0, foot.y_mm) * (y_mm - corner_mm)
    return np.asarray((off_mm < 0.0) | (off_mm > abs(foot.y_mm)))


def gap_of(p: Float64, foot: Foot) -> tuple[float, float]:
    """Return how far a foot stands off the other plate at a corner's parameters, mm, and its 1 sigma."""
    off_slope = abs(p[2] - p[3]) / math.hypot(1.0, p[3] if foot.y_mm > 0.0 else p[2])
    return float(off_slope * abs(foot.y_mm)), float(off_slope * foot.sigma_mm)


def corners_with_foot(p: Float64, foot: Foot | None) -> Float64:
    """Return a corner's section (n, 2) as (y, z), mm, at its parameters, with a foot if there is one."""
    (y, z, left, right), foot_mm = p.tolist(), 0.0 if foot is None else foot.y_mm
    ends = (y - FAR_MM, z - right * FAR_MM), (y + FAR_MM, z + left * FAR_MM)
    on_left, on_right = (y + foot_mm, z + left * foot_mm), (y + foot_mm, z + right * foot_mm)
    inner = [on_right, on_left] if foot_mm != 0.0 else [(y, z)]
    return np.array([ends[0], *inner, ends[1]])
