"""Grooves with a bevel on either side, V and U: plates, bevels and a root, whose middle is the seam point.

Of a narrow root gap and height are weighed and not picked, as the profile leaves them open.

Bevels are seen well, and with them where they would meet. The seam point lies above that by gap / (2 tan) of
a V: what the root's gap is moves it, and a narrow root shows in no line, for each that crosses it holds the
light of both bevels. So the groove is fitted from each gap of a grid, lines near the root left out, and the
answer is the fits' mean and covariance by their posterior probability (Hoeting et al. 1999, Statistical
Science 14, 382). A gap cannot be less than none: what the prior has below counts for the closed root.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Bool, Float64
from noise_model.compiled.kernel import kernel
from noise_model.compiled.median import median
from noise_model.surface.stated_joint import StatedJoint
from tracker.joint.common_mode import as_reported
from tracker.joint.measured import (
    LEFT_OUT,
    START_SIGMA_MM,
    SURE_MM,
    SURE_SIGMAS,
    MeasuredJoint,
    fit_points,
    opening_area,
    section_corners,
    shift_of,
    two_angles,
)
from tracker.joint.misfit import SeamEdge
from tracker.joint.section_fit import BISQUARE_WIDTH, ShapeFit
from tracker.joint.section_shapes import GROOVE, ROUND_GROOVE
from tracker.profile import Section
from tracker.state import BESIDE_PX, SIGMA_PX, Y_MM, Z_MM, JointShape

SEARCH_STEP_MM = 0.2
PRIOR_SIGMA = np.array([5.0, 5.0, 0.3, 0.04, 0.04, 0.3, 0.3, 0.03, 0.03])
"""1 sigma of y, z, gap, both tan(bevel), both depths (mm), both plate slopes: how far an edge may be off."""

ROUND_PRIOR_SIGMA = np.append(PRIOR_SIGMA, 0.2)
"""The same, and that of a rounding's radius, mm."""

GAP = 2
"""Index of the root's gap among the parameters."""

MUCH_LEFT_OUT, WIDER_MM = 0.2, 1.0
"""A fit that leaves out more of a groove's points may have lost a side: points so far off are let in anew."""

MIN_POINTS, MIN_ALONE = 5.0, 10.0
"""The weight of the points that must be seen on either side of a groove, and on one if it must do alone."""

END_SHARE = 0.25
"""The share of a bevel's width at either end whose points may be the root's or the plate's as well."""

NARROW_MM = 0.8
"""A root that comes out narrower than this is weighed."""

GAPS = np.array([0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.95, 1.1, 1.3, 1.5])
"""The gaps that are weighed, mm: none, and as wide as a narrow root may come out."""

EXACT_MM = 1e-4
"""1 sigma of a closed root's gap, mm. Another may move by half its cell of the grid."""

CELLS_MM = np.array([EXACT_MM, *(0.5 * np.diff(GAPS))])
"""1 sigma of the gap about each of GAPS, mm."""

CLOSED_AS_STATED = 0.95
"""Prior probability that a root that is stated closed is closed: tacked plates touch."""


def fit_groove(section: Section, stated: StatedJoint) -> MeasuredJoint | None:
    """Return the V or U that a section shows, None where too little of it lies within the bevels.

    It is a U where its roundings' radius is stated.
    """
    points, y_mm, half_mouth_mm = section.points, section.points[Y_MM], float(stated.corners_mm[-2, 0])
    shape, prior_sigma = GROOVE, PRIOR_SIGMA
    if not math.isnan(stated.radius_mm):
        shape, prior_sigma = ROUND_GROOVE, ROUND_PRIOR_SIGMA
    start = start_of(section, stated, len(prior_sigma))
    chosen = np.ones(len(y_mm), np.bool_)
    fit = fit_points(shape, points, chosen, START_SIGMA_MM, prior_sigma, start)
    if not math.isfinite(fit.chi2):
        return None
    shown = groove_coverage(fit, y_mm, half_mouth_mm)
    if shown.left_out > MUCH_LEFT_OUT:
        wider = fit_points(shape, points, chosen, WIDER_MM, prior_sigma, start)
        if math.isfinite(wider.chi2):
            shown_wider = groove_coverage(wider, y_mm, half_mouth_mm)
            if shown_wider.left_out < shown.left_out:
                fit, shown = wider, shown_wider
    if shape == GROOVE and min(shown.right_bevel, shown.left_bevel) > 0.0:
        clear = np.abs(y_mm - fit.parameters[0]) >= section.mixed_mm
        fit = weigh_root(shape, points, clear, start, prior_sigma, GAP, fit)
        shown = groove_coverage(fit, y_mm, half_mouth_mm)
    amid_mm = (1.0 - 2.0 * END_SHARE) * (half_mouth_mm - 0.5 * stated.gap_mm)
    # The share of a bevel's scan lines, but no more than so many points, without which it is not seen.
    enough = min(MIN_POINTS, 0.3 * amid_mm / section.column_mm)
    if min(shown.right_bevel, shown.left_bevel) < enough:
        is_left_hidden = shown.left_bevel < shown.right_bevel
        side, alone = (1.0, shown.right) if is_left_hidden else (-1.0, shown.left)
        if max(shown.right_bevel, shown.left_bevel) < enough or alone < MIN_ALONE:
            return None
        sure_mm = max(start[GAP] - SURE_SIGMAS * prior_sigma[GAP], 0.0)
        chosen = outside_hidden_bevel(
            side * (y_mm - fit.parameters[0]), fit.parameters, sure_mm, half_mouth_mm
        )
        fit = fit_points(shape, points, chosen, START_SIGMA_MM, prior_sigma, start)
        if not math.isfinite(fit.chi2):
            return None
    elif min(shown.right, shown.left) < MIN_POINTS:
        return None
    # On a side that is not seen its points are left out on purpose.
    measured = measured_groove(shape, fit)
    # The root is where the bevels say, or hidden.
    # What fills a root stands higher than its bevels say, and hardly to one side.
    return as_reported(section, measured, (SeamEdge(measured.y_mm, 0.03, 0.4, is_upright=False),))


class GrooveCoverage(NamedTuple):
    """Weights of a groove's points: of those within the mouth on either side, of those amid
    either bevel, and the share of all of them that it leaves out.
    """

    right: float
    left: float
    right_bevel: float
    left_bevel: float
    left_out: float


def start_of(section: Section, stated: StatedJoint, n_parameters: int) -> Float64:
    """Return the parameters (p,) of a stated groove where most of a section's points lie on it."""
    depth, tan = stated.depth_mm, stated.tan
    y_mm, z_mm = section.points[Y_MM], section.points[Z_MM]
    y_0, z_0 = shift_of(y_mm, z_mm, section.reach_mm, stated.corners_mm, depth, SEARCH_STEP_MM, 0.25 * depth)
    start = y_0, z_0, stated.gap_mm, tan, tan, depth, depth, 0.0, 0.0, stated.radius_mm
    return np.array(start[:n_parameters])


def groove_coverage(fit: ShapeFit, y_mm: Float64, half_mouth_mm: float) -> GrooveCoverage:
    """Return the coverage of a groove of a mouth by points (n,)."""
    middle_mm, _, gap_mm = fit.parameters[:3].tolist()
    return GrooveCoverage(
        *weights_within(y_mm, fit.weights, middle_mm, 0.5 * max(gap_mm, 0.0), half_mouth_mm)
    )


@kernel
def weights_within(
    y_mm: Float64, weights: Float64, middle_mm: float, half_gap_mm: float, half_mouth_mm: float
) -> tuple[float, float, float, float, float]:
    """Return the numbers of `GrooveCoverage` by points (n,) and their weights.

    Amid is without END_SHARE of the bevel's width at either end.
    """
    ends = END_SHARE * (half_mouth_mm - half_gap_mm)
    low, high = half_gap_mm + ends, half_mouth_mm - ends
    right, left, right_bevel, left_bevel, inside, out = 0.0, 0.0, 0.0, 0.0, 0, 0
    for i in range(y_mm.shape[0]):
        away = abs(y_mm[i] - middle_mm)
        if away >= half_mouth_mm:
            continue
        inside += 1
        out += weights[i] < LEFT_OUT
        amid = weights[i] if low < away < high else 0.0
        if y_mm[i] < middle_mm:
            right += weights[i]
            right_bevel += amid
        else:
            left += weights[i]
            left_bevel += amid
    return right, left, right_bevel, left_bevel, out / inside if inside else 1.0


def outside_hidden_bevel(out_mm: Float64, parameters: Float64, sure_mm: float, half_mouth_mm: float) -> Bool:
    """Return the points (n,), so far towards a bevel that is not seen, that count for a groove.

    Priors stand in for that, in the covariance too. Where the root ends there is not known: of the root only
    what lies well this side of it counts.
    """
    return np.asarray((out_mm + 0.5 * parameters[GAP] < sure_mm) | (out_mm > half_mouth_mm + SURE_MM))


def measured_groove(shape: int, fit: ShapeFit) -> MeasuredJoint:
    """Return the joint that a fitted groove is."""
    p, covariance = fit.parameters, fit.covariance
    bevels, bevel_sigmas = two_angles(p, covariance, 3, 4)
    plates, plate_sigmas = two_angles(p, covariance, 7, 8)
    area, area_sigma = opening_area(shape, p, covariance)
    joint_shape = JointShape(
        gap_sigma_mm=math.sqrt(covariance[2, 2]),
        mismatch_sigma_mm=math.sqrt(covariance[5, 5] + covariance[6, 6] - 2.0 * covariance[5, 6]),
        bevel_angles_deg=bevels,
        bevel_sigmas_deg=bevel_sigmas,
        plate_angles_deg=plates,
        plate_sigmas_deg=plate_sigmas,
        area_mm2=area,
        area_sigma_mm2=area_sigma,
    )
    return MeasuredJoint(
        y_mm=float(p[0]),
        z_mm=float(p[1]),
        covariance_mm2=covariance[:2, :2].copy(),
        gap_mm=max(float(p[GAP]), 0.0),
        mismatch_mm=float(p[5] - p[6]),
        chi2=fit.chi2,
        shape=joint_shape,
        corners_mm=section_corners(shape, p),
    )


def prior_of(stated_mm: float, sigma_mm: float) -> Float64:
    """Return the prior probability of each of GAPS for a stated gap and its 1 sigma, mm."""
    borders = [*(0.5 * (GAPS[1:] + GAPS[:-1])), math.inf]
    up_to = [0.5 * (1.0 + math.erf((b - stated_mm) / (math.sqrt(2.0) * sigma_mm))) for b in borders]
    prior = np.diff(up_to, prepend=0.0)
    if stated_mm == 0.0:
        prior[1:] *= (1.0 - CLOSED_AS_STATED) / prior[1:].sum()
        prior[0] = CLOSED_AS_STATED
    return prior


def weigh_root(
    shape: int, points: Float64, clear: Bool, start: Float64, prior_sigma: Float64, gap: int, fit: ShapeFit
) -> ShapeFit:
    """Return a groove's fit with its root weighed, or the fit as it is where the root is wide.

    `gap` is which parameter the root's gap is, `start` holds the stated one; `clear` (n,) are the points that
    hold light of one face. Where no gap of the grid can be fitted the fit stays too.
    """
    if not fit.parameters[gap] < NARROW_MM:
        return fit
    prior = prior_of(float(start[gap]), float(prior_sigma[gap]))
    parameters, covariances, weights, chi2, losses = fit_gaps(shape, points, clear, start, prior_sigma, gap)
    (held,) = np.nonzero(np.isfinite(chi2) & (prior > 0.0))
    if not len(held):
        return fit
    # Errors of neighbours go together: so many points say as much as one.
    common = median((points[BESIDE_PX, clear] / points[SIGMA_PX, clear]) ** 2) if clear.any() else 1.0
    moved = (parameters[held, gap] - GAPS[held]) / CELLS_MM[held]
    left_open = np.minimum(covariances[held, gap, gap] / CELLS_MM[held] ** 2, 1.0)
    nats = np.log(prior[held]) - losses[held] / common - 0.5 * moved**2 + 0.5 * np.log(left_open)
    mean, covariance = mixture_of(nats, parameters[held], covariances[held])
    likeliest = held[np.argmax(nats)]
    # What is left out next to the root was left out for the light that it mixes.
    weights = np.where(clear, weights[likeliest], fit.weights)
    return ShapeFit(mean, covariance, float(chi2[likeliest]), weights)


@kernel(allocates=True)
def fit_gaps(
    shape: int, points: Float64, clear: Bool, start: Float64, prior_sigma: Float64, gap: int
) -> tuple[Float64, Float64, Float64, Float64, Float64]:
    """Return a groove's fits from GAPS (k,): parameters, covariances, weights, chi2 and losses, nats."""
    k, m, n = GAPS.shape[0], prior_sigma.shape[0], clear.shape[0]
    parameters, covariances, weights = np.empty((k, m)), np.empty((k, m, m)), np.empty((k, n))
    chi2, losses = np.empty(k), np.zeros(k)
    for j in range(k):
        from_gap, sigma = start.copy(), prior_sigma.copy()
        from_gap[gap], sigma[gap] = GAPS[j], CELLS_MM[j]
        held = fit_points(shape, points, clear, START_SIGMA_MM, sigma, from_gap)
        chi2[j] = held.chi2
        for a in range(m):
            parameters[j, a] = held.parameters[a]
            for b in range(m):
                covariances[j, a, b] = held.covariance[a, b]
        for i in range(n):
            weights[j, i] = held.weights[i]
            if clear[i]:
                losses[j] += BISQUARE_WIDTH**2 / 6.0 * (1.0 - weights[j, i] * math.sqrt(weights[j, i]))
    return parameters, covariances, weights, chi2, losses


def mixture_of(nats: Float64, parameters: Float64, covariances: Float64) -> tuple[Float64, Float64]:
    """Return mean (m,) and covariance (m, m) of normals (k, m), (k, m, m) by their evidence (k,), nats."""
    shares = np.exp(nats - nats.max())
    shares /= shares.sum()
    mean = shares @ parameters
    off = parameters - mean
    return mean, np.tensordot(shares, covariances + off[:, :, None] * off[:, None, :], 1)
