"""The free section: a taught polyline, moved and turned onto the points by their likelihood.

A section of any shape is refused where it does not say where it lies: where it explains the points about as
well at another place, as a straight piece does, or where its 1 sigma across is large.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Bool, Float64
from noise_model.robust import MAD_SIGMA
from noise_model.surface.stated_joint import StatedJoint
from tracker.joint.common_mode import as_reported
from tracker.joint.measured import LEFT_OUT, START_SIGMA_MM, MeasuredJoint, section_at, shift_of
from tracker.joint.section_fit import (
    BISQUARE_WIDTH,
    CONVERGED,
    MAX_STEPS,
    MIN_ALONG_MM,
    SIGMA_FLOOR_PX,
    best_shift,
)
from tracker.profile import MIN_POINTS, Section
from tracker.state import BESIDE_PX, DY_MM, DZ_MM, N_LINES, SIGMA_PX, Y_MM, Z_MM

SEARCH_STEP_MM, SEARCH_LIMIT_MM = 0.2, 1.0

PRIOR_SIGMA = np.array([5.0, 5.0, math.radians(2.0)])
"""1 sigma of the section's place (y, z), mm, and of its turn, rad, from where it is sought."""

KNOWN = np.diag(1.0 / PRIOR_SIGMA**2)
"""The information that the prior has."""

APART_MM = 1.0
"""Places so far apart are different ones, of which the points must tell one."""

MAX_SIGMA_MM = 0.5
"""A seam of a larger 1 sigma across is none: `[follow] extrapolate_sigma_mm` would not send it either."""

MAX_LEFT_OUT, MAX_CHI2 = 0.25, 4.0
"""More of what tells the place off the section, or points off it by twice their noise, show another one."""


class Residuals(NamedTuple):
    """Points' distances (n,) from a section in their sigmas, how these change with its place and turn (n, 3).

    Points beyond its ends are not `within` (n,) it.
    """

    off: Float64
    by_place: Float64
    within: Bool


class Registration(NamedTuple):
    """Place (y, z), mm, and turn, rad, of a section on points, their information, and the points' weights."""

    place: Float64
    information: Float64
    seen: Residuals
    weights: Float64


def fit_free(section: Section, stated: StatedJoint) -> MeasuredJoint | None:
    """Return the joint where a taught section lies, None where the points do not tell."""
    points, corners = section.points, stated.corners_mm
    sigma_px = np.hypot(points[SIGMA_PX], SIGMA_FLOOR_PX / np.sqrt(points[N_LINES]))
    start = shift_of(
        points[Y_MM], points[Z_MM], section.reach_mm, corners, 0.0, SEARCH_STEP_MM, SEARCH_LIMIT_MM
    )
    laid = register(points, sigma_px, corners, start)
    if laid is None:
        return None
    p, information, seen, weights = laid
    chi2 = float(weights @ seen.off**2) / max(float(weights.sum()) - len(p), 1.0)
    # Points count by what they tell across: on a level stretch any section would lie.
    lateral = seen.by_place[:, 0] ** 2 * seen.within
    left_out = float(lateral[weights < LEFT_OUT].sum() / max(lateral.sum(), 1e-12))
    # Errors of neighbours go together: each point counts among the others by a larger sigma than its own.
    common = np.maximum((points[BESIDE_PX] / sigma_px) ** 2, 1.0)
    inverse, weighted = np.linalg.inv(information), seen.by_place * (weights * common)[:, None]
    covariance = inverse @ (weighted.T @ seen.by_place + KNOWN) @ inverse * max(1.0, chi2)
    if math.sqrt(covariance[0, 0]) > MAX_SIGMA_MM or left_out > MAX_LEFT_OUT or chi2 > MAX_CHI2:
        return None
    measured = MeasuredJoint(
        y_mm=float(p[0]),
        z_mm=float(p[1]),
        covariance_mm2=covariance[:2, :2].copy(),
        gap_mm=math.nan,
        mismatch_mm=math.nan,
        chi2=chi2,
        corners_mm=turned(corners, p),
        evidence_nats=place_evidence_nats(section, sigma_px, np.sqrt(common * max(1.0, chi2)), corners, p),
    )
    return as_reported(section, measured)


def register(
    points: Float64, sigma_px: Float64, corners: Float64, start_mm: tuple[float, float]
) -> Registration | None:
    """Lay a section onto points from a place (y, z) on, by Gauss-Newton steps with Tukey's weights.

    None is returned where hardly any points lie within its ends.
    """
    start = np.array([*start_mm, 0.0])
    p, scale = start.copy(), START_SIGMA_MM / float(np.median(np.abs(points[DZ_MM]) * sigma_px))
    for _ in range(MAX_STEPS):
        seen = residuals(points, sigma_px, corners, p)
        if np.count_nonzero(seen.within) < MIN_POINTS:
            return None
        wide = max(1.0, scale, MAD_SIGMA * float(np.median(np.abs(seen.off[seen.within]))))
        weights = seen.within * np.maximum(1.0 - (seen.off / (BISQUARE_WIDTH * wide)) ** 2, 0.0) ** 2
        weighted = seen.by_place * weights[:, None]
        information = weighted.T @ seen.by_place + KNOWN
        step = np.linalg.solve(information, -weighted.T @ seen.off - KNOWN @ (p - start))
        p += step
        if scale < 1.0 and np.abs(step).max() < CONVERGED:
            break
        scale /= 2.0
    return Registration(p, information, seen, weights) if np.isfinite(p).all() else None


def residuals(points: Float64, sigma_px: Float64, corners: Float64, p: Float64) -> Residuals:
    """Return the residuals of points from a section of corners (k, 2) at p: y and z, mm, and a turn, rad."""
    off_y, off_z, turn = points[Y_MM] - p[0], points[Z_MM] - p[1], float(p[2])
    y, z = off_y + turn * off_z, off_z - turn * off_y
    height, slope = section_at(corners, np.ascontiguousarray(y))
    along = points[DZ_MM] - turn * points[DY_MM] - slope * (points[DY_MM] + turn * points[DZ_MM])
    unit_mm = np.maximum(np.abs(along), MIN_ALONG_MM) * sigma_px
    moved = np.column_stack([turn + slope, slope * turn - 1.0, -off_y - slope * off_z])
    within = (y >= corners[1, 0]) & (y <= corners[-2, 0])
    return Residuals((z - height) / unit_mm, moved / unit_mm[:, None], within)


def place_evidence_nats(
    section: Section, sigma_px: Float64, wider: Float64, corners: Float64, p: Float64
) -> float:
    """Return the evidence of a section's place over the best other one within reach, nats.

    Points count by sigmas that are `wider` (n,) by a factor.
    """
    points = section.points
    low, high = max(section.y_mm[0], -section.reach_mm), min(section.y_mm[-1], section.reach_mm)
    others = np.arange(low, high, SEARCH_STEP_MM)
    others = others[np.abs(others - p[0]) >= APART_MM]
    if not len(others):
        return math.inf
    start = best_shift(points[Y_MM], points[Z_MM], corners, others, SEARCH_LIMIT_MM)
    other = register(points, sigma_px, corners, start)
    if other is None:
        return math.inf
    # From a place nearby the points may lead back.
    is_apart = abs(other.place[0] - p[0]) >= 0.5 * APART_MM
    there = other.place if is_apart else np.array([*start, p[2]])
    here_nats, there_nats = (_lost_nats(residuals(points, sigma_px * wider, corners, q)) for q in (p, there))
    return there_nats - here_nats


def _lost_nats(seen: Residuals) -> float:
    """Return Tukey's loss of points, nats; one beyond the section's ends loses what others do on average."""
    kept = np.maximum(1.0 - (seen.off[seen.within] / BISQUARE_WIDTH) ** 2, 0.0) ** 3
    share = float(kept.mean()) if len(kept) else 0.0
    return BISQUARE_WIDTH**2 / 6.0 * len(seen.off) * (1.0 - share)


def turned(corners: Float64, p: Float64) -> Float64:
    """Return a section's corners (k, 2), mm, at its place and turn."""
    y, z = corners.T
    return np.column_stack([p[0] + y - p[2] * z, p[1] + z + p[2] * y])
